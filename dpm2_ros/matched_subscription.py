# SPDX-License-Identifier: Apache-2.0
"""A subscription whose QoS and message type match its publishers."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import CameraInfo, CompressedImage, Image, Imu, PointCloud2

from dpm2_core.data.livox import LIVOX
from dpm2_core.data.message_kinds import CLOUD, IMAGES
from dpm2_ros.guard import take_waiting
from dpm2_ros.message_types import message_type
from dpm2_ros.settings import RosSettings

_IMAGES = (Image, CompressedImage)
_IMU_DEPTH = 1000  # samples that may wait: those of one second
_PARTS = 10  # clouds that may wait for each of `ros.queue_depth` sweeps: its parts


class MatchedSubscription:
    """A subscription with the reliability that the publishers offer and, for CameraInfo, with their durability.

    A reliable subscriber never connects to a best-effort publisher, and a best-effort one loses data that a reliable
    publisher would have sent again. So it starts reliable, and `refresh`, called often, follows the publishers. It also
    changes the type with them: from Image to CompressedImage and back, and from PointCloud2 to Livox CustomMsg, whose
    messages are passed on serialized.

    Attributes:
        topic: its full name, after remapping.
        problem: why nothing is received although there is a publisher; else empty.
    """

    def __init__(self, node: Node, kind: type, topic: str, callback: Callable[..., None], ros: RosSettings) -> None:
        self._node, self._requested_kind, self._callback = node, kind, callback
        depths = {Imu: _IMU_DEPTH, PointCloud2: _PARTS * ros.queue_depth}
        self._reliability_setting, self._depth = ros.reliability, depths.get(kind, ros.queue_depth)
        self._unresolved_topic, self.topic = topic, node.resolve_topic_name(topic)
        self._current = ReliabilityPolicy.RELIABLE, DurabilityPolicy.VOLATILE, kind
        self._subscription: Any = None
        self.problem = ""
        self.refresh()

    def take(self) -> None:
        """Call the callback, in the executor's thread, with all messages that have arrived."""
        take_waiting(self._subscription)

    def refresh(self) -> None:
        """Adapt the subscription to the present publishers."""
        requested, offered = self._current[0], self._node.get_publishers_info_by_topic(self.topic)
        best_effort = [info.qos_profile.reliability == ReliabilityPolicy.BEST_EFFORT for info in offered]
        if self._reliability_setting != "auto":
            requested = ReliabilityPolicy[self._reliability_setting.upper()]
        elif offered:
            requested = ReliabilityPolicy.BEST_EFFORT if any(best_effort) else ReliabilityPolicy.RELIABLE
        latched = DurabilityPolicy.TRANSIENT_LOCAL
        is_latched = (
            self._requested_kind is CameraInfo and offered and all(i.qos_profile.durability == latched for i in offered)
        )
        durability = latched if is_latched else DurabilityPolicy.VOLATILE  # for one sent only once, long ago
        self.problem = ""
        kind = self._kind_for({info.topic_type for info in offered})
        if requested == ReliabilityPolicy.RELIABLE and best_effort and all(best_effort):
            self.problem = f"{self.topic} is best effort, but ros.reliability is reliable: set it to auto"
        previous, self._current = self._current, (requested, durability, kind)
        if self._subscription is not None and self._current == previous:
            return
        old_subscription, type_changed = self._subscription, kind is not previous[2]
        raw = self._requested_kind is PointCloud2 and kind is not PointCloud2
        if old_subscription is not None and type_changed:  # DDS allows one type per topic
            self._node.destroy_subscription(old_subscription)
        keep = HistoryPolicy.KEEP_LAST
        qos = QoSProfile(depth=self._depth, history=keep, reliability=requested, durability=durability)
        self._subscription = self._node.create_subscription(kind, self._unresolved_topic, self._callback, qos, raw=raw)
        if old_subscription is not None:
            if not type_changed:
                self._node.destroy_subscription(old_subscription)
            self._node.get_logger().info(f"{self.topic}: {requested.name.lower()} {kind.__name__}, as its publisher")

    def _kind_for(self, offered: set[str]) -> type:
        """What to subscribe to, given the types of the publishers."""
        if self._requested_kind in _IMAGES:
            kinds = [kind for kind, name in zip(_IMAGES, IMAGES, strict=True) if name in offered]
            return kinds[0] if len(kinds) == 1 else self._requested_kind
        custom = sorted(offered.intersection(LIVOX))
        if self._requested_kind is not PointCloud2 or not custom or CLOUD in offered:
            return self._requested_kind
        found = message_type(custom[0])
        if found is None:
            self.problem = (
                f"{self.topic} is a {custom[0]}, whose package is not installed here: install it, or let the driver "
                f"send PointCloud2 (xfer_format: 0)"
            )
            self._node.get_logger().error(self.problem, once=True)
        return found or self._requested_kind
