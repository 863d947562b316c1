# SPDX-License-Identifier: Apache-2.0
"""Plays a recording in lockstep: a cloud is published once the previous one has its odometry, and never before its
images, its IMU samples and the cloud of a second LiDAR. So nothing depends on processing times, and slam_node processes
the same input as `dpm2 run`.
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
"""Longest wait for the odometry of a cloud, s, after which the next one is published: a node rejects a repeated stamp.
"""
_SECOND_TOPIC = "input.second_points_topic"
_RETRY_PERIOD = 2.0
"""Seconds without a response after which a node is asked once more: Fast DDS drops a response without an error here, if
the node has not discovered the client within 0.1 s."""


class Lockstep:
    """Order and pace of a player that waits for the node.

    Args:
        node: of the player.
        bag: the recording.
        publishers: by topic.
    """

    def __init__(self, node: Any, bag: Bag, publishers: Mapping[str, Any]) -> None:
        self._node, self._bag, self._publishers = node, bag, publishers
        qos = QoSProfile(depth=100, reliability=ReliabilityPolicy.RELIABLE)
        self._odometry = node.create_subscription(Odometry, ODOMETRY, self._on_odometry, qos)
        self._executor = SingleThreadedExecutor()
        self._executor.add_node(node)
        self._clouds: list[str] = []  # topics whose clouds get an odometry
        self._second_topics: list[str] = []  # topics of second LiDARs, whose clouds are joined to those
        self._awaited: int | None = None  # stamp of the cloud whose odometry is awaited, ns; 0: it has no stamp
        self._last_stamps: dict[str, int] = {}  # stamp of the last image or joining cloud, by topic
        self._sent = self._missing = 0

    def find(self, end: float) -> None:
        """Wait, until `end` of the monotonic clock, for the node that computes odometry from clouds.

        Raises:
            Dpm2Error: there is none.
        """
        topic, clouds = self._odometry.topic_name, [t for t in self._publishers if self._bag.types[t] in CLOUDS]
        while not STOP.wait(0.02):
            nodes = {_node_name(info) for info in self._node.get_publishers_info_by_topic(topic)}
            subscribers = {
                cloud: nodes & {_node_name(info) for info in self._node.get_subscriptions_info_by_topic(cloud)}
                for cloud in clouds
                if self._publishers[cloud].get_subscription_count()
            }
            used = [cloud for cloud, found in subscribers.items() if found]
            if used and self._odometry.get_publisher_count():
                # Two LiDARs of one node have one odometry, that of the first; a parameter names the second.
                candidates = nodes if len(clouds) > 1 else set()
                self._second_topics = [
                    second for node in sorted(candidates) if (second := self._second_topic_of(*node)) in used
                ]
                self._clouds = [cloud for cloud in used if cloud not in self._second_topics]
                if self._clouds:
                    self._check_one_topic_per_node(subscribers)
                    return
            if time.monotonic() >= end:
                raise Dpm2Error(
                    f"lockstep: no node subscribes to {' or '.join(clouds) or 'clouds'} and publishes {topic}"
                )

    def _check_one_topic_per_node(self, subscribers: Mapping[str, set[tuple[str, str]]]) -> None:
        """Raises Dpm2Error unless each node computes its odometry from one of the cloud topics."""
        for a, b in combinations(self._clouds, 2):
            if common := subscribers[a] & subscribers[b]:
                raise Dpm2Error(
                    f"lockstep: {min(common)[1]} takes clouds of {a} and {b}, and its {_SECOND_TOPIC} is neither: "
                    "which of them get an odometry is not known; replay without lockstep"
                )

    def _second_topic_of(self, namespace: str, name: str) -> str:
        """The topic of a node's second LiDAR, by its parameter; empty if it does not respond, or has none."""
        client = self._node.create_client(GetParameters, f"{namespace.rstrip('/')}/{name}/get_parameters")
        try:
            if not client.wait_for_service(TIMEOUT):
                return ""
            end, futures, responses = time.monotonic() + TIMEOUT, list[Any](), list[Any]()
            while not responses and not STOP.is_set() and (remaining := end - time.monotonic()) > 0:
                futures.append(client.call_async(GetParameters.Request(names=[_SECOND_TOPIC])))
                self._executor.spin_until_future_complete(futures[-1], min(remaining, _RETRY_PERIOD))
                responses = [future.result() for future in futures if future.done()]
            values = responses[0].values if responses else []
            topic: str = values[0].string_value if values else ""
            return topic and expand_topic_name(topic, name, namespace)
        finally:
            self._node.destroy_client(client)

    def begin(self) -> None:
        """Before the first message: publish the CameraInfo of each camera, which `dpm2 run` has from the start."""
        for topic, publisher in self._publishers.items():
            if self._bag.types[topic] == CAMERA_INFO:
                for _, _, data in islice(self._bag.playable([topic]), 1):
                    publisher.publish(bytes(data))

    def order(self, messages: Iterable[RawMessage]) -> Iterator[RawMessage]:
        """The same messages in the order of `dpm2 run`: each cloud follows its images, its IMU samples and the cloud
        that is joined to it, as far as they have a subscriber.
        """
        listened = [topic for topic, publisher in self._publishers.items() if publisher.get_subscription_count()]
        topics = [t for t in listened if self._bag.types[t] in (*IMAGES, IMU) or t in self._second_topics]
        others = {topic: -SWEEP if self._bag.types[topic] == IMU else 0 for topic in topics}
        return clouds_after_others(messages, self._clouds, others)

    def await_turn(self, topic: str, data: bytes) -> None:
        """Before a message is published: wait, if it is a cloud, for the odometry of the previous cloud.

        The messages synchronized with a cloud (images and the cloud that is joined to it) are published before the
        wait, and so have arrived when it ends. An image or joined cloud also waits if it may be closer to the previous
        cloud than those published before that cloud: it comes too late for it. So does a fix or an IMU sample that the
        previous cloud would use if it arrived in time.

        Raises:
            Dpm2Error: the node is gone.
        """
        kind, stamp, awaited = self._bag.types[topic], serialized_stamp(data, 0), self._awaited
        if kind in IMAGES or topic in self._second_topics:
            last_stamp = self._last_stamps.get(topic, 0)
            if awaited is not None and not (passed(last_stamp, awaited) and last_stamp <= stamp):
                self._await_odometry()
            self._last_stamps[topic] = stamp
        elif kind in (FIX, IMU) and awaited is not None and stamp <= awaited + SWEEP:
            self._await_odometry()
        if topic in self._clouds:
            self._await_odometry()
            self._awaited, self._sent = stamp, self._sent + 1

    def awaits(self, topic: str) -> bool:
        """Whether the clouds of that topic get an odometry."""
        return topic in self._clouds

    def conclude(self) -> None:
        """After the last message: wait for the last odometry, and log the result.

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
        if self._awaited in (0, stamp_ns(message.header)):  # a cloud without a stamp gets its arrival time
            self._awaited = None


def _node_name(info: Any) -> tuple[str, str]:
    return info.node_namespace, info.node_name
