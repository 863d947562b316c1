# SPDX-License-Identifier: Apache-2.0
"""Sends keyframes: three messages each, at most 100 kB together, again and again until the mapper has them.

A robot stores all keyframes of its drive in a file (`unsent.py`), and announces its last one every two seconds. The
mapper acknowledges the keyframes that it has: all below a number, in its map file, and some above, in memory. So
nothing is lost if the link fails for a while, if the mapper starts late or restarts, or if either process is killed:
the next start sends what is left of earlier drives. The reliability of DDS ends with either process, and DDS discards
old messages.
"""

from __future__ import annotations

import secrets
import sqlite3
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import suppress
from pathlib import Path

import numpy as np
from nav_msgs.msg import Odometry
from rclpy.serialization import serialize_message
from sensor_msgs.msg import PointCloud2
from std_msgs.msg import UInt8MultiArray, UInt32MultiArray

from dpm2_core.estimates import Keyframe
from dpm2_core.slam.mapping.admission import RejectedError
from dpm2_core.slam.settings import SlamSettings
from dpm2_ros.conversions import edge_to_msg, keyframe_name
from dpm2_ros.deliveries import Delivery
from dpm2_ros.guard import GuardedNode, take_waiting
from dpm2_ros.keyframe_messages import WIRE, of_earlier_drive, payload_to_msgs
from dpm2_ros.settings import RosSettings
from dpm2_ros.unsent import KeyframeFile, left_behind, path_of

_MAX_ACK_NUMBERS = 1001  # numbers in an acknowledgment
_RESEND_PERIOD, _MAX_RESENT = 0.25, 8  # s between two calls of `_resend`, and keyframes sent again by one
_CLOSE_TIMEOUT = 4.0  # s; acknowledgments arrive twice per second, and those of one second must agree


