# SPDX-License-Identifier: Apache-2.0
"""Angular rates are integrated to rotations: exact for a constant rate, to second order for others, none if samples are
missing."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from dpm2_core.frame import Array
from dpm2_core.geometry import se3
from dpm2_core.geometry.deskew import deskew
from dpm2_core.geometry.turning import leveled, turned

vectors = st.lists(st.floats(-3, 3), min_size=3, max_size=3).map(np.array)
SECONDS = np.arange(-0.2, 0.3, 0.01)


def axes(t: Array) -> Rotation:
    """Axes of a robot that swings and shakes at up to 110 deg/s."""
    return Rotation.from_euler("ZYX", np.stack([0.6 * np.sin(3 * t), 0.1 * np.sin(5 * t), 0.05 * np.cos(4 * t)], -1))


def rates(t: Array, h: float = 1e-5) -> Array:
    if not len(t):
        return np.zeros((0, 3))  # scipy before 1.15 does not support empty rotations
    return np.asarray((axes(t - h).inv() * axes(t + h)).as_rotvec() / (2 * h))


def worst(R: Array, expected: Rotation) -> float:
    """Largest error, degrees."""
    return float(np.degrees((Rotation.from_matrix(R).inv() * expected).magnitude().max()))


@given(vectors, st.lists(st.floats(-0.1, 0.1), min_size=1, max_size=5))
def test_a_steady_turn_is_an_exponential(rate: Array, at: list[float]) -> None:
    R = turned(SECONDS, np.tile(rate, (len(SECONDS), 1)), at)
    assert R is not None
    np.testing.assert_allclose(R, se3.exp(np.c_[np.outer(at, rate), np.zeros((len(at), 3))])[:, :3, :3], atol=1e-9)


@given(st.floats(-0.1, 0.1), st.floats(-0.1, 0.1))
def test_two_turns_in_a_row_are_one(a: float, b: float) -> None:
    """From b to a and from a to 0, whatever lies between the samples."""
    to_zero = turned(SECONDS, rates(SECONDS), [a, b])
    to_a = turned(SECONDS - a, rates(SECONDS), [b - a])
    np.testing.assert_allclose(to_zero[0] @ to_a[0], to_zero[1], atol=1e-9)


def test_the_error_falls_with_the_square_of_the_rate_of_samples() -> None:
    at, errors = np.linspace(-0.1, 0.1, 9), []
    for hz in (50, 100, 200):
        seconds = np.arange(-0.2, 0.3, 1 / hz)
        R = turned(seconds, rates(seconds), at)
        assert R is not None
        errors.append(worst(R, axes(np.zeros(1)).inv() * axes(at)))
    assert errors[1] < 2e-3  # degrees, at 100 Hz
    assert errors[0] / errors[1] == pytest.approx(4, rel=0.1)
    assert errors[1] / errors[2] == pytest.approx(4, rel=0.1)


@pytest.mark.parametrize(
    ("seconds", "known"),
    [
        (SECONDS, True),
        (np.zeros(0), False),
        (np.array([0.0]), False),  # the sweep begins 0.1 s before it
        (SECONDS[SECONDS > -0.06], True),  # 40 ms late: the first rate is used
        (SECONDS[SECONDS > -0.04], False),
        (SECONDS[SECONDS < 0.06], True),
        (SECONDS[SECONDS < 0.0], False),
        (SECONDS[(SECONDS < -0.035) | (SECONDS > 0.035)], True),
        (SECONDS[(SECONDS < -0.06) | (SECONDS > 0.06)], False),
        (SECONDS[(SECONDS < -0.17) | (SECONDS > -0.06)], True),  # samples are missing for a while, and return in time
        (SECONDS[(SECONDS < 0.06) | (SECONDS > 0.17)], True),
    ],
    ids=[
        "all",
        "none",
        "one",
        "begins late",
        "too late",
        "ends early",
        "too early",
        "a gap",
        "too long a gap",
        "back in time",
        "gone for a while",
    ],
)
def test_what_the_samples_do_not_tell_is_not_made_up(seconds: Array, known: bool) -> None:
    R = turned(seconds, rates(seconds), [-0.1, 0.1])
    assert (R is not None) == known
    if R is not None:
        assert worst(R, axes(np.zeros(1)).inv() * axes(np.array([-0.1, 0.1]))) < 1.0


@pytest.mark.parametrize("last", [0.4, 0.33], ids=["at the end", "most of a period before"])
@pytest.mark.parametrize("period", [0.1, 0.1036])
def test_ten_samples_a_second_are_enough_though_they_come_unevenly(period: float, last: float) -> None:
    """As in bags of kitti2bag, 0.1036 s apart. Previously, they gave no rotation at all. Missing samples are still not
    invented."""
    uneven = np.random.default_rng(0).uniform(-0.005, 0.005, 20)
    seconds, at = last + period * np.arange(-19, 1) + np.append(uneven[:-1], 0.0), np.array([0.0, 0.2, 0.4])
    R = turned(seconds, rates(seconds), at)
    assert R is not None
    assert worst(R, axes(np.zeros(1)).inv() * axes(at)) < 2.0  # 0.1 s at 5 rad/s2 are 1.5 degrees
    for some in (seconds[np.arange(20) != 17], seconds[1::2]):
        assert turned(some, rates(some), at) is None


@given(vectors.filter(lambda v: np.linalg.norm(v) > 0.1), vectors.filter(lambda v: np.linalg.norm(v) > 0.1))
def test_leveling_is_the_smallest_turn_there(up: Array, axis: Array) -> None:
    R, u, z = leveled(up, axis), up / np.linalg.norm(up), axis / np.linalg.norm(axis)
    np.testing.assert_allclose(R @ u, z, atol=1e-9)
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-9)
    angle = np.arctan2(np.linalg.norm(np.cross(u, z)), u @ z)
    assert Rotation.from_matrix(R).magnitude() == pytest.approx(angle, abs=1e-6)


def test_a_sensor_that_hangs_upside_down_is_turned_round() -> None:
    R = leveled([0, 0, -9.8])
    np.testing.assert_allclose(R @ [0, 0, -1], [0, 0, 1], atol=1e-12)
    assert np.linalg.det(R) == pytest.approx(1)


@pytest.mark.parametrize("stamp", [0.0, 0.05, 0.1], ids=["at the end", "in the middle", "at the start"])
def test_a_wall_seen_in_a_swing_is_straight_again(stamp: float) -> None:
    """Each point is in the frame of its own time; corrected with 100 Hz samples instead of a constant twist."""
    rng, time = np.random.default_rng(0), np.linspace(stamp - 0.1, stamp, 2000)
    velocity, at_stamp = np.array([1.5, 0.2, 0.0]), rng.uniform(-20, 20, (2000, 3))
    fine = np.arange(-0.15, 0.15, 1e-4)
    R = axes(np.zeros(1)).inv() * axes(fine)
    way = np.cumsum(R.apply(velocity), 0) * 1e-4
    way = np.stack([np.interp(time, fine, way[:, i]) - np.interp(0, fine, way[:, i]) for i in range(3)], -1)
    now = axes(np.zeros(1)).inv() * axes(time)
    points = np.c_[now.inv().apply(at_stamp - way), np.ones(2000)].astype(np.float32)
    offset, twist = time.astype(np.float32), np.r_[rates(np.zeros(1))[0], velocity]
    measured = deskew(points, offset, twist, lambda at: turned(SECONDS, rates(SECONDS), at))
    # 64 poses in 0.1 s: half a step of 0.8 ms at 1.9 rad/s and 35 m is 5 cm
    assert np.abs(measured[:, :3] - at_stamp).max() < 0.06
    np.testing.assert_array_equal(measured[:, 3], 1)


def test_where_the_turn_is_not_known_it_is_taken_to_be_steady() -> None:
    points, offset = np.random.default_rng(0).normal(0, 9, (50, 4)).astype(np.float32), np.linspace(0, 0.1, 50)
    twist = np.array([0.1, 0.2, 0.3, 4, 5, 6])
    steady = deskew(points, offset.astype(np.float32), twist)
    np.testing.assert_array_equal(deskew(points, offset.astype(np.float32), twist, lambda at: None), steady)
