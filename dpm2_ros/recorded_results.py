# SPDX-License-Identifier: Apache-2.0
"""A recording that was made while nodes of dpm2 ran has what they published, too. Where such nodes run again, both
would come in turns: poses of then and of now on one topic, and on /tf two places for one frame."""

from __future__ import annotations

from collections.abc import Collection, Iterable

from rclpy.node import Node
from rclpy.serialization import deserialize_message, serialize_message

from dpm2_core.data.bag_file import Bag
from dpm2_core.data.naming import frame_name
from dpm2_ros.lockstep import ODOMETRY
from dpm2_ros.tf_message import TFMessage


def is_result(topic: str) -> bool:
    """Whether it is a topic of dpm2's own."""
    return "/dpm2/" in topic


def published_here(node: Node, topics: Iterable[str]) -> list[str]:
    """Those of the topics that nodes of dpm2 other than this one publish now."""
    own = node.get_name()
    return [
        topic
        for topic in topics
        if is_result(topic) and any(one.node_name != own for one in node.get_publishers_info_by_topic(topic))
    ]


def odometry_frames(bag: Bag, topics: Iterable[str]) -> set[str]:
    """The frames of the odometry of these topics: what the recording has on /tf from or to one of them is dpm2's."""
    first = [next(bag.decoded(topic), None) for topic in topics if topic.endswith(f"/{ODOMETRY}")]
    return {frame_name(message.header.frame_id) for message in first if message is not None}


def without_frames(data: bytes, frames: Collection[str]) -> bytes:
    """A serialized TFMessage without the transforms from or to these frames; empty if there is no other."""
    try:
        transforms = deserialize_message(data, TFMessage).transforms
    except Exception:  # rclpy raises RMWError or RuntimeError; who listens says what is wrong with it
        return data
    kept = [t for t in transforms if not {frame_name(t.header.frame_id), frame_name(t.child_frame_id)} & {*frames}]
    return bytes(serialize_message(TFMessage(transforms=kept))) if kept else b""
