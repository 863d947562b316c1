# SPDX-License-Identifier: Apache-2.0
"""The state in one word, latched, sent at each change: for behavior trees and supervisors."""

from __future__ import annotations

import threading
import time

from std_msgs.msg import String

from dpm2_core.estimates import OdometryResult, State
from dpm2_ros.guard import GuardedNode, excerpt
from dpm2_ros.subscriptions import LAST_ONE

SILENT = 2.0
"""Seconds without a message after which a sensor counts as silent; without a pose, the node does."""
NO_POSE = "silent"
_LOG_PERIOD = 10.0  # s between two messages of the log


class StatePublisher:
    """Publishes `dpm2/state`: a `State`, or silent once no pose has followed for `SILENT` s. Any thread may call."""

    def __init__(self, node: GuardedNode) -> None:
        self._publisher = node.create_publisher(String, "dpm2/state", LAST_ONE)
        self._lock, self._last_state = threading.Lock(), ""
        self._log, self._breaks = node.get_logger(), 0
        self._last_pose_time: float | None = None  # when a pose was published
        self._publish_state(str(State.INITIALIZING))
        node.create_timer(0.25, self._check_silence)

    def send(self, tracked: OdometryResult) -> None:
        """Send the state of a pose that is published now; a loss of the odometry is logged, too."""
        self._last_pose_time = time.monotonic()
        reason = excerpt(tracked.registration.reason)
        if tracked.breaks > self._breaks:
            self._log.warning(f"the odometry broke, its motion meanwhile is not known: {reason}")
        elif tracked.state is State.LOST and self._last_state != str(State.LOST):
            self._log.warning(f"lost: {reason}", throttle_duration_sec=_LOG_PERIOD)
        self._breaks = tracked.breaks
        self._publish_state(str(tracked.state))

    def _check_silence(self) -> None:
        if self._last_pose_time is not None and time.monotonic() - self._last_pose_time > SILENT:
            self._publish_state(NO_POSE)

    def _publish_state(self, state: str) -> None:
        with self._lock:
            if state != self._last_state:
                self._last_state = state
                self._publisher.publish(String(data=state))
