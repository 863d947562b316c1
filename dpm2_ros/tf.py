# SPDX-License-Identifier: Apache-2.0
"""/tf, where its message is there."""

from __future__ import annotations

from rclpy.node import Node

from dpm2_core.frame import Array
from dpm2_core.geometry import se3
from dpm2_ros.conversions import transform_to_msg
from dpm2_ros.tf_message import TFMessage


class TransformBroadcaster:
    """Publishes one transform of /tf.

    Args:
        enabled: False publishes nothing.
        inverted: the parent becomes the child.
    """

    def __init__(self, node: Node, parent: str, enabled: bool, inverted: bool = False) -> None:
        self._parent, self._inverted = parent, inverted
        self._publisher = None
        if not enabled:
            return
        if TFMessage is None:
            node.get_logger().error("no /tf: tf2_msgs is missing; `python -m dpm2_ros.build_tf2_msgs` builds it")
            return
        self._publisher = node.create_publisher(TFMessage, "/tf", 100)

    def send(self, T_parent_child: Array, stamp: int, child: str) -> None:
        """(4, 4) at a stamp in ns."""
        if self._publisher is None:
            return
        link = (T_parent_child, stamp, self._parent, child)
        if self._inverted:
            link = (se3.inverse(T_parent_child), stamp, child, self._parent)
        self._publisher.publish(TFMessage(transforms=[transform_to_msg(*link)]))
