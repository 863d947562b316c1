# SPDX-License-Identifier: Apache-2.0
"""Bags: clouds in order, images by time, and every kind of damage to stamps."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from dpm2_core.data.bags import BagSource
from dpm2_core.data.settings import InputSettings
from dpm2_core.data.vertical_angle import HDL64_CORRECTION_DEG
from dpm2_core.errors import UsageError
from test.helpers.recordings import IMAGE, POINTS, Message, by_time, clouds, rig, seen


@pytest.mark.parametrize("plugin", ["MCAP", "SQLITE3"])
def test_frames_of_both_storages(bags: Any, tmp_path: Path, plugin: str) -> None:
    bag = bags.write(tmp_path / "drive", clouds(bags, [1, 1.1, 1.2, 1.3]), plugin)
    source = BagSource(bag)
    assert (source.name, len(source), source.notes) == ("drive", 4, [])
    frames = list(source.frames())
    assert [frame.points[0, 0] for frame in frames] == [0, 1, 2, 3]
    assert [(frame.index, frame.stamp) for frame in frames] == [(i, 10**9 + i * 10**8) for i in range(4)]
    assert [frame.index for frame in source.frames(1, 3)] == [1, 2]
    assert source.poses is None
    assert source.T_cam_lidar is None


def test_stamps_are_the_headers_else_those_of_recording(bags: Any, tmp_path: Path) -> None:
    messages = [(5, POINTS, bags.cloud(4.9)), (6, POINTS, bags.cloud(0))]
    source = BagSource(bags.write(tmp_path / "b", messages))
    assert [frame.stamp for frame in source.frames()] == source.stamps.tolist() == [4_900_000_000, 6_000_000_000]


def test_times_of_recording_that_no_clock_shows(bags: Any, tmp_path: Path) -> None:
    """MCAP stores them with 64 bits, a stamp has 63."""
    messages = [(5, POINTS, bags.cloud(4.9)), (1.2e10, POINTS, bags.cloud(0))]
    source = BagSource(bags.write(tmp_path / "b", messages))
    assert [frame.stamp for frame in source.frames()] == source.stamps.tolist() == [4_900_000_000, 2**63 - 1]


def test_a_clock_that_was_set_is_told_from_a_pause_by_the_time_of_recording(bags: Any, tmp_path: Path) -> None:
    stamps, recorded = (1, 1.1, 4.1, 4.2, 8.2, 8.3), (1, 1.1, 1.2, 1.3, 5.3, 5.4)
    messages = [(at, POINTS, bags.cloud(stamp)) for at, stamp in zip(recorded, stamps, strict=True)]
    source = BagSource(bags.write(tmp_path / "b", messages))
    assert [frame.stepped for frame in source.frames()] == [False, False, True, False, False, False]


@pytest.mark.parametrize(
    ("recorded", "stepped"), [((1.2, 1.3, 1.4), True), ((1.8, 1.9, 2.0), False), ((1.11, 1.2, 1.3), False)]
)
def test_a_clock_that_was_set_ahead_by_less_than_a_second_is_no_pause(
    bags: Any, tmp_path: Path, recorded: tuple[float, ...], stepped: bool
) -> None:
    """This is so if the cloud was recorded when it was due: neither after a pause, nor together with clouds that were
    held back before it."""
    times = zip((1.0, 1.1, *recorded), (1.0, 1.1, 1.8, 1.9, 2.0), strict=True)
    source = BagSource(bags.write(tmp_path / "b", [(at, POINTS, bags.cloud(stamp)) for at, stamp in times]))
    assert [frame.stepped for frame in source.frames()] == [False, False, stepped, False, False]


def test_compressed_images(bags: Any, tmp_path: Path) -> None:
    data = cv2.imencode(".png", np.full((6, 8, 3), 33, np.uint8))[1].reshape(-1)
    compressed = bags.new("sensor_msgs/CompressedImage", header=bags.header(1, "cam"), format="png", data=data)
    messages = [*clouds(bags, [1]), *rig(bags), (1, f"{IMAGE}/compressed", compressed)]
    assert seen(BagSource(bags.write(tmp_path / "b", messages))) == [33]


def test_images_join_the_nearest_cloud(bags: Any, tmp_path: Path) -> None:
    """A camera at 15 Hz, out of phase, recorded up to 0.2 s late: each cloud receives the nearest image by stamp."""
    times = [round(1 + 0.1 * i, 3) for i in range(10)]
    shots = [round(0.99 + i / 15, 3) for i in range(16)]
    late = np.random.default_rng(0).uniform(0, 0.2, len(shots))
    images = [(t + wait, IMAGE, bags.image(t, i)) for i, (t, wait) in enumerate(zip(shots, np.sort(late), strict=True))]
    bag = bags.write(tmp_path / "b", by_time([*clouds(bags, times), *rig(bags), *images]))
    want = [int(np.argmin(np.abs(np.array(shots) - t))) for t in times]
    assert seen(BagSource(bag)) == want
    # A camera whose clock is 66.7 ms behind: the next image is the right one.
    shifted = seen(BagSource(bag, InputSettings(image_time_offset=-1 / 15)))
    assert shifted[:-1] == [i + 1 for i in want[:-1]]


def test_a_camera_that_never_comes(bags: Any, tmp_path: Path) -> None:
    silent = [(IMAGE, "sensor_msgs/msg/Image")]
    source = BagSource(bags.write(tmp_path / "b", [*clouds(bags, [1, 2]), *rig(bags)], silent=silent))
    assert seen(source) == [None, None]
    assert "no message on the image topic /cam/image_raw" in source.notes[0]


@pytest.mark.parametrize(("shots", "want"), [([0, 1, 2], [0, 1, 2, None, None, None]), ([4, 5], [None] * 4 + [4, 5])])
def test_a_camera_that_stops_or_starts_late(bags: Any, tmp_path: Path, shots: list[int], want: list[int]) -> None:
    times = [1 + 0.4 * i for i in range(6)]
    images = [(times[i] + 0.01, IMAGE, bags.image(times[i] + 0.01, i)) for i in shots]
    source = BagSource(bags.write(tmp_path / "b", by_time([*clouds(bags, times), *rig(bags), *images])))
    assert seen(source) == want
    assert f"{6 - len(shots)} of 6 frames have no image of /cam/image_raw (within 0.05 s)" in source.notes


def test_images_that_do_not_fit_are_not_missing(bags: Any, tmp_path: Path) -> None:
    """For example from a camera that was switched to another size: they exist, and are within the tolerance."""
    times = [1 + 0.1 * i for i in range(6)]
    images = [(t, IMAGE, bags.image(t, i, size=(4, 3) if i > 1 else (8, 6))) for i, t in enumerate(times[:5])]
    source = BagSource(bags.write(tmp_path / "b", by_time([*clouds(bags, times), *rig(bags), *images])))
    assert seen(source) == [0, 1, None, None, None, None]
    assert f"{IMAGE}: image of (3, 4, 3), calibration for (6, 8); images are left out" in source.notes
    assert f"4 of 6 frames have no image of {IMAGE} (within 0.05 s; 3 have an unusable one)" in source.notes


@pytest.mark.parametrize(
    ("change", "message"),
    [({"encoding": "yuv411"}, "encoding 'yuv411' is not supported"), ({"size": (9, 6)}, r"image of \(6, 9, 3\)")],
)
def test_images_that_cannot_be_used_cost_the_image_alone(
    bags: Any, tmp_path: Path, change: dict[str, Any], message: str
) -> None:
    images = [(1, IMAGE, bags.image(1, 1)), (2, IMAGE, bags.image(2, 2, **change)), (3, IMAGE, bags.image(3, 3))]
    bag = bags.write(tmp_path / "b", by_time([*clouds(bags, [1, 2, 3]), *rig(bags), *images]))
    source = BagSource(bag)
    assert seen(source) == [1, None, 3]
    assert any(np.char.find(note, message.replace("\\", "")) >= 0 for note in source.notes)


# --- points


def test_vertical_angle_correction_is_what_the_recording_says(bags: Any, tmp_path: Path) -> None:
    topic = "/kitti/velo/pointcloud"
    texts = (1, "/kitti/vertical_angle_correction_deg", bags.new("std_msgs/Float64", data=0.0))
    kitti = bags.write(tmp_path / "kitti", clouds(bags, [1], topic))
    simulated = bags.write(tmp_path / "sim", [*clouds(bags, [1], topic), texts])
    other = bags.write(tmp_path / "other", clouds(bags, [1]))
    assert BagSource(kitti).vertical_angle_correction_deg == HDL64_CORRECTION_DEG
    assert BagSource(simulated).vertical_angle_correction_deg == 0
    assert BagSource(other).vertical_angle_correction_deg == 0
    assert BagSource(other, InputSettings(vertical_angle_correction_deg=0.3)).vertical_angle_correction_deg == 0.3
    absurd = (1, "/kitti/vertical_angle_correction_deg", bags.new("std_msgs/Float64", data=90.0))
    with pytest.raises(UsageError, match=r"_deg: want a vertical angle correction of -5 to 5 degrees, got 90"):
        BagSource(bags.write(tmp_path / "absurd", [*clouds(bags, [1]), absurd]))
    raw, corrected = (next(BagSource(path).frames()).points for path in (simulated, kitti))
    assert corrected[0, 2] - raw[0, 2] == pytest.approx(np.hypot(raw[0, 0], raw[0, 1]) * np.radians(0.205), rel=5e-3)


def test_clouds_that_cannot_be_decoded_cost_their_frame_alone(bags: Any, tmp_path: Path) -> None:
    whole = bytes(bags.store.serialize_cdr(bags.cloud(1.1, 1), "sensor_msgs/msg/PointCloud2"))
    short = bags.cloud(1.2)
    short.width += 1
    messages = [(1, POINTS, bags.cloud(1, 0)), (1.1, POINTS, whole[: len(whole) // 2]), (1.2, POINTS, short),
                (1.25, POINTS, b""), (1.3, POINTS, bags.cloud(1.3, 4))]  # fmt: skip
    frames = list(BagSource(bags.write(tmp_path / "b", messages)).frames())
    assert [frame.problem is None for frame in frames] == [True, False, False, False, True]
    assert "is damaged" in str(frames[1].problem)
    assert "declared" in str(frames[2].problem)
    assert frames[4].points[0, 0] == 4


@pytest.mark.parametrize("count", [0, 50])
def test_an_empty_and_a_small_cloud_among_good_ones(bags: Any, tmp_path: Path, count: int) -> None:
    messages = [(1, POINTS, bags.cloud(1)), (2, POINTS, bags.cloud(2, count=count)), (3, POINTS, bags.cloud(3))]
    frames = list(BagSource(bags.write(tmp_path / "b", messages)).frames())
    assert [len(frame.points) for frame in frames] == [60, count, 60]
    assert all(frame.problem is None for frame in frames)


# --- stamps


@pytest.mark.parametrize(
    ("stamps", "where"),
    [([1, 1.1, 1.1, 1.2], "frame 2: +0.000 s"), ([1, 1.1, 1.2, 1, 1.1], "frame 3: -0.200 s"), ([1, 1, 1], "frame 1")],
)
def test_stamps_that_repeat_jump_back_or_stop_lose_no_frame(
    bags: Any, tmp_path: Path, stamps: list[float], where: str
) -> None:
    messages = [(10 + 0.1 * i, POINTS, bags.cloud(t)) for i, t in enumerate(stamps)]
    source = BagSource(bags.write(tmp_path / "b", messages))
    assert [frame.stamp * 1e-9 for frame in source.frames()] == pytest.approx(stamps)
    assert where in "".join(source.notes)


@pytest.mark.parametrize("off", [-0.4, 0.4, 1, 60, -60])
@pytest.mark.parametrize("count", [1, 3, 4])
def test_stamps_that_are_off_are_put_between_their_neighbors(bags: Any, tmp_path: Path, off: float, count: int) -> None:
    """Up to three in a row: more are a clock that was set. Images are still associated with their clouds."""
    true = 10 + 0.1 * np.arange(20)
    stamps = true + off * ((np.arange(20) >= 8) & (np.arange(20) < 8 + count))
    messages: list[Message] = rig(bags)
    for i, (now, stamp) in enumerate(zip(true, stamps, strict=True)):
        messages += [(now, IMAGE, bags.image(now, i)), (now, POINTS, bags.cloud(stamp))]
    source = BagSource(bags.write(tmp_path / "b", messages))
    found = [frame.stamp * 1e-9 for frame in source.frames()]
    assert found == pytest.approx(source.stamps * 1e-9)
    corrected = [note for note in source.notes if "not between their neighbors" in note]
    if count <= 3:
        assert found == pytest.approx(true)
        assert seen(source) == [*range(20)]
        assert [f"frame 8: {stamps[8]:.3f} s" in note for note in corrected] == [True]
    elif abs(off) > 0.4:
        assert found == pytest.approx(stamps)
        assert not corrected


def test_a_looped_bag_keeps_its_images(bags: Any, tmp_path: Path) -> None:
    messages: list[Message] = rig(bags)
    for turn in range(2):
        for i in range(8):
            now, stamp = 10 + turn + 0.1 * i, 10 + 0.1 * i
            messages += [(now, IMAGE, bags.image(stamp, i)), (now, POINTS, bags.cloud(stamp))]
    assert seen(BagSource(bags.write(tmp_path / "b", messages))) == [*range(8), *range(8)]
