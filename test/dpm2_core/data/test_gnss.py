# SPDX-License-Identifier: Apache-2.0
"""Fixes of bags and hostile publishers: each is associated with the next scan, with covariance and antenna, or left out
and counted."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dpm2_core.data.bags import BagSource
from dpm2_core.data.convert import EPOCH_NS, convert
from dpm2_core.data.frames import Calibration, FrameBuilder
from dpm2_core.data.gnss import FixBuffer, decode_fix
from dpm2_core.data.kitti import KittiSource
from dpm2_core.data.messages import MessageError
from dpm2_core.data.naming import FIX, POINTS
from dpm2_core.data.settings import InputSettings
from dpm2_core.errors import UsageError

SECOND = 10**9
NAN, INF = float("nan"), float("inf")
COVARIANCE = (4.0, 0, 0, 0, 4, 0, 0, 0, 16)


def nav(bags: Any, stamp: float, place: tuple = (49.0, 8.4, 110.0), **other: Any) -> Any:
    """A NavSatFix message; `other`: status, covariance, kind, frame."""
    return bags.new(
        "sensor_msgs/NavSatFix",
        header=bags.header(stamp, other.get("frame", "gnss")),
        status=bags.new("sensor_msgs/NavSatStatus", status=other.get("status", 0), service=1),
        latitude=float(place[0]),
        longitude=float(place[1]),
        altitude=float(place[2]),
        position_covariance=np.array(other.get("covariance", COVARIANCE), np.float64),
        position_covariance_type=other.get("kind", 3),
    )


def drive(bags: Any, **other: Any) -> list[tuple[float, str, Any]]:
    """Clouds at 1.0 to 1.9 s; fixes at 1.05 and 1.35 s, which arrive 0.12 s late."""
    clouds = [(1 + 0.1 * i, POINTS, bags.cloud(1 + 0.1 * i)) for i in range(10)]
    fixes = [(t + 0.12, "/fix", nav(bags, t, (49.0, 8.4 + t, 110.0), **other)) for t in (1.05, 1.35)]
    return sorted([*clouds, *fixes], key=lambda m: m[0])


def test_a_cloud_has_the_fix_that_came_before_it(bags: Any, tmp_path: Path) -> None:
    place = (0.5, "/tf_static", bags.transform("velo_link", "gnss", (0.3, 0.2, 1.0)))
    path = bags.write(tmp_path / "b", [place, *drive(bags)])
    source = BagSource(path, InputSettings(gnss_topic="/fix"))
    fixes = {frame.index: frame.fix for frame in source.frames() if frame.fix is not None}
    assert source.notes == []
    assert list(fixes) == [2, 5]
    assert fixes[2].stamp == round(1.05 * SECOND)
    np.testing.assert_allclose(fixes[2].geodetic, [49.0, 9.45, 110.0])
    np.testing.assert_allclose(fixes[2].antenna, [0.3, 0.2, 1.0])
    np.testing.assert_allclose(np.diag(fixes[2].covariance), [4, 4, 16], atol=1e-3)
    assert [frame.fix is not None for frame in source.frames()].count(True) == 2  # read again
    assert all(frame.fix is None for frame in BagSource(path).frames())  # GNSS is off


@pytest.mark.parametrize("ahead", [18, -18])
def test_fixes_of_another_clock_are_said(bags: Any, tmp_path: Path, ahead: int) -> None:
    """For example from a receiver whose clock differs from all others by the leap seconds."""
    messages = [*drive(bags), *((t, "/other", nav(bags, t + ahead, frame="velo_link")) for t in (1.05, 1.35))]
    path = bags.write(tmp_path / "b", sorted(messages, key=lambda m: m[0]))
    source = BagSource(path, InputSettings(gnss_topic="/other"))
    assert len(list(source.frames())) == 10
    assert source.notes == ["10 of 10 frames have no fix of /other (within 1 s)"]


def test_an_antenna_without_a_place_is_at_the_lidar_and_said(bags: Any, tmp_path: Path) -> None:
    source = BagSource(bags.write(tmp_path / "b", drive(bags)), InputSettings(gnss_topic="/fix"))
    fixes = [frame.fix for frame in source.frames() if frame.fix is not None]
    assert len(fixes) == 2
    assert not fixes[0].antenna.any()
    (note,) = source.notes
    assert note.startswith("/fix: no transform from 'gnss' to 'velo_link'")
    assert note.endswith("; the antenna is assumed to be at the LiDAR")
    own = BagSource(bags.write(tmp_path / "own", drive(bags, frame="velo_link")), InputSettings(gnss_topic="/fix"))
    assert sum(frame.fix is not None for frame in own.frames()) == 2
    assert own.notes == []


def test_the_antenna_of_a_fix_is_not_that_of_another_receiver(bags: Any, tmp_path: Path) -> None:
    """Two receivers on one topic, 6 m apart. Previously, the fixes of one had the antenna of the other, and the map had
    another heading."""
    place = {"gnss": (3, 0, 0), "rear": (-3, 0, 0)}
    tree = [(0.5, "/tf_static", bags.transform("velo_link", frame, xyz)) for frame, xyz in place.items()]
    rear = [(t + 0.01, topic, nav(bags, t - 0.12, frame="rear")) for t, topic, _ in drive(bags) if topic == "/fix"]
    messages = sorted([*tree, *drive(bags), *rear], key=lambda m: m[0])
    source = BagSource(bags.write(tmp_path / "b", messages), InputSettings(gnss_topic="/fix"))
    fixes = [frame.fix for frame in source.frames() if frame.fix is not None]
    assert [fix.antenna.tolist() for fix in fixes] == [[3, 0, 0]] * 2
    problem = "a message in frame 'rear', the previous ones are in 'gnss': a topic has one sensor"
    assert source.notes == [f"/fix: 2 samples left out (the first: {problem})"]


def test_an_antenna_without_a_place_is_known_until_it_has_one(bags: Any) -> None:
    """Previously, clouds without a fix of their own, nine of ten, cleared the problem: /diagnostics mostly reported "in
    use"."""
    fixes, calibration, said = FixBuffer(), Calibration(POINTS, gnss_topic="/fix"), list[str]()
    builder = FrameBuilder(InputSettings(gnss_topic="/fix"), calibration, said.append, gnss=fixes)
    known = []
    for i in range(30):  # 10 Hz clouds, 1 Hz fixes; /tf_static arrives before the last of these
        stamp = SECOND + i * SECOND // 10
        if i % 10 == 0:
            fixes.add(stamp, nav(bags, stamp / SECOND))
        if i == 20:
            calibration.transforms.add(bags.transform("velo_link", "gnss", (0.3, 0.2, 1.0)))
        builder.frame(stamp, bags.cloud(stamp / SECOND), i)
        known.append("no transform from 'gnss'" in builder.problems.get("/fix", ""))
    assert known == [True] * 20 + [False] * 10
    assert len(said) == 1


