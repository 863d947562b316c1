# SPDX-License-Identifier: Apache-2.0
"""Inputs are checked by the topics that are really subscribed to, after remapping; absurd values are ignored."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest
import rclpy
from rclpy.node import Node
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import CameraInfo, CompressedImage, Image, PointCloud2
from std_msgs.msg import Float64

from dpm2_core.data.frames import Calibration, CameraTopic, FrameBuilder
from dpm2_core.data.settings import InputSettings
from dpm2_core.errors import UsageError
from dpm2_core.frame import Points
from dpm2_ros.conversions import cloud_to_msg
from dpm2_ros.guard import GuardedNode
from dpm2_ros.runtime import end_ros, ros_context
from dpm2_ros.settings import RosSettings
from dpm2_ros.stamps import stamp_to_msg
from dpm2_ros.subscriptions import LATCHED, Inputs

INFO = CameraInfo(height=6, width=8, k=[5.0, 0, 4, 0, 5, 3, 0, 0, 1], p=[5.0, 0, 4, 0, 0, 5, 3, 0, 0, 0, 1, 0])
CLOUD: Points = np.array([[50, 0, 0, 0.5], [0, 30, 1, 0.5]], np.float32)


@pytest.fixture
def node(domain: int) -> Iterator[Callable[..., Node]]:
    """Makes a node: node(*remappings, namespace="")."""
    nodes = list[Node]()

    def make(*remappings: str, namespace: str = "") -> Node:
        ros_context(["--ros-args", *(part for rule in remappings for part in ("-r", rule))], domain)
        nodes.append(GuardedNode("listener", namespace=namespace))
        return nodes[-1]

    yield make
    end_ros(*nodes)


def inputs(node: Node, **settings: Any) -> Inputs:
    return Inputs(node, InputSettings(**settings), RosSettings())


def raised(inputs: Inputs) -> float:
    """Degrees by which the points of a cloud have been raised."""
    frame = FrameBuilder(InputSettings(), inputs.calibration, print).frame(0, cloud_to_msg(CLOUD, 1, "lidar"), 0)
    return math.degrees(math.atan2(frame.points[0, 2], frame.points[0, 0]))


def test_a_remapped_lidar_has_not_the_error_of_kittis(node: Callable[..., Node]) -> None:
    """If the LiDAR's topic is remapped from KITTI's, which the setting still names, KITTI's angle correction is not
    applied."""
    made = inputs(node("/kitti/velo/pointcloud:=/ouster/points"))
    assert made.calibration.points_topic == "/ouster/points"
    assert raised(made) == 0


@pytest.mark.parametrize(
    ("remappings", "settings"),
    [((), {}), (("/points:=/kitti/velo/pointcloud",), {"points_topic": "/points"})],
)
def test_kittis_own_topic_has_it(
    node: Callable[..., Node], remappings: tuple[str, ...], settings: dict[str, str]
) -> None:
    assert raised(inputs(node(*remappings), **settings)) == pytest.approx(0.205, abs=1e-3)


@pytest.mark.parametrize(
    ("remappings", "namespace", "settings", "image", "info"),
    [
        ((), "", {}, "/kitti/camera_color_left/image_raw", "/kitti/camera_color_left/camera_info"),
        ((), "", {"image_topic": "/a/b/compressed"}, "/a/b/compressed", "/a/camera_info"),
        ((), "/red", {"image_topic": "cam/image"}, "/red/cam/image", "/red/cam/camera_info"),
        ((), "/red", {"image_topic": "/image"}, "/image", "/camera_info"),
        ((), "/red", {"image_topic": "image"}, "/red/image", "/red/camera_info"),
        (
            ("/kitti/camera_color_left/image_raw:=/cam/image/compressed",),
            "",
            {},
            "/cam/image/compressed",
            "/cam/camera_info",
        ),
        (
            ("/kitti/camera_color_left/image_raw:=/cam/image", "/kitti/camera_color_left/camera_info:=/calibration"),
            "",
            {},
            "/cam/image",
            "/calibration",
        ),
        (("/c/image:=/a/image",), "", {"image_topic": "/c/image", "camera_info_topic": "/b"}, "/a/image", "/b"),
    ],
)  # fmt: skip
def test_image_type_and_calibration_follow_the_remapped_topic(
    node: Callable[..., Node],
    remappings: tuple[str, ...],
    namespace: str,
    settings: dict[str, str],
    image: str,
    info: str,
) -> None:
    kind = CompressedImage if image.endswith("/compressed") else Image
    n = node(*remappings, namespace=namespace)
    made = inputs(n, **settings)
    assert [camera.topic for camera in made.calibration.cameras] == [image]
    listening = {(s.topic_name, s.msg_type) for s in n.subscriptions}
    assert {(image, kind), (info, CameraInfo)} <= listening


def test_compressed_images_come_on_a_topic_of_any_name(node: Callable[..., Node]) -> None:
    """The topic need not end in /compressed: the publisher's type decides."""
    n = node()
    publisher = n.create_publisher(CompressedImage, "/front/image_rect_compressed", LATCHED)
    made = inputs(n, image_topic="/front/image_rect_compressed")
    camera = made.synchronizer.sensors["/front/image_rect_compressed"]
    message, end = CompressedImage(format="jpeg", data=b"1"), time.monotonic() + 20
    while not camera.received and time.monotonic() < end:
        publisher.publish(message)
        rclpy.spin_once(n, timeout_sec=0.1)
    _, taken = camera.messages.nearest(n.get_clock().now().nanoseconds) or (0, None)
    assert taken == message


