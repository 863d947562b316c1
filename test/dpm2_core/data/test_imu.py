# SPDX-License-Identifier: Apache-2.0
"""IMU samples of bags, folders and hostile publishers: each is associated with its scan, or left out and counted."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dpm2_core.data import bag_messages
from dpm2_core.data.bags import BagSource
from dpm2_core.data.convert import EPOCH_NS, convert
from dpm2_core.data.imu import ImuBuffer, decode_imu
from dpm2_core.data.kitti import KittiSource
from dpm2_core.data.messages import MessageError
from dpm2_core.data.naming import POINTS
from dpm2_core.data.settings import InputSettings
from dpm2_core.errors import UsageError
from test.helpers.recordings import by_time

SECOND = 10**9
NAN, INF = float("nan"), float("inf")


def imu(bags: Any, stamp: float, rates: tuple = (0.1, 0.2, 0.3), forces: tuple = (0.0, 0.0, 9.8), **other: Any) -> Any:
    """An Imu message; `other`: frame, rates_known, forces_known."""
    message = bag_messages.imu(round(stamp * 1e9), np.array(rates, float), np.array(forces, float))
    message.header.frame_id = other.get("frame", "imu_link")
    message.angular_velocity_covariance = np.full(9, 0.0 if other.get("rates_known", True) else -1.0)
    message.linear_acceleration_covariance = np.full(9, 0.0 if other.get("forces_known", True) else -1.0)
    return message


def drive(bags: Any, until: float = 2.0, **other: Any) -> list[tuple[float, str, Any]]:
    """Clouds at 1.0 to 1.9 s; samples at 100 Hz until `until` s, logged as they arrive."""
    messages = [(1 + 0.1 * i, POINTS, bags.cloud(1 + 0.1 * i)) for i in range(10)]
    samples = [(0.9 + 0.01 * i, "/imu", imu(bags, 0.9 + 0.01 * i, **other)) for i in range(120)]
    return sorted(messages + [s for s in samples if s[0] < until], key=lambda m: m[0])


def quarter(bags: Any) -> tuple[float, str, Any]:
    """Mounting of the IMU: rotated by 90 degrees to the left in the LiDAR's frame."""
    return (0.5, "/tf_static", bags.transform("velo_link", "imu_link", (0.5, 0, 0), [[0, -1, 0], [1, 0, 0], [0, 0, 1]]))


def test_each_cloud_has_the_samples_since_the_one_before(bags: Any, tmp_path: Path) -> None:
    source = BagSource(bags.write(tmp_path / "b", [quarter(bags), *drive(bags)]))
    frames = list(source.frames())
    assert source.notes == []
    counts = [len(frame.imu) for frame in frames if frame.imu is not None]
    assert counts == [11, *[10] * 9]
    for frame in frames:
        assert frame.imu.stamps[-1] == frame.stamp
        np.testing.assert_allclose(frame.imu.rates[0], [-0.2, 0.1, 0.3], atol=1e-9)  # along the LiDAR's axes
        np.testing.assert_allclose(frame.imu.forces[0], [0, 0, 9.8], atol=1e-9)
    again = list(source.frames(3, 5))
    assert [len(frame.imu) for frame in again if frame.imu is not None] == [41, 10]  # those of skipped clouds, too


@pytest.mark.parametrize("sweep", [10**8, 18 * 10**7])
def test_a_cloud_that_was_recorded_at_its_stamp_has_the_samples_of_its_sweep(
    bags: Any, tmp_path: Path, sweep: int
) -> None:
    """The samples up to its last point were recorded after the cloud."""
    messages = [quarter(bags), *drive(bags, until=2.2)]
    noise = np.random.default_rng(0)
    for i, (t, topic, _) in enumerate(messages):
        if topic == POINTS:
            columns = {k: noise.uniform(1, 9, 60).astype(np.float32) for k in "xyz"}
            columns["t"] = np.linspace(0, sweep, 60).astype(np.uint32)
            messages[i] = (t, topic, bags.cloud_of(t, columns))
    for frame in BagSource(bags.write(tmp_path / "b", messages)).frames():
        assert frame.imu.stamps[-1] == frame.stamp + sweep


