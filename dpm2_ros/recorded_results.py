# SPDX-License-Identifier: Apache-2.0
"""Leaves out results of dpm2 in a recording. A recording made while nodes of dpm2 ran also contains their messages. If
such nodes run again, both would be mixed: old and new poses on one topic, and two poses of one frame on /tf."""

from __future__ import annotations

from collections.abc import Collection, Iterable

from rclpy.node import Node
from rclpy.serialization import deserialize_message, serialize_message

from dpm2_core.data.bag_file import Bag
from dpm2_core.data.naming import frame_name
from dpm2_ros.lockstep import ODOMETRY
from dpm2_ros.tf_message import TFMessage


def is_result(topic: str) -> bool:
    """Whether it is a topic that dpm2 publishes."""
    return "/dpm2/" in topic


def published_here(node: Node, topics: Iterable[str]) -> list[str]:
    """Those of the topics that other nodes of dpm2 publish now."""
    own = node.get_name()
    return [
        topic
        for topic in topics
        if is_result(topic) and any(one.node_name != own for one in node.get_publishers_info_by_topic(topic))
    ]


def odometry_frames(bag: Bag, topics: Iterable[str]) -> set[str]:
    """The frames of the odometry on these topics: transforms from or to one of them on the recorded /tf are dpm2's."""
    first = [next(bag.decoded(topic), None) for topic in topics if topic.endswith(f"/{ODOMETRY}")]
    return {frame_name(message.header.frame_id) for message in first if message is not None}


def without_frames(data: bytes, frames: Collection[str]) -> bytes:
    """A serialized TFMessage without the transforms from or to these frames; empty if there is no other."""
    try:
        transforms = deserialize_message(data, TFMessage).transforms
    except Exception:  # rclpy raises RMWError or RuntimeError; subscribers report what is wrong
        return data
    kept = [t for t in transforms if not {frame_name(t.header.frame_id), frame_name(t.child_frame_id)} & {*frames}]
    return bytes(serialize_message(TFMessage(transforms=kept))) if kept else b""
