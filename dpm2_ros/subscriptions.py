# SPDX-License-Identifier: Apache-2.0
"""Subscriptions that suit their publishers, and what comes in through them."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import CameraInfo, CompressedImage, Image, Imu, PointCloud2
from std_msgs.msg import Float64

from dpm2_core.data import topics
from dpm2_core.data.frames import Calibration
from dpm2_core.data.image_messages import decode_camera
from dpm2_core.data.imu import ImuBuffer
from dpm2_core.data.kitti import checked_correction
from dpm2_core.data.livox import LIVOX, cloud_of_custom
from dpm2_core.data.messages import stamp_ns
from dpm2_core.data.settings import InputSettings
from dpm2_core.errors import UsageError
from dpm2_core.slam.mapping.admission import RejectedError
from dpm2_ros.checks import check_header, check_size, extended, unreadable
from dpm2_ros.losses import Losses
from dpm2_ros.message_types import message_type
from dpm2_ros.settings import RosSettings
from dpm2_ros.synchronizer import Bundle, SensorState, StampCheck, Synchronizer
from dpm2_ros.tf import TFMessage

_IMU_DEPTH = 1000  # samples that may wait: those of a second
_OTHER_FRAME = 2.0  # s without a cloud after which one in another frame begins another drive
STEADY = Clock(clock_type=ClockType.STEADY_TIME)
"""For timers that must go on when /clock stops at the end of a bag."""

LAST_ONE = QoSProfile(depth=1, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL)
LATCHED = QoSProfile(depth=100, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL)


class MatchedSubscription:
    """A subscription with the reliability that the publishers offer.

    A reliable subscriber never connects to a best-effort publisher, and a best-effort one loses data that a reliable
    publisher would have sent again. So it starts reliable, and `refresh`, called often, follows the publishers. It also
    follows one of PointCloud2 that finds a Livox' CustomMsg on its topic, whose messages come serialized.

    Attributes:
        topic: its full name, after remapping.
        problem: why nothing comes although there is a publisher; else empty.
    """

    def __init__(self, node: Node, kind: type, topic: str, callback: Callable[..., None], ros: RosSettings) -> None:
        self._node, self._kind, self._wanted, self._callback = node, kind, kind, callback
        self._setting, self._depth = ros.reliability, _IMU_DEPTH if kind is Imu else ros.queue_depth
        self._given, self.topic = topic, node.resolve_topic_name(topic)
        self.reliability = ReliabilityPolicy.RELIABLE
        self._subscription: Any = None
        self._raw, self.problem = False, ""
        self.refresh()

    def take(self) -> None:
        """Call back, in the executor's thread, with all that has arrived; it would take one of each topic in turn."""
        handle = self._subscription.handle
        with handle:  # not to be destroyed meanwhile
            for _ in range(self._depth):
                if (taken := handle.take_message(self._kind, self._raw)) is None:
                    return
                self._subscription.callback(taken[0])

    def refresh(self) -> None:
        """Follow the publishers of this moment."""
        requested, offered = self.reliability, self._node.get_publishers_info_by_topic(self.topic)
        if self._setting != "auto":
            requested = ReliabilityPolicy[self._setting.upper()]
        elif offered:
            reliable = all(info.qos_profile.reliability != ReliabilityPolicy.BEST_EFFORT for info in offered)
            requested = ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT
        kind = self._kind_of({info.topic_type for info in offered})
        if self._subscription is not None and (requested, kind) == (self.reliability, self._kind):
            return
        before, other_type = self._subscription, kind is not self._kind
        self.reliability, self._kind, self._raw = requested, kind, kind is not self._wanted
        if before is not None and other_type:  # DDS allows one type a topic
            self._node.destroy_subscription(before)
        qos = QoSProfile(depth=self._depth, history=HistoryPolicy.KEEP_LAST, reliability=requested)
        self._subscription = self._node.create_subscription(kind, self._given, self._callback, qos, raw=self._raw)
        if before is not None:
            if not other_type:
                self._node.destroy_subscription(before)
            self._node.get_logger().info(f"{self.topic}: {requested.name.lower()} {kind.__name__}, as its publisher")

    def _kind_of(self, offered: set[str]) -> type:
        """What to subscribe to, given the types of the publishers."""
        self.problem, custom = "", sorted(offered.intersection(LIVOX))
        if self._wanted is not PointCloud2 or not custom or "sensor_msgs/msg/PointCloud2" in offered:
            return self._wanted
        found = message_type(custom[0])
        if found is None:
            self.problem = (
                f"{self.topic} is a {custom[0]}, whose package is not installed here: install it, or let the driver "
                f"send PointCloud2 (xfer_format: 0)"
            )
            self._node.get_logger().error(self.problem, once=True)
        return found or self._wanted


