# SPDX-License-Identifier: Apache-2.0
"""Keyframes on the wire: three messages each, at most 100 kB together, sent again until the mapper has them.

A robot keeps all keyframes of its drive, in a temporary file, and announces its last one every two seconds. The mapper
acknowledges what it has: all below a number, and some above. So it costs nothing to be out of reach for a while, to
join late, or to start the mapper again; DDS' own reliability ends with either process, and forgets what is too old.
"""

from __future__ import annotations

import functools
import secrets
import threading
import time
from collections.abc import Sequence, Set
from dataclasses import dataclass

import numpy as np
from nav_msgs.msg import Odometry
from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.serialization import serialize_message
from sensor_msgs.msg import PointCloud2, PointField
from std_msgs.msg import MultiArrayDimension, MultiArrayLayout, UInt8MultiArray, UInt32MultiArray

from dpm2_core.descriptors import Descriptors
from dpm2_core.frame import Keyframe
from dpm2_core.geometry.voxel import voxel_first
from dpm2_core.network.pretrained import weights_path
from dpm2_core.slam.mapping.admission import RejectedError
from dpm2_core.slam.settings import SlamSettings
from dpm2_core.slam.store.cloud_codec import pack_cloud
from dpm2_core.slam.store.cloud_store import SpillFile
from dpm2_core.slam.store.rows import weights_id
from dpm2_ros.conversions import bytes_to_array, edge_to_msg, header, keyframe_name
from dpm2_ros.subscriptions import STEADY

WIRE = QoSProfile(depth=64, reliability=ReliabilityPolicy.RELIABLE)
"""Of keyframes; what falls out of the queue is sent again."""
BUDGET = 99_000
"""Bytes of a keyframe's cloud and descriptors on the wire; its pose and the protocol's own have the rest of 100 kB."""
BEHIND = 10
"""Keyframes that the mapper may lack before /diagnostics warns; a few are always on their way."""

_FEATURE = "feature"
_MOST_CHANNELS = 4096
_MOST_ACKED = 1001  # numbers in an acknowledgment
_SLOT, _MEMORY = 0.3, 0.8  # s; the mapper acknowledges twice a second
_TICK, _PATIENCE, _ANNOUNCE, _BURST = 0.25, 1.5, 2.0, 8  # s; s until sent again; s; keyframes a tick
_FAREWELL = 4.0  # s; DDS asks after 3 s for a receipt that has not come


