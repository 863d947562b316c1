# SPDX-License-Identifier: Apache-2.0
"""Bags: choice of topics, images by time, ground truth, and every kind of damage to files and stamps."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from dpm2_core.data.bags import BagSource
from dpm2_core.data.messages import cloud_fields
from dpm2_core.data.settings import InputSettings
from dpm2_core.data.vertical_angle import HDL64_CORRECTION_DEG
from dpm2_core.errors import UsageError

POINTS, IMAGE, INFO = "/points", "/cam/image_raw", "/cam/camera_info"
Message = tuple[float, str, Any]


def clouds(bags: Any, times: list[float], topic: str = POINTS) -> list[Message]:
    return [(t, topic, bags.cloud(t, x=float(i))) for i, t in enumerate(times)]


def rig(bags: Any) -> list[Message]:
    """Calibration of a camera 0.2 m in front of the LiDAR."""
    return [(1, "/tf_static", bags.transform("velo_link", "cam", (0.2, 0, 0))), (1, INFO, bags.info(1))]


def by_time(messages: list[Message]) -> list[Message]:
    return sorted(messages, key=lambda message: message[0])


def seen(source: BagSource) -> list[int | None]:
    """The gray value of each frame's image."""
    return [int(frame.images[0].pixels[0, 0, 0]) if frame.images else None for frame in source.frames()]


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
    """MCAP has 64 bits for them, of which a stamp has 63."""
    messages = [(5, POINTS, bags.cloud(4.9)), (1.2e10, POINTS, bags.cloud(0))]
    source = BagSource(bags.write(tmp_path / "b", messages))
    assert [frame.stamp for frame in source.frames()] == source.stamps.tolist() == [4_900_000_000, 2**63 - 1]


def test_a_clock_that_was_set_is_told_from_a_pause_by_the_time_of_recording(bags: Any, tmp_path: Path) -> None:
    stamps, recorded = (1, 1.1, 4.1, 4.2, 8.2, 8.3), (1, 1.1, 1.2, 1.3, 5.3, 5.4)
    messages = [(at, POINTS, bags.cloud(stamp)) for at, stamp in zip(recorded, stamps, strict=True)]
    source = BagSource(bags.write(tmp_path / "b", messages))
    assert [frame.stepped for frame in source.frames()] == [False, False, True, False, False, False]


# --- choice of topics


def test_no_point_cloud_lists_the_topics(bags: Any, tmp_path: Path) -> None:
    bag = bags.write(tmp_path / "b", [(1, INFO, bags.info(1))], silent=[("/lidar", "sensor_msgs/msg/PointCloud2")])
    with pytest.raises(
        UsageError, match=r"no PointCloud2 messages; topics: /cam/camera_info \(.*CameraInfo, 1\), /lid"
    ):
        BagSource(bag)
    with pytest.raises(UsageError, match="of a driver's packets make clouds first"):
        BagSource(bag)


def test_two_point_clouds_are_a_question_except_for_kitti(bags: Any, tmp_path: Path) -> None:
    two = clouds(bags, [1, 2], "/a") + clouds(bags, [1, 2, 3], "/b")
    bag = bags.write(tmp_path / "two", two)
    with pytest.raises(UsageError, match=r"several PointCloud2 topics, choose one with input\.points_topic: /a, /b"):
        BagSource(bag)
    assert len(BagSource(bag, InputSettings(points_topic="/b"))) == 3
    with pytest.raises(UsageError, match=r"no PointCloud2 messages on /c; topics: /a"):
        BagSource(bag, InputSettings(points_topic="/c"))
    source = BagSource(bags.write(tmp_path / "kitti", two + clouds(bags, [1], "/kitti/velo/pointcloud")))
    assert len(source) == 1
    assert "/a, /b, /kitti/velo/pointcloud: /kitti/velo/pointcloud was chosen" in source.notes[0]


