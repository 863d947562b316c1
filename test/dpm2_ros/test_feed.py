# SPDX-License-Identifier: Apache-2.0
"""What a feed has acknowledged reaches the map, whatever ends first."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Any

import numpy as np
from nav_msgs.msg import Odometry
from sensor_msgs.msg import PointCloud2
from std_msgs.msg import UInt8MultiArray, UInt32MultiArray

from dpm2_core.frame import Keyframe
from dpm2_core.slam.settings import SlamSettings
from dpm2_ros.conversions import edge_to_msg, keyframe_name
from dpm2_ros.feed import Feed
from dpm2_ros.guard import GuardedNode
from dpm2_ros.keyframes import WIRE, payload_to_msgs
from dpm2_ros.mapping import MapperThread
from dpm2_ros.settings import NodeConfig, RosSettings

COUNT = 45  # more than may wait for the mapper


def keyframe(id: int) -> Keyframe:
    points = np.random.default_rng(id).uniform(0, 20, (100, 4)).astype(np.float32)
    return Keyframe(id, 1000 + id, id, np.eye(4), points)


class Node(GuardedNode):
    """A map, and the keyframes of one robot."""

    def __init__(self) -> None:
        super().__init__("mapper")
        slam = SlamSettings.model_validate({"registration": "geometric", "loops": {"descriptors": False}})
        self.mapper = MapperThread(self, NodeConfig(slam=slam, ros=RosSettings(map_directory="")), "robot")
        self.feed = Feed(self, self.mapper, "/robot", "")
        self.feed.open()
        self.create_timer(0.1, self.feed.tick)
        self.busy = threading.Event()

    def wait(self) -> Keyframe:
        """A first keyframe that takes long."""
        self.busy.wait()
        return keyframe(0)

    def close(self) -> None:
        """The feed first, while the mapper is still busy."""
        self.feed.close()
        self.busy.set()
        self.mapper.close()


def test_what_it_has_acknowledged_reaches_the_map(ros: Callable[..., Any]) -> None:
    """Also where it is closed while keyframes come faster than the mapper works: their robot may be gone."""
    harness = ros()
    kinds = ((Odometry, "keyframe_odom"), (PointCloud2, "keyframe"), (UInt8MultiArray, "keyframe_cloud"))
    wires = [harness.node.create_publisher(kind, f"/robot/dpm2/{topic}", WIRE) for kind, topic in kinds]
    acknowledged = harness.hear(UInt32MultiArray, "/robot/dpm2/keyframes_received")
    node = harness.add(Node())
    node.mapper.add(node.wait)
    harness.wait(lambda: all(wire.get_subscription_count() for wire in wires), "the feed")
    for id in range(COUNT):
        name = keyframe_name("robot", id, "0123abcd")
        pose = edge_to_msg(np.eye(4), np.eye(6) * 1e-4, 1000 + id, "odom", name)
        for wire, part in zip(wires, (pose, *payload_to_msgs(keyframe(id), name)), strict=True):
            wire.publish(part)
    count = lambda: acknowledged[-1].data[0] + len(acknowledged[-1].data) - 1 if acknowledged else 0  # noqa: E731
    harness.wait(lambda: count() == COUNT, "the acknowledgment of all")
    assert acknowledged[-1].data[0] < COUNT
    harness.remove(node)
    assert len(node.mapper.slam.mapper.keyframes) == COUNT + 1
