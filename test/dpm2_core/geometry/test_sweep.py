# SPDX-License-Identifier: Apache-2.0
"""Whatever time of a sweep the driver stamps: a frame is timed from the middle, and the motion to the stamp is
known."""

from __future__ import annotations

from copy import copy
from dataclasses import replace

import numpy as np
import pytest

from dpm2_core.frame import Frame, Inertial
from dpm2_core.geometry import se3
from dpm2_core.geometry.sweep import Sweep

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


def test_each_cloud_has_a_middle_of_its_own() -> None:
    """A driver begins in the middle of a sweep. Previously, its first cloud determined the middle of all that
    followed."""
    sweep, whole = Sweep(), a_frame(START)
    late = whole.time_offset > 0.075
    assert sweep.centered(replace(whole, points=whole.points[late], time_offset=whole.time_offset[late])).stamp == (
        pytest.approx(10**9 + 40_000_000, abs=10)  # ns: times are float32
    )
    part = copy(sweep)
    assert sweep.centered(whole).stamp == pytest.approx(10**9, abs=10)
    assert sweep.shows_part(part)
    assert not sweep.shows_part(sweep)


@pytest.mark.parametrize(("before", "is_part"), [(0, False), (4, True), (6, False), (11, False), (30, False)])
def test_without_times_a_part_of_a_sweep_has_less_than_half_of_the_points(before: int, is_part: bool) -> None:
    """An empty cloud is not a part: it shows nothing that could be wrong."""
    other, sweep = Sweep(), Sweep()
    other.look(Frame(0, np.ones((before, 4), np.float32)))
    sweep.look(Frame(10**8, np.ones((11, 4), np.float32)))
    assert sweep.shows_part(other) == is_part


def test_a_stamp_near_the_middle_is_left() -> None:
    """Otherwise, each pose would be interpolated for no benefit."""
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