def test_the_only_camera_is_taken_and_several_are_left(bags: Any, tmp_path: Path) -> None:
    one = [*clouds(bags, [1]), *rig(bags), (1, IMAGE, bags.image(1, 7))]
    assert seen(BagSource(bags.write(tmp_path / "one", one))) == [7]
    assert seen(BagSource(tmp_path / "one", InputSettings(images=False))) == [None]
    two = [*one, (1, "/other/image_raw", bags.image(1, 9)), (1, "/other/camera_info", bags.info(1))]
    source = BagSource(bags.write(tmp_path / "two", two))
    assert seen(source) == [None]
    assert "image topics /cam/image_raw, /other/image_raw: none is used" in source.notes[0]
    assert seen(BagSource(tmp_path / "two", InputSettings(image_topic="/other/image_raw"))) == [9]
    with pytest.raises(UsageError, match="no images on /absent; topics: "):
        BagSource(tmp_path / "two", InputSettings(image_topic="/absent"))


# --- a second LiDAR


def test_clouds_of_a_second_lidar_join_in_the_frame_of_the_first(bags: Any, tmp_path: Path) -> None:
    """It stands 2 m to the left, and is 40 ms late: its points say when they were taken."""
    second = [(t + 0.04, "/second", bags.cloud(t + 0.04, x=10 * t, frame="left")) for t in (1, 1.1, 1.3)]
    tree = (1, "/tf_static", bags.transform("velo_link", "left", (0, 2, 0)))
    bag = bags.write(tmp_path / "b", by_time([*clouds(bags, [1, 1.1, 1.2, 1.3]), *second, tree]))
    settings = InputSettings(points_topic=POINTS, second_points_topic="/second")
    frames = list(BagSource(bag, settings).frames())
    assert [len(frame.points) for frame in frames] == [120, 120, 60, 120]
    for n, frame in enumerate(frames):
        np.testing.assert_allclose(frame.points[:60], [[n, 2, 3, 0.5]] * 60, rtol=1e-6)
    np.testing.assert_allclose(frames[1].points[60:], [[11, 4, 3, 0.5]] * 60, rtol=1e-6)
    assert frames[1].time_offset is not None
    np.testing.assert_allclose(frames[1].time_offset, [0.0] * 60 + [0.04] * 60, atol=1e-6)
    assert frames[2].time_offset is None


def test_missing_returns_of_a_second_lidar_are_no_points_at_its_place(bags: Any, tmp_path: Path) -> None:
    """Drivers send zeros for them, or NaN. Their times go with them."""
    columns = {name: np.full(60, value, np.float32) for name, value in (("x", 5.0), ("y", 2.0), ("z", 3.0))}
    columns["t"] = np.linspace(0, 0.1, 60, dtype=np.float32)
    for name in "xyz":
        columns[name][:20], columns[name][20:30] = 0, np.nan
    fields = cloud_fields(columns, bags.store.types["sensor_msgs/msg/PointField"])
    second = bags.new("sensor_msgs/PointCloud2", header=bags.header(1, "left"), **fields)
    tree = (1, "/tf_static", bags.transform("velo_link", "left", (0, 2, 0)))
    bag = bags.write(tmp_path / "b", [*clouds(bags, [1]), (1, "/second", second), tree])
    (frame,) = BagSource(bag, InputSettings(points_topic=POINTS, second_points_topic="/second")).frames()
    np.testing.assert_allclose(frame.points[60:], [[5, 4, 3, 0]] * 30, rtol=1e-6)
    assert frame.time_offset is not None
    np.testing.assert_allclose(frame.time_offset, [*[0] * 60, *columns["t"][30:]], atol=1e-6)  # float32 of 0.1 s


