# SPDX-License-Identifier: Apache-2.0
"""Which part of an IMU's forces is gravity, and the errors of the remaining accelerations."""

from __future__ import annotations

import numpy as np
import pytest

from dpm2_core.slam.odometry.vertical import Vertical

UP = np.array([0.0, 0.0, 1.0])
GRAVITY = 9.81 * UP


def driven(
    vertical: Vertical, seconds: float, forces: np.ndarray, acceleration: np.ndarray, speed: float = 0.0
) -> None:
    """Add steps of 0.1 s, in which the scans show the velocities of an acceleration that starts at a forward speed."""
    for i in range(round(10 * seconds)):
        vertical.add(forces, speed * np.array([1.0, 0, 0]) + 0.1 * i * acceleration, 0.1)


@pytest.mark.parametrize("unit", [1.0, 1 / 9.81], ids=["m/s2", "g"])
def test_after_a_start_at_rest_accelerations_are_what_gravity_leaves(unit: float) -> None:
    vertical = Vertical()
    assert vertical.start(unit * GRAVITY, UP)
    found = vertical.accelerations(unit * (GRAVITY + np.array([[2.0, 0, 0], [0, -1.0, 0]])))
    np.testing.assert_allclose(found, [[2.0, 0, 0], [0, -1.0, 0]], atol=1e-6)


@pytest.mark.parametrize("stood", [True, False])
@pytest.mark.parametrize("unit", [1.0, 1 / 9.81], ids=["m/s2", "g"])
def test_a_bump_is_no_other_unit(unit: float, stood: bool) -> None:
    """On a rough road, the mean force of one period may be 0.8 or 1.3 g. The unit is that of all samples before."""
    vertical = Vertical()
    if stood:
        vertical.start(unit * GRAVITY, UP)
    driven(vertical, 15.0, unit * GRAVITY, np.zeros(3))
    for bump in (-9.0, -8.81, -3.0, 0.0, 3.0):
        found = vertical.accelerations(unit * (GRAVITY + bump * UP)[None])
        np.testing.assert_allclose(found, bump * UP[None], atol=1e-6)


def test_they_are_unknown_before_gravity_is_and_where_the_forces_have_none() -> None:
    vertical = Vertical()
    assert vertical.accelerations(GRAVITY[None]) is None
    driven(vertical, 15.0, GRAVITY, np.zeros(3))
    assert vertical.accelerations(GRAVITY[None]) is not None
    without = Vertical()
    assert not without.start(np.zeros(3), UP)
    driven(without, 15.0, np.zeros(3), np.zeros(3))
    assert without.accelerations(np.zeros((1, 3))) is None


def test_scans_that_confirm_them_make_them_surer_and_others_doubtful() -> None:
    brakes = np.array([-1.0, 0.0, 0.0])
    vertical = Vertical()
    vertical.start(GRAVITY, UP)
    vertical.add(GRAVITY, np.zeros(3), 0.1)
    at_first = vertical.sigma
    driven(vertical, 30.0, GRAVITY + brakes, brakes)
    confirmed = vertical.sigma
    assert confirmed < 0.5 * at_first
    driven(vertical, 30.0, GRAVITY - brakes, brakes)
    assert vertical.sigma > 5 * confirmed


@pytest.mark.parametrize(("speed", "force", "stood"), [(0.0, 0.0, True), (0.2, 4.0, True), (10.0, 0.0, False)])
def test_a_start_on_the_way_that_seemed_at_rest_proves_little(speed: float, force: float, stood: bool) -> None:
    """A bend at constant speed looks like a slope. A robot that sets off at once has stood still."""
    vertical = Vertical()
    vertical.start(GRAVITY, UP)
    vertical.add(GRAVITY + np.array([force, 0, 0]), np.array([speed, 0, 0]), 0.1)
    assert (vertical.sigma < 0.5) == stood
