# SPDX-License-Identifier: Apache-2.0
"""A recording into the graph exactly: a cloud goes out when the one before has its odometry, and never ahead of its
images and IMU samples, nor of the cloud of a second LiDAR. So nothing depends on how long anything takes, and slam_node
sees what `dpm2 run` sees.
"""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator, Mapping
from itertools import combinations, islice
from typing import Any

from nav_msgs.msg import Odometry
from rcl_interfaces.srv import GetParameters
from rclpy.executors import SingleThreadedExecutor
from rclpy.expand_topic_name import expand_topic_name
from rclpy.qos import QoSProfile, ReliabilityPolicy

from dpm2_core.data.bag_file import Bag
from dpm2_core.data.message_kinds import CAMERA_INFO, CLOUDS, FIX, IMAGES, IMU
from dpm2_core.data.messages import serialized_stamp, stamp_ns
from dpm2_core.data.pairing import SWEEP, RawMessage, clouds_after_others, passed
from dpm2_core.errors import Dpm2Error
from dpm2_ros.runtime import STOP

ODOMETRY = "dpm2/odom"
"""Topic, in the namespace of the player."""
TIMEOUT = 10.0
"""Seconds that a cloud waits for its odometry. A node rejects one whose stamp repeats; then the next goes out."""
_SECOND = "input.second_points_topic"
_AGAIN = 2.0
"""Seconds without an answer after which a node is asked once more: Fast DDS drops an answer where the node has not
found who asks within 0.1 s, and does not say so here."""