@pytest.mark.parametrize(("ahead", "missing"), [(0, 0), (0.08, 4), (1000, 4)])
def test_clouds_of_a_second_lidar_that_do_not_fit_are_counted(
    bags: Any, tmp_path: Path, ahead: float, missing: int
) -> None:
    """Too far apart, or stamps of another clock: as of a camera, nothing else says that its points are missing."""
    times = [1, 1.2, 1.4, 1.6]
    second = [(t + 0.01, "/second", bags.cloud(t + ahead, frame="left")) for t in times]
    tree = (1, "/tf_static", bags.transform("velo_link", "left", (0, 2, 0)))
    bag = bags.write(tmp_path / "b", by_time([tree, *clouds(bags, times), *second]))
    source = BagSource(bag, InputSettings(points_topic=POINTS, second_points_topic="/second"))
    assert [len(frame.points) for frame in source.frames()] == [60 if missing else 120] * 4
    said = [note for note in source.notes if "/second" in note]
    assert said == ["4 of 4 frames have no cloud of /second (within 0.05 s)"] * bool(missing)


def test_a_second_lidar_without_a_place_is_left_out(bags: Any, tmp_path: Path) -> None:
    second = [(1.01, "/second", bags.cloud(1.01, frame="left"))]
    bag = bags.write(tmp_path / "b", [*clouds(bags, [1]), *second])
    source = BagSource(bag, InputSettings(points_topic=POINTS, second_points_topic="/second"))
    assert [len(frame.points) for frame in source.frames()] == [60]
    assert "/second: no transform from 'left' to 'velo_link'" in source.notes[0]
    assert "going on without the second LiDAR" in source.notes[0]
    for wrong in ("/third", POINTS):
        with pytest.raises(UsageError, match=rf"second_points_topic: no other point clouds on {wrong}; topics: "):
            BagSource(bag, InputSettings(points_topic=POINTS, second_points_topic=wrong))


# --- a second camera

REAR, REAR_INFO = "/rear/image_raw", "/rear/camera_info"


def of_frame(message: Any, frame: str) -> Any:
    message.header.frame_id = frame
    return message


def rear(bags: Any, times: list[float]) -> list[Message]:
    """A camera 1 m behind the LiDAR; its values are 100 and up."""
    images = [(t, REAR, of_frame(bags.image(t, 100 + n), "rear")) for n, t in enumerate(times)]
    info, place = of_frame(bags.info(1), "rear"), bags.transform("velo_link", "rear", (-1, 0, 0))
    return [(1, REAR_INFO, info), (1, "/tf_static", place), *images]


def all_seen(source: BagSource) -> list[list[int]]:
    """The gray values of each frame's images."""
    return [[int(image.pixels[0, 0, 0]) for image in frame.images] for frame in source.frames()]


TWO = InputSettings(second_image_topic=REAR)


def test_images_of_two_cameras_each_join_the_nearest_cloud(bags: Any, tmp_path: Path) -> None:
    """Out of phase; each misses some clouds, which costs the other nothing. The second alone is one more camera."""
    times = [1.0, 1.1, 1.2, 1.3, 1.4]
    ahead = [(t, IMAGE, bags.image(t, n)) for n, t in enumerate((1.01, 1.11, 1.41))]
    recorded = [*clouds(bags, times), *rig(bags), *ahead, *rear(bags, [0.97, 1.17, 1.27, 1.37])]
    bag = bags.write(tmp_path / "b", by_time(recorded))
    source = BagSource(bag, TWO)
    frames = list(source.frames())
    assert all_seen(source) == [[0, 100], [1], [101], [102], [2, 103]]
    assert [image.camera.T_lidar_cam[0, 3] for image in frames[0].images] == [0.2, -1]
    assert [image.camera.name for image in frames[0].images] == [IMAGE, REAR]
    assert source.camera is not None
    assert source.camera.T_lidar_cam[0, 3] == 0.2
    assert f"2 of 5 frames have no image of {IMAGE} (within 0.05 s)" in source.notes
    assert f"1 of 5 frames have no image of {REAR} (within 0.05 s)" in source.notes
    assert all_seen(BagSource(bag, InputSettings(image_topic=IMAGE))) == [[0], [1], [], [], [2]]
    assert all_seen(BagSource(bag, InputSettings(image_topic=REAR))) == [[100], [], [101], [102], [103]]
    placed = InputSettings(second_image_topic=REAR, T_lidar_cam=(0.5, 0, 0, 0, 0, 0, 1))  # of the first one alone
    (first, *_) = BagSource(bag, placed).frames()
    assert [image.camera.T_lidar_cam[0, 3] for image in first.images] == [0.5, -1]
    alone = bags.write(tmp_path / "alone", by_time([*clouds(bags, times), *rear(bags, times)]))
    assert all_seen(BagSource(alone, TWO)) == [[100 + n] for n in range(5)]


