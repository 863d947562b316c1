# SPDX-License-Identifier: Apache-2.0
"""Curves have the derivatives that they are made of, and points that were seen along them are static after the
correction."""

from __future__ import annotations

from functools import partial

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from dpm2_core.geometry import curve, se3

MOTION = st.lists(st.floats(-1, 1), min_size=18, max_size=18).map(lambda v: np.reshape(v, (3, 6)))
SCALE = np.array([[1.0], [10.0], [200.0]]) * [1, 1, 1, 5, 5, 5]
"""Motion of a hasty person who carries the sensor: rad/s, rad/s2, rad/s3, and five times as much in m."""


@given(st.lists(st.floats(-2, 2), min_size=6, max_size=6), st.floats(-1, 1))
def test_a_twist_alone_is_constant(twist: list[float], time: float) -> None:
    np.testing.assert_allclose(curve.poses(time, np.array(twist)), se3.exp(np.array(twist) * time), atol=1e-12)


@given(MOTION)
def test_the_motion_is_made_of_the_derivatives_at_0(motion: np.ndarray) -> None:
    h = 1e-3
    way = se3.log(curve.poses([-2 * h, -h, h, 2 * h], motion * SCALE))
    twist = (8 * (way[2] - way[1]) - (way[3] - way[0])) / (12 * h)
    np.testing.assert_allclose(twist, motion[0] * SCALE[0], atol=1e-6)
    # Rounding, 1e-16, is divided by h^2.
    np.testing.assert_allclose((way[1] + way[2]) / h**2, motion[1] * SCALE[1], atol=1e-3)


@given(MOTION)
def test_points_seen_along_a_curve_come_to_rest(motion: np.ndarray) -> None:
    rng = np.random.default_rng(0)
    at_rest, times = rng.uniform(-20, 20, (300, 3)), rng.uniform(-0.05, 0.05, 300)
    T = se3.inverse(curve.poses(times, motion * SCALE))
    seen = np.einsum("nij,nj->ni", T[:, :3, :3], at_rest) + T[:, :3, 3]
    found = curve.moved(seen, times, partial(curve.poses, motion=motion * SCALE))
    # Between 33 poses in 0.1 s the motion is linear: at 2 rad/s and 30 rad/s2 the error is within 0.3 mm, 35 m away.
    np.testing.assert_allclose(found, at_rest, atol=1e-3)
    with_more = np.c_[seen, np.ones(300)].astype(np.float32)  # as a cloud: other columns stay
    cloud = curve.moved(with_more, times.astype(np.float32), partial(curve.poses, motion=motion * SCALE))
    np.testing.assert_array_equal(cloud[:, 3], 1)
    np.testing.assert_allclose(cloud[:, :3], at_rest, atol=1e-3)


@given(MOTION, st.floats(-0.05, 0.05), st.sampled_from([-1.0, 1.0]))
def test_beyond_its_ends_a_motion_goes_on_as_it_was_there(motion: np.ndarray, time: float, side: float) -> None:
    motion, half, h = motion * SCALE, 0.05, 1e-5
    np.testing.assert_array_equal(curve.beyond(time, half, motion), curve.poses(time, motion))
    at, after, far = (curve.beyond(side * t, half, motion) for t in (half, half + h, half + 0.25))
    np.testing.assert_allclose(se3.way(at, far) * h / 0.25, se3.way(at, after), atol=1e-12)  # one twist
    before = se3.way(curve.poses(side * (half - h), motion), at)
    # The twist of the body stays, not that of the tangent space: 0.2 rad later they differ by a tenth.
    np.testing.assert_allclose(se3.way(at, after), before, atol=0.15 * np.abs(before).max() + 1e-8)


def test_points_of_one_moment_and_none() -> None:
    motion = np.array([0.1, 0, 0, 1, 0, 0])
    points, along = np.array([[1.0, 2, 3], [4, 5, 6]]), partial(curve.poses, motion=motion)
    T = curve.poses(0.03, motion)
    np.testing.assert_allclose(curve.moved(points, np.full(2, 0.03), along), points @ T[:3, :3].T + T[:3, 3], atol=1e-8)
    assert curve.moved(points[:0], np.zeros(0), along).shape == (0, 3)


@given(MOTION)
def test_a_measured_turn_becomes_the_curve_that_is_nearest(motion: np.ndarray) -> None:
    def turn(times: np.ndarray) -> np.ndarray:
        return curve.poses(times, motion * SCALE)[:, :3, :3]

    found = curve.fitted(turn, 0.05)
    assert found is not None
    np.testing.assert_allclose(found, (motion * SCALE)[:, :3], atol=1e-6 * 0.05**-3)
    assert curve.fitted(lambda _: None, 0.05) is None
