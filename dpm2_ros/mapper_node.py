# SPDX-License-Identifier: Apache-2.0
"""mapper_node: the mapper apart from the odometry, as on another machine. Builds one map of one or more robots."""

from __future__ import annotations

import time
from collections import Counter
from contextlib import ExitStack

from diagnostic_msgs.msg import DiagnosticStatus
from std_srvs.srv import Trigger

from dpm2_core.errors import UsageError
from dpm2_core.slam.system import Slam
from dpm2_ros.diagnostics import OK, WARN, mapper_status, message_status, publish_diagnostics, status
from dpm2_ros.feed import ODOM, Feed
from dpm2_ros.guard import slow_service
from dpm2_ros.keyframe_sender import weights_identity
from dpm2_ros.lifecycle import ManagedNode
from dpm2_ros.mapping import MapperThread

_MAX_ROBOTS = 64
PATIENCE = 10.0
"""s within which a namespace must deliver a keyframe before its subscriptions may be closed."""


class MapperNode(ManagedNode):
    """Subscribes to every robot in its namespace and below, also to those that start later, and builds one map of all.

    It sends map -> odom of each robot, with the odometry frame that the robot itself names.
    """

    def __init__(self, managed: bool = False) -> None:
        super().__init__("mapper_node")
        if self._config.ros.localization_mode:
            raise UsageError("ros.localization_mode: only slam_node can localize")
        self._own_namespace = self.get_namespace().rstrip("/")
        self.start(managed)

    def configure(self, undo: ExitStack) -> None:
        """See `ManagedNode`."""
        self._weights = weights_identity(self._config.slam)
        self._open_map(undo)
        self._feeds: dict[str, Feed] = {}
        slow_service(self, Trigger, "~/reset", self._on_reset)
        publish_diagnostics(self, self._statuses)

    def activate(self, undo: ExitStack) -> None:
        """Subscribe, with the same map. Keyframes sent in the meantime were not acknowledged, and are sent again."""
        for feed in self._feeds.values():
            feed.open()
        undo.callback(self._close_feeds)
        self._discover()
        self.create_timer(0.5, self._discover)
        self.create_timer(0.5, self._tick)

    @property
    def slam(self) -> Slam:
        """The SLAM system that works on the map."""
        return self._map.active.slam

    @property
    def _map(self) -> MapperThread:
        assert self._mapper is not None
        return self._mapper

    def _close_feeds(self) -> None:
        for feed in self._feeds.values():
            feed.close()

    def _discover(self) -> None:
        """Subscribe to the robots that publish now, and always to the one of this node's own namespace."""
        topics = [topic for topic, _ in self.get_topic_names_and_types() if topic.endswith(ODOM)]
        for namespace in (self._own_namespace, *(topic.removesuffix(ODOM) for topic in topics)):
            if namespace in self._feeds or not f"{namespace}/".startswith(f"{self._own_namespace}/"):
                continue
            if len(self._feeds) >= _MAX_ROBOTS and not self._close_idle_feed():
                self.reject(ODOM, "too many robots", f"{namespace}: not subscribed, {_MAX_ROBOTS} others are")
                return
            feed = self._feeds[namespace] = Feed(self, self._map, namespace, self._weights)
            feed.open()
        for namespace, feed in list(self._feeds.items()):
            if self._is_idle(namespace, feed) and not self.count_publishers(namespace + ODOM):
                self._feeds.pop(namespace).close()

    def _is_idle(self, namespace: str, feed: Feed) -> bool:
        """Whether that feed can be closed without a loss."""
        return namespace != self._own_namespace and not feed.has_delivered and time.monotonic() - feed.opened > PATIENCE

    def _close_idle_feed(self) -> bool:
        oldest = next((namespace for namespace, feed in self._feeds.items() if self._is_idle(namespace, feed)), None)
        if oldest is not None:
            self._feeds.pop(oldest).close()
        return oldest is not None

    def _tick(self) -> None:
        for feed in self._feeds.values():
            feed.tick()

    async def _on_reset(self, _request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        await self._map.before_reset(response, "the map begins again empty")
        if response.success:
            self._map.reset()
            for feed in self._feeds.values():
                feed.forget()
        return response

    def _shared_frames(self) -> list[str]:
        """Odometry frames that robots in several namespaces use at the same time."""
        counts = Counter(frame for feed in self._feeds.values() for frame in feed.odom_frames)
        return sorted(frame for frame, count in counts.items() if count > 1)

    def _statuses(self) -> list[DiagnosticStatus]:
        now, figures = time.monotonic(), {}
        further_robots = [name for feed in self._feeds.values() for name in feed.further_robots]
        for feed in self._feeds.values():
            for robot, stream in feed.robots.items():
                figures[robot or "/"] = f"{stream.taken} keyframes, last message {now - stream.heard:.0f} s ago"
        text = f"{len(figures)} robots"
        if further_robots:
            text += f"; several in one namespace: {', '.join(further_robots)} kept separate"
        if shared := self._shared_frames():
            text += f"; robots share an odom_frame: {', '.join(shared)}; set another for each"
            problem = f"map -> {shared[0]} jumps between two robots: set another ros.odom_frame for each"
            self.get_logger().error(problem, once=True)
        robots = status(self, "robots", WARN if further_robots or shared else OK, text, figures)
        return [mapper_status(self, self._map), robots, message_status(self)]