def test_a_second_camera_that_cannot_be_used_is_named(bags: Any, tmp_path: Path) -> None:
    """It was asked for: an error, as of a camera that is; images that cannot be read cost themselves."""
    first = [*clouds(bags, [1, 2]), *rig(bags), (1, IMAGE, bags.image(1, 7)), (2, IMAGE, bags.image(2, 8))]
    second = rear(bags, [1, 2])
    cases: list[tuple[list[Message], str]] = [
        ([], f"input.second_image_topic: no other images on {REAR}; topics: "),
        (second[1:], f"no CameraInfo on {REAR_INFO} for {REAR}"),
        ([second[0], *second[2:]], f"camera {REAR}: no transform from 'rear' to 'velo_link'; .*; publish it on /tf_st"),
        (
            [(1, REAR_INFO, bags.info(1)), *second[1:]],
            f"camera {REAR}: its frame 'cam' is that of {IMAGE}: two cameras",
        ),
    ]
    for n, (messages, problem) in enumerate(cases):
        bag = bags.write(tmp_path / str(n), by_time([*first, *messages]))
        with pytest.raises(UsageError, match=problem):
            BagSource(bag, TWO)
        assert len(BagSource(bag, InputSettings(image_topic=IMAGE))) == 2
    with pytest.raises(UsageError, match=rf"second_image_topic: no other images on {IMAGE}"):
        BagSource(tmp_path / "0", InputSettings(image_topic=IMAGE, second_image_topic=IMAGE))
    assert all_seen(BagSource(tmp_path / "0", InputSettings(images=False, second_image_topic=REAR))) == [[], []]
    odd = of_frame(bags.image(1, 9, encoding="yuv411"), "rear")
    source = BagSource(bags.write(tmp_path / "odd", by_time([*first, *second[:2], (1, REAR, odd), second[3]])), TWO)
    assert all_seen(source) == [[7], [8, 101]]
    assert any(note.startswith(f"{REAR}: image encoding 'yuv411' is not supported") for note in source.notes)


# --- camera


def test_a_missing_extrinsic_is_an_error_never_identity(bags: Any, tmp_path: Path) -> None:
    messages = [*clouds(bags, [1]), (1, INFO, bags.info(1)), (1, IMAGE, bags.image(1, 7)),
                (1, "/tf_static", bags.transform("base_link", "velo_link", (0, 0, 1.7)))]  # fmt: skip
    bag = bags.write(tmp_path / "b", messages)
    with pytest.raises(
        UsageError, match=r"'cam' to 'velo_link'; frames known: base_link, velo_link; set .*T_lidar_cam"
    ):
        BagSource(bag)
    camera = BagSource(bag, InputSettings(T_lidar_cam=(0.1, 0.2, 0.3, 0, 0, 0, 1))).camera
    assert camera is not None
    np.testing.assert_allclose(camera.T_lidar_cam[:3, 3], [0.1, 0.2, 0.3])
    np.testing.assert_allclose(camera.T_lidar_cam[:3, :3], np.eye(3))
    assert BagSource(bag, InputSettings(images=False)).camera is None


def test_the_extrinsic_comes_from_tf_static(bags: Any, tmp_path: Path) -> None:
    messages = [*clouds(bags, [1]), (1, INFO, bags.info(1)), (1, IMAGE, bags.image(1, 7)),
                (1, "/tf_static", bags.transform("base_link", "velo_link", (1, 0, 0))),
                (1, "/tf_static", bags.transform("base_link", "cam", (1.5, 0, 0))),
                (1, "/tf_static", bags.transform("velo_link", "camera_gray_left", (0, 2, 0)))]  # fmt: skip
    source = BagSource(bags.write(tmp_path / "b", messages))
    assert source.camera is not None
    assert source.T_cam_lidar is not None
    np.testing.assert_allclose(source.camera.T_lidar_cam[:3, 3], [0.5, 0, 0])
    np.testing.assert_allclose(source.T_cam_lidar[:3, 3], [0, -2, 0])
    assert (source.camera.size, source.camera.K[0, 0]) == ((8, 6), 5)


