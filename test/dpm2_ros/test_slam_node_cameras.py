# SPDX-License-Identifier: Apache-2.0
"""Images and a second LiDAR for slam_node: synchronized with the clouds, missing, late, or rejected with a reason."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticStatus
from sensor_msgs.msg import Image, PointCloud2

from dpm2_core.data.messages import stamp_ns
from dpm2_core.data.naming import IMAGE, KITTI
from dpm2_core.frame import R_AHEAD
from dpm2_core.geometry import se3
from dpm2_ros.conversions import cloud_to_msg
from test.helpers.rig import Camera, Rig, publish_static, record_frames

from ..helpers.diagnostics import figures, having, saying
from .conftest import pose, scan


def with_camera(rig: Callable[..., Rig], *parameters: str) -> tuple[Rig, Camera]:
    r = rig("input.images:=true", *parameters)
    return r, Camera(r)


PLACE = "input.T_lidar_cam:=[0.0, 0.0, 0.0, 0.5, -0.5, 0.5, -0.5]"
AHEAD = se3.make(R_AHEAD, np.zeros(3))
"""The same rotation as a matrix."""


def test_an_image_joins_its_cloud(rig: Callable[..., Rig]) -> None:
    r, camera = with_camera(rig, PLACE, "ros.sync_timeout:=2.0")
    frames = record_frames(r)
    for n in range(4):
        camera.send(n, offset=0.01)
        r.send_and_wait(n)
    assert [len(frame.images) for frame in frames] == [1] * 4
    assert frames[0].images[0].pixels.shape == (6, 8, 3)
    np.testing.assert_allclose(frames[0].images[0].camera.T_lidar_cam[:3, 2], [1, 0, 0], atol=1e-9)  # looks ahead
    assert r.status("camera", saying("in use"), since=0).level == DiagnosticStatus.OK


def test_the_cloud_is_painted_into_its_image_for_who_looks(rig: Callable[..., Rig]) -> None:
    r, camera = with_camera(rig, PLACE, "ros.sync_timeout:=2.0")
    camera.send(0)
    r.send_and_wait(0)
    painted = r.harness.hear(Image, "/dpm2/projection", 1)
    r.wait(lambda: r.node.count_subscribers("/dpm2/projection"), "the subscription")
    camera.send(1)
    r.send_and_wait(1)
    # The first one may be painted only now: its odometry is published before that.
    r.wait(lambda: painted and stamp_ns(painted[-1].header) == r.drive.stamp(1), "the projection")
    assert (painted[-1].height, painted[-1].width, painted[-1].encoding) == (6, 8, "rgb8")
    assert painted[-1].header.frame_id == "camera"
    assert any(painted[-1].data)  # the image itself is black
    r.send_and_wait(2)  # without an image
    assert stamp_ns(painted[-1].header) == r.drive.stamp(1)


def test_of_parts_of_a_sweep_the_whole_sweep_is_painted(rig: Callable[..., Rig]) -> None:
    """Each part was painted alone, a tenth of the cloud on the same image, ten times as often."""
    r, camera = with_camera(rig, PLACE, "ros.sync_timeout:=2.0")
    painted = r.harness.hear(Image, "/dpm2/projection", 100)
    r.wait(lambda: r.node.count_subscribers("/dpm2/projection"), "the subscription")
    for n in (0, 1):
        camera.send(n, offset=0.045)
        r.send_in_parts(n)
    r.wait(lambda: len(painted) == 3, "the projections")
    stamps = [stamp_ns(message.header) - r.drive.start for message in painted]
    assert stamps == [0, 90_000_000, 190_000_000]  # nothing tells that the first cloud is a part
    assert [message.header.frame_id for message in painted] == ["camera"] * 3
    assert np.count_nonzero(painted[-1].data) > np.count_nonzero(painted[0].data)


SECOND = "input.second_image_topic:=/rear/image"


def test_two_cameras_and_what_each_loss_costs(rig: Callable[..., Rig], monkeypatch: pytest.MonkeyPatch) -> None:
    """The second camera looks back. Without extrinsics it is left out and reported; if it is late or silent, only its
    image is missing."""
    r, camera = with_camera(rig, PLACE, SECOND, "ros.sync_timeout:=1.0")
    rear = Camera(r, "/rear/image", "/rear/camera_info", "rear")
    frames, T = record_frames(r), se3.exp([0, 0, np.pi, 0, 0, 0]) @ AHEAD
    shown = [r.harness.hear(Image, f"/dpm2/{name}", 5) for name in ("projection", "second_projection")]
    r.wait(lambda: r.node.count_subscribers("/dpm2/second_projection"), "the subscription")
    camera.send(0)
    rear.send(0)
    r.send_and_wait(0)
    missing = "no transform from 'rear' to 'lidar'; frames known: none; publish it on /tf_static; going on without"
    r.status("second camera", saying(missing), since=0)
    publish_static(r, "lidar", "rear", T)
    for n in (1, 2):
        camera.send(n)
        rear.send(n, offset=-0.03)
        r.send_and_wait(n)
    for part in ("camera", "second camera"):
        r.status(part, saying("in use"), since=0)
    rear.send(3)  # the first camera has none
    r.send_and_wait(3)
    camera.send(4)
    r.send_and_wait(4)
    rear.send(4)  # too late
    r.status("second camera", having(received=5, matched=4, late=1))
    topics = [[image.camera.name for image in frame.images] for frame in frames]
    assert topics == [[IMAGE], [IMAGE, "/rear/image"], [IMAGE, "/rear/image"], ["/rear/image"], [IMAGE]]
    np.testing.assert_allclose(frames[1].images[1].camera.T_lidar_cam, T, atol=1e-9)
    np.testing.assert_allclose(frames[1].images[1].camera.T_lidar_cam[:3, 2], [-1, 0, 0], atol=1e-9)
    r.wait(lambda: len(shown[0]) == 4 and len(shown[1]) == 3, "every image with its cloud")
    assert {message.header.frame_id for message in shown[1]} == {"rear"}
    monkeypatch.setattr("dpm2_ros.slam_diagnostics.SILENT", 1.0)
    r.status("second camera", saying("no image on /rear/image for"))
    assert figures(r.processed(5))["failed registrations"] == "0"


def test_two_cameras_of_one_frame_are_one_too_many(rig: Callable[..., Rig]) -> None:
    """Drivers of stereo cameras may send the same frame for both: the second camera is left out, since its extrinsics
    are unknown."""
    r, camera = with_camera(rig, PLACE, SECOND, "ros.sync_timeout:=1.0")
    rear = Camera(r, "/rear/image", "/rear/camera_info")
    frames = record_frames(r)
    for n in range(2):
        camera.send(n)
        rear.send(n)
        r.send_and_wait(n)
    assert [len(frame.images) for frame in frames] == [1, 1]
    r.status("second camera", saying(f"its frame 'camera' is that of {IMAGE}: two cameras"), since=0)


def test_two_cameras_on_one_topic_are_not_taken_for_one_that_jumps(rig: Callable[..., Rig]) -> None:
    """Only the images of the camera received first are used, with its calibration, even if the other's are nearer."""
    r, camera = with_camera(rig, "ros.sync_timeout:=2.0")
    other, frames = Camera(r, frame="left"), record_frames(r)
    for name, x in (("camera", 0.5), ("left", -1.0)):
        publish_static(r, "lidar", name, se3.make(AHEAD[:3, :3], [x, 0, 0]))
    for n in range(4):
        camera.send(n, offset=0.01)
        r.wait(lambda n=n: r.node.calibration.cameras[0].info is not None, "the calibration")
        other.send(n)
        r.wait(lambda n=n: sum(r.node.rejections.values()) == 2 * n + 2, "the rejections")
        r.send_and_wait(n)
    assert {kind.rpartition(": ")[0]: count for kind, count in r.node.rejections.items()} == {
        IMAGE: 4,
        f"{KITTI.camera}/camera_info": 4,
    }
    images = [image for frame in frames for image in frame.images]
    assert [(image.time_offset, image.camera.T_lidar_cam[0, 3]) for image in images] == [(0.01, 0.5)] * 4