class KeyframeSender:
    """Publishes a robot's keyframes, keeps them, and sends those again that the mapper misses. Any thread may call."""

    def __init__(self, node: Node, robot: str, odom_frame: str, keep: bool, weights: str = "") -> None:
        """`keep`: for a mapper elsewhere; else each is sent once. `weights`: see `weights_identity`."""
        self._robot, self._odom_frame, self._keep, self._weights = robot, odom_frame, keep, weights
        self._lock = threading.Lock()
        self._descriptors = node.create_publisher(PointCloud2, "dpm2/keyframe", WIRE)
        self._cloud = node.create_publisher(UInt8MultiArray, "dpm2/keyframe_cloud", WIRE)
        self._pose = node.create_publisher(Odometry, "dpm2/keyframe_odom", WIRE)
        self.restart()
        if keep:
            node.create_subscription(UInt32MultiArray, "dpm2/keyframes_received", self._on_received, 10)
            node.create_timer(_TICK, self._repeat, clock=STEADY)

    @property
    def delivered(self) -> tuple[int, int]:
        """Keyframes that the mapper has acknowledged, and all."""
        with self._lock:
            below, above = self._acks.agreed
            return below + len(above), len(self._kept)

    def restart(self) -> None:
        """A new drive begins: a session of its own."""
        with self._lock:
            self.session = secrets.token_hex(4) if self._keep else ""
            self._kept: list[list[int]] = []  # numbers in the file of the three messages, by id
            self._file = SpillFile()
            self._sent: list[float] = []  # when each was sent last
            self._acks = Acks()
            self._announced = 0.0

    def send(self, keyframe: Keyframe) -> None:
        """A new one, in the frame whose pose is published."""
        covariance = np.zeros((6, 6)) if keyframe.edge is None else keyframe.edge.covariance
        name = keyframe_name(self._robot, keyframe.id, self.session)
        pose = edge_to_msg(keyframe.T_odom_kf, covariance, keyframe.stamp, self._odom_frame, name)
        parts = [bytes(serialize_message(part)) for part in (pose, *payload_to_msgs(keyframe, name, self._weights))]
        with self._lock:
            if self._keep:
                self._kept.append([self._file.append(part) for part in parts])
                self._sent.append(time.monotonic())
                self._announced = time.monotonic()
        self._publish(parts)

    def close(self) -> None:
        """Before the node ends: wait until a mapper elsewhere has received what was sent last, or for `_FAREWELL`."""
        end = time.monotonic() + (_FAREWELL if self._keep else 0.0)
        for publisher in (self._pose, self._descriptors, self._cloud):
            publisher.wait_for_all_acked(Duration(seconds=max(0.0, end - time.monotonic())))

    def _publish(self, parts: Sequence[bytes]) -> None:
        for publisher, message in zip((self._pose, self._descriptors, self._cloud), parts, strict=True):
            publisher.publish(message)

    def _on_received(self, message: UInt32MultiArray) -> None:
        if not message.layout.dim or not 0 < len(message.data) <= _MOST_ACKED:
            raise RejectedError(
                "acknowledgment", f"an acknowledgment of {len(message.data)} numbers; want 1 to {_MOST_ACKED}"
            )
        with self._lock:
            if message.layout.dim[0].label == self.session:
                below, *above = message.data.tolist()
                made = len(self._kept)
                self._acks.add(min(below, made), {id for id in above if below <= id < made}, time.monotonic())

    def _repeat(self) -> None:
        """Send a few of those again that have been missed for long; announce the last one."""
        now = time.monotonic()
        with self._lock:
            below, above = self._acks.agreed
            requested = range(below, len(self._kept))
            late = [id for id in requested if id not in above and now - self._sent[id] > _PATIENCE][:_BURST]
            for id in late:
                self._sent[id] = now
            again = [[self._file.read(number) for number in self._kept[id]] for id in late]
            last = None
            if self._kept and now - self._announced > _ANNOUNCE:
                self._announced, last = now, self._file.read(self._kept[-1][0])
        for parts in again:
            self._publish(parts)
        if last is not None:
            self._pose.publish(last)


class Acks:
    """What the mapper has: that on which all its acknowledgments of the last second agree.

    Anyone can send one. One that claims too little costs a keyframe sent twice; one that claims too much would
    cost the keyframe, so no single one is trusted.
    """

    def __init__(self) -> None:
        self._slots: list[_Slot] = []  # the oldest first

    @property
    def agreed(self) -> tuple[int, frozenset[int]]:
        """All ids below the number, and some above."""
        results = [(slot.below, slot.above) for slot in self._slots]
        return functools.reduce(_both, results) if results else (0, frozenset())

    def add(self, below: int, above: Set[int], now: float) -> None:
        """One that came at that time, s."""
        if not self._slots or now - self._slots[-1].begin > _SLOT:
            self._slots.append(_Slot(now, now, below, frozenset(above)))
        else:
            last = self._slots[-1]
            last.end = now
            last.below, last.above = _both((last.below, last.above), (below, frozenset(above)))
        self._slots = [slot for slot in self._slots if now - slot.end <= _MEMORY]


@dataclass(eq=False)
class _Slot:
    """Those that came between two times, s, and on what they agree."""

    begin: float
    end: float
    below: int
    above: frozenset[int]


def _both(a: tuple[int, frozenset[int]], b: tuple[int, frozenset[int]]) -> tuple[int, frozenset[int]]:
    less, more = sorted((a, b), key=lambda result: result[0])
    return less[0], frozenset(id for id in less[1] if id < more[0] or id in more[1])


