# SPDX-License-Identifier: Apache-2.0
"""Prediction of the next frame from the registered frames."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from dpm2_core.estimates import Registration
from dpm2_core.geometry import se3
from dpm2_core.slam.odometry.motion_state import MotionState
from dpm2_core.slam.odometry.settings import OdometrySettings

TWIST = np.array([0, 0, 0.2, 10, 0, 0])


def registered(T: np.ndarray, sigma: float = 0.01, along: float = 0.01) -> Registration:
    """Registration at T in a scene that constrains x to `along` m."""
    of_scene = np.diag([1e-3, 1e-3, 1e-3, along, sigma, sigma]) ** 2
    return Registration(T, of_scene, 1.0, 0.0, "points")


def driven(frames: int, period: float = 0.1, along: float = 0.01) -> MotionState:
    """State after `frames` frames with a steady motion."""
    motion = MotionState(OdometrySettings())
    motion.register(registered(np.eye(4)), None, moved=False)
    for i in range(1, frames):
        result = registered(se3.exp(TWIST * period * i), along=along)
        motion.advance(result, period, None, led=False)
    return motion


@given(st.floats(0.02, 2), st.integers(2, 5))
def test_a_steady_motion_is_predicted_exactly(period: float, frames: int) -> None:
    motion = driven(frames, period)
    T = motion.predicted(motion.known_twist, period)
    np.testing.assert_allclose(T, se3.exp(TWIST * period * frames), atol=1e-6)
    np.testing.assert_allclose(motion.change, 0, atol=1e-6 / period)


def test_frames_that_are_not_registered_follow_the_motion_ever_less_certain() -> None:
    motion = driven(3)
    before = motion.covariance
    for i in range(3, 6):
        motion.coast(0.1)
        np.testing.assert_allclose(motion.T, se3.exp(TWIST * 0.1 * i), atol=1e-6)
        assert (np.diag(motion.covariance) > np.diag(before)).all()
        before = motion.covariance
    np.testing.assert_allclose(motion.seconds, 0.3)


def test_a_frame_that_is_not_registered_is_as_uncertain_as_the_motion_was_unsteady() -> None:
    """A LiDAR swings by 60 deg/s and back. After three frames its roll is up to 9 degrees off; previously, 0.5 were
    reported."""
    motion = MotionState(OdometrySettings())
    motion.register(registered(np.eye(4)), None, moved=False)
    T = np.eye(4)
    for i in range(6):
        T = T @ se3.exp(np.array([np.radians(6.0) * (-1) ** i, 0, 0, 0.1, 0, 0]))
        motion.advance(registered(T), 0.1, None, led=False)
    motion.coast(0.1)
    assert np.degrees(np.sqrt(motion.covariance[0, 0])) > 6.0
    steady = driven(6)
    steady.coast(0.1)
    assert np.degrees(np.sqrt(steady.covariance[0, 0])) < 0.5


def test_what_no_vehicle_can_do_is_rejected_the_later_the_less() -> None:
    motion = driven(3)
    T = motion.predicted(motion.known_twist, 0.1)
    beside = registered(T @ se3.exp([0, 0, 0, 0, 3, 0]))
    turned = registered(T @ se3.exp([0, 0, np.radians(40), 0, 0, 0]))
    assert motion.gated(registered(T), T, 0.1).ok
    assert motion.gated(beside, T, 0.1).reason == "3.0 m from the prediction"
    assert motion.gated(turned, T, 0.1).reason == "40 deg from the prediction"
    motion.coast(0.1)
    motion.coast(0.1)
    assert motion.gated(beside, T, 0.1).ok  # 0.3 s at 40 m/s2
    assert motion.gated(turned, T, 0.1).ok


def test_along_an_open_direction_the_covariance_grows_with_the_time_in_it_and_ends_with_it() -> None:
    short, long = driven(4, along=1.0), driven(20, along=1.0)
    assert long.covariance[3, 3] > 4 * short.covariance[3, 3]
    np.testing.assert_allclose(long.covariance[4, 4], 0.01**2)
    out = registered(se3.exp(TWIST * 2))
    long.advance(out, 0.1, None, led=False)
    np.testing.assert_allclose(long.covariance, out.covariance)
