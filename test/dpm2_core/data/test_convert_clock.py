# SPDX-License-Identifier: Apache-2.0
"""A drive during which a clock was set, as a bag: the same frames, steps and samples."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from dpm2_core.data.bag_file import open_bag
from dpm2_core.data.bags import BagSource
from dpm2_core.data.convert import EPOCH_NS, convert
from dpm2_core.frame import Frame, Inertial

STAMP = 1_700_000_000_000_000_000  # ns


class OddClock:
    """Clouds whose numbers are their first coordinates, with a sample of an IMU before each and an image every 2nd."""

    name, truth, T_cam_lidar, poses = "clock", "", None, None

    def __init__(self, stamps: list[int]) -> None:
        self.stamps, self.notes = stamps, list[str]()

    def __len__(self) -> int:
        return len(self.stamps)

    def frames(self, start: int = 0, stop: int | None = None) -> Iterator[Frame]:
        """All of them."""
        for index, stamp in enumerate(self.stamps):
            imu = Inertial(np.array([stamp - 10**7]), np.ones((1, 3)), np.ones((1, 3)))
            yield Frame(stamp, np.full((3, 4), index, np.float32), index=index, imu=imu)


@pytest.mark.parametrize(
    "stamps",
    [
        [STAMP, STAMP + 10**8, STAMP - 10**9, STAMP - 9 * 10**8],  # set back while driving
        [5 * 10**9, 5 * 10**9 + 10**8, STAMP, STAMP + 10**8],  # set once it hears of the time
    ],
)
def test_the_order_is_kept_where_the_clock_is_set(tmp_path: Path, stamps: list[int]) -> None:
    """Players and readers go by the time of recording, and nothing is lost."""
    convert(OddClock(stamps), tmp_path / "bag")
    bag = open_bag(tmp_path / "bag")
    clouds = [bag.decode(topic, data) for topic, _, data in bag.messages(["/points"])]
    assert [float(np.frombuffer(cloud.data, "<f4")[0]) for cloud in clouds] == [0, 1, 2, 3]
    said = [cloud.header.stamp.sec * 10**9 + cloud.header.stamp.nanosec for cloud in clouds]
    assert said == [stamp if stamp > 10**17 else stamp + EPOCH_NS for stamp in stamps]
    assert bag.counts["/imu"] == 4


class SetAhead:
    """Ten clouds a period (s) apart with ten samples of an IMU each; before the sixth its clock is set ahead by 2 s."""

    name, truth, T_cam_lidar, poses = "clock", "", None, None

    def __init__(self, period: float) -> None:
        self.period, self.notes = round(period * 1e9), list[str]()

    def __len__(self) -> int:
        return 10

    def frames(self, start: int = 0, stop: int | None = None) -> Iterator[Frame]:
        """All of them."""
        for index in range(10):
            stamp = STAMP + index * self.period + (2 * 10**9 if index > 4 else 0)
            samples = stamp - np.arange(10)[::-1] * self.period // 10
            imu = Inertial(samples, np.ones((10, 3)), np.ones((10, 3)))
            yield Frame(stamp, np.ones((3, 4), np.float32), index=index, imu=imu, stepped=index == 5)


@pytest.mark.parametrize("period", [0.1, 0.2])
def test_a_clock_that_was_set_ahead_is_no_pause_in_the_bag(tmp_path: Path, period: float) -> None:
    """And no sample of the IMU is lost there."""
    drive = SetAhead(period)
    convert(drive, tmp_path / "bag")
    frames = [(frame.stamp, frame.stepped) for frame in BagSource(tmp_path / "bag").frames()]
    assert frames == [(frame.stamp, frame.stepped) for frame in drive.frames()]
    assert open_bag(tmp_path / "bag").counts["/imu"] == 100
