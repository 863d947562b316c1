# SPDX-License-Identifier: Apache-2.0
"""The compiled solver for inference compared with the one in torch, which has gradients."""

from __future__ import annotations

import numpy as np
import torch

from dpm2_core.geometry import se3
from dpm2_core.geometry.se3_torch import transform
from dpm2_core.network.gauss_newton import solve_pose, weighted_gauss_newton, whitened_residuals
from dpm2_core.network.matching import Correspondences

PAIRS = 120


def noisy(noise: np.random.Generator) -> tuple[Correspondences, torch.Tensor]:
    """One set of pairs of which a fifth is wrong, and a start 1 m and 0.2 rad off."""
    T = torch.from_numpy(se3.exp(noise.normal(0, 1, (1, 6)) * [0.3, 0.3, 2, 5, 5, 1]))
    source = torch.from_numpy(noise.normal(0, 15, (1, PAIRS, 3)))
    target = transform(T, source) + 0.2 * torch.from_numpy(noise.normal(0, 1, (1, PAIRS, 3)))
    target[:, ::5] += 10 * torch.from_numpy(noise.normal(0, 1, target[:, ::5].shape))
    L = torch.from_numpy(noise.normal(0, 1, (1, PAIRS, 3, 3))).tril()
    L.diagonal(dim1=-2, dim2=-1).abs_().add_(0.5)
    weight = torch.from_numpy(noise.uniform(0, 1, (1, PAIRS)))
    return Correspondences(source, target, weight, L), T @ torch.from_numpy(se3.exp([0, 0.1, 0.2, 1, -0.5, 0]))


def test_equals_the_solve_in_torch_to_rounding(noise: np.random.Generator) -> None:
    """Both use double precision, so only the order of sums differs; 8 steps and the conditioning amplify the
    difference."""
    for _ in range(20):
        pairs, start = noisy(noise)
        T, information = weighted_gauss_newton(start, pairs)
        squared = whitened_residuals(T, pairs)[0].square().sum(-1)
        pose = start[0].numpy().copy()
        found, residuals = solve_pose(pose, *(field[0].contiguous().numpy() for field in pairs))
        np.testing.assert_allclose(pose, T[0].numpy(), atol=1e-9)
        np.testing.assert_allclose(found, information[0].numpy(), rtol=1e-8, atol=1e-6)
        np.testing.assert_allclose(residuals, squared[0].numpy(), rtol=1e-7, atol=1e-7)


def test_without_weight_the_pose_stays_and_of_nothing_finite_comes_nothing_finite(noise: np.random.Generator) -> None:
    pairs, start = noisy(noise)
    arrays = [field[0].contiguous().numpy() for field in pairs]
    pose = start[0].numpy().copy()
    solve_pose(pose, arrays[0], arrays[1], np.zeros(PAIRS), arrays[3])
    np.testing.assert_allclose(pose, start[0].numpy(), atol=1e-12)
    solve_pose(pose, arrays[0], np.full((PAIRS, 3), np.nan), arrays[2], arrays[3])
    assert not np.isfinite(pose).all()
