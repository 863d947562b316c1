# SPDX-License-Identifier: Apache-2.0
"""The error of the pose that the network finds, with a gradient: what losses on descriptors and offsets never see.

Beyond the paper, whose registration training stops at the matches. It is eq. 3 of "Differentiable SLAM Helps Deep
Learning-based LiDAR Perception Tasks" for single pairs.
"""

from __future__ import annotations

import torch
from torch import Tensor

from dpm2_core.diffslam.trajectory_loss import squared_errors
from dpm2_core.network.decoder import Correlated, Decoder
from dpm2_core.network.gauss_newton import weighted_gauss_newton
from dpm2_core.network.matching import correspond, guided_scores, match_scores
from dpm2_core.network.pose_solver import solve_batch
from dpm2_core.network.tokens import Tokens

DIVERGED = 1.0
"""A registration that is wrong by more than this has no gradient that leads back, m: what counts then is what pulls
its pairs away from the truth, and the less the farther."""
FINE = 0.05
"""Errors well above this count as they are, not squared: the tail does not rule the step, m."""


def differentiable_poses(
    decoder: Decoder, source: Tokens, target: Tokens, correlated: Correlated, truth: Tensor
) -> tuple[Tensor, Tensor]:
    """Poses (B, 4, 4) T_target_source float64 with gradients, and which of them (B,) the network found itself.

    Matches, offsets and their precisions have a gradient; the pose has it through the last steps of its least squares,
    which start at the solution: as the implicit function theorem gives it, and without that of a decomposition, which
    is infinite where singular values meet.

    Args:
        truth: (B, 4, 4) float64; where the network is `DIVERGED`, the steps start there.
    """
    with torch.no_grad():
        solved = solve_batch(decoder, source, target, correlated)
    if solved is None:
        return truth, torch.zeros(len(truth), dtype=torch.bool, device=truth.device)
    off = (solved.T[:, :3, 3] - truth[:, :3, 3]).norm(dim=-1)
    found = off < DIVERGED  # False for NaN
    start = torch.where(found[:, None, None], solved.T, truth)
    scores = guided_scores(match_scores(decoder, correlated), start, source, target)
    T, _ = weighted_gauss_newton(start, correspond(decoder, source, target, correlated, scores), rounds=2)
    finite = T.detach().flatten(1).isfinite().all(1)
    return torch.where(finite[:, None, None], T, truth), found & finite


def pose_loss(T: Tensor, truth: Tensor) -> Tensor:
    """Mean over poses (B, 4, 4) of their errors, m: of d / (1 + d / DIVERGED), which never exceeds `DIVERGED`, with
    d = sqrt(squared_errors + FINE^2) - FINE."""
    distance = (squared_errors(T, truth) + FINE**2).sqrt() - FINE
    return (distance / (1 + distance / DIVERGED)).mean()