def test_a_second_camera_is_found_as_the_first_one_is(node: Callable[..., Node]) -> None:
    """Its CameraInfo is expected next to its real image topic after remapping, whatever is set for the first camera."""
    n = node("/rear/image:=/back/image/compressed", namespace="/red")
    made = inputs(n, image_topic="cam/image", camera_info_topic="/info", second_image_topic="/rear/image")
    assert [camera.topic for camera in made.calibration.cameras] == ["/red/cam/image", "/back/image/compressed"]
    assert list(made.synchronizer.sensors) == ["/red/cam/image", "/back/image/compressed"]
    listening = {(s.topic_name, s.msg_type) for s in n.subscriptions}
    assert {("/back/image/compressed", CompressedImage), ("/back/camera_info", CameraInfo)} <= listening
    assert {("/red/cam/image", Image), ("/info", CameraInfo)} <= listening
    assert inputs(n, images=False, second_image_topic="/rear/image").calibration.cameras == []
    with pytest.raises(UsageError, match=r"^input\.second_image_topic: /red/x is that of the first camera$"):
        inputs(n, image_topic="x", second_image_topic="/red/x")


def test_a_remapping_is_applied_once(node: Callable[..., Node]) -> None:
    """If a remapping exchanges two topics, it is applied once: a second application would undo it."""
    n = node("/a:=/b", "/b:=/a")
    assert inputs(n, points_topic="/a", images=False).calibration.points_topic == "/b"
    assert "/b" in {s.topic_name for s in n.subscriptions}
    assert "/a" not in {s.topic_name for s in n.subscriptions}


def test_parts_of_a_sweep_wait_for_a_busy_node_as_long_as_sweeps(node: Callable[..., Node]) -> None:
    """At 100 Hz, a part was lost on the way whenever the executor was busy for a tenth of a second."""
    listener = node()
    publisher = listener.create_publisher(PointCloud2, "/points", 100)
    made = inputs(listener, points_topic="/points")
    end = time.monotonic() + 10
    while not publisher.get_subscription_count() and time.monotonic() < end:
        time.sleep(0.01)
    for n in range(1, 61):
        publisher.publish(cloud_to_msg(CLOUD, n * 10_000_000, "lidar"))
    time.sleep(0.3)  # until all have arrived
    while made.synchronizer.received + made.losses.count < 60 and time.monotonic() < end:
        rclpy.spin_once(listener, timeout_sec=0.1)
    assert (made.synchronizer.received, made.losses.count) == (60, 0)


def test_a_camera_info_that_was_sent_once_arrives(node: Callable[..., Node]) -> None:
    """A latched CameraInfo that was sent long before the subscription is received."""
    n = node()
    n.create_publisher(CameraInfo, "/front/camera_info", LATCHED).publish(INFO)
    made = inputs(n, image_topic="/front/image")
    end = time.monotonic() + 20
    while made.calibration.cameras[0].info is None and time.monotonic() < end:
        rclpy.spin_once(n, timeout_sec=0.2)
    assert made.calibration.cameras[0].info == INFO


def test_a_camera_info_that_cannot_be_used_replaces_none_that_can(node: Callable[..., Node]) -> None:
    """An invalid CameraInfo does not replace a valid one, here one from before the node was deactivated."""
    n = node()
    assert isinstance(n, GuardedNode)
    known = Calibration("/points", camera=CameraTopic("/front/image", INFO))
    made = Inputs(n, InputSettings(image_topic="/front/image"), RosSettings(), known)
    n.create_publisher(CameraInfo, "/front/camera_info", LATCHED).publish(CameraInfo(height=6, width=8))
    end = time.monotonic() + 20
    while not n.rejections and made.calibration.cameras[0].info == INFO and time.monotonic() < end:
        rclpy.spin_once(n, timeout_sec=0.2)
    assert sum(n.rejections.values()) == 1
    assert made.calibration.cameras[0].info == INFO


class LastFirst(GuardedNode):
    """If messages wait on several topics, its executor takes that of the last subscription first."""

    @property
    def subscriptions(self) -> Iterator[Any]:
        yield from reversed(list(super().subscriptions))


def test_a_cloud_has_the_time_of_the_clock_that_was_sent_before_it(domain: int) -> None:
    """The order of reception does not matter. With the time of the previous cloud, a gap in a lockstep replay was taken
    for a clock that was set."""
    ros_context(["--ros-args", "-p", "use_sim_time:=true"], domain)
    n = LastFirst("listener")
    try:
        made = inputs(n, points_topic="/points", images=False)
        clock, clouds = n.create_publisher(Clock, "/clock", 10), n.create_publisher(PointCloud2, "/points", 10)
        taken: list[float] = []
        end = time.monotonic() + 20
        for seconds in (5, 8):
            clock.publish(Clock(clock=stamp_to_msg(seconds * 10**9)))
            clouds.publish(cloud_to_msg(CLOUD, seconds * 10**9, "lidar"))
            while len(taken) < seconds // 4 and time.monotonic() < end:
                rclpy.spin_once(n, timeout_sec=0.1)
                taken += [bundle.clock for bundle in [made.take(0.0)] if bundle is not None]
        assert taken == [5.0, 8.0]
    finally:
        end_ros(n)


@pytest.mark.parametrize("value", [math.nan, math.inf, 90.0, -5.1])
def test_an_absurd_correction_from_the_wire_is_ignored(node: Callable[..., Node], value: float) -> None:
    """An absurd value is ignored, whichever values were received before."""
    n = node()
    made = inputs(n)
    publisher = n.create_publisher(Float64, "/kitti/vertical_angle_correction_deg", LATCHED)
    for data in (1.5, value, 2.5):
        publisher.publish(Float64(data=data))
    seen = set()
    while 2.5 not in seen:
        rclpy.spin_once(n, timeout_sec=5)
        seen.add(made.calibration.angle_correction_deg)
    assert seen <= {None, 1.5, 2.5}