def weights_identity(settings: SlamSettings) -> str:
    """The identity of what made descriptors: the first 16 digits of the SHA-256 of the network's file; "" without one.

    Raises:
        UsageError: there is no such file.
    """
    if not settings.uses_descriptors:
        return ""
    return weights_id(weights_path(settings.neural.weights)).split()[-1]


def received_to_msg(session: str, below: int, above: Sequence[int]) -> UInt32MultiArray:
    """What a mapper has of a session: all ids below one, and some above."""
    dimension = MultiArrayDimension(label=session, size=1 + len(above), stride=1 + len(above))
    return UInt32MultiArray(layout=MultiArrayLayout(dim=[dimension]), data=[below, *above])


def payload_to_msgs(keyframe: Keyframe, name: str, weights: str = "") -> tuple[PointCloud2, UInt8MultiArray]:
    """Descriptors and packed cloud of a keyframe, the cloud downsampled until both are within `BUDGET`."""
    d = keyframe.descriptors
    descriptors = descriptors_to_msg(d, keyframe.stamp, name, weights)
    room = BUDGET - len(descriptors.data)
    cloud, voxel = keyframe.cloud, 0.3
    while len(packed := pack_cloud(cloud)) > room:
        voxel *= 1.15
        cloud = keyframe.cloud[voxel_first(keyframe.cloud, voxel)]
    dimension = MultiArrayDimension(label=name, size=len(packed), stride=len(packed))
    return descriptors, UInt8MultiArray(layout=MultiArrayLayout(dim=[dimension]), data=bytes_to_array(packed))


def descriptors_to_msg(d: Descriptors | None, stamp: int, name: str, weights: str = "") -> PointCloud2:
    """A cloud of points x, y, z, axis_x, axis_y and the bits of 128 half floats `feature:WEIGHTS`; empty for None.

    Those of a tilted LiDAR whose base is not known are not sent: the receiver makes its own of the cloud.
    """
    d = None if d is not None and d.up is not None else d
    channels = 0 if d is None else d.features.shape[1]
    dtype = _row(max(channels, 1))
    rows = np.zeros(0 if d is None else len(d), dtype)
    if d is not None:
        rows["xyz"], rows["axis"], rows["feature"] = d.xyz, d.axes, d.features
    names = ("x", "y", "z", "axis_x", "axis_y")
    fields = [PointField(name=n, offset=4 * i, datatype=PointField.FLOAT32, count=1) for i, n in enumerate(names)]
    feature = f"{_FEATURE}:{weights}" if weights else _FEATURE
    fields.append(PointField(name=feature, offset=20, datatype=PointField.UINT16, count=max(channels, 1)))
    return PointCloud2(
        header=header(stamp, name),
        height=1,
        width=len(rows),
        fields=fields,
        point_step=dtype.itemsize,
        row_step=dtype.itemsize * len(rows),
        data=bytes_to_array(rows.tobytes()),
        is_dense=True,
    )


def descriptors_from_msg(message: PointCloud2) -> tuple[Descriptors | None, str]:
    """The inverse of `descriptors_to_msg`: descriptors, and the identity of the weights that made them.

    Raises:
        RejectedError: it is something else.
    """
    if not message.width:
        return None, ""
    feature = next((f for f in message.fields if f.name.partition(":")[0] == _FEATURE), None)
    channels = 0 if feature is None else feature.count
    if not 0 < channels <= _MOST_CHANNELS:
        raise RejectedError("descriptors", f"a cloud that holds descriptors of {channels} channels")
    dtype = _row(channels)
    if message.point_step != dtype.itemsize or len(message.data) != dtype.itemsize * message.width:
        raise RejectedError(
            "descriptors", f"{len(message.data)} bytes for {message.width} descriptors of {channels} channels"
        )
    rows = np.frombuffer(message.data, dtype)
    xyz, features, axis = (np.ascontiguousarray(rows[name]) for name in ("xyz", "feature", "axis"))
    return Descriptors(xyz, features, axis), "" if feature is None else feature.name.partition(":")[2][:64]


def _row(channels: int) -> np.dtype[np.void]:
    return np.dtype([("xyz", "<f4", 3), ("axis", "<f4", 2), ("feature", "<f2", channels)])