class KeyframeSender:
    """Publishes a robot's keyframes, stores them, and sends those again that the mapper lacks. Any thread may call.

    Drives are sent one after the other: the remaining keyframes of an earlier one come before those of the next.
    """

    def __init__(self, node: GuardedNode, robot: str, ros: RosSettings, weights: str = "") -> None:
        """`weights`: see `weights_identity`. With the mapper in the same process, each keyframe is sent once."""
        self._robot, self._odom_frame, self._weights = robot, ros.own_frame, weights
        self._log, self._lock = node.get_logger(), threading.Lock()
        self._folder = Path(ros.map_directory) if ros.map_directory else None
        self._descriptors = node.create_publisher(PointCloud2, "dpm2/keyframe", WIRE)
        self._cloud = node.create_publisher(UInt8MultiArray, "dpm2/keyframe_cloud", WIRE)
        self._pose = node.create_publisher(Odometry, "dpm2/keyframe_odom", WIRE)
        self._drives: list[Delivery] = []  # those that are over and not delivered, then the current one
        if not ros.embed_mapper:
            self._drives += self._undelivered_drives()
            self.restart()
            self._ack_subscription = node.create_subscription(
                UInt32MultiArray, "dpm2/keyframes_received", self._on_received, 10
            )
            node.create_timer(_RESEND_PERIOD, self._resend)

    @property
    def arrived(self) -> tuple[int, int]:
        """Number of keyframes that the mapper has acknowledged, and of all; both include those of earlier drives."""
        with self._lock:
            return sum(drive.arrived for drive in self._drives), sum(len(drive.file) for drive in self._drives)

    @property
    def problem(self) -> str:
        """Why keyframes that the mapper lacks would be lost with this process; empty if none would."""
        with self._lock:
            file = self._drives[-1].file
            return f"{len(file) - file.stored} keyframes in memory only: {file.problem}" if file.problem else ""

    def restart(self) -> None:
        """Begin a new drive, with its own session. The mapper is notified at once that the drive before is over."""
        session = secrets.token_hex(4)
        drive = Delivery(session, self._create_file(session), False, time.monotonic())
        last = None
        with self._lock:
            for empty in (earlier for earlier in self._drives if not len(earlier.file)):
                empty.file.close(keep=False)
            self._drives = [*(earlier for earlier in self._drives if len(earlier.file)), drive]
            for earlier in self._drives[:-1]:
                if not earlier.earlier:
                    with suppress(sqlite3.Error, OSError, RuntimeError):  # `_resend` reads it again, and logs it
                        last = of_earlier_drive(earlier.file.read(len(earlier.file) - 1))[0]
                earlier.earlier = True
            for earlier in self._drives[1:-1]:
                earlier.file.pause()  # closed until its turn: without a mapper there may be hundreds
        if last is not None:
            self._pose.publish(last)

    def send(self, keyframe: Keyframe) -> None:
        """Send a new keyframe, which is in the frame whose pose is published."""
        drive = self._drives[-1] if self._drives else None
        covariance = np.zeros((6, 6)) if keyframe.edge is None else keyframe.edge.covariance
        name = keyframe_name(self._robot, keyframe.id, drive.session if drive else "")
        pose = edge_to_msg(keyframe.T_odom_kf, covariance, keyframe.stamp, self._odom_frame, name)
        parts = [bytes(serialize_message(part)) for part in (pose, *payload_to_msgs(keyframe, name, self._weights))]
        if drive is not None:
            with self._lock:
                is_current_turn, before = drive is self._drives[0], drive.file.problem
                drive.append(parts, time.monotonic() if is_current_turn else None)
                if drive.file.problem and not before:
                    self._log.error(f"{drive.file.path}: {drive.file.problem}; further keyframes are in memory only")
            if not is_current_turn:
                return
        self._publish(parts)

    def close(self) -> None:
        """Before the node ends: wait until the mapper, if one runs, has all in its file, but at most `_CLOSE_TIMEOUT`.

        Keyframes that it does not have stay on disk, for the next start.
        """
        end = time.monotonic() + _CLOSE_TIMEOUT
        while any(drive.late for drive in self._drives) and self._ack_subscription.get_publisher_count():
            if time.monotonic() > end:
                break
            time.sleep(_RESEND_PERIOD)
            take_waiting(self._ack_subscription)  # no executor does it any more
            self._resend()
        with self._lock:
            for drive in self._drives:
                late, file = drive.late, drive.file
                if late:
                    file.catch_up()  # there may be space by now
                lost = min(late, len(file) - file.stored)
                file.close(keep=late > lost)
                if file.path is not None and late > lost:
                    self._log.warning(f"{late - lost} keyframes not delivered: sent at the next start from {file.path}")
                if lost:
                    where = "on the disk" if file.path is None else f"in {file.path}"
                    why = file.problem or "ros.map_directory is empty"
                    self._log.error(f"{lost} keyframes neither delivered nor {where}: {why}")

    def _create_file(self, session: str) -> KeyframeFile:
        """The file of a new drive, on disk if possible."""
        if self._folder is not None:
            path = path_of(self._folder, self._robot, session)
            try:
                return KeyframeFile(path)
            except (sqlite3.Error, OSError) as error:
                self._log.error(f"{path}: {error}; undelivered keyframes are lost when this process ends")
                file = KeyframeFile()
                file.problem = str(error)
                return file
        return KeyframeFile()

    def _undelivered_drives(self) -> Iterator[Delivery]:
        """Drives of processes that ended before everything was delivered."""
        for session, path in [] if self._folder is None else left_behind(self._folder, self._robot):
            try:
                file = KeyframeFile(path)
            except (sqlite3.Error, OSError) as error:
                if "locked" not in str(error):  # else another process with this robot's name uses it
                    self._log.error(f"{path}: not sent: {error}")
                continue
            if len(file):
                self._log.info(f"{len(file)} keyframes of an earlier drive are sent first, from {path}")
            file.pause()
            yield Delivery(session, file, True, time.monotonic())

    def _publish(self, parts: Sequence[bytes]) -> None:
        for publisher, message in zip((self._pose, self._descriptors, self._cloud), parts, strict=True):
            publisher.publish(message)

    def _on_received(self, message: UInt32MultiArray) -> None:
        if not message.layout.dim or not 0 < len(message.data) <= _MAX_ACK_NUMBERS:
            raise RejectedError(
                "acknowledgment", f"an acknowledgment of {len(message.data)} numbers; want 1 to {_MAX_ACK_NUMBERS}"
            )
        with self._lock:
            drive = self._drives[0]
            if message.layout.dim[0].label == drive.session:
                below, *above = message.data.tolist()
                drive.acknowledge(below, set(above), time.monotonic())

    def _resend(self) -> None:
        """Send a few keyframes again that were not acknowledged for a while; announce the last one."""
        now = time.monotonic()
        with self._lock:
            while len(self._drives) > 1 and self._drives[0].certain(now):
                self._drives.pop(0).file.close(keep=False)
            drive = self._drives[0]
            try:
                resent = [self._read(drive, id) for id in drive.due(now, _MAX_RESENT)]
                last = self._read(drive, len(drive.file) - 1)[0] if drive.announces(now) else None
            except (sqlite3.Error, OSError, RuntimeError) as error:
                self._log.error(f"{drive.file.path}: not sent: {error}", throttle_duration_sec=10)
                if drive.earlier:  # an unreadable file must not block the other drives
                    drive.file.close(keep=True)
                    self._drives.remove(drive)
                return
        for parts in resent:
            self._publish(parts)
        if last is not None:
            self._pose.publish(last)

    @staticmethod
    def _read(drive: Delivery, id: int) -> list[bytes]:
        """The messages of a keyframe; those of an earlier drive are marked as such."""
        parts = drive.file.read(id)
        return of_earlier_drive(parts) if drive.earlier else parts


def weights_identity(settings: SlamSettings) -> str:
    """Identity of the weights that make descriptors: digits of `network.pretrained.weights_id`; "" without descriptors.

    Raises:
        UsageError: there are no such weights.
    """
    return settings.weights_id().split(" ")[-1]