def test_without_camera_info_images_are_left_out(bags: Any, tmp_path: Path) -> None:
    bag = bags.write(tmp_path / "b", [*clouds(bags, [1]), (1, IMAGE, bags.image(1))])
    source = BagSource(bag)
    assert seen(source) == [None]
    assert "images of /cam/image_raw are left out: no CameraInfo on /cam/camera_info" in source.notes[0]
    with pytest.raises(UsageError, match="no CameraInfo on /cam/camera_info for /cam/image_raw"):
        BagSource(bag, InputSettings(image_topic=IMAGE))


def test_the_first_camera_info_of_use_counts(bags: Any, tmp_path: Path) -> None:
    """Drivers send zeros before the calibration is there. With zeros alone the drive goes on without images."""
    zeros = bags.info(1)
    zeros.k = np.zeros(9)
    messages = [*clouds(bags, [1]), (0.9, INFO, zeros), (1, IMAGE, bags.image(1, 7))]
    place, info = rig(bags)
    late = bags.write(tmp_path / "late", by_time([*messages, place, info]))
    assert seen(BagSource(late)) == [7]
    never = bags.write(tmp_path / "never", by_time([*messages, place]))
    source = BagSource(never)
    assert seen(source) == [None]
    assert source.notes[0].startswith(f"images of {IMAGE} are left out: {INFO}: CameraInfo has no focal length (the c")
    with pytest.raises(UsageError, match=f"{INFO}: CameraInfo has no focal length .* for {IMAGE}; topics: "):
        BagSource(never, InputSettings(image_topic=IMAGE))


def test_depth_is_no_image(bags: Any, tmp_path: Path) -> None:
    """Alone it needs no place either; beside a camera it leaves no choice open."""
    depth = bags.image(1, 3, encoding="16UC1", size=(16, 6))
    depth.width = 8
    messages = [*clouds(bags, [1]), (1, "/depth/image", depth), (1, "/depth/camera_info", bags.info(1))]
    alone = BagSource(bags.write(tmp_path / "alone", messages))
    assert seen(alone) == [None]
    assert alone.notes[0] == "depth images are not used: /depth/image"
    both = bags.write(tmp_path / "both", [*messages, *rig(bags), (1, IMAGE, bags.image(1, 7))])
    assert seen(BagSource(both)) == [7]
    asked = BagSource(both, InputSettings(image_topic="/depth/image"))
    assert seen(asked) == [None]
    assert "/depth/image: image encoding '16UC1' is not supported" in asked.notes[0]


def test_compressed_images(bags: Any, tmp_path: Path) -> None:
    data = cv2.imencode(".png", np.full((6, 8, 3), 33, np.uint8))[1].reshape(-1)
    compressed = bags.new("sensor_msgs/CompressedImage", header=bags.header(1, "cam"), format="png", data=data)
    messages = [*clouds(bags, [1]), *rig(bags), (1, f"{IMAGE}/compressed", compressed)]
    assert seen(BagSource(bags.write(tmp_path / "b", messages))) == [33]


def test_images_join_the_nearest_cloud(bags: Any, tmp_path: Path) -> None:
    """A camera at 15 Hz, out of phase, recorded up to 0.2 s late: each cloud finds the nearest by stamp."""
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
    """Up to three in a row: more are a clock that was set. An image finds its cloud all the same."""
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


# --- ground truth