def test_a_topic_that_is_not_there(bags: Any, tmp_path: Path) -> None:
    path = bags.write(tmp_path / "b", drive(bags))
    for topic in ("/none", POINTS):
        with pytest.raises(UsageError, match=f"no NavSatFix messages on {topic}; topics: .*/fix"):
            BagSource(path, InputSettings(gnss_topic=topic))


def test_what_is_not_known(bags: Any) -> None:
    """No fix returns None. Without a covariance, that of a plain receiver is assumed. Without an altitude, the height
    has no weight.

    Previously, a variance of 0 along one axis alone was taken for 1 cm. A receiver that states none of its heights lost
    104 of 120 fixes to it, and one that sends altitude 0 flattened the map.
    """
    assert decode_fix(nav(bags, 1.0, (NAN, NAN, NAN), status=-1), SECOND) is None
    assert decode_fix(nav(bags, 1.0, status=-2), SECOND) is not None  # a driver that does not set the status
    for assumed in ({"kind": 0}, {"covariance": np.zeros(9)}):
        fix = decode_fix(nav(bags, 1.0, **assumed), SECOND)
        np.testing.assert_allclose(np.diag(fix.covariance), [25, 25, 100], atol=1e-3)
    of_axes = (((4, 1, 1, 1, 4, 1, 1, 1, 0), (4, 4, 100)), ((0, 0, 0, 0, 0, 0, 0, 0, 16), (25, 25, 16)))
    for covariance, variances in of_axes:
        fix = decode_fix(nav(bags, 1.0, covariance=covariance), SECOND)
        np.testing.assert_allclose(np.diag(fix.covariance), variances, atol=1e-3)  # 1 cm is added
        assert not fix.covariance[2, :2].any()
    flat = decode_fix(nav(bags, 1.0, (49.0, 8.4, NAN), covariance=(4, 0, 1, 0, 4, 0, 1, 0, NAN)), SECOND)
    np.testing.assert_allclose(flat.covariance, np.diag([4, 4, 1e8]), atol=1e-3)
    np.testing.assert_array_equal(flat.geodetic, [49.0, 8.4, 0.0])


