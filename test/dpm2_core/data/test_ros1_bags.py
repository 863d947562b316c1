# SPDX-License-Identifier: Apache-2.0
"""ROS 1 bags, and Livox' CustomMsg in bags of both ROS versions, are read like any other bag."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dpm2_core.data.bag_file import open_bag
from dpm2_core.data.bags import BagSource
from dpm2_core.data.livox import cloud_of_custom, custom_of_ros1
from dpm2_core.data.messages import MessageError, decode_points
from dpm2_core.data.open import open_source
from dpm2_core.errors import UsageError
from test.helpers.livox import custom_message, livox_store

CUSTOM = "livox_ros_driver2/msg/CustomMsg"
POINTS = np.random.default_rng(0).uniform(-20, 20, (50, 3)).astype(np.float32)
SECONDS = np.linspace(0, 0.1, 50)


@pytest.fixture(scope="module")
def ros1(bags: Any, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three clouds, images, calibrations and Livox clouds each, written by rosbags."""
    from rosbags.rosbag1 import Writer
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    path, noetic = tmp_path_factory.mktemp("ros1") / "drive.bag", get_typestore(Stores.ROS1_NOETIC)
    noetic.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", "tf2_msgs/msg/TFMessage"))
    with Writer(path) as writer:
        kinds = {"/points": "PointCloud2", "/cam/image_raw": "Image", "/cam/camera_info": "CameraInfo"}
        connections = {t: writer.add_connection(t, f"sensor_msgs/msg/{k}", typestore=noetic) for t, k in kinds.items()}
        connections["/tf_static"] = writer.add_connection("/tf_static", "tf2_msgs/msg/TFMessage", typestore=noetic)
        livox = writer.add_connection("/livox/lidar", CUSTOM, typestore=livox_store(ros1=True))
        statics = bags.transform("velo_link", "cam", (0.0, 0.0, 0.1))
        writer.write(connections["/tf_static"], 10**9, as_ros1(statics))
        for i in range(3):
            stamp = 1 + 0.1 * i
            sent = {"/cam/image_raw": bags.image(stamp, i), "/cam/camera_info": bags.info(stamp),
                    "/points": bags.cloud(stamp, i)}  # fmt: skip
            for topic, message in sent.items():
                writer.write(connections[topic], round(stamp * 1e9), as_ros1(message))
            raw = custom_message(round(stamp * 1e9), POINTS + i, SECONDS, ros1=True)
            writer.write(livox, round(stamp * 1e9), raw)
    return path


def as_ros1(message: Any) -> bytes:
    """A ROS 2 message, whose header has no sequence number, as ROS 1 serializes it."""
    from rosbags.typesys import Stores, get_typestore

    jazzy = get_typestore(Stores.ROS2_JAZZY)
    return bytes(jazzy.cdr_to_ros1(jazzy.serialize_cdr(message, message.__msgtype__), message.__msgtype__))


def test_clouds_and_images_of_a_ros1_bag(ros1: Path) -> None:
    from dpm2_core.data.settings import InputSettings

    with pytest.raises(UsageError, match=r"several PointCloud2 topics.*/livox/lidar, /points"):
        open_source(ros1)
    source = open_source(ros1, InputSettings(points_topic="/points"))
    assert isinstance(source, BagSource)
    frames = list(source.frames())
    assert len(frames) == len(source) == 3
    assert [frame.stamp for frame in frames] == [1_000_000_000, 1_100_000_000, 1_200_000_000]
    assert [frame.points[0, 0] for frame in frames] == [0, 1, 2]
    assert [frame.images[0].pixels[0, 0, 0] for frame in frames] == [0, 1, 2]
    assert frames[0].images[0].camera.T_lidar_cam[2, 3] == pytest.approx(0.1)
    assert f"{source.points_topic}: no time field: not de-skewed (first at frame 0)" in source.notes


def test_livox_points_of_a_ros1_bag(ros1: Path) -> None:
    from dpm2_core.data.settings import InputSettings

    source = open_source(ros1, InputSettings(points_topic="/livox/lidar", images=False))
    for i, frame in enumerate(source.frames()):
        np.testing.assert_array_equal(frame.points[:, :3], POINTS + i)
        assert frame.time_offset is not None
        np.testing.assert_allclose(frame.time_offset, SECONDS, atol=1e-8)
    assert source.notes == []


