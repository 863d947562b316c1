# SPDX-License-Identifier: Apache-2.0
"""Chamfer distance compared with brute force, in both of its forms."""

from __future__ import annotations

import math

import pytest
import torch

from dpm2_core.errors import UsageError
from dpm2_core.tasks.chamfer import chamfer_figures

A = torch.rand(40, 3, generator=torch.Generator().manual_seed(0))
B = torch.rand(55, 3, generator=torch.Generator().manual_seed(1)) + 0.2


def test_is_what_all_distances_give() -> None:
    """All pairs by cdist, in double: equal to the rounding of the float32 input."""
    distance = torch.cdist(A.double(), B.double())
    forth, back = distance.min(1)[0], distance.min(0)[0]
    figures = chamfer_figures(A, B)
    assert figures["chamfer_m"] == pytest.approx(float(forth.mean() + back.mean()) / 2, rel=1e-9)
    assert figures["chamfer"] == pytest.approx(float((forth**2).sum() + (back**2).sum()) / 120**2, rel=1e-9)


def test_is_symmetric_and_zero_for_the_same() -> None:
    """The order of the clouds does not matter."""
    assert chamfer_figures(A, B) == pytest.approx(chamfer_figures(B, A))
    assert chamfer_figures(A, A[torch.randperm(len(A))]) == {"chamfer_m": 0, "chamfer": 0}


def test_a_shift_of_well_separated_points_is_the_distance() -> None:
    """64 points 1 m apart, all moved by 0.1 m: mean 0.1 m, sum of squares of both clouds 1.28 m2."""
    grid = torch.cartesian_prod(*[torch.arange(4.0)] * 3)
    figures = chamfer_figures(grid, grid + torch.tensor([0.1, 0, 0]))
    assert figures == pytest.approx({"chamfer_m": 0.1, "chamfer": 1.28 / 120**2}, rel=1e-5)


def test_clouds_without_a_distance() -> None:
    """An empty cloud has none; a cloud that is not finite is an error."""
    assert all(math.isnan(value) for value in chamfer_figures(torch.empty(0, 3), B).values())
    with pytest.raises(UsageError, match="points that are not finite"):
        chamfer_figures(A, torch.full((2, 3), torch.nan))