def test_without_its_place_it_is_left_out_and_said(bags: Any, tmp_path: Path) -> None:
    bag = bags.write(tmp_path / "b", drive(bags))
    source = BagSource(bag)
    assert all(frame.imu is None for frame in source.frames())
    (note,) = source.notes
    assert note.startswith("/imu: no transform from 'imu_link' to 'velo_link'")
    assert "input.q_lidar_imu" in note
    given = BagSource(bag, InputSettings(q_lidar_imu=(0, 0, 0.5**0.5, 0.5**0.5)))
    first = next(given.frames())
    np.testing.assert_allclose(first.imu.rates[0], [-0.2, 0.1, 0.3], atol=1e-9)
    assert all(frame.imu is None for frame in BagSource(bag, InputSettings(imu=False)).frames())
    own = BagSource(bags.write(tmp_path / "own", drive(bags, frame="velo_link")))
    assert all(frame.imu is not None for frame in own.frames())  # in the LiDAR's own frame
    with pytest.raises(ValueError, match="no unit quaternion"):
        InputSettings(q_lidar_imu=(0, 0, 0, 2))


PAGES = Path(__file__).resolve().parents[3] / "docs"
OUSTER = {
    "how_to.md": r"/ouster/imu --set input\.q_lidar_imu=\[(.*?)\]",
    "ros2.md": r"\| `/ouster/imu` \| .*? without that, as in many a bag, `\[(.*?)\]`",
}


@pytest.mark.parametrize("page", OUSTER)
def test_the_rotation_that_a_page_gives_for_an_ouster_is_its_own(bags: Any, tmp_path: Path, page: str) -> None:
    """Compared with the design values in its metadata: clouds are in os_lidar, rotated by 180 degrees against the
    housing, and its IMU is parallel to the housing. Previously, a page gave no rotation instead: rates were right,
    forces reversed."""
    lidar_to_sensor, imu_to_sensor = np.diag([-1.0, -1, 1]), np.eye(3)
    messages = drive(bags, frame="os_imu", forces=(1.0, 0.5, 9.8))
    for _, topic, message in messages:
        if topic == POINTS:
            message.header.frame_id = "os_lidar"
    places = [
        (0.5, "/tf_static", bags.transform("os_sensor", "os_lidar", (0, 0, 0.036), lidar_to_sensor)),
        (0.5, "/tf_static", bags.transform("os_sensor", "os_imu", (0.006, -0.012, 0.008), imu_to_sensor)),
    ]
    (said,) = re.findall(OUSTER[page], (PAGES / page).read_text())
    x, y, z, w = (float(number) for number in said.split(","))
    given = InputSettings(q_lidar_imu=(x, y, z, w))
    driver = next(BagSource(bags.write(tmp_path / "driver", [*places, *messages])).frames()).imu
    bare = next(BagSource(bags.write(tmp_path / "bare", messages), given).frames()).imu
    assert driver is not None
    assert bare is not None
    np.testing.assert_allclose(bare.forces, driver.forces, atol=1e-9)
    np.testing.assert_allclose(bare.rates, driver.rates, atol=1e-9)


def test_two_frames_without_a_name_are_not_one(bags: Any, tmp_path: Path) -> None:
    """Cloud and IMU without a frame_id may have any relative rotation. A manual setting still applies."""
    messages = drive(bags, frame="")
    for _, topic, message in messages:
        if topic == POINTS:
            message.header.frame_id = ""
    bag = bags.write(tmp_path / "b", messages)
    source = BagSource(bag)
    assert all(frame.imu is None for frame in source.frames())
    (note,) = source.notes
    assert note.startswith("/imu: no transform from '' to ''")
    assert "input.q_lidar_imu" in note
    given = BagSource(bag, InputSettings(q_lidar_imu=(0, 0, 0, 1)))
    assert all(frame.imu is not None for frame in given.frames())


def test_one_that_stops_is_missed_once(bags: Any, tmp_path: Path) -> None:
    source = BagSource(bags.write(tmp_path / "b", [quarter(bags), *drive(bags, until=1.45)]))
    assert [frame.imu is not None for frame in source.frames()] == [True] * 6 + [False] * 4
    assert source.notes == ["/imu: no samples at the time of the scan; going on without the IMU"]


def test_clouds_between_two_samples_are_not_reported_to_have_none(bags: Any, tmp_path: Path) -> None:
    """Parts of a sweep at 100 Hz, and an IMU at 50 Hz, which was reported as missing though it was used."""
    parts = [(1 + 0.01 * i, POINTS, bags.cloud(1 + 0.01 * i)) for i in range(100)]
    samples = [(1.004 + 0.02 * i, "/imu", imu(bags, 1.004 + 0.02 * i)) for i in range(-5, 80)]
    source = BagSource(bags.write(tmp_path / "b", by_time([quarter(bags), *parts, *samples])))
    frames = list(source.frames())
    assert sum(frame.imu is None for frame in frames) == 49
    assert sum(len(frame.imu) for frame in frames if frame.imu is not None) == 55
    assert source.notes == []