class Inputs:
    """Clouds, images, an IMU and calibration as they come in. The callbacks only put them into queues.

    Attributes:
        imu: its samples; None where none is wanted. imu_received: messages so far.
        calibration: what is known by now; its topics are full names, after remapping.
    """

    def __init__(self, node: Node, settings: InputSettings, ros: RosSettings, known: Calibration | None = None) -> None:
        """`known`: what an earlier one has learned."""
        self._node = node
        points_topic, image_topic = settings.points_topic or topics.POINTS, settings.image_topic or topics.IMAGE
        image_name = node.resolve_topic_name(image_topic) if settings.images else ""
        imu_topic = settings.imu_topic or topics.IMU.lstrip("/")
        imu_name = node.resolve_topic_name(imu_topic) if settings.imu else ""
        second_topic = settings.second_points_topic
        second_name = node.resolve_topic_name(second_topic) if second_topic else ""
        points_name = node.resolve_topic_name(points_topic)
        if second_name == points_name:
            raise UsageError(f"input.second_points_topic: {second_name} is that of the first LiDAR")
        self.calibration = known or Calibration(points_name, image_name, imu_name, second_name)
        self.imu = ImuBuffer() if settings.imu else None
        self.imu_received = 0
        self._image_shift = round(settings.image_time_offset * 1e9)
        self._arrived = threading.Condition()
        self.synchronizer = Synchronizer(
            camera=settings.images,
            depth=ros.queue_depth,
            timeout=ros.sync_timeout,
            tolerance=settings.image_tolerance,
            second=bool(second_topic),
        )
        self.losses = Losses()
        """Clouds that were sent, and never arrived."""
        self._calibrated = False  # by a CameraInfo
        self._frame: str | None = None  # of the clouds
        self._times: deque[tuple[int, int]] = deque(maxlen=5)
        beside: list[MatchedSubscription] = []
        if settings.images:
            image_type = CompressedImage if image_name.endswith("/compressed") else Image
            info_topic = settings.camera_info_topic or _camera_info_beside(node, image_topic)
            beside = [
                MatchedSubscription(node, image_type, image_topic, self._on_image, ros),
                MatchedSubscription(node, CameraInfo, info_topic, self._on_camera_info, ros),
            ]
        self._awaited: list[tuple[SensorState, MatchedSubscription]] = []
        if self.synchronizer.camera is not None:
            self._awaited.append((self.synchronizer.camera, beside[0]))
        if second_topic:
            beside.append(MatchedSubscription(node, PointCloud2, second_topic, self._on_second, ros))
            assert self.synchronizer.second is not None
            self._awaited.append((self.synchronizer.second, beside[-1]))
        if settings.imu:
            beside.append(MatchedSubscription(node, Imu, imu_topic, self._on_imu, ros))
        self._static_topic, self._static_messages = node.resolve_topic_name(topics.TF_STATIC), 0
        if TFMessage is not None:  # else extrinsics come from parameters alone
            node.create_subscription(TFMessage, topics.TF_STATIC, self._on_static, LATCHED)
        self._correction_topic = node.resolve_topic_name(topics.VERTICAL_ANGLE_CORRECTION)
        node.create_subscription(Float64, topics.VERTICAL_ANGLE_CORRECTION, self._on_correction, LATCHED)
        # The last to be announced: who waits for it has found the others.
        self.subscriptions = [MatchedSubscription(node, PointCloud2, points_topic, self._on_cloud, ros), *beside]
        node.create_timer(0.1, self._refresh, clock=STEADY)

    def take(self, timeout: float) -> Bundle | None:
        """The next cloud that is ready, with its images; None after `timeout` s without one."""
        end = time.monotonic() + timeout
        with self._arrived:
            while True:
                now = time.monotonic()
                bundle = self.synchronizer.pop(now)
                if bundle is not None or now >= end:
                    return bundle
                self._arrived.wait(min(end, self.synchronizer.deadline() or end) - now)

    def calibrated(self, lidar_frame: str) -> bool:
        """Whether all latched messages about the LiDAR that have a publisher have arrived."""
        known, count = self.calibration, self._node.count_publishers
        publishers, frames = count(self._static_topic), known.transforms.frames
        if publishers and (self._static_messages < publishers or lidar_frame.lstrip("/") not in frames):
            return False
        return known.angle_correction_deg is not None or not count(self._correction_topic)

    @property
    def times(self) -> tuple[int, int] | None:
        """ns: a late cloud's stamp, and what the node's clock said when it came; None before there are some.

        Of the last five the one with the median difference: /clock and clouds may change places on their way.
        """
        times = sorted(self._times, key=lambda pair: pair[1] - pair[0])
        return times[len(times) // 2] if len(times) >= 3 else None

    def candidates(self) -> list[str]:
        """Other topics with point clouds."""
        own = {topic for topic, _ in self._node.get_publisher_names_and_types_by_node(
            self._node.get_name(), self._node.get_namespace())}  # fmt: skip
        wanted = {"sensor_msgs/msg/PointCloud2", *LIVOX}
        return sorted(
            topic
            for topic, kinds in self._node.get_topic_names_and_types()
            if wanted.intersection(kinds) and topic not in own and self._node.count_publishers(topic)
        )

    def _check_cloud(self, message: PointCloud2) -> None:
        """An unreadable cloud counts as a failed scan where one was due; any other is not of this drive."""
        now, frame = time.monotonic(), message.header.frame_id
        check_header(message.header)
        check_size(message, message.width * message.height)
        last = self.synchronizer.last_arrival
        if self._frame not in (None, frame) and last is not None and now - last < _OTHER_FRAME:
            raise RejectedError("another frame", f"a cloud in frame {frame[:80]!r}; the drive's is {self._frame!r}")
        problem, stamp = unreadable(message), stamp_ns(message.header)
        if problem and not (frame == self._frame and self.synchronizer.due(stamp, now)):
            raise RejectedError("unreadable", problem)
        self._frame = frame

    def _on_cloud(self, message: PointCloud2 | bytes, info: Mapping[str, Any]) -> None:
        if isinstance(message, bytes):
            message = cloud_of_custom(message)
        cloud, *others = self.subscriptions
        for other in reversed(others):  # what was sent before the cloud is to be there before it; calibration first
            other.take()
        # Several publishers count each for themselves.
        number = info.get("publication_sequence_number") if self._node.count_publishers(cloud.topic) < 2 else None
        try:
            self._check_cloud(message)
        except RejectedError:
            self.losses.skip(number)
            raise
        if stamped := stamp_ns(message.header):
            self._times.append((stamped, self._node.get_clock().now().nanoseconds))
        stamp = self._stamp(message)
        with self._arrived:
            for sensor, subscription in self._awaited:
                sensor.present = bool(self._node.count_publishers(subscription.topic))
            lost = self.losses.add(stamp, number)
            check = self.synchronizer.add_cloud(stamp, message, time.monotonic())
            self._arrived.notify()
        if lost:
            self._node.get_logger().warning(
                f"{lost} clouds before that at {stamp / 1e9:.3f} s were lost on the way", throttle_duration_sec=5
            )
        if check is not StampCheck.ACCEPTED:
            self._node.get_logger().warning(
                f"cloud at {stamp_ns(message.header) / 1e9:.3f} s: {check}", throttle_duration_sec=5
            )

    def _on_image(self, message: Any) -> None:
        check_header(message.header)
        check_size(message)
        with self._arrived:
            stamp = self._stamp(message) + self._image_shift
            self.synchronizer.add_image(stamp, message, time.monotonic())
            self._arrived.notify()

    def _on_second(self, message: PointCloud2 | bytes) -> None:
        if isinstance(message, bytes):
            message = cloud_of_custom(message)
        check_header(message.header)
        check_size(message, message.width * message.height)
        if problem := unreadable(message):
            raise RejectedError("unreadable", problem)
        with self._arrived:
            self.synchronizer.add_second(self._stamp(message), message, time.monotonic())
            self._arrived.notify()

    def _on_imu(self, message: Imu) -> None:
        check_header(message.header)
        if self.imu is not None:
            self.imu.add(self._stamp(message), message)
            self.imu_received += 1

    def _stamp(self, message: Any) -> int:
        """ns; drivers that leave the stamp at 0 get the time of arrival."""
        return stamp_ns(message.header) or self._node.get_clock().now().nanoseconds

    def _on_camera_info(self, message: CameraInfo) -> None:
        check_header(message.header)
        try:
            decode_camera(message, np.eye(4), "camera")
        except UsageError:
            if self._calibrated:
                raise  # what is known stays
        else:
            self._calibrated = True
        self.calibration.camera_info = message

    def _on_static(self, message: Any) -> None:
        self._static_messages += 1
        tree, problem = extended(self.calibration.transforms, message)
        self.calibration.transforms = tree  # another one: the worker may be reading that of before
        if problem:
            raise RejectedError("transform", problem)

    def _on_correction(self, message: Float64) -> None:
        self.calibration.angle_correction_deg = checked_correction(message.data, self._correction_topic)

    def _refresh(self) -> None:
        for subscription in self.subscriptions:
            subscription.refresh()


def _camera_info_beside(node: Node, image_topic: str) -> str:
    """The camera_info beside the images where they really come from, unless it has a remapping of its own."""
    usual = _beside(image_topic)
    if node.resolve_topic_name(usual) != node.resolve_topic_name(usual, only_expand=True):
        return usual
    return _beside(node.resolve_topic_name(image_topic))


def _beside(image_topic: str) -> str:
    folder = image_topic.removesuffix("/compressed").rpartition("/")[0]
    return f"{folder}/camera_info".removeprefix("" if folder or image_topic.startswith("/") else "/")
