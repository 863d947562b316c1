# SPDX-License-Identifier: Apache-2.0
"""Which part of an IMU's forces is gravity, and the errors of the remaining accelerations."""

from __future__ import annotations

import numpy as np
import pytest

from dpm2_core.geometry import se3
from dpm2_core.slam.odometry.vertical import Vertical

UP = np.array([0.0, 0.0, 1.0])
AXES = np.eye(3)
GRAVITY = 9.81 * UP


def driven(
    vertical: Vertical, seconds: float, forces: np.ndarray, acceleration: np.ndarray, speed: float = 0.0
) -> None:
    """Add steps of 0.1 s, in which the scans show the velocities of an acceleration that starts at a forward speed."""
    for i in range(round(10 * seconds)):
        vertical.add(AXES, forces, speed * np.array([1.0, 0, 0]) + 0.1 * i * acceleration, 0.1)


@pytest.mark.parametrize("unit", [1.0, 1 / 9.81], ids=["m/s2", "g"])
def test_after_a_start_at_rest_accelerations_are_what_gravity_leaves(unit: float) -> None:
    vertical = Vertical()
    assert vertical.start(AXES, unit * GRAVITY, UP)
    found = vertical.accelerations(AXES, unit * (GRAVITY + np.array([[2.0, 0, 0], [0, -1.0, 0]])))
    np.testing.assert_allclose(found, [[2.0, 0, 0], [0, -1.0, 0]], atol=1e-6)


@pytest.mark.parametrize("stood", [True, False])
@pytest.mark.parametrize("unit", [1.0, 1 / 9.81], ids=["m/s2", "g"])
def test_a_bump_is_no_other_unit(unit: float, stood: bool) -> None:
    """On a rough road, the mean force of one period may be 0.8 or 1.3 g. The unit is that of all samples before."""
    vertical = Vertical()
    if stood:
        vertical.start(AXES, unit * GRAVITY, UP)
    driven(vertical, 15.0, unit * GRAVITY, np.zeros(3))
    for bump in (-9.0, -8.81, -3.0, 0.0, 3.0):
        found = vertical.accelerations(AXES, unit * (GRAVITY + bump * UP)[None])
        np.testing.assert_allclose(found, bump * UP[None], atol=1e-6)


def test_they_are_unknown_before_gravity_is_and_where_the_forces_have_none() -> None:
    vertical = Vertical()
    assert vertical.accelerations(AXES, GRAVITY[None]) is None
    driven(vertical, 15.0, GRAVITY, np.zeros(3))
    assert vertical.accelerations(AXES, GRAVITY[None]) is not None
    without = Vertical()
    assert not without.start(AXES, np.zeros(3), UP)
    driven(without, 15.0, np.zeros(3), np.zeros(3))
    assert without.accelerations(AXES, np.zeros((1, 3))) is None


def test_scans_that_confirm_them_make_them_surer_and_others_doubtful() -> None:
    brakes = np.array([-1.0, 0.0, 0.0])
    vertical = Vertical()
    vertical.start(AXES, GRAVITY, UP)
    vertical.add(AXES, GRAVITY, np.zeros(3), 0.1)
    at_first = vertical.sigma
    driven(vertical, 30.0, GRAVITY + brakes, brakes)
    confirmed = vertical.sigma
    assert confirmed < 0.5 * at_first
    driven(vertical, 10.0, GRAVITY - brakes, brakes)
    assert vertical.sigma > 5 * confirmed


@pytest.mark.parametrize(("speed", "force", "stood"), [(0.0, 0.0, True), (0.2, 4.0, True), (10.0, 0.0, False)])
def test_a_start_on_the_way_that_seemed_at_rest_proves_little(speed: float, force: float, stood: bool) -> None:
    """A bend at constant speed looks like a slope. A robot that sets off at once has stood still."""
    vertical = Vertical()
    vertical.start(AXES, GRAVITY, UP)
    vertical.add(AXES, GRAVITY + np.array([force, 0, 0]), np.array([speed, 0, 0]), 0.1)
    assert (vertical.sigma < 0.5) == stood


def degrees_of(R: np.ndarray) -> float:
    return float(np.degrees(np.linalg.norm(se3.rotation_vector(R))))


def turning(vertical: Vertical, seconds: float, error: np.ndarray, tilt: float = 0.0) -> np.ndarray:
    """Circles of a minute at 5 m/s, with an error of the accelerometer, (3,) m/s2, in a frame that is tilted by `tilt`
    rad. Returns the rotation that the vertical then shows."""
    R_odom_level = se3.rotation(np.array([tilt, 0.0, 0.0]))
    for i in range(round(10 * seconds)):
        R_level_robot = se3.rotation(np.array([0.0, 0.0, 2 * np.pi * i / 600]))
        R = R_odom_level @ R_level_robot
        middle = R_odom_level @ se3.rotation(np.array([0.0, 0.0, 2 * np.pi * (i + 0.5) / 600]))
        centripetal = 5.0 * 2 * np.pi / 60 * R[:, 1]
        force = R.T @ (R_odom_level @ GRAVITY + centripetal) + error
        vertical.add(R, force, middle @ np.array([5.0, 0.0, 0.0]), 0.1)
    return vertical.turn


@pytest.mark.parametrize("seconds", [15, 30, 45, 60, 180])
@pytest.mark.parametrize("stood", [True, False])
def test_an_error_that_rotates_with_the_robot_does_not_tilt_the_frame(seconds: float, stood: bool) -> None:
    """A bias of 0.2 m/s2, as of a cheap IMU or one mounted 1.2 degrees askew, is seen from the other side after half a
    circle: a mean over a minute tilted the frame by up to 2 degrees."""
    vertical, error = Vertical(), np.array([0.2, -0.1, 0.1])
    before = np.eye(3)
    if stood:
        assert vertical.start(AXES, GRAVITY + error, UP)
        before = vertical.turn
    after = turning(vertical, seconds, error)
    assert degrees_of(after @ before.T) < 0.25  # an eighth of it


def test_a_tilt_after_an_unknown_motion_is_found() -> None:
    """3 degrees, of which the part that gravity shows at once is corrected; its error does not count as a tilt."""
    vertical, error = Vertical(), np.array([0.2, -0.1, 0.1])
    turning(vertical, 120, error)
    vertical.break_off()
    turn = turning(vertical, 60, error, tilt=np.radians(3.0))
    np.testing.assert_allclose(np.degrees(se3.rotation_vector(turn)), [-3.0, 0.0, 0.0], atol=0.3)


def test_a_start_that_only_seemed_at_rest_bends_no_drive() -> None:
    """A car that accelerates by 1 m/s2 does not rotate. Its start is tilted by 6 degrees, and stays so: to level it on
    the way would bend the map."""
    vertical = Vertical()
    assert vertical.start(AXES, GRAVITY + np.array([1.0, 0, 0]), UP)
    tilted = vertical.turn
    driven(vertical, 60.0, GRAVITY, np.zeros(3), speed=10.0)
    assert degrees_of(vertical.turn @ tilted.T) < 0.05