def test_one_of_zeros_is_left_out_and_said(bags: Any, tmp_path: Path) -> None:
    """For example from a driver that fills in only the orientation. Previously, it counted as not rotating, even in a
    bend."""
    zeros = {"frame": "velo_link", "rates": (0, 0, 0)}
    source = BagSource(bags.write(tmp_path / "b", drive(bags, forces=(0, 0, 0), **zeros)))
    assert all(frame.imu is None for frame in source.frames())
    said = "its rates and forces are all 0: it measures neither"
    assert source.notes == [f"/imu: {said}; going on without the IMU"]
    still = BagSource(bags.write(tmp_path / "still", drive(bags, **zeros)))  # from a simulator, at rest
    assert all(frame.imu is not None for frame in still.frames())


def test_which_topic(bags: Any, tmp_path: Path) -> None:
    two = [*drive(bags, frame="velo_link"), (0.9, "/other", imu(bags, 0.9, frame="velo_link"))]
    usual = BagSource(bags.write(tmp_path / "usual", sorted(two, key=lambda m: m[0])))
    assert usual.imu_topic == "/imu"
    renamed = [(t, topic.replace("/imu", "/ouster/imu"), m) for t, topic, m in drive(bags, frame="velo_link")]
    alone = BagSource(bags.write(tmp_path / "alone", renamed))
    assert alone.imu_topic == "/ouster/imu"
    both = bags.write(tmp_path / "both", sorted([*renamed, two[-1]], key=lambda m: m[0]))
    unclear = BagSource(both)
    assert unclear.imu_topic == ""
    assert unclear.notes == ["Imu topics /other, /ouster/imu: none is used; choose one with input.imu_topic"]
    assert BagSource(both, InputSettings(imu_topic="/other")).imu_topic == "/other"
    with pytest.raises(UsageError, match=r"no Imu messages on /none; topics: .*/ouster/imu"):
        BagSource(both, InputSettings(imu_topic="/none"))


@pytest.mark.parametrize(
    ("wrong", "reason"),
    [
        ({"rates": (NAN, 0, 0)}, "angular velocity"),
        ({"rates": (0, INF, 0)}, "angular velocity"),
        ({"rates": (0, 0, 1e30)}, "angular velocity"),
        ({"forces": (0, NAN, 9.8)}, "acceleration"),
        ({"forces": (0, 0, 1e9)}, "acceleration"),
        ({"rates_known": False}, "without angular velocities"),
    ],
)
def test_numbers_that_cannot_be_are_rejected(bags: Any, wrong: dict, reason: str) -> None:
    with pytest.raises(MessageError, match=reason):
        decode_imu(imu(bags, 1.0, **wrong))


def test_a_gyroscope_alone_is_enough(bags: Any) -> None:
    """Zeros, as realsense2_camera sends them, are never measured by an accelerometer."""
    for unknown in ({"forces_known": False}, {"forces": (NAN, NAN, NAN)}, {"forces": (0, 0, 0)}):
        rates, forces = decode_imu(imu(bags, 1.0, **unknown))
        np.testing.assert_allclose(rates, [0.1, 0.2, 0.3])
        assert np.isnan(forces).all()


def test_two_imus_on_one_topic_are_not_taken_for_one_that_turns(bags: Any, tmp_path: Path) -> None:
    """Previously, the samples of both were rotated with the mounting of the last one. If the first IMU falls silent,
    the other one is used."""
    first = drive(bags, until=1.2, frame="first")
    other = [(t + 0.005, "/imu", imu(bags, t + 0.005, frame="/other")) for t in 0.9 + 0.01 * np.arange(300)]
    late = [(t, POINTS, bags.cloud(t)) for t in (2.0, 3.0, 3.5)]
    tree = [(0.5, "/tf_static", bags.transform("velo_link", "first", (0, 0, 0)))]
    tree.append((0.5, "/tf_static", bags.transform("velo_link", "other", (0, 0, 0), np.diag([1.0, -1, -1]))))
    source = BagSource(bags.write(tmp_path / "b", sorted([*tree, *first, *other, *late], key=lambda m: m[0])))
    for _ in range(2):  # read again
        upwards = {frame.stamp: frame.imu.forces[:, 2].tolist() for frame in source.frames() if frame.imu is not None}
        assert all(up == pytest.approx(9.8) for stamp, ups in upwards.items() for up in ups if stamp < 2 * SECOND)
        assert upwards[round(3.5 * SECOND)] == pytest.approx([-9.8] * 31)
    left_out = "/imu: 229 samples left out (the first: a message in frame 'other', the previous ones are in 'first': a"
    assert any(note.startswith(left_out) for note in source.notes)


