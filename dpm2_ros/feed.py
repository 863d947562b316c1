# SPDX-License-Identifier: Apache-2.0
"""Receives the keyframes of one namespace: checks them, and orders those of each drive separately."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any

from nav_msgs.msg import Odometry
from sensor_msgs.msg import PointCloud2
from std_msgs.msg import UInt8MultiArray, UInt32MultiArray

from dpm2_core.data.messages import stamp_ns
from dpm2_core.descriptors import Descriptors
from dpm2_core.errors import UsageError
from dpm2_core.estimates import Keyframe, Registration
from dpm2_core.frame import NO_POINTS
from dpm2_core.geometry import se3
from dpm2_core.slam.mapping.admission import RejectedError, check_covariance, check_descriptors
from dpm2_core.slam.store.cloud_codec import CodecError, origin_of, unpack_cloud
from dpm2_ros.checks import checked_pose
from dpm2_ros.conversions import EARLIER, check_frame, covariance_from_ros, parse_keyframe_name
from dpm2_ros.guard import GuardedNode
from dpm2_ros.keyframe_messages import BUDGET, WIRE, Payload, descriptors_from_msg, payload_from_msg, received_to_msg
from dpm2_ros.mapping import MapperThread
from dpm2_ros.streams import Parts, Stream

ODOM = "/dpm2/keyframe_odom"
"""Topic, in a robot's namespace, by which robots are discovered."""
SILENT = 5.0
"""s without a message after which a drive counts as over; a robot announces its last keyframe every 2 s."""
BESIDE = 2.5
"""s for which two drives must both send messages to count as two robots."""
_MAX_STREAMS = 256  # known drives, most of them over
_MAX_FURTHER_ROBOTS = 8  # robots in the namespace of another one
_MAX_WAITING_BYTES = 16_000_000  # bytes that may wait
_MAX_ACKS = 50  # acknowledgments between two ticks, to drives whose robot is not decided
_MAX_BACKLOG = 32  # keyframes that may wait for the mapper


