# SPDX-License-Identifier: Apache-2.0
"""Kabsch: exact, and always a rotation, whatever the points are."""

from __future__ import annotations

import numpy as np
import torch

from dpm2_core.geometry import se3
from dpm2_core.geometry.kabsch import weighted_kabsch
from dpm2_core.geometry.se3_torch import transform


def test_kabsch_is_exact_and_batched(noise: np.random.Generator) -> None:
    """Perfect matches give the transform to rounding, whatever the positive weights."""
    T = torch.from_numpy(se3.exp(noise.normal(0, 1, (5, 6)) * [1, 1, 1, 9, 9, 9]))
    source = torch.from_numpy(noise.normal(0, 10, (5, 40, 3)))
    weights = torch.from_numpy(noise.uniform(0.1, 1, (5, 40)))
    torch.testing.assert_close(weighted_kabsch(source, transform(T, source), weights), T, atol=1e-9, rtol=0)


def test_kabsch_never_reflects(noise: np.random.Generator) -> None:
    """Mirrored and flat point sets still give a rotation."""
    source = torch.from_numpy(noise.normal(0, 10, (2, 40, 3)))
    source[1, :, 2] = 0  # coplanar: without the guard the sign of the normal is undetermined
    target = source * torch.tensor([1.0, 1.0, -1.0])
    T = weighted_kabsch(source, target, torch.ones(2, 40))
    torch.testing.assert_close(torch.linalg.det(T[:, :3, :3]), torch.ones(2, dtype=torch.float64))


def test_kabsch_without_weight_is_finite() -> None:
    """All weights zero give some rigid transform, not NaN."""
    zero = torch.zeros(1, 5, 3)
    assert weighted_kabsch(zero, zero, torch.zeros(1, 5)).isfinite().all()