def test_unsound_samples_of_a_bag_are_counted(bags: Any, tmp_path: Path) -> None:
    messages = [quarter(bags), *drive(bags)]
    messages[20:20] = [(messages[20][0], "/imu", imu(bags, 1.0, rates=(NAN, 0, 0)))] * 3
    source = BagSource(bags.write(tmp_path / "b", messages))
    assert all(frame.imu is not None for frame in source.frames())
    (note,) = source.notes
    assert note.startswith("/imu: 3 samples left out (the first: angular velocity [nan, 0.0, 0.0] rad/s")


def test_stamps_that_repeat_go_back_or_flood(bags: Any) -> None:
    """They are left out, unless the time itself has gone back by more than a second, or ahead: then the buffer starts
    anew."""
    buffer = ImuBuffer()
    buffer.add(10 * SECOND, imu(bags, 10))
    for stamp in (10 * SECOND, 9_500_000_000, 10 * SECOND + 100_000):
        with pytest.raises(MessageError, match="ms after the one before"):
            buffer.add(stamp, imu(bags, 10))
    buffer.add(8 * SECOND, imu(bags, 8))
    assert buffer.take(20 * SECOND, 20 * SECOND) is None  # the sample at 8 s is too old, and that at 10 s is deleted
    buffer.add(8 * SECOND + 10**7, imu(bags, 8))
    buffer.add(10**18, imu(bags, 1))
    buffer.add(8 * SECOND + 2 * 10**7, imu(bags, 8))  # an outlier among the stamps costs the samples before it, no more
    found = buffer.take(8 * SECOND, 9 * SECOND)
    assert found.stamps.tolist() == [8 * SECOND + 2 * 10**7]


def test_a_clock_that_is_set_back_by_less_than_a_second_costs_no_sample(bags: Any) -> None:
    """The first three may be late samples. From the fourth on all count, and those from before no longer do."""
    buffer = ImuBuffer()
    for k in range(-50, 1):
        buffer.add(10 * SECOND + k * 10**7, imu(bags, 1))
    for k in range(1, 4):
        with pytest.raises(MessageError, match="ms after the one before"):
            buffer.add(9_500_000_000 + k * 10**7, imu(bags, 2))
    buffer.add(9_540_000_000, imu(bags, 2))
    found = buffer.take(9_540_000_000, 9_600_000_000)
    assert found.stamps.tolist() == [9_500_000_000 + k * 10**7 for k in range(1, 5)]


def test_memory_is_bounded_where_no_cloud_comes(bags: Any) -> None:
    buffer, message = ImuBuffer(), imu(bags, 1)
    for k in range(12_000):
        buffer.add(SECOND + k * 1_000_000, message)
    assert buffer.take(13 * SECOND, 13 * SECOND) is not None
    found = buffer.take(13 * SECOND, 13 * SECOND)
    assert found is None  # taken


def test_a_folder_becomes_a_bag_with_the_same_samples(kitti_folder: Any, tmp_path: Path) -> None:
    folder = kitti_folder()
    rng = np.random.default_rng(0)
    rows = np.c_[np.arange(-10, 50) / 100, rng.normal(size=(60, 3)), rng.normal(0, 9, (60, 3))]
    np.savetxt(folder / "imu.txt", rows, "%.9e")
    assert "left out: no Tr_imu_to_velo" in KittiSource(folder).notes[-1]
    with (folder / "calib.txt").open("a") as file:
        file.write("Tr_imu_to_velo: 0 -1 0 0 1 0 0 0 0 0 1 0\n")
    source = KittiSource(folder)
    assert source.notes == []
    convert(source, tmp_path / "bag")
    bag = BagSource(tmp_path / "bag")
    for ours, theirs in zip(bag.frames(), source.frames(), strict=True):
        np.testing.assert_array_equal(ours.imu.stamps, theirs.imu.stamps + EPOCH_NS)
        np.testing.assert_allclose(ours.imu.rates, theirs.imu.rates, atol=1e-9)
        np.testing.assert_allclose(ours.imu.forces, theirs.imu.forces, atol=1e-9)
    assert KittiSource(folder, InputSettings(imu=False)).imu is None
