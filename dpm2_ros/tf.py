# SPDX-License-Identifier: Apache-2.0
"""Publishes on /tf, if its message type is available."""

from __future__ import annotations

import time
from typing import Any

from rclpy.callback_groups import CallbackGroup
from rclpy.node import Node

from dpm2_core.data.messages import stamp_ns
from dpm2_core.data.naming import TF, frame_name
from dpm2_core.frame import Array
from dpm2_core.geometry import se3
from dpm2_ros.checks import check_transforms
from dpm2_ros.conversions import transform_to_msg
from dpm2_ros.guard import excerpt, take_waiting
from dpm2_ros.tf_message import TFMessage

_MAX_SENT = 500  # sent transforms kept per child: all that may be received again before they are compared
_RECENT_TIME = 5.0  # s
_Link = tuple[str, int, float, float, float]
"""Parent, stamp (ns) and translation of a transform: two nodes that use the same clouds have the same stamps."""
_REMEDY = "see ros.odom_source, or turn one of the two off, as with ros.publish_tf_odom or ros.publish_tf_map"


class TransformBroadcaster:
    """Publishes transforms of one parent on /tf, and detects another node that publishes a transform of such a child.

    Args:
        enabled: False publishes nothing.
        inverted: the parent becomes the child.
    """

    def __init__(self, node: Node, parent: str, enabled: bool, inverted: bool = False) -> None:
        self._node, self._parent, self._inverted = node, parent, inverted
        self._publisher = self._subscription = None
        self._sent: dict[str, dict[_Link, None]] = {}  # recent ones, by child
        self._conflict: tuple[float, str] | None = None  # when another node last sent one, and the problem in words
        if not enabled:
            return
        if TFMessage is None:
            node.get_logger().error("no /tf: tf2_msgs is missing; `python -m dpm2_ros.build_tf2_msgs` builds it")
            return
        self._publisher = node.create_publisher(TFMessage, TF, 100)
        # Read only now and then: there may be a thousand messages per second.
        self._subscription = node.create_subscription(TFMessage, TF, self._on_tf, 100, callback_group=_UnservedGroup())

    def send(self, T_parent_child: Array, stamp: int, child: str) -> None:
        """Publish a transform (4, 4) at a stamp in ns."""
        if self._publisher is None:
            return
        link = (T_parent_child, stamp, self._parent, child)
        if self._inverted:
            link = (se3.inverse(T_parent_child), stamp, child, self._parent)
        stamped = transform_to_msg(*link)
        sent = self._sent.setdefault(stamped.child_frame_id, {})  # changed here, read in another thread
        sent[_link_of(stamped)] = None
        if len(sent) > _MAX_SENT:
            del sent[next(iter(sent))]
        self._publisher.publish(TFMessage(transforms=[stamped]))

    def problem(self) -> str:
        """Which frame another node publishes, too, in words; empty if there is none. Only for the executor's thread."""
        if self._subscription is not None:
            take_waiting(self._subscription)
        if self._conflict is None or time.monotonic() - self._conflict[0] > _RECENT_TIME:
            return ""
        self._node.get_logger().warning(self._conflict[1], throttle_duration_sec=60)
        return self._conflict[1]

    def _on_tf(self, message: Any) -> None:
        check_transforms(message)
        for stamped in message.transforms:
            sent = self._sent.get(child := frame_name(stamped.child_frame_id))
            if sent is not None and (link := _link_of(stamped)) not in sent:
                text = f"another node also publishes {excerpt(link[0])} -> {child} on /tf: poses in that frame jump"
                self._conflict = time.monotonic(), f"{text}; {_REMEDY}"


def _link_of(stamped: Any) -> _Link:
    at = stamped.transform.translation
    return frame_name(stamped.header.frame_id), stamp_ns(stamped.header), at.x, at.y, at.z


class _UnservedGroup(CallbackGroup):
    """Group of a subscription that no executor serves: its messages wait, and the oldest are dropped."""

    def can_execute(self, entity: Any) -> bool:
        """Never."""
        return False
