# SPDX-License-Identifier: Apache-2.0
"""A recording into the graph exactly: a cloud goes out when the one before has its odometry, and never ahead of its
images. So nothing depends on how long anything takes, and slam_node sees what `dpm2 run` sees.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Iterable, Iterator, Mapping
from typing import Any

from nav_msgs.msg import Odometry
from rclpy.executors import SingleThreadedExecutor
from rclpy.qos import QoSProfile, ReliabilityPolicy

from dpm2_core.data.bag_file import Bag
from dpm2_core.data.bags import CAMERA_INFO, CLOUD, IMAGES, LATE, serialized_stamp
from dpm2_core.data.messages import stamp_ns
from dpm2_core.errors import Dpm2Error
from dpm2_ros.runtime import STOP

ODOMETRY = "dpm2/odom"
"""Topic, in the namespace of the player."""
TIMEOUT = 10.0
"""Seconds that a cloud waits for its odometry. A node rejects one whose stamp repeats; then the next goes out."""

_Message = tuple[str, int, bytes]
_UNSEEN, _SEEN = float("-inf"), float("inf")


class Lockstep:
    """The order and the pace of a player that waits for the node that answers.

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
        self._clouds: list[str] = []  # topics that are answered
        self._asked: int | None = None  # stamp of the cloud that is not answered yet, ns; 0: it has none
        self._sent = self._unanswered = 0

    def find(self, end: float) -> None:
        """Wait, until `end` of the monotonic clock, for the node that turns clouds into odometry.

        Raises:
            Dpm2Error: there is none.
        """
        topic, clouds = self._odometry.topic_name, [t for t in self._publishers if self._bag.types[t] == CLOUD]
        while not STOP.wait(0.02):
            answering = {_node(info) for info in self._node.get_publishers_info_by_topic(topic)}
            self._clouds = [
                cloud
                for cloud in clouds
                if any(_node(info) in answering for info in self._node.get_subscriptions_info_by_topic(cloud))
                and self._publishers[cloud].get_subscription_count()
            ]
            if self._clouds and self._odometry.get_publisher_count():
                return
            if time.monotonic() >= end:
                raise Dpm2Error(f"lockstep: no node turns {' or '.join(clouds) or 'clouds'} into {topic}")

    def order(self, messages: Iterable[_Message]) -> Iterator[_Message]:
        """The same messages, each cloud after the images, of topics that somebody listens to, that may be its own.

        As `dpm2 run` does, it waits until no later image can be nearer, or for half a second of the recording.
        """
        listened = [topic for topic, publisher in self._publishers.items() if publisher.get_subscription_count()]
        latest = {topic: _UNSEEN for topic in listened if self._bag.types[topic] in (*IMAGES, CAMERA_INFO)}
        waiting: deque[_Message] = deque()
        for topic, log_time, data in messages:
            while waiting and log_time - waiting[0][1] > LATE:
                yield waiting.popleft()
            if topic in self._clouds:
                waiting.append((topic, log_time, data))
            else:
                yield topic, log_time, data
            if topic in latest:
                calibration = self._bag.types[topic] == CAMERA_INFO  # any will do
                latest[topic] = _SEEN if calibration else serialized_stamp(data, log_time)
            while waiting and all(stamp >= serialized_stamp(waiting[0][2], waiting[0][1]) for stamp in latest.values()):
                yield waiting.popleft()
        yield from waiting

    def turn(self, topic: str, data: bytes) -> None:
        """Before a message is published: wait, if it is a cloud, for the odometry of the one before.

        Its images went out before the wait, and so have arrived when it ends.

        Raises:
            Dpm2Error: the node is gone.
        """
        if topic in self._clouds:
            self._await_answer()
            self._asked = serialized_stamp(data, 0)
            self._sent += 1

    def conclude(self) -> None:
        """After the last message: wait for the last odometry, and say how it went.

        Raises:
            Dpm2Error: not every cloud had its odometry.
        """
        self._await_answer()
        if STOP.is_set():
            return
        if self._unanswered:
            raise Dpm2Error(f"lockstep: {self._unanswered} of {self._sent} clouds had no odometry")
        self._node.get_logger().info(f"lockstep: each of {self._sent} clouds had its odometry")

    def _await_answer(self) -> None:
        end = time.monotonic() + TIMEOUT
        while self._asked is not None and not STOP.is_set():
            if not self._odometry.get_publisher_count():
                raise Dpm2Error(f"lockstep: nobody publishes {self._odometry.topic_name} any more")
            if time.monotonic() >= end:
                self._node.get_logger().warning(
                    f"lockstep: no odometry within {TIMEOUT:g} s for the cloud at {self._asked * 1e-9:.3f} s; going on"
                )
                self._unanswered, self._asked = self._unanswered + 1, None
                return
            self._executor.spin_once(timeout_sec=0.1)

    def _on_odometry(self, message: Odometry) -> None:
        if self._asked in (0, stamp_ns(message.header)):  # a cloud without a stamp gets the time of its arrival
            self._asked = None


def _node(info: Any) -> tuple[str, str]:
    return info.node_namespace, info.node_name
