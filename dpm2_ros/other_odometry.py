# SPDX-License-Identifier: Apache-2.0
"""The odometry that a robot already has, at a cloud's stamp: `odom -> base` on /tf, or nav_msgs/Odometry on a topic."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from contextlib import suppress
from typing import Any

import numpy as np
from nav_msgs.msg import Odometry
from rclpy.qos import QoSProfile

from dpm2_core.data.messages import stamp_ns
from dpm2_core.data.naming import TF, frame_name
from dpm2_core.data.transforms import TransformTree
from dpm2_core.errors import UsageError
from dpm2_core.estimates import Comparison
from dpm2_core.frame import Array, Guess
from dpm2_core.geometry import se3
from dpm2_core.slam.mapping.admission import RejectedError, check_covariance
from dpm2_ros.checks import check_header, check_transforms, checked_pose
from dpm2_ros.conversions import check_frame, covariance_from_ros
from dpm2_ros.guard import GuardedNode
from dpm2_ros.matched_subscription import MatchedSubscription
from dpm2_ros.settings import RosSettings
from dpm2_ros.synchronizer import PATIENCE
from dpm2_ros.tf_message import TFMessage
from dpm2_ros.transform_history import TransformHistory

WAIT = 0.1
"""s that a cloud waits for an odometry message that arrives after it."""
_MEAN_WEIGHT = 0.02  # weight of the newest step in the mean distances, of which `slip` is the ratio
_MAX_SLIP = 0.05  # a larger slip is reported; a wheel's radius is often wrong by 2 %, which does no harm
_MAX_DOUBT = 1.5  # times the assumed error
_RECENT_TIME = 10.0  # s


class OtherOdometry:
    """The odometry that `ros.odom_source` names. The executor calls its callbacks, the worker all other methods.

    Attributes:
        problem: why it had no pose at the last cloud, in words; empty if it had one.
        missed: clouds for which it had no pose. found: clouds for which it had one. outweighed: those of the latter
            whose scans contradicted it.
    """

    def __init__(self, node: GuardedNode, ros: RosSettings, static: Callable[[], TransformTree]) -> None:
        """`static`: returns the current tree of static transforms.

        Raises:
            UsageError: tf2_msgs is missing, and needed.
        """
        self._static, self._frame = static, ros.odom_frame
        self._history, self._changed = TransformHistory(), threading.Condition()
        self._child = ""  # the frame whose pose the topic has
        self.source = node.resolve_topic_name(TF if ros.odom_source == "tf" else ros.odom_topic)
        self.problem, self.missed, self.found, self.outweighed = f"no usable message on {self.source} yet", 0, 0, 0
        self._consecutive_missed = 0  # clouds without it
        self._last_missed: tuple[int, str, float] | None = None  # its stamp, base, and end of the longest wait
        self._comparison: Comparison | None = None
        self._last_outweighed: tuple[float, str] | None = None  # when it was outweighed last, and why
        self._mean_distances = np.zeros(2)  # m per cloud, recent means of the distance: its own, and that of the scans
        self._subscription: MatchedSubscription | None = None
        if ros.odom_source == "topic":
            self._subscription = MatchedSubscription(node, Odometry, ros.odom_topic, self._on_odometry, ros)
            node.create_timer(0.5, self._subscription.refresh)
        elif TFMessage is None:
            raise UsageError("ros.odom_source: tf needs tf2_msgs; `python -m dpm2_ros.build_tf2_msgs` builds it")
        else:
            node.create_subscription(TFMessage, TF, self._on_tf, QoSProfile(depth=100))

    def guess(self, stamp: int, base: str, T_base_lidar: Array) -> Guess | None:
        """Its pose of the LiDAR at a stamp (ns), as soon as it is received; None if it is not received in time."""
        began = time.monotonic()
        with self._changed:
            end = began + (WAIT if self._consecutive_missed < PATIENCE else 0.0)
            found, problem = self._try_find(stamp, base)
            while found is None and (remaining := end - time.monotonic()) > 0:
                self._changed.wait(remaining)
                found, problem = self._try_find(stamp, base)
            self.problem = problem  # only now: the executor's thread reads it while this one waits
            self._consecutive_missed = 0 if found is not None else self._consecutive_missed + 1
            self._last_missed = None if found is not None else (stamp, base, began + WAIT)
        self.found, self.missed = self.found + (found is not None), self.missed + (found is None)
        if found is None:
            self._comparison = None
            return None
        T_odom_base, covariance = found
        if covariance is not None:
            covariance = _rotated(covariance, T_base_lidar)
        return Guess(T_odom_base @ T_base_lidar, covariance)

    def T_odom_base(self, stamp: int, base: str) -> Array | None:
        """(4, 4) at a stamp (ns); None if it is not known yet."""
        with self._changed, suppress(UsageError):
            found = self._find(stamp, base)
            return None if found is None else found[0]
        return None

    def judge(self, comparison: Comparison | None) -> str:
        """Compare it with the scan of the last cloud; returns why it was outweighed, or an empty text."""
        self._comparison = comparison
        if comparison is None or comparison.unsure:
            return ""
        if comparison.used:  # else it jumped, which is no slip
            distances = [np.linalg.norm(T[:3, 3]) for T in (comparison.T_other, comparison.T_scans)]
            self._mean_distances = (1 - _MEAN_WEIGHT) * self._mean_distances + _MEAN_WEIGHT * np.array(distances)
            return ""
        self.outweighed += 1
        meters, degrees = se3.apart(comparison.T_other, comparison.T_scans)
        text = f"outweighed: {meters:.2f} m, {degrees:.1f} deg from the motion of the scans"
        self._last_outweighed = time.monotonic(), text
        return text

    @property
    def slip(self) -> float:
        """By which fraction its recent distances are longer than those of the scans; NaN while the robot stands."""
        other, scans = self._mean_distances
        return float(other / scans - 1) if scans > 1e-3 else float("nan")

    @property
    def verdict(self) -> str:
        """What contradicts it, or why it has no pose, in words; empty if nothing does."""
        if self.problem:
            return (self._subscription.problem if self._subscription is not None else "") or self.problem
        problems = []
        if self._last_outweighed is not None and (age := time.monotonic() - self._last_outweighed[0]) < _RECENT_TIME:
            problems.append(f"{self._last_outweighed[1]}, {age:.0f} s ago")
        if self._comparison is not None and self._comparison.doubt > _MAX_DOUBT:
            problems.append(f"its error is {self._comparison.doubt:.1f} times the assumed one")
        if self._comparison is not None and self._comparison.unsure:
            problems.append("left out: its own covariance is larger than that of the predicted motion")
        if abs(self.slip) > _MAX_SLIP:
            problems.append(f"its distances are {abs(self.slip):.1%} too {'long' if self.slip > 0 else 'short'}")
        return "; ".join(problems)

    def _try_find(self, stamp: int, base: str) -> tuple[tuple[Array, Array | None] | None, str]:
        """As `_find`, and the `problem` that is to be set then."""
        try:
            found = self._find(stamp, base)
        except UsageError as error:
            return None, f"{self.source}: {error}"
        return found, self.problem if found is None else ""

    def _find(self, stamp: int, base: str) -> tuple[Array, Array | None] | None:
        static, source = self._static(), base if self._subscription is None else self._child
        if not source:  # no usable message yet: `problem` is as at the start
            return None
        T, covariance = self._history.lookup(self._frame, source, stamp, static)
        if source != base:
            T_child_base = static.lookup(source, base)
            T = T @ T_child_base
            covariance = None if covariance is None else _rotated(covariance, T_child_base)
        return T, covariance

    def _notify_waiting(self) -> None:
        """A message has arrived: a waiting `guess` looks again. If the last cloud without a pose would have had one by
        waiting, the next cloud waits again."""
        if self._last_missed is not None and self._consecutive_missed >= PATIENCE:
            stamp, base, end = self._last_missed
            with suppress(UsageError):
                if time.monotonic() <= end and self._find(stamp, base) is not None:
                    self._consecutive_missed = 0
        self._changed.notify()

    def _on_tf(self, message: Any) -> None:
        check_transforms(message)
        with self._changed:
            for stamped in message.transforms:
                parent, child = frame_name(stamped.header.frame_id), frame_name(stamped.child_frame_id)
                check_frame(parent)
                check_frame(child)
                self._history.add(parent, child, stamp_ns(stamped.header), stamped.transform)
            self._notify_waiting()

    def _on_odometry(self, message: Odometry) -> None:
        check_header(message.header)
        frame, child = frame_name(message.header.frame_id), frame_name(message.child_frame_id)
        if frame != self._frame:
            raise RejectedError("frame", f"odometry in frame {frame[:80]!r}; ros.odom_frame is {self._frame!r}")
        if not child:
            raise RejectedError("frame", "odometry without a child_frame_id")
        check_frame(child)
        T = checked_pose(message.pose.pose)
        numbers, covariance = np.asarray(message.pose.covariance, np.float64), None
        with suppress(RejectedError):  # all zero, or -1 for "unknown"
            stated = covariance_from_ros(np.nan_to_num(numbers, posinf=-1.0), T[:3, :3])
            check_covariance(stated)
            covariance = stated
        with self._changed:
            self._child = child
            self._history.add(frame, child, stamp_ns(message.header), message.pose.pose, covariance)
            self._notify_waiting()


def _rotated(covariance: Array, T_body_other: Array) -> Array:
    """A covariance (6, 6) along the axes of another frame of the same body. It is rotated only: with a lever arm, large
    values of directions that a driver does not measure, such as 1e6, would spread to all directions."""
    R = np.kron(np.eye(2), T_body_other[:3, :3].T)
    return np.asarray(R @ covariance @ R.T)
