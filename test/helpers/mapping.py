# SPDX-License-Identifier: Apache-2.0
"""Messages to mapper_node, and the state of its map; `mapper` is the fixture of test/dpm2_ros."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from nav_msgs.msg import Odometry
from sensor_msgs.msg import PointCloud2
from std_msgs.msg import UInt8MultiArray

from dpm2_core.estimates import Keyframe
from dpm2_core.geometry import se3
from dpm2_core.slam.mapping.mapper import Mapper
from dpm2_ros.conversions import edge_to_msg, keyframe_name
from dpm2_ros.keyframe_messages import payload_to_msgs
from dpm2_ros.mapping import KEEP_ALL
from dpm2_ros.tf_message import TFMessage

from .diagnostics import having

S, OTHER = "5f3a9c01", "00000bad"  # sessions


class Wires:
    """Publishers of a robot's keyframes: of their poses, descriptors and clouds."""

    def __init__(self, harness: Any, namespace: str = "") -> None:
        kinds = ((Odometry, "keyframe_odom"), (PointCloud2, "keyframe"), (UInt8MultiArray, "keyframe_cloud"))
        create, self._harness = harness.node.create_publisher, harness
        self.all = [create(kind, f"{namespace}/dpm2/{topic}", KEEP_ALL) for kind, topic in kinds]
        self.pose, _, self.cloud = self.all

    def wait(self) -> None:
        """Wait for the subscriptions of the mapper."""
        self._harness.wait(lambda: all(wire.get_subscription_count() for wire in self.all), "the mapper's ears")

    def send(self, keyframe: Keyframe, name: str, weights: str = "", cloud_first: bool = False) -> None:
        """Publish the three messages of a keyframe."""
        pose = edge_to_msg(keyframe.T_odom_kf, np.eye(6) * 1e-4, keyframe.stamp, "odom", name)
        parts = list(zip(self.all, (pose, *payload_to_msgs(keyframe, name, weights)), strict=True))
        for wire, part in reversed(parts) if cloud_first else parts:
            wire.publish(part)


def core(mapper: Any) -> Mapper:
    """The node's `Mapper`."""
    return mapper.mapper.slam.mapper


def keyframes(mapper: Any) -> int:
    """Number of keyframes in the map so far."""
    return len(core(mapper).keyframes)


def mapped(mapper: Any, count: int) -> None:
    """Wait until `count` keyframes are in the map, and all their processing is done."""
    mapper.status("mapper_node: mapper", having(keyframes=count, waiting=0))


def points(seed: int) -> np.ndarray:
    return np.random.default_rng(seed).uniform(0, 1, (500, 4)).astype(np.float32) * np.float32([20, 20, 5, 1])


def placed(mapper: Any) -> tuple[Callable[..., None], list[TFMessage]]:
    """A function that publishes an odometry at its origin with a stamp (ns) and a frame, and the transforms
    received."""
    odometry, heard = mapper.publisher(Odometry, "/dpm2/odom"), mapper.hear(TFMessage, "/tf")
    mapper.wait(lambda: odometry.get_subscription_count() and mapper.found_by(mapper.mapper, "/tf"), "connections")

    def move(stamp: int, frame: str = "odom") -> None:
        odometry.publish(edge_to_msg(np.eye(4), np.eye(6), stamp, frame, "base"))

    return move, heard


def taken_in(mapper: Any) -> None:
    """Wait until the mapper has received every keyframe that was sent: a pose sent after them has been rejected.
    Messages on other topics may arrive before or after."""
    before = sum(mapper.mapper.rejections.values())
    mapper.wires.pose.publish(edge_to_msg(np.eye(4), np.eye(6), 1000, "odom", "no keyframe"))
    mapper.wait(lambda: sum(mapper.mapper.rejections.values()) > before, "the rejection")


def send_all(mapper: Any, *ids: int, session: str = S, shift: float = 0.0) -> None:
    for id in ids:
        T = se3.exp([0, 0, 0, 5.0 * id + shift, 0, 0])
        mapper.send(id, T, points(id), name=keyframe_name("", id, session))


def rejections(mapper: Any) -> dict[str, int]:
    """Rejections as published in the diagnostics."""
    for message in reversed(mapper.diagnostics):
        for status in message.status:
            if status.name == "mapper_node: messages":
                return {value.key: int(value.value) for value in status.values if value.value != "0"}
    return {}
