# SPDX-License-Identifier: Apache-2.0
"""Chamfer distance against brute force, in each of its forms."""

from __future__ import annotations

from typing import Literal

import pytest
import torch

from dpm2_core.errors import UsageError
from dpm2_core.tasks.chamfer import chamfer_distance

A = torch.rand(40, 3, generator=torch.Generator().manual_seed(0))
B = torch.rand(55, 3, generator=torch.Generator().manual_seed(1)) + 0.2


@pytest.mark.parametrize("squared", [False, True])
@pytest.mark.parametrize("reduction", ["mean", "sum"])
def test_is_what_all_distances_give(squared: bool, reduction: Literal["mean", "sum"]) -> None:
    """All pairs by cdist, in double: equal to rounding of the float32 input."""
    distance = torch.cdist(A.double(), B.double()) ** (2 if squared else 1)
    forth, back = distance.min(1)[0], distance.min(0)[0]
    requested = forth.sum() + back.sum() if reduction == "sum" else (forth.mean() + back.mean()) / 2
    assert chamfer_distance(A, B, squared, reduction) == pytest.approx(float(requested), rel=1e-9)


def test_is_symmetric_and_zero_for_the_same() -> None:
    """Whichever comes first."""
    assert chamfer_distance(A, B) == pytest.approx(chamfer_distance(B, A))
    assert chamfer_distance(A, A[torch.randperm(len(A))]) == 0


def test_a_shift_of_well_separated_points_is_the_distance() -> None:
    """Points 1 m apart, all moved by 0.1 m: mean 0.1 m, mean of squares 0.01 m2."""
    grid = torch.cartesian_prod(*[torch.arange(4.0)] * 3)
    assert chamfer_distance(grid, grid + torch.tensor([0.1, 0, 0])) == pytest.approx(0.1, rel=1e-5)
    assert chamfer_distance(grid, grid + torch.tensor([0.1, 0, 0]), squared=True) == pytest.approx(0.01, rel=1e-5)


def test_clouds_that_cannot_be_are_rejected() -> None:
    """Empty, of the wrong shape, not finite: the message says which."""
    with pytest.raises(UsageError, match="first cloud has shape"):
        chamfer_distance(torch.empty(0, 3), B)
    with pytest.raises(UsageError, match="second cloud has shape"):
        chamfer_distance(A, torch.zeros(5, 4))
    with pytest.raises(UsageError, match="second cloud has points that are not finite"):
        chamfer_distance(A, torch.full((2, 3), torch.nan))
