# SPDX-License-Identifier: Apache-2.0
"""Which topics of a bag are read: clouds, cameras, their poses, and ground truth."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from dpm2_core.data.bags import BagSource
from dpm2_core.data.settings import InputSettings
from dpm2_core.errors import UsageError
from test.helpers.recordings import IMAGE, INFO, by_time, clouds, rig, seen

# --- choice of topics


def test_no_point_cloud_lists_the_topics(bags: Any, tmp_path: Path) -> None:
    bag = bags.write(tmp_path / "b", [(1, INFO, bags.info(1))], silent=[("/lidar", "sensor_msgs/msg/PointCloud2")])
    with pytest.raises(
        UsageError, match=r"no PointCloud2 messages; topics: /cam/camera_info \(.*CameraInfo, 1\), /lid"
    ):
        BagSource(bag)
    with pytest.raises(UsageError, match="convert a driver's packets to clouds first"):
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


def test_what_is_compressed_beside_the_raw_images_is_no_second_camera(bags: Any, tmp_path: Path) -> None:
    """image_transport publishes it, and `ros2 bag record -a` records it. Previously, no camera was used then."""
    jpeg = cv2.imencode(".jpg", np.full((6, 8), 9, np.uint8))[1].ravel()
    packed = bags.new("sensor_msgs/CompressedImage", header=bags.header(1, "cam"), format="jpeg", data=jpeg)
    sent = [*clouds(bags, [1]), *rig(bags), (1, IMAGE, bags.image(1, 7)), (1, f"{IMAGE}/compressed", packed)]
    bag = bags.write(tmp_path / "b", sent)
    source = BagSource(bag)
    assert seen(source) == [7]
    assert not any("image topics" in note for note in source.notes)
    assert seen(BagSource(bag, InputSettings(image_topic=f"{IMAGE}/compressed"))) == [9]


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
    np.testing.assert_allclose(camera.T_lidar_cam[:3, 3], [0.1, 0.2, 0.3])
    np.testing.assert_allclose(camera.T_lidar_cam[:3, :3], np.eye(3))
    assert BagSource(bag, InputSettings(images=False)).camera is None


def test_the_extrinsic_comes_from_tf_static(bags: Any, tmp_path: Path) -> None:
    messages = [*clouds(bags, [1]), (1, INFO, bags.info(1)), (1, IMAGE, bags.image(1, 7)),
                (1, "/tf_static", bags.transform("base_link", "velo_link", (1, 0, 0))),
                (1, "/tf_static", bags.transform("base_link", "cam", (1.5, 0, 0))),
                (1, "/tf_static", bags.transform("velo_link", "camera_gray_left", (0, 2, 0)))]  # fmt: skip
    source = BagSource(bags.write(tmp_path / "b", messages))
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
    """Drivers send zeros before the calibration is available. With only zeros, the drive continues without images."""
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
    """Alone, it needs no extrinsics either. Next to a camera, it does not make the choice ambiguous."""
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


# --- ground truth


@pytest.mark.parametrize("child", ["velo_link", "base_link"])
def test_odometry_is_interpolated_at_the_clouds(bags: Any, tmp_path: Path, child: str) -> None:
    """Also if it is that of another frame, here 1 m behind the LiDAR."""
    messages = [
        *clouds(bags, [1, 1.25, 1.5, 3]),
        (1, "/tf_static", bags.transform("base_link", "velo_link", (1, 0, 0))),
    ]
    messages += [(t, "/truth", bags.odometry(t, x, child)) for t, x in ((1, 10), (1.5, 20), (2, 20))]
    bag = bags.write(tmp_path / "b", by_time(messages))
    assert BagSource(bag).poses is None  # by default, only KITTI's topics are used as ground truth
    poses = BagSource(bag, InputSettings(ground_truth_topic="/truth")).poses
    np.testing.assert_allclose(poses[:3, 0, 3], np.array([10, 15, 20]) + (child == "base_link"), atol=1e-9)
    assert np.isnan(poses[3]).all()


@pytest.mark.parametrize(("child", "lidar"), [("/velo_link", "velo_link"), ("velo_link", "/velo_link")])
def test_a_truth_of_the_lidar_with_a_leading_slash(bags: Any, tmp_path: Path, child: str, lidar: str) -> None:
    truth = [(t, "/ground_truth/odom", bags.odometry(t, t, child)) for t in (1, 2)]
    messages = [*((t, "/points", bags.cloud(t, frame=lidar)) for t in (1, 2)), *truth]
    poses = BagSource(bags.write(tmp_path / "b", messages)).poses
    assert poses[:, 0, 3].tolist() == [1, 2]


def test_a_truth_whose_frame_is_not_connected_is_left_out_or_named(bags: Any, tmp_path: Path) -> None:
    """A note if the topic was found, an error that names it if it was requested."""
    topic = "/ground_truth/odom"
    bag = bags.write(tmp_path / "b", [*clouds(bags, [1]), (1, topic, bags.odometry(1, 0, "body"))])
    source = BagSource(bag)
    assert source.poses is None
    assert source.notes == [
        f"{topic} is not used as ground truth (no transform from 'velo_link' to 'body'; frames known: none)"
    ]
    with pytest.raises(UsageError, match=f"{bag}: {topic}: no transform from 'velo_link' to 'body'"):
        _ = BagSource(bag, InputSettings(ground_truth_topic=topic)).poses


def test_a_truth_of_another_time_is_said(bags: Any, tmp_path: Path) -> None:
    """For example from a clock that counts leap seconds. A zero stamp is replaced by the time of recording."""
    messages = [*clouds(bags, [1, 1.5]), *((t, "/truth", bags.odometry(t + 37, 0)) for t in (1, 1.5))]
    messages += [(t, "/unstamped", bags.odometry(0, x)) for t, x in ((1, 10), (1.5, 20))]
    bag = bags.write(tmp_path / "b", by_time(messages))
    source = BagSource(bag, InputSettings(ground_truth_topic="/truth"))
    assert source.poses is not None
    assert np.isnan(source.poses).all()
    (note,) = source.notes
    assert note.startswith("/truth: 2 of 2 frames have no pose (poses from 38.000 to 38.500 s, clouds from 1.000")
    unstamped = BagSource(bag, InputSettings(ground_truth_topic="/unstamped")).poses
    np.testing.assert_allclose(unstamped[:, 0, 3], [10, 20])


@pytest.mark.parametrize(("damaged", "why"), [(False, "no rigid transform"), (True, "is damaged")])
def test_an_invalid_true_pose_costs_itself(bags: Any, tmp_path: Path, damaged: bool, why: str) -> None:
    """A cloud at this time receives the pose interpolated between its neighbors."""
    truth = [bags.odometry(1 + 0.5 * i, x) for i, x in enumerate((0.0, 99.0, 10.0))]
    if damaged:
        truth[1].header.frame_id = "no text"
    else:
        truth[1].pose.pose.orientation.w = 0.0
    sent = [(1 + 0.5 * i, "/ground_truth/odom", message) for i, message in enumerate(truth)]
    file = bags.write(tmp_path / "b", by_time([*clouds(bags, [1, 1.5, 2]), *sent])) / "b.mcap"
    file.write_bytes(file.read_bytes().replace(b"no text", b"\xff" * 7))
    source = BagSource(file)
    np.testing.assert_allclose(source.poses[:, 0, 3], [0, 5, 10], atol=1e-9)
    (note,) = source.notes
    assert note.startswith("/ground_truth/odom: 1 poses left out (the first: ")
    assert why in note


def test_a_path_is_ground_truth(bags: Any, tmp_path: Path) -> None:
    stamped = [bags.new("geometry_msgs/PoseStamped", header=o.header, pose=o.pose.pose)
               for o in (bags.odometry(1, 5.0), bags.odometry(2, 6.0))]  # fmt: skip
    path = bags.new("nav_msgs/Path", header=bags.header(1, "map"), poses=stamped)
    source = BagSource(bags.write(tmp_path / "b", [*clouds(bags, [1, 2]), (1, "/kitti/ground_truth/path", path)]))
    np.testing.assert_array_equal(source.poses[:, 0, 3], [5, 6])
    stamped[0].pose.orientation.w = 0.0
    source = BagSource(bags.write(tmp_path / "c", [*clouds(bags, [1, 2]), (1, "/kitti/ground_truth/path", path)]))
    np.testing.assert_array_equal(source.poses[:, 0, 3], [np.nan, 6])
    assert source.notes[0].startswith("/kitti/ground_truth/path: 1 poses left out")
    with pytest.raises(UsageError, match="no Odometry or Path messages on /odom"):
        _ = BagSource(tmp_path / "b", InputSettings(ground_truth_topic="/odom")).poses