def test_extrinsics_come_from_tf_static(rig: Callable[..., Rig]) -> None:
    """While they are missing, images are rejected, and that is reported."""
    r, camera = with_camera(rig, "ros.sync_timeout:=2.0")
    frames, T = record_frames(r), se3.exp([0.1, -1.2, 1.2, 0.3, 0.0, -0.1])
    for n in range(6):
        if n == 3:
            status = r.status("camera", saying("no transform from 'camera' to 'lidar'"), since=0)
            publish_static(r, "lidar", "camera", T)
        camera.send(n)
        r.send_and_wait(n)
    assert status.level == DiagnosticStatus.ERROR
    assert "input.T_lidar_cam" in status.message
    assert [len(frame.images) for frame in frames] == [0] * 3 + [1] * 3
    np.testing.assert_allclose(frames[-1].images[0].camera.T_lidar_cam, T, atol=1e-9)


def test_two_lidars_are_one_scan(rig: Callable[..., Rig], drive: Any) -> None:
    """Each LiDAR sees one side of the street; the second is rotated and mounted to the right. When it stops, the drive
    continues."""
    r = rig("input.second_points_topic:=/right", "ros.sync_timeout:=2.0", "input.vertical_angle_correction_deg:='0.0'")
    T = se3.exp([0, 0, -1.5, 0.3, -0.5, 0.1])
    publish_static(r, "lidar", "right", T)
    right = r.harness.publisher(PointCloud2, "/right")
    frames = record_frames(r)
    for n in range(5):
        points = scan(pose(n))
        left = points[:, 1] > 0
        others = se3.transform(se3.inverse(T), points[~left])
        right.publish(cloud_to_msg(others, drive.stamp(n) - 20_000_000, "right"))
        before = len(r.odom)
        r.lidar.publish(cloud_to_msg(points[left], drive.stamp(n), "lidar"))
        r.wait(lambda before=before: len(r.odom) > before, f"the odometry of cloud {n}")
        np.testing.assert_allclose(frames[n].points, np.concatenate([points[left], points[~left]]), atol=1e-4)
    assert frames[-1].time_offset is not None
    assert set(np.round(frames[-1].time_offset, 6)) == {0.0, np.float32(-0.02)}
    r.status("second lidar", lambda s: s.message == "in use", since=0)
    r.send_and_wait(5)  # without the second LiDAR
    assert len(frames[5].points) == len(scan(pose(5)))
    r.processed(6)
    r.status("second lidar", having(received=5, matched=5, late=0))