@pytest.mark.parametrize("child", ["velo_link", "base_link"])
def test_odometry_is_interpolated_at_the_clouds(bags: Any, tmp_path: Path, child: str) -> None:
    """Also when it is that of another frame, here 1 m behind the LiDAR."""
    messages = [
        *clouds(bags, [1, 1.25, 1.5, 3]),
        (1, "/tf_static", bags.transform("base_link", "velo_link", (1, 0, 0))),
    ]
    messages += [(t, "/truth", bags.odometry(t, x, child)) for t, x in ((1, 10), (1.5, 20), (2, 20))]
    bag = bags.write(tmp_path / "b", by_time(messages))
    assert BagSource(bag).poses is None  # only KITTI's topics are taken for truth unasked
    poses = BagSource(bag, InputSettings(ground_truth_topic="/truth")).poses
    assert poses is not None
    np.testing.assert_allclose(poses[:3, 0, 3], np.array([10, 15, 20]) + (child == "base_link"), atol=1e-9)
    assert np.isnan(poses[3]).all()


def test_a_truth_of_another_time_is_said(bags: Any, tmp_path: Path) -> None:
    """As by a clock that counts leap seconds; a stamp of zero is that of the recording."""
    messages = [*clouds(bags, [1, 1.5]), *((t, "/truth", bags.odometry(t + 37, 0)) for t in (1, 1.5))]
    messages += [(t, "/unstamped", bags.odometry(0, x)) for t, x in ((1, 10), (1.5, 20))]
    bag = bags.write(tmp_path / "b", by_time(messages))
    source = BagSource(bag, InputSettings(ground_truth_topic="/truth"))
    assert source.poses is not None
    assert np.isnan(source.poses).all()
    (note,) = source.notes
    assert note.startswith("/truth: 2 of 2 frames have no pose (poses from 38.000 to 38.500 s, clouds from 1.000")
    unstamped = BagSource(bag, InputSettings(ground_truth_topic="/unstamped")).poses
    assert unstamped is not None
    np.testing.assert_allclose(unstamped[:, 0, 3], [10, 20])


def test_a_path_is_ground_truth(bags: Any, tmp_path: Path) -> None:
    stamped = [bags.new("geometry_msgs/PoseStamped", header=o.header, pose=o.pose.pose)
               for o in (bags.odometry(1, 5.0), bags.odometry(2, 6.0))]  # fmt: skip
    path = bags.new("nav_msgs/Path", header=bags.header(1, "map"), poses=stamped)
    source = BagSource(bags.write(tmp_path / "b", [*clouds(bags, [1, 2]), (1, "/kitti/ground_truth/path", path)]))
    assert source.poses is not None
    np.testing.assert_array_equal(source.poses[:, 0, 3], [5, 6])
    with pytest.raises(UsageError, match="no Odometry or Path messages on /odom"):
        _ = BagSource(tmp_path / "b", InputSettings(ground_truth_topic="/odom")).poses


# --- damaged files


@pytest.fixture
def recording(bags: Any, tmp_path: Path) -> Path:
    """100 clouds of 1000 points, about 16 kB each."""
    messages = [(1 + 0.1 * i, POINTS, bags.cloud(1 + 0.1 * i, i, count=1000)) for i in range(100)]
    return bags.write(tmp_path / "rec", messages)


def mcap(recording: Path) -> Path:
    return recording / f"{recording.name}.mcap"


@pytest.mark.parametrize("bare", [False, True])
def test_a_truncated_mcap_gives_what_is_whole(recording: Path, bare: bool) -> None:
    whole = mcap(recording).read_bytes()
    mcap(recording).write_bytes(whole[: int(0.9 * len(whole))])
    source = BagSource(mcap(recording) if bare else recording)
    frames = list(source.frames())
    assert 60 <= len(frames) == len(source) < 100  # a chunk holds 65 of them
    assert [frame.points[0, 0] for frame in frames] == list(range(len(frames)))
    assert all(frame.problem is None and len(frame.points) == 1000 for frame in frames)
    assert f"truncated or never closed (File end magic is invalid.); {len(frames)} messages" in source.notes[0]


