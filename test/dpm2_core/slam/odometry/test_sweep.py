# SPDX-License-Identifier: Apache-2.0
"""Whatever moment of a sweep the driver stamps: the pose is that at the stamp, and an error of it decays."""

from __future__ import annotations

import numpy as np
import pytest

from dpm2_core.frame import Frame, Inertial, State
from dpm2_core.geometry import se3
from dpm2_core.sim.lidar import Lidar
from dpm2_core.sim.settings import LidarConfig
from dpm2_core.sim.world import build_world
from dpm2_core.slam.build import make_odometry
from dpm2_core.slam.odometry.sweep import Sweep
from dpm2_core.slam.settings import SlamSettings

START, MIDDLE, END = -0.05, 0.0, 0.05
"""Stamps, s after the middle of the sweep."""


def a_frame(stamp_at: float, imu: Inertial | None = None) -> Frame:
    """A few points of a sweep of 0.1 s around 1 s."""
    times = np.linspace(-0.05, 0.05, 11, dtype=np.float32) - np.float32(stamp_at)
    return Frame(10**9 + round(stamp_at * 1e9), np.ones((11, 4), np.float32), times, imu=imu)


@pytest.mark.parametrize("stamp_at", [START, MIDDLE, END, 0.02])
def test_a_frame_is_timed_from_the_middle_of_its_sweep(stamp_at: float) -> None:
    sweep = Sweep()
    centered = sweep.centered(a_frame(stamp_at))
    assert centered.stamp == pytest.approx(10**9, abs=2)  # ns: times are float32
    assert centered.time_offset is not None
    np.testing.assert_allclose(centered.time_offset, np.linspace(-0.05, 0.05, 11), atol=1e-6)  # float32
    without = sweep.centered(Frame(2 * 10**9, np.ones((3, 4), np.float32)))
    assert without.stamp == pytest.approx(2 * 10**9 - round(stamp_at * 1e9), abs=2)


def test_a_stamp_near_the_middle_is_left() -> None:
    """Or each pose would be one that is interpolated, for nothing."""
    frame = a_frame(0.004)
    assert Sweep().centered(frame) is frame


def test_the_pose_at_the_stamp_is_that_of_the_motion() -> None:
    sweep, twist = Sweep(), np.array([0, 0, 1.0, 10, 0, 0])
    frame = sweep.centered(a_frame(START))
    np.testing.assert_allclose(sweep.to_stamp(frame, twist), se3.exp(START * twist), atol=1e-9)
    np.testing.assert_array_equal(sweep.to_stamp(frame, None), np.eye(4))


def test_its_turn_is_the_measured_one() -> None:
    stamps = 9 * 10**8 + np.arange(21) * 10**7
    imu = Inertial(stamps, np.tile([0, 0, 2.0], (21, 1)), np.zeros((21, 3)))
    sweep = Sweep()
    T = sweep.to_stamp(sweep.centered(a_frame(START, imu)), np.array([0, 0, 1.0, 10, 0, 0]))
    assert se3.rotation_vector(T[:3, :3])[2] == pytest.approx(2.0 * START, abs=1e-3)


@pytest.mark.slow
@pytest.mark.parametrize("stamp_at", [START, END])
def test_a_bump_is_forgotten(stamp_at: float) -> None:
    """Of clouds stamped at their start the odometry swung to and fro for ever after it, 0.15 m, as `tracking`."""
    world, lidar = build_world("straight", "suburb", seed=11, length=200.0), Lidar(LidarConfig(columns=720))
    rng = np.random.default_rng(0)

    def pose(t: float) -> np.ndarray:
        return world.drive_pose(2 + t) @ se3.exp([0, np.radians(3) * np.exp(-(((t - 0.5) / 0.08) ** 2)), 0, 0, 0, 0])

    odometry, truth, tracked = make_odometry(SlamSettings()), [], []
    for i in range(20):
        T, twist = pose(0.1 * i), se3.log(se3.inverse(pose(0.1 * i - 0.05)) @ pose(0.1 * i + 0.05)) / 0.1
        scan = lidar.scan(world, T, 2 + 0.1 * i, rng, twist=twist)
        tracked.append(odometry.process(Frame(i * 10**8, scan.points, scan.time_offset, index=i).later(stamp_at)))
        truth.append(T @ se3.exp(stamp_at * twist))
    off = se3.inverse(np.array(truth)) @ truth[0] @ np.array([result.T_odom_lidar for result in tracked])
    steps = se3.inverse(off[12:-1]) @ off[13:]
    assert np.linalg.norm(steps[:, :3, 3], axis=1).max() < 0.03  # 0.016 of clouds stamped in the middle
    assert np.degrees(se3.angle(steps)).max() < 0.5  # 2.7 before
    assert tracked[-1].state is State.TRACKING