def test_a_camera_that_never_comes_comes_late_and_stops(
    rig: Callable[..., Rig], drive: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Every cloud gets its pose throughout, and /diagnostics shows the state of the camera."""
    r, camera = with_camera(rig, PLACE, "ros.sync_timeout:=0.05")
    frames = record_frames(r)
    r.send_and_wait(0, 1, 2)
    r.status("camera", saying("no image on /kitti/camera_color_left/image_raw yet"))
    seen = len(r.diagnostics)
    for n in range(3, 10):
        camera.send(n)
        r.status("camera", having(received=n - 2), since=seen)  # in time, however busy the machine is
        r.send_and_wait(n)
    assert r.status("camera", saying("in use"), since=seen).level == DiagnosticStatus.OK
    r.send_and_wait(*range(10, drive.frames))
    assert [bool(frame.images) for frame in frames] == [3 <= n < 10 for n in range(drive.frames)]
    monkeypatch.setattr("dpm2_ros.slam_diagnostics.SILENT", 1.0)
    assert r.status("camera", saying("no image")).level == DiagnosticStatus.WARN


def test_without_a_camera_no_cloud_waits_for_one(rig: Callable[..., Rig], drive: Any) -> None:
    """Images are on by default; a drive without any is as fast from its first cloud as one with images disabled."""
    r = rig("input.images:=true", "input.second_image_topic:=/rear/image", "ros.sync_timeout:=5.0")
    assert r.node.slam.odometry.uses_images
    began = time.monotonic()
    r.send_and_wait(*range(drive.frames))
    assert time.monotonic() - began < 20.0  # the first five would wait 5 s each; without waits it takes under a second


def test_images_that_nothing_looks_at_are_not_received(rig: Callable[..., Rig]) -> None:
    r = rig("input.images:=true", "slam.visual.enabled:=false")
    assert r.node.count_subscribers(IMAGE) == 0
    r.send_and_wait(0)
