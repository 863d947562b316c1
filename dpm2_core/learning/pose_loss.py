# SPDX-License-Identifier: Apache-2.0
"""Differentiable error of the pose that the network estimates; losses on descriptors and offsets do not measure it.

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
"""A registration that is wrong by more than this, m, has no gradient that leads back. The steps then start at the
truth: the loss is how far its pairs pull the pose away from there, and it counts less with distance."""
FINE = 0.05
"""Errors well above this, m, count linearly and not squared, so that the tail does not dominate the step."""


def differentiable_poses(
    decoder: Decoder, source: Tokens, target: Tokens, correlated: Correlated, truth: Tensor
) -> tuple[Tensor, Tensor]:
    """Poses (B, 4, 4) T_target_source float64 with gradients, and which of them (B,) the network found itself.

    Matches, offsets and their precisions have a gradient. The pose gets it through the last steps of its least squares,
    which start at the solution, as by the implicit function theorem. This avoids the gradient of a decomposition, which
    is infinite where singular values coincide.

    Args:
        truth: (B, 4, 4) float64; where the network is `DIVERGED`, the steps start there.
    """
    with torch.no_grad():
        solved = solve_batch(decoder, source, target, correlated)
    if solved is None:
        return truth, torch.zeros(len(truth), dtype=torch.bool, device=truth.device)
    error = (solved.T[:, :3, 3] - truth[:, :3, 3]).norm(dim=-1)
    found = error < DIVERGED  # False for NaN
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