@pytest.mark.parametrize(
    ("wrong", "reason"),
    [
        ({"place": (NAN, 8.4, 110)}, "no place on Earth"),
        ({"place": (91.0, 8.4, 110)}, "no place on Earth"),
        ({"place": (49.0, 1e300, 110)}, "no place on Earth"),
        ({"place": (49.0, 8.4, INF)}, "no place on Earth"),
        ({"place": (0.0, 0.0, 0.0)}, "before they have a fix"),
        ({"covariance": (NAN, *COVARIANCE[1:])}, "no covariance"),
        ({"covariance": (-4.0, *COVARIANCE[1:])}, "no covariance"),
        ({"covariance": (4.0, 3, *COVARIANCE[2:])}, "no covariance"),
        ({"covariance": (1e300, *COVARIANCE[1:])}, "no covariance"),
    ],
)
def test_what_cannot_be_is_left_out_and_counted(bags: Any, tmp_path: Path, wrong: dict, reason: str) -> None:
    with pytest.raises(MessageError, match=reason):
        decode_fix(nav(bags, 1.0, **wrong), SECOND)
    messages = drive(bags, frame="velo_link")
    messages[4:4] = [(messages[4][0], "/fix", nav(bags, 1.2, frame="velo_link", **wrong))] * 3
    source = BagSource(bags.write(tmp_path / "b", messages), InputSettings(gnss_topic="/fix"))
    assert sum(frame.fix is not None for frame in source.frames()) == 2
    (note,) = source.notes
    assert note.startswith("/fix: 3 samples left out (the first: ")
    assert reason in note


def test_a_flood_and_stamps_of_the_future_do_no_harm(bags: Any) -> None:
    buffer = FixBuffer()
    buffer.add(10**18, nav(bags, 1.0))
    message = nav(bags, 1.0)
    for k in range(500):
        buffer.add(SECOND + k, message)
    fix = buffer.take(2 * SECOND)
    assert fix.stamp == SECOND + 499
    assert buffer.take(2 * SECOND) is None
    buffer.add(5 * SECOND // 2, message)
    assert buffer.take(2 * SECOND) is None  # not for this scan yet
    assert buffer.take(3 * SECOND) is not None


def test_a_fast_receiver_does_not_push_out_what_a_waiting_cloud_needs(bags: Any) -> None:
    """Previously, at 100 Hz a cloud that was processed 1 s late, as on a busy machine, found no fix. It may be 30
    clouds late."""
    buffer, message = FixBuffer(), nav(bags, 1.0)
    for k in range(400):
        buffer.add(SECOND + k * SECOND // 100, message)
    fix = buffer.take(2 * SECOND)
    assert fix is not None
    assert fix.stamp == 2 * SECOND


def test_a_folder_becomes_a_bag_with_the_same_fixes(kitti_folder: Any, tmp_path: Path) -> None:
    folder = kitti_folder()
    rows = [(t, 49 + t, 8.4, 110.0, 1.0, 2.0, 3.0) for t in (0.05, 0.12, 0.18, 0.33)]  # two of them before one scan
    np.savetxt(folder / "gnss.txt", rows, "%.12e")
    assert "gnss.txt: the antenna is assumed to be at the LiDAR" in KittiSource(folder).notes[-1]
    with (folder / "calib.txt").open("a") as file:
        file.write("Tr_gnss_to_velo: 1 0 0 0.3 0 1 0 0.2 0 0 1 1\n")
    source = KittiSource(folder)
    assert source.notes == []
    convert(source, tmp_path / "bag")
    bag = BagSource(tmp_path / "bag", InputSettings(gnss_topic=FIX))
    taken = {}
    for ours, theirs in zip(bag.frames(), source.frames(), strict=True):
        assert (ours.fix is None) == (theirs.fix is None)
        if ours.fix is not None and theirs.fix is not None:
            taken[ours.index] = theirs.fix.geodetic[0]
            assert ours.fix.stamp == theirs.fix.stamp + EPOCH_NS
            np.testing.assert_array_equal(ours.fix.geodetic, theirs.fix.geodetic)
            np.testing.assert_array_equal(ours.fix.antenna, [0.3, 0.2, 1.0])
            np.testing.assert_allclose(ours.fix.covariance, np.diag([1.0, 4, 9]), atol=1e-3)
    assert taken == {1: 49.05, 2: 49.18, 4: 49.33}