@pytest.mark.parametrize("plugin", ["MCAP", "SQLITE3"])
def test_livox_points_of_a_rosbag2(tmp_path: Path, plugin: str) -> None:
    """Without the message's package, and without the definition in the bag."""
    from rosbags.rosbag2 import StoragePlugin, Writer

    with Writer(tmp_path / "b", version=9, storage_plugin=StoragePlugin[plugin]) as writer:
        connection = writer.add_connection("/livox/lidar", CUSTOM, typestore=livox_store())
        for i in range(3):
            writer.write(connection, i, custom_message(10**9 + i * 10**8, POINTS + i, SECONDS))
    source = open_source(tmp_path / "b")
    frames = list(source.frames())
    assert len(frames) == len(source) == 3
    np.testing.assert_array_equal(frames[2].points[:, :3], POINTS + 2)
    np.testing.assert_allclose(frames[2].points[:, 3], np.arange(50) / 255, atol=1e-6)
    np.testing.assert_allclose(frames[2].time_offset, SECONDS, atol=1e-8)


@pytest.mark.parametrize("frame", ["", "a", "livox_frame", "ab" * 20])
@pytest.mark.parametrize("count", [0, 1, 50])
def test_what_ros1_and_ros2_serialize_is_alike(frame: str, count: int) -> None:
    """Whatever the length of the frame's name, which shifts the fields behind it."""
    want = custom_message(10**9, POINTS[:count], SECONDS[:count], frame)
    message = cloud_of_custom(want)
    assert (message.header.frame_id, message.width) == (frame, count)
    np.testing.assert_array_equal(decode_points(message)[0][:, :3], POINTS[:count])
    again = cloud_of_custom(custom_of_ros1(custom_message(10**9, POINTS[:count], SECONDS[:count], frame, ros1=True)))
    np.testing.assert_array_equal(decode_points(again)[0], decode_points(message)[0])
    assert (again.header.frame_id, again.header.stamp.sec) == (frame, 1)


def test_damaged_livox_messages_are_named() -> None:
    whole = custom_message(10**9, POINTS, SECONDS)
    for size in range(len(whole) - 1):
        with pytest.raises(MessageError, match="Livox CustomMsg"):
            cloud_of_custom(whole[:size])
    raw = custom_message(10**9, POINTS, SECONDS, ros1=True)
    endless = raw.replace((50).to_bytes(4, "little"), b"\xff" * 4)
    for damaged in (raw[:-1], raw[:10], b"", endless):
        with pytest.raises(Exception, match=r"."):
            custom_of_ros1(damaged)


def test_damaged_ros1_bags(ros1: Path, tmp_path: Path) -> None:
    """Cut anywhere: one clear line. Overwritten anywhere: frames, failed ones, or an end that the notes explain."""
    from dpm2_core.data.settings import InputSettings

    whole, path, rng = ros1.read_bytes(), tmp_path / "b.bag", np.random.default_rng(0)
    for size in range(0, len(whole), len(whole) // 20):
        path.write_bytes(whole[:size])
        with pytest.raises(UsageError, match=r"b\.bag: (cannot be read as a ROS 1 bag|no PointCloud2)"):
            open_source(path)
    for place in rng.integers(5000, len(whole) - 200, 20):
        path.write_bytes(whole[:place] + rng.bytes(50) + whole[place + 50 :])
        try:
            source = open_source(path, InputSettings(points_topic="/points", images=False))
        except UsageError:
            continue
        count = len(list(source.frames()))
        assert count == len(source) or any("damaged after" in note for note in source.notes)


def test_types_that_are_not_known_are_only_named(ros1: Path) -> None:
    bag = open_bag(ros1)
    assert bag.types["/livox/lidar"] == CUSTOM
    bag.types["/points"] = "my_msgs/msg/Cloud"
    with pytest.raises(MessageError, match="/points"):
        bag.decode("/points", b"12345678")


def test_a_folder_of_split_bags_is_one_recording(bags: Any, tmp_path: Path) -> None:
    """In time order, not by name. A truncated bag is left out, and named."""
    from rosbags.rosbag1 import Writer
    from rosbags.typesys import Stores, get_typestore

    folder = tmp_path / "drive"
    folder.mkdir()
    for part in range(12):
        with Writer(folder / f"drive_{part}.bag") as writer:
            kind = "sensor_msgs/msg/PointCloud2"
            points = writer.add_connection("/points", kind, typestore=get_typestore(Stores.ROS1_NOETIC))
            writer.write(points, 10**9 + part * 10**8, as_ros1(bags.cloud(1 + 0.1 * part, part)))
    source = open_source(folder)
    assert len(source) == 12
    assert [frame.points[0, 0] for frame in source.frames()] == list(range(12))
    assert source.notes[0].startswith(f"{folder}: bags of ROS 1 in one folder are one recording; read drive_0.bag, ")
    last = folder / "drive_11.bag"
    last.write_bytes(last.read_bytes()[:100])
    source = open_source(folder)
    assert [frame.points[0, 0] for frame in source.frames()] == list(range(11))
    assert source.notes[0].startswith(f"{last}: cannot be read as a ROS 1 bag")
