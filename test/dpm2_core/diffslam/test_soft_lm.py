# SPDX-License-Identifier: Apache-2.0
"""The two soft rules: their limits, their direction, and how the printed rule differs."""

from __future__ import annotations

import pytest
import torch

from dpm2_core.config import settings_from
from dpm2_core.diffslam.soft_lm import SoftLmSettings, error_change, next_damping, step_gate
from dpm2_core.errors import UsageError

CHANGE = torch.linspace(-30, 30, 241).double()


def test_damping_rises_with_the_error_between_its_limits() -> None:
    """Eq. 4: lambda_min for a step that helps, lambda_max for one that does not, and monotonic in between."""
    settings = SoftLmSettings(lambda_min=0.5, lambda_max=2.0, steepness=1.0)
    damping = next_damping(CHANGE, settings)
    assert bool((damping.diff() > 0).all())
    assert float(damping[0]) == pytest.approx(0.5, abs=1e-9)
    assert float(damping[-1]) == pytest.approx(2.0, abs=1e-9)
    assert float(next_damping(torch.zeros(1).double(), settings)) == pytest.approx(1.25)  # D = 1: half-way


def test_gate_falls_with_the_error_and_the_printed_one_rises() -> None:
    """This is the sign of eq. 5: the gate must be larger for an improving step."""
    soft = step_gate(CHANGE, SoftLmSettings())
    assert bool((soft.diff() < 0).all())
    assert float(soft[0]) > 0.999
    assert float(soft[-1]) < 1e-9
    paper = step_gate(CHANGE, SoftLmSettings(gate="paper"))
    assert bool((paper.diff() > 0).all())
    assert float(paper[0]) < 1e-9
    gradslam = step_gate(CHANGE, SoftLmSettings(gate="gradslam"))
    assert bool((gradslam.diff() > 0).all())
    assert float(gradslam[0]) > 0.7  # exp(-70 / 200) is its minimum
    assert float(step_gate(CHANGE, SoftLmSettings(gate="none")).min()) == 1.0


def test_gate_and_damping_keep_a_gradient_where_they_saturate() -> None:
    """They do up to the clamp: an error that vanishes, and one that grows sixfold."""
    before = torch.tensor([1e-2, 1.0], dtype=torch.float64, requires_grad=True)
    change = error_change(before, torch.tensor([6e-2, 1e-4]).double(), torch.ones(2).double(), SoftLmSettings())
    value = step_gate(change, SoftLmSettings()).sum() + next_damping(change, SoftLmSettings()).sum()
    (slope,) = torch.autograd.grad(value, before)
    assert bool(slope.isfinite().all())
    assert bool((slope != 0).all())


def test_change_depends_on_neither_scale_nor_number_of_points() -> None:
    """The relative change does not; the printed difference of sums grows with both."""
    before, after, many = torch.tensor([0.04, 4.0]), torch.tensor([0.02, 2.0]), torch.tensor([100.0, 2000.0])
    relative = error_change(before, after, many, SoftLmSettings())
    torch.testing.assert_close(relative, torch.full((2,), -5.0), atol=1e-4, rtol=0)
    printed = error_change(before, after, many, SoftLmSettings(gate="paper"))
    torch.testing.assert_close(printed, torch.tensor([-2.0, -70.0]))  # the latter at the clamp of gradslam


def test_perfect_fit_is_no_division_by_zero() -> None:
    """No error before and after: no change, and a finite slope."""
    zero = torch.zeros(1, dtype=torch.float64, requires_grad=True)
    change = error_change(zero, torch.zeros(1).double(), torch.ones(1).double(), SoftLmSettings())
    (slope,) = torch.autograd.grad(change, zero)
    assert float(change.detach()) == 0.0
    assert bool(slope.isfinite().all())


@pytest.mark.parametrize("bad", [{"iterations": 0}, {"lambda_min": 0.0}, {"gate": "hard"}, {"gradient": "none"}])
def test_settings_that_cannot_be_are_rejected(bad: dict[str, object]) -> None:
    """The error names the setting."""
    with pytest.raises(UsageError, match=next(iter(bad))):
        settings_from(SoftLmSettings, bad)
