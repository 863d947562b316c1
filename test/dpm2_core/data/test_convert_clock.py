# SPDX-License-Identifier: Apache-2.0
"""A drive during which a clock was set, as a bag: the same frames, steps and samples."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from dpm2_core.data.bag_file import open_bag
from dpm2_core.data.bags import BagSource
from dpm2_core.data.convert import EPOCH_NS, convert
from dpm2_core.data.messages import serialized_stamp
from dpm2_core.frame import Frame, Inertial

from ...helpers.drives import InMemory

STAMP = 1_700_000_000_000_000_000  # ns


def test_clouds_are_recorded_at_the_end_of_their_sweeps(tmp_path: Path) -> None:
    """As drivers publish them, so that a player has published the samples of a sweep by then. One distant point changes
    no order, and sweeps that overlap a little are not taken for a clock that was set."""
    drive = [frame_of(STAMP + i * 10**8, i, STAMP + i * 10**8 + np.arange(1, 11) * 10**7) for i in range(10)]
    ends = [0.101] * 5 + [1.5] + [0.1] * 4
    drive = [replace(f, time_offset=np.float32([0, end / 2, end])) for f, end in zip(drive, ends, strict=True)]
    convert(InMemory(drive), tmp_path / "bag")
    clouds, samples = list[tuple[int, int]](), 0
    for topic, time, data in open_bag(tmp_path / "bag").messages(["/points", "/imu"]):
        samples += topic == "/imu"
        if topic == "/points":
            clouds.append((time - serialized_stamp(data, 0), samples))
    late = np.array([late for late, _ in clouds]) * 1e-9
    np.testing.assert_allclose(late, [0.101] * 5 + [0.25, 0.15] + [0.1] * 3, atol=1e-6)
    assert [seen >= 10 * (i + 1) for i, (_, seen) in enumerate(clouds)] == [True] * 10
    frames = list(BagSource(tmp_path / "bag").frames())
    assert [(f.stamp, f.stepped, f.points[0, 0]) for f in frames] == [(f.stamp, False, i) for i, f in enumerate(drive)]


def frame_of(stamp: int, index: int, samples: np.ndarray, stepped: bool = False) -> Frame:
    """Three points with the frame's number as coordinates, and IMU samples at these stamps, ns."""
    imu = Inertial(samples, np.ones((len(samples), 3)), np.ones((len(samples), 3)))
    return Frame(stamp, np.full((3, 4), index, np.float32), index=index, imu=imu, stepped=stepped)


@pytest.mark.parametrize(
    "stamps",
    [
        [STAMP, STAMP + 10**8, STAMP - 10**9, STAMP - 9 * 10**8],  # set back while driving
        [5 * 10**9, 5 * 10**9 + 10**8, STAMP, STAMP + 10**8],  # set when the time becomes known
    ],
)
def test_the_order_is_kept_where_the_clock_is_set(tmp_path: Path, stamps: list[int]) -> None:
    """Players and readers use the recording time, and nothing is lost."""
    frames = [frame_of(stamp, index, np.array([stamp - 10**7])) for index, stamp in enumerate(stamps)]
    convert(InMemory(frames), tmp_path / "bag")
    bag = open_bag(tmp_path / "bag")
    clouds = [bag.decode(topic, data) for topic, _, data in bag.messages(["/points"])]
    assert [float(np.frombuffer(cloud.data, "<f4")[0]) for cloud in clouds] == [0, 1, 2, 3]
    said = [cloud.header.stamp.sec * 10**9 + cloud.header.stamp.nanosec for cloud in clouds]
    assert said == [stamp if stamp > 10**17 else stamp + EPOCH_NS for stamp in stamps]
    assert bag.counts["/imu"] == 4


@pytest.mark.parametrize("period", [10**8, 2 * 10**8])
def test_a_clock_that_was_set_ahead_is_no_pause_in_the_bag(tmp_path: Path, period: int) -> None:
    """The sixth of ten clouds is 2 s ahead. Each cloud has ten IMU samples, and none is lost there."""
    stamps = [STAMP + index * period + (2 * 10**9 if index > 4 else 0) for index in range(10)]
    ago = np.arange(10)[::-1] * period // 10
    drive = [frame_of(stamp, index, stamp - ago, index == 5) for index, stamp in enumerate(stamps)]
    convert(InMemory(drive), tmp_path / "bag")
    frames = [(frame.stamp, frame.stepped) for frame in BagSource(tmp_path / "bag").frames()]
    assert frames == [(frame.stamp, frame.stepped) for frame in drive]
    assert open_bag(tmp_path / "bag").counts["/imu"] == 100
