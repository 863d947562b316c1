# SPDX-License-Identifier: Apache-2.0
"""The inputs of slam_node: clouds, images, an IMU, a GNSS receiver and calibration."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

import numpy as np
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.time_source import CLOCK_TOPIC
from sensor_msgs.msg import CameraInfo, CompressedImage, Image, Imu, NavSatFix, PointCloud2
from std_msgs.msg import Float64

from dpm2_core.data import naming
from dpm2_core.data.frames import Calibration, CameraTopic
from dpm2_core.data.gnss import FixBuffer
from dpm2_core.data.image_messages import decode_camera, info_of, info_topic_beside
from dpm2_core.data.imu import ImuBuffer
from dpm2_core.data.message_kinds import CLOUDS
from dpm2_core.data.messages import stamp_ns
from dpm2_core.data.naming import frame_name
from dpm2_core.data.settings import InputSettings
from dpm2_core.data.vertical_angle import checked_correction
from dpm2_core.errors import UsageError
from dpm2_core.slam.mapping.admission import RejectedError
from dpm2_ros.checks import check_header, check_size, checked_cloud, extended, replaced
from dpm2_ros.guard import GuardedNode, excerpt, take_waiting
from dpm2_ros.lost_messages import Losses
from dpm2_ros.matched_subscription import MatchedSubscription
from dpm2_ros.settings import RosSettings
from dpm2_ros.synchronizer import Bundle, StampCheck, Synchronizer
from dpm2_ros.tf_message import TFMessage

OTHER_FRAME = 2.0
"""s without a cloud after which a cloud in another frame begins another drive."""

LAST_ONE = QoSProfile(depth=1, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL)
LATCHED = QoSProfile(depth=100, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL)


class Inputs:
    """Subscriptions to clouds, images, IMU, GNSS receiver and calibration. The callbacks only put messages into queues.

    Attributes:
        imu: its samples; None if it is not used. imu_received: messages so far. imu_last: arrival of the last, s.
        gnss: its fixes; None if it is not used. gnss_received: messages so far. gnss_last: stamp, ns, and arrival, s,
            of the last fix.
        calibration: what is known by now; its topics are full names, after remapping.
    """

    def __init__(
        self, node: GuardedNode, settings: InputSettings, ros: RosSettings, known: Calibration | None = None
    ) -> None:
        """`known`: the calibration that an earlier instance has received.

        Raises:
            UsageError: a second sensor with the topic of the first.
        """
        self._node, self._ros = node, ros
        unresolved = _with_defaults(settings)
        self.calibration = known or _make_calibration(node, unresolved)
        self.imu = ImuBuffer() if settings.imu else None
        self.imu_received = 0
        self.imu_last: float | None = None
        self.gnss, self.gnss_received = FixBuffer() if settings.gnss_topic else None, 0
        self.gnss_last: tuple[int, float] | None = None
        self._image_shift = round(settings.image_time_offset * 1e9)
        self._arrived = threading.Condition()
        topics = [camera.topic for camera in self.calibration.cameras]
        topics += filter(None, [self.calibration.second_topic])
        self.synchronizer = Synchronizer(topics, ros.queue_depth, ros.sync_timeout, settings.image_tolerance)
        self.losses = Losses()
        """Clouds that were sent and never arrived."""
        self._cloud_frame: str | None = None  # of the clouds
        self._clock_pairs: deque[tuple[int, int]] = deque(maxlen=5)
        others = self._subscribe_others(unresolved)
        self._static_topic, self._static_messages = node.resolve_topic_name(naming.TF_STATIC), 0
        if TFMessage is not None:  # else extrinsics come from parameters only
            node.create_subscription(TFMessage, naming.TF_STATIC, self._on_static, LATCHED)
        self._correction_topic = node.resolve_topic_name(naming.VERTICAL_ANGLE_CORRECTION)
        node.create_subscription(Float64, naming.VERTICAL_ANGLE_CORRECTION, self._on_correction, LATCHED)
        # Announced last: a publisher that waits for this subscription has found the others by then.
        self.subscriptions = [self._subscribe(PointCloud2, unresolved.points_topic, self._on_cloud), *others]
        node.create_timer(0.1, self._refresh)

    def _subscribe_others(self, unresolved: InputSettings) -> list[MatchedSubscription]:
        """The subscriptions to all topics but that of the clouds; `unresolved` has their names before remapping."""
        known, out = self.calibration, list[MatchedSubscription]()
        if known.camera is not None:
            out += self._subscribe_images(known.camera, unresolved.image_topic, unresolved.camera_info_topic)
        if known.second_camera is not None:
            out += self._subscribe_images(known.second_camera, unresolved.second_image_topic, "")
        if unresolved.second_points_topic:
            out.append(self._subscribe(PointCloud2, unresolved.second_points_topic, self._on_second_cloud))
        if unresolved.imu:
            out.append(self._subscribe(Imu, unresolved.imu_topic, self._on_imu))
        if unresolved.gnss_topic:
            out.append(self._subscribe(NavSatFix, unresolved.gnss_topic, self._on_fix))
        return out

    def _subscribe_images(self, camera: CameraTopic, topic: str, info_topic: str) -> list[MatchedSubscription]:
        """The subscriptions to a camera's images and CameraInfo."""
        kind = CompressedImage if camera.topic.endswith("/compressed") else Image
        return [
            self._subscribe(kind, topic, partial(self._on_image, camera)),
            self._subscribe(
                CameraInfo, info_topic or _camera_info_topic(self._node, topic), partial(self._on_camera_info, camera)
            ),
        ]

    def _subscribe(self, kind: type, topic: str, callback: Callable[..., None]) -> MatchedSubscription:
        return MatchedSubscription(self._node, kind, topic, callback, self._ros)

    def take(self, timeout: float) -> Bundle | None:
        """The next cloud that is ready, with its synchronized messages; None after `timeout` s without one."""
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
        if publishers and (self._static_messages < publishers or frame_name(lidar_frame) not in frames):
            return False
        return known.angle_correction_deg is not None or not count(self._correction_topic)

    def problem(self, topic: str) -> str:
        """Why nothing is received on one of these topics although it has a publisher, in words; else empty."""
        return next((one.problem for one in self.subscriptions if one.topic == topic), "")

    @property
    def times(self) -> tuple[int, int] | None:
        """ns: stamp of a recent cloud, and the node's clock when it arrived; None before three clouds.

        Of the last five the pair with the median difference: /clock and clouds may arrive in another order.
        """
        times = sorted(self._clock_pairs, key=lambda pair: pair[1] - pair[0])
        return times[len(times) // 2] if len(times) >= 3 else None

    def candidates(self) -> list[str]:
        """Other topics with point clouds."""
        own = {topic for topic, _ in self._node.get_publisher_names_and_types_by_node(
            self._node.get_name(), self._node.get_namespace())}  # fmt: skip
        own.add(self.calibration.points_topic)
        return sorted(
            topic
            for topic, kinds in self._node.get_topic_names_and_types()
            if set(CLOUDS).intersection(kinds) and topic not in own and self._node.count_publishers(topic)
        )

    def _check_cloud(self, message: PointCloud2 | bytes) -> PointCloud2:
        """The cloud, if it is of this drive. An unreadable one is accepted, as a failed scan, if a cloud was due.

        Raises:
            RejectedError: it is in another frame, or unreadable when no cloud was due.
        """
        cloud, problem = checked_cloud(message)
        now, frame, last = time.monotonic(), cloud.header.frame_id, self.synchronizer.last_arrival
        if self._cloud_frame not in (None, frame) and last is not None and now - last < OTHER_FRAME:
            raise RejectedError(
                "another frame", f"a cloud in frame {frame[:80]!r}; the drive's is {self._cloud_frame!r}"
            )
        if problem and not (
            frame == self._cloud_frame and self.synchronizer.due(stamp_ns(cloud.header), now, self._clock)
        ):
            raise RejectedError("unreadable", problem)
        self._cloud_frame = frame
        return cloud

    def _on_cloud(self, message: PointCloud2 | bytes, info: Mapping[str, Any]) -> None:
        cloud, *others = self.subscriptions
        self._process_clock()
        for other in reversed(others):  # messages sent before the cloud are added before it; calibration first
            other.take()
        # With several publishers, each has its own numbers.
        number = info.get("publication_sequence_number") if self._node.count_publishers(cloud.topic) < 2 else None
        try:
            message = self._check_cloud(message)
        except UsageError:
            self.losses.skip(number)
            raise
        if header_stamp := stamp_ns(message.header):
            self._clock_pairs.append((header_stamp, self._node.get_clock().now().nanoseconds))
        stamp = self._stamp(message)
        for topic, sensor in self.synchronizer.sensors.items():  # without the lock, for which the worker would wait
            sensor.present = bool(self._node.count_publishers(topic))
        with self._arrived:
            lost = self.losses.add(stamp, number)
            check = self.synchronizer.add_cloud(stamp, message, time.monotonic(), self._clock)
            self._arrived.notify()
        if lost:
            self._node.get_logger().warning(
                f"{lost} clouds before that at {stamp / 1e9:.3f} s were lost on the way", throttle_duration_sec=5
            )
        text = f"cloud at {stamp_ns(message.header) / 1e9:.3f} s: {check}"
        if check is StampCheck.SET_BACK:  # not throttled: it follows the warnings on clouds out of order
            self._node.get_logger().warning(text)
        elif check is not StampCheck.ACCEPTED:
            self._node.get_logger().warning(text, throttle_duration_sec=5)

    def _process_clock(self) -> None:
        """Process the /clock messages that have arrived: in lockstep, the last one has the time of the cloud."""
        if self._node.get_clock().ros_time_is_active:
            for subscription in list(self._node.subscriptions):
                if subscription.topic_name == CLOCK_TOPIC:
                    take_waiting(subscription)

    def _on_image(self, camera: CameraTopic, message: Any) -> None:
        check_header(message.header)
        check_size(message)
        stamp = self._stamp(message)
        self.calibration.check_sensor(camera.topic, message.header.frame_id, stamp)
        self._add(camera.topic, stamp + self._image_shift, message)

    def _on_second_cloud(self, message: PointCloud2 | bytes) -> None:
        cloud, problem = checked_cloud(message)
        if problem:
            raise RejectedError("unreadable", problem)
        self._add(self.calibration.second_topic, self._stamp(cloud), cloud)

    def _add(self, topic: str, stamp: int, message: Any) -> None:
        with self._arrived:
            self.synchronizer.add(topic, stamp, message, time.monotonic())
            self._arrived.notify()

    def _on_imu(self, message: Imu) -> None:
        check_header(message.header)
        if self.imu is not None:
            stamp = self._stamp(message)
            self.calibration.check_sensor(self.calibration.imu_topic, message.header.frame_id, stamp)
            self.imu.add(stamp, message)
            self.imu_received, self.imu_last = self.imu_received + 1, time.monotonic()

    def _on_fix(self, message: NavSatFix) -> None:
        check_header(message.header)
        if self.gnss is not None:
            stamp = self._stamp(message)
            self.calibration.check_sensor(self.calibration.gnss_topic, message.header.frame_id, stamp)
            if self.gnss.add(stamp, message):  # else the receiver reports that it has no fix
                self.gnss_last = stamp, time.monotonic()
            self.gnss_received += 1

    @property
    def _clock(self) -> float:
        """Time of /clock, s; 0 if the node does not use it."""
        clock = self._node.get_clock()
        return float(clock.now().nanoseconds * 1e-9) if clock.ros_time_is_active else 0.0

    def _stamp(self, message: Any) -> int:
        """Stamp in ns; the time of arrival if the driver leaves the stamp at 0."""
        return stamp_ns(message.header) or self._node.get_clock().now().nanoseconds

    def _on_camera_info(self, camera: CameraTopic, message: CameraInfo) -> None:
        check_header(message.header)
        info = info_of(camera.topic, message)
        if _is_usable(camera.info):
            decode_camera(info, np.eye(4), "camera")  # raises if it is invalid: the known one stays
            frame, known, images = info.header.frame_id, camera.info.header.frame_id, self.calibration.frame_of(camera)
            if images and frame_name(frame) not in (images, frame_name(known)):
                raise RejectedError("another frame", f"a CameraInfo in frame {frame[:80]!r}, the images' is {images!r}")
        camera.info = info

    def _on_static(self, message: Any) -> None:
        self._static_messages += 1
        before = self.calibration.transforms
        tree, problem = extended(before, message)
        if changed := replaced(before, tree):
            text = f"{self._static_topic}: {excerpt(changed)}; if two publishers disagree, the last message is used"
            self._node.get_logger().warning(text, throttle_duration_sec=5)
        self.calibration.transforms = tree  # a new tree: the worker may be reading the old one
        if problem:
            raise RejectedError("transform", problem)

    def _on_correction(self, message: Float64) -> None:
        self.calibration.angle_correction_deg = checked_correction(message.data, self._correction_topic)

    def _refresh(self) -> None:
        for subscription in self.subscriptions:
            subscription.refresh()


def _with_defaults(settings: InputSettings) -> InputSettings:
    """The settings, with the default topic for each one that is empty."""
    defaults = {"points_topic": naming.POINTS, "image_topic": naming.IMAGE, "imu_topic": naming.IMU.lstrip("/")}
    return settings.model_copy(update={key: getattr(settings, key) or topic for key, topic in defaults.items()})


def _make_calibration(node: Node, unresolved: InputSettings) -> Calibration:
    """A calibration with the full names of the topics, after remapping; it contains no values yet."""
    known = Calibration(node.resolve_topic_name(unresolved.points_topic))
    if unresolved.second_points_topic:
        known.second_topic = node.resolve_topic_name(unresolved.second_points_topic)
        if known.second_topic == known.points_topic:
            raise UsageError(f"input.second_points_topic: {known.points_topic} is that of the first LiDAR")
    if unresolved.imu:
        known.imu_topic = node.resolve_topic_name(unresolved.imu_topic)
    if unresolved.gnss_topic:
        known.gnss_topic = node.resolve_topic_name(unresolved.gnss_topic)
    if unresolved.images:
        known.camera = CameraTopic(node.resolve_topic_name(unresolved.image_topic))
    if unresolved.images and unresolved.second_image_topic:
        known.second_camera = CameraTopic(node.resolve_topic_name(unresolved.second_image_topic))
        if known.second_camera.topic == known.cameras[0].topic:
            raise UsageError(f"input.second_image_topic: {known.second_camera.topic} is that of the first camera")
    return known


def _is_usable(info: Any) -> bool:
    """Whether it is a usable CameraInfo."""
    if info is None:
        return False
    try:
        decode_camera(info, np.eye(4), "camera")
    except UsageError:
        return False
    return True


def _camera_info_topic(node: Node, image_topic: str) -> str:
    """The camera_info topic next to that of the images after remapping, unless it has its own remapping."""
    default = info_topic_beside(image_topic)
    if node.resolve_topic_name(default) != node.resolve_topic_name(default, only_expand=True):
        return default
    return info_topic_beside(node.resolve_topic_name(image_topic))