def test_every_cut_is_survived(bags: Any, tmp_path: Path) -> None:
    """Wherever a small file is cut: some frames, all of them good, or one clear error."""
    bag = bags.write(tmp_path / "b", clouds(bags, [1, 2, 3]))
    whole, rejected = mcap(bag).read_bytes(), []
    for size in range(0, len(whole), 97):
        mcap(bag).write_bytes(whole[:size])
        try:
            frames = list(BagSource(bag).frames())
        except UsageError as error:
            rejected.append(str(error))
            continue
        assert len(frames) == 3
        assert all(frame.problem is None for frame in frames)
    assert rejected
    assert all(re.search("file is empty|wrong magic|truncated before", reason) for reason in rejected)


@pytest.mark.parametrize("bare", [False, True])
@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "the file is empty"),
        (b"garbage " * 1000, r"is no MCAP file \(wrong magic bytes\)"),
        (b"\x89MCAP0\r\n", "truncated before its first message"),
        (b"\x89MCAP0\r\n" * 20, "truncated before its first message"),
    ],
)
def test_files_without_anything_to_read(recording: Path, bare: bool, content: bytes, message: str) -> None:
    mcap(recording).write_bytes(content)
    with pytest.raises(UsageError, match=message):
        BagSource(mcap(recording) if bare else recording)


@pytest.mark.parametrize("text", [None, "", "rosbag2_bagfile_information: [", "a: 1"])
def test_without_usable_metadata_the_files_are_read(recording: Path, text: str | None) -> None:
    (recording / "metadata.yaml").unlink()
    if text is not None:
        (recording / "metadata.yaml").write_text(text)
    source = BagSource(recording)
    assert len(list(source.frames())) == 100
    assert ("no metadata.yaml" if text is None else "metadata.yaml is unusable") in source.notes[0]


def test_metadata_without_its_file(recording: Path) -> None:
    mcap(recording).unlink()
    with pytest.raises(UsageError, match=r"no \.mcap or \.db3 file in this folder"):
        BagSource(recording)


@pytest.mark.parametrize("keep", [0, 100, 5000])
def test_a_damaged_sqlite_bag_is_named(bags: Any, tmp_path: Path, keep: int) -> None:
    bag = bags.write(tmp_path / "b", clouds(bags, [1, 2, 3]), "SQLITE3")
    file = bag / "b.db3"
    file.write_bytes(file.read_bytes()[:keep])
    with pytest.raises(UsageError, match=r"b\.db3: (the file is empty|cannot be read as a bag)"):
        BagSource(bag)


def test_bytes_overwritten_in_the_middle_never_crash(recording: Path) -> None:
    """Inside a cloud they change points, elsewhere a record: frames, failed ones, or an end that the notes explain."""
    whole, rng = mcap(recording).read_bytes(), np.random.default_rng(0)
    for place in rng.integers(1000, len(whole) - 6000, 12):
        mcap(recording).write_bytes(whole[:place] + rng.bytes(200) + whole[place + 200 :])
        source = BagSource(recording)
        count = len(list(source.frames()))
        assert count == 100 or any("damaged after" in note for note in source.notes)


def test_a_damaged_chunk_ends_the_drive_and_says_so(bags: Any, tmp_path: Path) -> None:
    """A compressed chunk cannot be read at all once a byte of it is wrong."""
    messages = [(1 + 0.1 * i, POINTS, bags.cloud(1 + 0.1 * i, i, count=1000)) for i in range(100)]
    bag = bags.write(tmp_path / "b", messages, zstd=True)
    whole = mcap(bag).read_bytes()
    second = whole.index(b"\x28\xb5\x2f\xfd", whole.index(b"\x28\xb5\x2f\xfd") + 4)  # where a zstd frame begins
    mcap(bag).write_bytes(whole[:second] + bytes(20) + whole[second + 20 :])
    source = BagSource(bag)
    frames = list(source.frames())
    assert [frame.points[0, 0] for frame in frames] == list(range(len(frames)))
    assert 0 < len(frames) < len(source) == 100
    assert any(f"damaged after {len(frames)} messages of /points" in note for note in source.notes)