class Feed:
    """One namespace: assembles keyframes, passes them to the mapper, and acknowledges those that have arrived.

    A keyframe that is not in the map file yet is acknowledged as waiting: its robot keeps it, but does not send it
    again. Once a session has been silent for `SILENT` s, a new session is that of the restarted robot. If both send
    messages, they are two robots, and the second gets a name of its own, `robot.session`. So no session ends another.
    The robot itself marks the drives that are over: it sends them first, and its odometry is of none of them.
    """

    def __init__(self, node: GuardedNode, mapper: MapperThread, namespace: str, weights: str) -> None:
        """`weights`: identity of the weights of the mapper's network."""
        self._node, self._mapper, self._namespace, self._weights = node, mapper, namespace, weights
        self._robot = namespace.strip("/")
        self.opened = -float("inf")
        self._streams: dict[str, Stream] = {}  # by session, the one with the latest message at the end
        self._ack_count = 0
        self._cloud_topic, self._descriptor_topic = f"{namespace}/dpm2/keyframe_cloud", f"{namespace}/dpm2/keyframe"
        self._pose_topic = namespace + ODOM
        self._subscriptions: list[Any] = []
        self._ack_publisher: Any = None

    def open(self) -> None:
        """Subscribe, for the first time or again; the known drives are kept."""
        node, self.opened = self._node, time.monotonic()
        self._subscriptions = [
            node.create_subscription(Odometry, self._pose_topic, self._on_pose, WIRE),
            node.create_subscription(PointCloud2, self._descriptor_topic, self._on_descriptors, WIRE),
            node.create_subscription(UInt8MultiArray, self._cloud_topic, self._on_cloud, WIRE),
            node.create_subscription(Odometry, f"{self._namespace}/dpm2/odom", self._on_odom, 10),
        ]
        self._ack_publisher = node.create_publisher(UInt32MultiArray, f"{self._namespace}/dpm2/keyframes_received", 10)

    @property
    def robots(self) -> dict[str, Stream]:
        """The drives that are in the map, by the robot's name there."""
        return {stream.robot: stream for stream in self._streams.values() if stream.robot is not None}

    @property
    def has_delivered(self) -> bool:
        """Whether a keyframe of this namespace was passed to the mapper."""
        return any(stream.taken for stream in self._streams.values())

    @property
    def further_robots(self) -> list[str]:
        """Names of further robots in this namespace that send messages now."""
        recent = time.monotonic() - SILENT
        return [name for name, s in self.robots.items() if name != self._robot and s.heard > recent]

    @property
    def odom_frames(self) -> set[str]:
        """Odometry frames of the robots that send messages now."""
        recent = time.monotonic() - SILENT
        return {stream.odom_frame for stream in self.robots.values() if stream.live and stream.heard > recent}

    def tick(self) -> None:
        """Called twice per second: pass on keyframes that wait, and acknowledge those that have arrived."""
        now = time.monotonic()
        self._ack_count = 0
        for stream in list(self._streams.values())[-_MAX_ACKS:]:
            if (id := stream.give_up(now)) is not None:
                self._node.reject(
                    self._pose_topic, "keyframe given up", f"keyframe {id} of {self._robot or '/'} was never valid"
                )
            self._pass_on(stream, now)
            if now - stream.heard < 2 * SILENT and (stream.robot is not None or stream.holds):
                self._acknowledge(stream, now)

    def forget(self) -> None:
        """Note that the map is empty: the next keyframe of each drive is its first there."""
        for stream in self._streams.values():
            stream.last = None

    def close(self) -> None:
        """Unsubscribe. Complete keyframes are passed to the mapper, however many wait there already.

        Those of a drive whose robot is not decided are not: they are sent again.
        """
        for stream in self.robots.values():
            self._pass_on(stream, time.monotonic(), math.inf)
        for subscription in self._subscriptions:
            self._node.destroy_subscription(subscription)
        self._node.destroy_publisher(self._ack_publisher)

    def _on_odom(self, message: Odometry) -> None:
        frame = message.header.frame_id
        check_frame(frame)
        known = self.robots  # a robot without a keyframe in the map has no pose in it
        main = [self._robot] if self._robot in known else []
        for robot in (*main, *reversed(known)):  # of two with the same frame, the first
            if known[robot].odom_frame == frame and known[robot].live:
                if not self._has_restarted(known[robot]):
                    self._mapper.broadcast(stamp_ns(message.header), robot, frame)
                return

    def _has_restarted(self, drive: Stream) -> bool:
        """Whether the robot of a drive has restarted since its last message: its odometry is then of another drive."""
        return any(s.robot is None and s.live and drive.heard < s.since <= s.heard for s in self._streams.values())

    def _on_pose(self, message: Odometry) -> None:
        self._add_part("pose", message.child_frame_id, lambda id: _checked_pose(message, id))

    def _on_cloud(self, message: UInt8MultiArray) -> None:
        if not message.layout.dim:
            raise RejectedError("name", "a cloud without the name of its keyframe")
        self._add_part("cloud", message.layout.dim[0].label, lambda id: _checked_payload(message, id))

    def _on_descriptors(self, message: PointCloud2) -> None:
        self._add_part("seen", message.header.frame_id, lambda id: self._usable_descriptors(message, id))

    def _add_part(self, part: str, name: str, checked: Callable[[int], Any]) -> None:
        """Add one of the messages of a keyframe, by its name; the stream counts a rejected one."""
        stream, id = self._find_stream(name)
        if not stream.wants(id, part):
            return
        try:
            value = checked(id)
        except Exception:
            stream.reject(id, time.monotonic())
            raise
        if stream.put(id, part, value):
            self._pass_on(stream, time.monotonic())
        if stream.robot != self._robot and stream.holds:
            self._limit_memory()

    def _usable_descriptors(self, message: PointCloud2, id: int) -> Descriptors | None:
        """Descriptors that the mapper's network can compare; None: it computes its own from the keyframe's cloud."""
        _check_budget(message, id)
        descriptors, weights = descriptors_from_msg(message)
        channels = self._mapper.active.mapper.channels
        if descriptors is None or channels is None:
            return None
        try:
            if weights != self._weights:
                text = f"weights {weights or 'unnamed'}, the mapper's are {self._weights}"
                raise RejectedError("descriptors of other weights", text)
            check_descriptors(descriptors, channels)
        except RejectedError as error:
            text = f"keyframe {id}: {error}; it is used with new descriptors of its cloud"
            self._node.reject(self._descriptor_topic, error.reason, text)
            return None
        return descriptors

    def _find_stream(self, name: str) -> tuple[Stream, int]:
        """The drive of a keyframe with that name, and its id."""
        _, id, session = parse_keyframe_name(name)
        now, live, session = time.monotonic(), not session.endswith(EARLIER), session.removesuffix(EARLIER)
        stream = self._streams.pop(session, None) or Stream(session, now)
        self._streams[session] = stream
        stream.hear(now, live)
        while len(self._streams) > _MAX_STREAMS:
            without_keyframes = (s for s in self._streams.values() if not s.taken)
            oldest = next(without_keyframes, None) or next(s for s in self._streams.values() if s.robot != self._robot)
            del self._streams[oldest.session]
        if session and stream.robot is None and now - stream.acknowledged > 0.4 and self._ack_count < _MAX_ACKS:
            self._ack_count += 1
            self._acknowledge(stream, now)
        return stream, id

    def _limit_memory(self) -> None:
        """Limit the memory of other drives: the messages of those with the oldest last message are dropped."""
        sizes = {session: s.holds for session, s in self._streams.items() if s.robot != self._robot}
        total = sum(sizes.values())
        for session, size in sizes.items():
            if total <= _MAX_WAITING_BYTES:
                return
            self._streams[session].drop()
            total -= size

    def _pass_on(self, stream: Stream, now: float, max_waiting: float = _MAX_BACKLOG) -> None:
        """Pass the complete keyframes before the first gap to the mapper, once the drive's robot is decided.

        Args:
            max_waiting: keyframes that may wait in the mapper.
        """
        while self._mapper.waiting < max_waiting and (stream.robot is not None or self._decide_robot(stream, now)):
            keyframe = stream.take()
            if keyframe is None:
                return
            self._add_keyframe(stream, *keyframe)

    def _decide_robot(self, stream: Stream, now: float) -> bool:
        """Decide whose drive it is: this robot's, or that of another one in the same namespace; returns whether that is
        decided."""
        main, name = self.robots.get(self._robot), self._robot or "/"
        if not stream.ready:
            return False
        if main is None or not main.live or now - main.heard > SILENT:
            if main is not None:
                self._node.get_logger().warning(f"robot {name} has restarted: it gets a new session in the map")
                main.replaced()
                self._mapper.restart(self._robot)
            stream.robot = self._robot
            return True
        if main.heard < stream.since + BESIDE:
            return False
        if len(self.further_robots) >= _MAX_FURTHER_ROBOTS:
            raise RejectedError(
                "too many robots", f"more than {_MAX_FURTHER_ROBOTS} further robots in the namespace of {name}"
            )
        stream.robot = f"{self._robot}.{stream.session or 'none'}"
        self._node.get_logger().error(f"two robots in namespace {name}: the second one is {stream.robot} in the map")
        return True

    def _add_keyframe(self, stream: Stream, id: int, parts: Parts) -> None:
        assert stream.robot is not None
        pose, (packed, fix, thumbnail) = parts["pose"], parts["cloud"]
        keyframe = keyframe_from(pose, stream.robot, id, stream.last, parts["seen"])
        stream.last, stream.odom_frame = replace(keyframe, descriptors=None), pose.header.frame_id
        stream.taken += 1
        keyframe = replace(keyframe, origin=origin_of(packed), fix=fix, thumbnail=thumbnail)
        stream.given(id, self._mapper.add(lambda: replace(keyframe, cloud=unpack_cloud(packed))))

    def _acknowledge(self, stream: Stream, now: float) -> None:
        if stream.session:
            stream.acknowledged = now
            written, missing = self._mapper.written, self._mapper.missing
            self._ack_publisher.publish(received_to_msg(stream.session, *stream.arrived(written, missing)))


