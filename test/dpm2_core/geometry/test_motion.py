# SPDX-License-Identifier: Apache-2.0
"""Constant velocity: predictions compose, and their uncertainty grows with time up to what a vehicle can do. If a stamp
is doubtful, the distance traveled shows how long the period was."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dpm2_core.frame import Array
from dpm2_core.geometry import se3
from dpm2_core.geometry.motion import between, combined, covariance, period_by_motion, predicted, turned_open

TWIST = np.array([0.01, -0.02, 0.3, 15.0, 0.2, -0.1])
OF_VELOCITY = np.diag([0.2, 0.2, 0.2]) ** 2


@given(st.floats(0, 5), st.floats(0, 5))
def test_two_predictions_in_turn_are_one(a: float, b: float) -> None:
    T = se3.exp([0.1, 0.2, 0.3, 1, 2, 3])
    np.testing.assert_allclose(predicted(predicted(T, TWIST, a), TWIST, b), predicted(T, TWIST, a + b), atol=1e-9)


def test_no_motion_is_predicted_farther_than_ten_seconds() -> None:
    np.testing.assert_array_equal(predicted(np.eye(4), TWIST, 60.0), predicted(np.eye(4), TWIST, 10.0))


def test_an_even_change_of_the_motion_covers_its_mean() -> None:
    """Straight ahead, braking from 10 to 4 m/s. If both motions are equal, it is this motion."""
    before, after = np.array([0, 0, 0, 10.0, 0, 0]), np.array([0, 0, 0, 4.0, 0, 0])
    np.testing.assert_allclose(between(np.eye(4), before, after, 3.0)[:3, 3], [21, 0, 0], atol=1e-9)
    np.testing.assert_allclose(between(np.eye(4), TWIST, TWIST, 3.0), predicted(np.eye(4), TWIST, 3.0), atol=1e-9)


@given(st.floats(-1.0, 1.0), st.floats(0.1, 10.0))
def test_an_even_turn_that_was_measured_is_one_motion(rate: float, seconds: float) -> None:
    """Except that each of ten parts of the time is assumed to be straight: for n parts of a rotation by an angle a, the
    midpoint rule has an error of (a / n)^2 / 24 of the distance."""
    twist = np.array([0, 0, rate, 8.0, 0, 0])
    at = np.append((np.arange(10) + 0.5) / 10, 1.0) * seconds
    T = predicted(np.eye(4), twist, seconds, se3.exp(at[:, None] * twist)[:, :3, :3])
    expected = predicted(np.eye(4), twist, seconds)
    np.testing.assert_allclose(T[:3, :3], expected[:3, :3], atol=1e-9)
    fraction = 1.1 * (rate * seconds / 10) ** 2 / 24
    assert np.linalg.norm(T[:3, 3] - expected[:3, 3]) <= fraction * 8.0 * seconds + 1e-9


def test_a_turn_that_came_late_leads_less_far_aside() -> None:
    """From 10 to 5 m/s in two seconds: ahead in the first, sideways in the second."""
    turns = np.stack([np.eye(3)] * 5 + [se3.rotation(np.array([0, 0, np.pi / 2]))] * 6)
    before, after = np.array([0, 0, 0, 10.0, 0, 0]), np.array([0, 0, 0, 5.0, 0, 0])
    T = between(np.eye(4), before, after, 2.0, turns)
    np.testing.assert_allclose(T[:3, 3], [8.75, 6.25, 0], atol=1e-9)


@given(st.floats(0, 40), st.floats(0.01, 60), st.floats(0.01, 60))
def test_uncertainty_grows_with_time(speed: float, a: float, b: float) -> None:
    early, late = (np.diag(covariance(speed, t, 10.0, OF_VELOCITY)) for t in sorted((a, b)))
    assert (late >= early).all()
    assert se3.is_covariance(covariance(speed, a, 10.0, OF_VELOCITY))


def test_a_heading_of_which_nothing_is_known_is_uniform() -> None:
    """The standard deviation of a uniform angle is pi over the root of 3."""
    assert np.sqrt(covariance(10.0, 60.0, 10.0, OF_VELOCITY)[2, 2]) == pytest.approx(np.pi / np.sqrt(3))


def test_a_pause_of_more_than_an_hour_is_one_of_an_hour() -> None:
    """A map rejects a keyframe whose position is less certain than 1000 km. Previously, after three days none was
    accepted."""
    hour = covariance(10.0, 3600.0, 10.0, OF_VELOCITY)
    np.testing.assert_array_equal(covariance(10.0, 1e9, 10.0, OF_VELOCITY), hour)


def test_what_swings_is_uncertain_about_every_axis() -> None:
    """With 0.5 rad/s for 0.2 s, it is more uncertain than the heading of a car, but never more than an arbitrary
    rotation."""
    sigma = np.sqrt(np.diag(covariance(1.0, 0.2, 10.0, OF_VELOCITY, turn=0.5)))
    assert (sigma[:3] >= 0.1).all()
    assert (sigma[:3] < 0.12).all()
    assert covariance(1.0, 60.0, 10.0, OF_VELOCITY, turn=0.5)[0, 0] < 2 * np.pi**2 / 3


def test_an_unknown_velocity_makes_the_prediction_uncertain_along_it() -> None:
    """10 m/s along x for 3 s: 30 m, and what the vehicle may have done since."""
    sigma = np.sqrt(np.diag(covariance(0.0, 3.0, 1.0, np.diag([10.0, 0, 0]) ** 2)))
    assert sigma[3] == pytest.approx(np.hypot(30, sigma[4]))
    assert sigma[4] < 5


@given(st.floats(0.01, 5), st.floats(0.01, 0.3), st.floats(-3, 3))
def test_a_direction_that_the_scene_leaves_open_keeps_the_uncertainty_of_the_prediction(
    predicted_sigma: float, seen_sigma: float, heading: float
) -> None:
    """Scene: `seen_sigma` across, 1 m along, which is uninformative. The prediction is the same in both directions."""
    R = se3.exp([0, 0, heading, 0, 0, 0])[:3, :3]
    of_scene = R @ np.diag([1.0, seen_sigma**2, seen_sigma**2]) @ R.T
    result = R.T @ combined(of_scene, predicted_sigma**2 * np.eye(3)) @ R
    assert result[0, 0] == pytest.approx(predicted_sigma**2)
    assert result[1, 1] <= min(predicted_sigma**2, seen_sigma**2 / (1 - seen_sigma**2)) * (1 + 1e-9)


def test_scenes_whose_open_directions_differ_a_little_do_not_show_the_way_along_them() -> None:
    """As for a road that is visible for 10 m, starting with a velocity sigma of 15 m/s. In 12 scans the open direction
    is up to 25 degrees to either side; across it the translation is stated to 0.03 m, vertically to 2 mm. Previously,
    the velocity sigma along the road fell to 1.9 m/s."""
    of_velocity = 15.0**2 * np.eye(3)
    for heading in np.radians([25, -10, 15, -25, 5, 20, -15, 25, 0, -20, 10, -5]):
        R = se3.exp([0, 0, heading, 0, 0, 0])[:3, :3]
        of_scene = R @ np.diag([1.0, 0.03, 0.002]) ** 2 @ R.T
        of_prediction = of_velocity * 0.1**2 + 0.1**2 * np.eye(3)
        of_velocity = combined(turned_open(of_scene, of_prediction), of_prediction) / 0.1**2
    assert np.sqrt(of_velocity[0, 0]) > 10
    assert np.sqrt(of_velocity[2, 2]) < 0.5


@given(st.floats(0.01, 5), st.floats(0.01, 0.3))
def test_a_scene_that_leaves_nothing_open_is_as_certain_as_it_states(predicted_sigma: float, seen_sigma: float) -> None:
    of_scene = np.diag([seen_sigma, 0.3, 0.01]) ** 2
    assert (turned_open(of_scene, predicted_sigma**2 * np.eye(3)) == of_scene).all()


def test_across_a_tunnel_the_way_stays_known() -> None:
    """With walls on all sides, the open direction is known to 2 degrees: 3 cm across for an unknown step of 1 m."""
    of_scene = np.diag([1.0, 0.01, 0.01]) ** 2
    turned = turned_open(of_scene, np.diag([1.0, 0.1, 0.1]) ** 2)
    np.testing.assert_allclose(np.sqrt(np.diag(turned)), [1.0, 0.03, 0.03], atol=0.005)


def moved(speed: float, seconds: float) -> Array:
    """Pose (4, 4) after this time, in a slight curve."""
    return se3.exp(seconds * np.array([0, 0, 0.1, speed, 0, 0]))


def found(speed: float, stamped: float, true: float, usual: float = 0.1) -> float:
    """Period that is estimated for a frame that arrived after `true` s."""
    ends = [(seconds, moved(speed, seconds)) for seconds in (stamped, usual)]
    return period_by_motion(moved(speed, true), ends[0], ends[1], 10.0)


@given(st.floats(5, 40), st.floats(0.3, 1))
def test_at_a_steady_speed_the_way_is_the_time(speed: float, share: float) -> None:
    """A frame that was delayed by 0.2 s, part of which are lost frames, and a frame of a burst."""
    true = 0.1 + 0.2 * (1 - share)
    assert found(speed, 0.3, true) == pytest.approx(true, abs=0.01 + 0.5 / speed)  # an acceleration may explain this
    assert found(speed, 0.01, 0.1) == pytest.approx(0.1, abs=1e-3)


@given(st.floats(-40, 40), st.floats(-8, 8), st.sampled_from([0.01, 0.05, 0.2, 0.3, 0.6]))
def test_an_acceleration_of_a_vehicle_leaves_the_stamp(speed: float, acceleration: float, dt: float) -> None:
    """For lost frames, and for a stream that has become faster: braking and accelerating are no delay."""
    T = moved(speed, dt)
    T[0, 3] += 0.5 * acceleration * dt * dt
    ends = [(seconds, moved(speed, seconds)) for seconds in (dt, 0.1)]
    assert period_by_motion(T, ends[0], ends[1], 10.0) == dt


def test_at_a_halt_the_stamp_is_believed() -> None:
    """Otherwise, a stream that changes its rate meanwhile would have the speed of another rate from then on."""
    assert found(0.0, 0.05, 0.1) == 0.05
    assert found(0.3, 0.05, 0.1) == 0.05


def test_a_way_beyond_both_is_one_of_them() -> None:
    """Whatever the pose, the period is one that the stamp or the stream allows."""
    assert found(20.0, 0.3, 0.01) == pytest.approx(0.1)
    assert found(20.0, 0.3, 0.9) == pytest.approx(0.3)
