# SPDX-License-Identifier: Apache-2.0
"""Moving frames at a stamp: between samples, through static links, never outside the known times, for any input."""

from __future__ import annotations

import math

import numpy as np
import pytest
from geometry_msgs.msg import Pose, Quaternion

from dpm2_core.data.transforms import TransformTree
from dpm2_core.errors import UsageError
from dpm2_core.frame import Array
from dpm2_core.geometry import se3
from dpm2_core.slam.mapping.admission import RejectedError
from dpm2_ros.conversions import pose_to_msg
from dpm2_ros.transform_history import TransformHistory

SECOND = 10**9
TWIST = np.array([0.0, 0.0, 0.3, 2.0, 0.1, 0.0])


def truth(stamp: int) -> Array:
    return se3.exp(TWIST * stamp / SECOND)


def moving(*stamps: int) -> TransformHistory:
    history = TransformHistory()
    for stamp in stamps:
        history.add("odom", "base", stamp, pose_to_msg(truth(stamp)))
    return history


def test_between_samples_the_motion_is_even() -> None:
    history = moving(*range(0, SECOND, 50_000_000))
    for stamp in (0, 123_456_789, 50_000_000, 949_999_999):
        T, covariance = history.lookup("odom", "base", stamp, TransformTree())
        np.testing.assert_allclose(T, truth(stamp), atol=1e-9)
        assert covariance is None


@pytest.mark.parametrize(
    ("stamp", "words"),
    [(5 * SECOND, "ends 4.00 s before"), (-SECOND, "begins 1.00 s after"), (SECOND // 2, "gap of 1.00 s")],
)
def test_it_never_says_more_than_it_knows(stamp: int, words: str) -> None:
    with pytest.raises(UsageError, match=words):
        moving(0, SECOND).lookup("odom", "base", stamp, TransformTree())


def test_static_links_above_and_below_a_frame_that_moves() -> None:
    static, T_base_sensor, T_odom_wheel = TransformTree(), se3.exp([0, 0.1, 0, 1, 0, 0.5]), se3.exp([0, 0, 1, 0, 2, 0])
    static.set("base", "sensor", T_base_sensor)
    static.set("odom", "wheel_odom", T_odom_wheel)
    history = TransformHistory()
    history.add("wheel_odom", "base", SECOND, pose_to_msg(truth(SECOND)))
    T, _ = history.lookup("odom", "sensor", SECOND, static)
    np.testing.assert_allclose(T, T_odom_wheel @ truth(SECOND) @ T_base_sensor, atol=1e-9)
    with pytest.raises(UsageError, match="'odom' has no parent"):
        history.lookup("map", "sensor", SECOND, static)


def test_a_cycle_ends() -> None:
    history = TransformHistory()
    history.add("a", "b", 0, pose_to_msg(np.eye(4)))
    history.add("b", "a", 0, pose_to_msg(np.eye(4)))
    with pytest.raises(UsageError, match="no transform"):
        history.lookup("odom", "a", 0, TransformTree())


def test_time_that_goes_back_begins_anew_and_samples_out_of_order_are_left_out() -> None:
    history = moving(0, SECOND // 4, 10 * SECOND, SECOND // 2, SECOND // 2 + 1)  # a stray stamp ahead
    np.testing.assert_allclose(history.lookup("odom", "base", SECOND // 2, TransformTree())[0], truth(SECOND // 2))
    history.add("odom", "base", SECOND // 4, pose_to_msg(np.eye(4)))
    with pytest.raises(UsageError, match="begins"):
        history.lookup("odom", "base", SECOND // 4, TransformTree())


def test_a_clock_that_is_set_back_by_less_than_a_second_tells_the_time() -> None:
    """Samples with the same stamps from before the clock was set are not used afterwards."""
    history, elsewhere = moving(*range(0, SECOND, SECOND // 20)), pose_to_msg(se3.exp([0, 0, 0, 7.0, 0, 0]))
    for k in range(4):
        before = history.lookup("odom", "base", SECOND // 2, TransformTree())[0]
        np.testing.assert_allclose(before, truth(SECOND // 2))
        history.add("odom", "base", SECOND // 2 + k * SECOND // 20, elsewhere)
    after = history.lookup("odom", "base", SECOND // 2, TransformTree())[0]
    np.testing.assert_allclose(after[:3, 3], [7.0, 0.0, 0.0])


@pytest.mark.parametrize("number", [math.nan, math.inf, 1e9])
def test_a_sample_that_is_no_pose_is_named(number: float) -> None:
    history, bad = moving(0), pose_to_msg(np.eye(4))
    bad.position.x = number
    history.add("odom", "base", SECOND // 10, bad)
    with pytest.raises(UsageError):
        history.lookup("odom", "base", SECOND // 10, TransformTree())
    history.add("odom", "base", 2 * SECOND // 10, Pose(orientation=Quaternion(w=0.0)))
    with pytest.raises(UsageError, match="no rigid transform"):
        history.lookup("odom", "base", 2 * SECOND // 10, TransformTree())


def test_its_size_is_bounded() -> None:
    history, still = TransformHistory(), pose_to_msg(np.eye(4))
    for n in range(200):
        history.add("odom", f"joint_{n}", 0, still)
    with pytest.raises(RejectedError, match="more than 200 moving frames"):
        history.add("odom", "one_more", 0, still)
    for n in range(20_000):  # 5 kHz
        history.add("odom", "joint_0", 200_000 * n, still)
    with pytest.raises(UsageError, match="begins"):  # the oldest samples are deleted
        history.lookup("odom", "joint_0", 0, TransformTree())
    history.lookup("odom", "joint_0", 200_000 * 19_999, TransformTree())