class Lockstep:
    """The order and the pace of a player that waits for the node.

    Args:
        node: of the player.
        bag: what is played.
        publishers: by topic.
    """

    def __init__(self, node: Any, bag: Bag, publishers: Mapping[str, Any]) -> None:
        self._node, self._bag, self._publishers = node, bag, publishers
        qos = QoSProfile(depth=100, reliability=ReliabilityPolicy.RELIABLE)
        self._odometry = node.create_subscription(Odometry, ODOMETRY, self._on_odometry, qos)
        self._executor = SingleThreadedExecutor()
        self._executor.add_node(node)
        self._clouds: list[str] = []  # topics that get an odometry
        self._joining: list[str] = []  # of second LiDARs, whose clouds join those
        self._awaited: int | None = None  # stamp of the cloud whose odometry is awaited, ns; 0: it has no stamp
        self._beside: dict[str, int] = {}  # stamp of the last image or joining cloud, by topic
        self._sent = self._missing = 0

    def find(self, end: float) -> None:
        """Wait, until `end` of the monotonic clock, for the node that turns clouds into odometry.

        Raises:
            Dpm2Error: there is none.
        """
        topic, clouds = self._odometry.topic_name, [t for t in self._publishers if self._bag.types[t] in CLOUDS]
        while not STOP.wait(0.02):
            nodes = {_node(info) for info in self._node.get_publishers_info_by_topic(topic)}
            takers = {
                cloud: nodes & {_node(info) for info in self._node.get_subscriptions_info_by_topic(cloud)}
                for cloud in clouds
                if self._publishers[cloud].get_subscription_count()
            }
            taken = [cloud for cloud, found in takers.items() if found]
            if taken and self._odometry.get_publisher_count():
                # Two LiDARs of one node make one odometry, that of the first: which is the second one the node says.
                among = nodes if len(clouds) > 1 else set()
                self._joining = [second for node in sorted(among) if (second := self._second_of(*node)) in taken]
                self._clouds = [cloud for cloud in taken if cloud not in self._joining]
                if self._clouds:
                    self._check_alone(takers)
                    return
            if time.monotonic() >= end:
                raise Dpm2Error(f"lockstep: no node turns {' or '.join(clouds) or 'clouds'} into {topic}")

    def _check_alone(self, takers: Mapping[str, set[tuple[str, str]]]) -> None:
        """Whether each node makes its odometry of one of the clouds."""
        for one, other in combinations(self._clouds, 2):
            if common := takers[one] & takers[other]:
                raise Dpm2Error(
                    f"lockstep: {min(common)[1]} takes clouds of {one} and {other}, and its {_SECOND} is neither: "
                    "which of them get an odometry is not known; replay without lockstep"
                )

    def _second_of(self, namespace: str, name: str) -> str:
        """The topic of a node's second LiDAR by its parameters; empty if it does not answer, or has none."""
        client = self._node.create_client(GetParameters, f"{namespace.rstrip('/')}/{name}/get_parameters")
        try:
            if not client.wait_for_service(TIMEOUT):
                return ""
            end, asked, answers = time.monotonic() + TIMEOUT, list[Any](), list[Any]()
            while not answers and not STOP.is_set() and (left := end - time.monotonic()) > 0:
                asked.append(client.call_async(GetParameters.Request(names=[_SECOND])))
                self._executor.spin_until_future_complete(asked[-1], min(left, _AGAIN))
                answers = [future.result() for future in asked if future.done()]
            values = answers[0].values if answers else []
            topic: str = values[0].string_value if values else ""
            return topic and expand_topic_name(topic, name, namespace)
        finally:
            self._node.destroy_client(client)

    def begin(self) -> None:
        """Before the first message: the calibration of each camera, which `dpm2 run` has from the start."""
        for topic, publisher in self._publishers.items():
            if self._bag.types[topic] == CAMERA_INFO:
                for _, _, data in islice(self._bag.playable([topic]), 1):
                    publisher.publish(bytes(data))

    def order(self, messages: Iterable[RawMessage]) -> Iterator[RawMessage]:
        """The same messages as `dpm2 run` takes them: a cloud after images, IMU and what joins it, of those that have a
        subscriber.
        """
        listened = [topic for topic, publisher in self._publishers.items() if publisher.get_subscription_count()]
        beside = [t for t in listened if self._bag.types[t] in (*IMAGES, IMU) or t in self._joining]
        others = {topic: -SWEEP if self._bag.types[topic] == IMU else 0 for topic in beside}
        return clouds_after_others(messages, self._clouds, others)

    def turn(self, topic: str, data: bytes) -> None:
        """Before a message is published: wait, if it is a cloud, for the odometry of the one before.

        What goes with it, images and the cloud that joins it, went out before the wait, and so has arrived when it
        ends. One that may be nearer to the cloud before than those that went out ahead of it came too late for it, and
        waits as well; so does a fix, or a sample, that the cloud before would take if it were there.

        Raises:
            Dpm2Error: the node is gone.
        """
        kind, stamp, awaited = self._bag.types[topic], serialized_stamp(data, 0), self._awaited
        if kind in IMAGES or topic in self._joining:
            before = self._beside.get(topic, 0)
            if awaited is not None and not (passed(before, awaited) and before <= stamp):
                self._await_odometry()
            self._beside[topic] = stamp
        elif kind in (FIX, IMU) and awaited is not None and stamp <= awaited + SWEEP:
            self._await_odometry()
        if topic in self._clouds:
            self._await_odometry()
            self._awaited, self._sent = stamp, self._sent + 1

    def awaits(self, topic: str) -> bool:
        """Whether it has clouds that get an odometry."""
        return topic in self._clouds

    def conclude(self) -> None:
        """After the last message: wait for the last odometry, and say how it went.

        Raises:
            Dpm2Error: not every cloud had its odometry.
        """
        self._await_odometry()
        if STOP.is_set():
            return
        if self._missing:
            raise Dpm2Error(f"lockstep: {self._missing} of {self._sent} clouds had no odometry")
        self._node.get_logger().info(f"lockstep: each of {self._sent} clouds had its odometry")

    def _await_odometry(self) -> None:
        end = time.monotonic() + TIMEOUT
        while self._awaited is not None and not STOP.is_set():
            if not self._odometry.get_publisher_count():
                raise Dpm2Error(f"lockstep: {self._odometry.topic_name} has no publisher any more")
            if time.monotonic() >= end:
                self._node.get_logger().warning(
                    f"lockstep: no odometry within {TIMEOUT:g} s for the cloud at {self._awaited * 1e-9:.3f} s; "
                    "the next one goes out"
                )
                self._missing, self._awaited = self._missing + 1, None
                return
            self._executor.spin_once(timeout_sec=0.1)

    def _on_odometry(self, message: Odometry) -> None:
        if self._awaited in (0, stamp_ns(message.header)):  # a cloud without a stamp gets the time of its arrival
            self._awaited = None


def _node(info: Any) -> tuple[str, str]:
    return info.node_namespace, info.node_name