def _checked_pose(message: Odometry, id: int) -> Odometry:
    check_frame(message.header.frame_id)
    keyframe_from(message, "", id, None)
    return message


def _checked_payload(message: UInt8MultiArray, id: int) -> Payload:
    _check_budget(message, id)
    payload = payload_from_msg(message)
    try:
        unpack_cloud(payload.cloud)
    except CodecError as error:
        raise RejectedError("cloud", f"keyframe {id}: {error}") from None
    return payload


def _check_budget(message: Any, id: int) -> None:
    if len(message.data) > BUDGET:
        raise RejectedError("size", f"keyframe {id}: {len(message.data)} bytes; at most {BUDGET} are sent")


def keyframe_from(
    pose: Odometry, robot: str, id: int, before: Keyframe | None, descriptors: Descriptors | None = None
) -> Keyframe:
    """A keyframe without its cloud; its edge leads to the last one that arrived (the mapper expects gaps).

    A covariance of zeros means that the odometry restarted: there is no edge.

    Raises:
        RejectedError: the pose is not a rigid transform, or the covariance is invalid.
    """
    try:
        T_odom_kf = checked_pose(pose.pose.pose)
    except UsageError as error:
        raise RejectedError("pose", f"keyframe {id}: {error}") from None
    covariance, edge = covariance_from_ros(pose.pose.covariance, T_odom_kf[:3, :3]), None
    if covariance.any():
        check_covariance(covariance)
        if before is not None and id > before.id:
            T_before_this = se3.inverse(before.T_odom_kf) @ T_odom_kf
            edge = Registration(T_before_this, covariance, method="odometry")
    return Keyframe(id, stamp_ns(pose.header), id, T_odom_kf, NO_POINTS, edge, robot, descriptors)
