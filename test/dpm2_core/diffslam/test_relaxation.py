# SPDX-License-Identifier: Apache-2.0
"""Relaxation of a ring with a loop: consistent measurements are met, gradients agree, errors name the problem."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch import Tensor

from dpm2_core.diffslam.relaxation import relax
from dpm2_core.diffslam.soft_lm import SoftLmSettings
from dpm2_core.errors import UsageError
from dpm2_core.geometry import se3, se3_torch

N = 8
EDGES = torch.tensor([*((i, i + 1) for i in range(N - 1)), (0, N - 1), (2, 6)])


@pytest.fixture
def ring() -> Tensor:
    """(N, 4, 4) poses around a circle of 10 m, of different heights."""
    angle = 2 * np.pi * np.arange(N) / N
    R = se3.exp(np.column_stack([0.05 * np.sin(angle), 0.02 * angle, angle, np.zeros((N, 3))]))[:, :3, :3]
    return torch.from_numpy(se3.make(R, np.column_stack([10 * np.sin(angle), 10 - 10 * np.cos(angle), 0.1 * angle])))


def relative(poses: Tensor, edges: Tensor = EDGES) -> Tensor:
    return se3_torch.inverse(poses[edges[:, 0]]) @ poses[edges[:, 1]]


def moved(T: Tensor, scale: float, seed: int = 0) -> Tensor:
    xi = torch.randn(len(T), 6, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    return T @ se3_torch.exp(scale * xi)


def test_consistent_measurements_are_met(ring: Tensor) -> None:
    """From poses 20 cm and 11 degrees off, the ring is restored; its first pose never moves."""
    begin = torch.cat([ring[:1], moved(ring[1:], 0.2)])
    found = relax(begin, EDGES, relative(ring), settings=SoftLmSettings(iterations=15))
    torch.testing.assert_close(found, ring, atol=1e-6, rtol=0)
    torch.testing.assert_close(found[0], begin[0], atol=0, rtol=0)


def test_a_loop_pulls_drift_together(ring: Tensor) -> None:
    """Odometry that rotates a degree too far at each step, and two correct loops: the end moves closer to the truth."""
    turn = torch.from_numpy(se3.exp(np.array([0, 0, np.deg2rad(1), 0, 0, 0])))
    measured = relative(ring)
    measured[: N - 1] = measured[: N - 1] @ turn
    chained = [ring[0]]
    for step in measured[: N - 1]:
        chained.append(chained[-1] @ step)
    begin = torch.stack(chained)
    found = relax(begin, EDGES, measured)
    before = float((begin - ring)[:, :3, 3].norm(dim=-1).mean())
    assert float((found - ring)[:, :3, 3].norm(dim=-1).mean()) < 0.6 * before
    assert float((found[-1] - ring[-1])[:3, 3].norm()) < 0.5 * float((begin[-1] - ring[-1])[:3, 3].norm())


def test_weights_decide_between_loops(ring: Tensor) -> None:
    """A wrong loop of weight zero has no effect."""
    wrong = relative(ring)
    wrong[-1, 1, 3] += 5.0
    weights = torch.ones(len(EDGES)).double()
    weights[-1] = 0.0
    found = relax(ring, EDGES, wrong, weights)
    torch.testing.assert_close(found, ring, atol=1e-9, rtol=0)
    assert float((relax(ring, EDGES, wrong) - ring)[:, :3, 3].abs().max()) > 0.3


@pytest.mark.slow
def test_gradients_agree_with_finite_differences_and_each_other(ring: Tensor) -> None:
    """For every third pose, by measurements (as tangents) and weights; they are inconsistent: residuals are not
    zero."""
    measured = moved(relative(ring), 0.05)
    xi = torch.zeros(len(EDGES), 6, dtype=torch.float64, requires_grad=True)
    weights = torch.full((len(EDGES),), 0.7, dtype=torch.float64, requires_grad=True)

    def solved(xi: Tensor, weights: Tensor, gradient: str = "unrolled", iterations: int = 3) -> Tensor:
        settings = SoftLmSettings(iterations=iterations, gradient=gradient)
        return relax(ring, EDGES, measured @ se3_torch.exp(xi), weights, 25.0, settings)[1:, :3]

    assert torch.autograd.gradcheck(lambda *by: solved(*by)[::3], (xi, weights), atol=1e-6, fast_mode=True)
    slopes = []
    for gradient in ("unrolled", "implicit"):
        value = solved(xi, weights, gradient, 25).pow(2).sum()
        slopes.append(torch.cat([g.flatten() for g in torch.autograd.grad(value, (xi, weights))]))
    assert float((slopes[0] - slopes[1]).norm() / slopes[0].norm()) < 0.01


def test_unusable_graphs_are_rejected(ring: Tensor) -> None:
    """An edge to a pose that does not exist, or fewer measurements than edges."""
    with pytest.raises(UsageError, match="pose 9 of 8"):
        relax(ring, torch.tensor([[0, 9]]), relative(ring)[:1])
    with pytest.raises(UsageError, match="for 3 measured"):
        relax(ring, EDGES, relative(ring)[:3])
    with pytest.raises(UsageError, match="weights"):
        relax(ring, EDGES, relative(ring), torch.ones(2))


def test_poses_without_edges_stay(ring: Tensor) -> None:
    """Poses without measurements keep their finite values."""
    found = relax(ring, EDGES[:2], relative(ring)[:2])
    torch.testing.assert_close(found, ring, atol=1e-9, rtol=0)
    torch.testing.assert_close(relax(ring, EDGES[:0], relative(ring)[:0]), ring)
