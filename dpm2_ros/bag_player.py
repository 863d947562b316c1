# SPDX-License-Identifier: Apache-2.0
"""Plays a rosbag2 recording with its own timing, for machines without `ros2 bag`. Messages are not decoded, except
those of /tf_static."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import rclpy
import typer
from rclpy.duration import Duration
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.serialization import deserialize_message
from rclpy.utilities import remove_ros_args
from rosgraph_msgs.msg import Clock

from dpm2_core.data import naming
from dpm2_core.data.bag_file import Bag, open_bag
from dpm2_core.data.message_kinds import CAMERA_INFO, CLOUDS
from dpm2_core.data.messages import rigid_parts
from dpm2_core.data.naming import frame_name
from dpm2_core.data.prefetch import prefetch
from dpm2_core.errors import UsageError, printable
from dpm2_core.files import atomic_write
from dpm2_ros.lockstep import ODOMETRY, Lockstep
from dpm2_ros.message_types import message_type
from dpm2_ros.recorded_results import is_result, odometry_frames, published_here, without_frames
from dpm2_ros.runtime import STOP, end_ros, ros_context
from dpm2_ros.stamps import stamp_to_msg
from dpm2_ros.tf_message import MAX_TRANSFORMS, TFMessage

CLOCK = "/clock"
LATCHED = (naming.TF_STATIC, naming.VERTICAL_ANGLE_CORRECTION)
_STATIC = naming.TF_STATIC, "tf2_msgs/msg/TFMessage"  # topic and type
CLOCK_PERIOD = 0.01
"""Seconds between two /clock messages."""
HELD_UP = 1.0
"""Largest delay of a message, s, after which the following ones still catch up: a node has room for ten clouds."""
DELIVERY = 5.0
"""Longest wait for the end of a recording to arrive, s: a lost acknowledgment is requested again after three."""


@dataclass(frozen=True)
class Options:
    """Publish a recording. The exit code is 2 if it cannot be read."""  # the help: typer takes a command from this

    bag: Annotated[Path, typer.Argument(help="rosbag2 folder, .mcap or .db3 file")]
    rate: Annotated[float, typer.Option(help="playing speed, relative to the recording", min=0.001)] = 1.0
    start: Annotated[float, typer.Option(help="seconds to skip at the start", min=0)] = 0.0
    duration: Annotated[float | None, typer.Option(help="seconds of the recording to play", min=0)] = None
    loop: Annotated[bool, typer.Option("--loop", help="start again at the end, until stopped")] = False
    topics: Annotated[list[str] | None, typer.Option(help="play only this topic; may be repeated")] = None
    wait: Annotated[float, typer.Option(help="longest wait for a subscriber to the clouds, s", min=0)] = 30.0
    subscribers: Annotated[int, typer.Option(help="number of these subscribers to wait for", min=1)] = 1
    listener: Annotated[str, typer.Option("--for", help="wait only for nodes of this name, such as slam_node")] = ""
    clock: Annotated[bool, typer.Option(help="publish /clock, for nodes with use_sim_time")] = True
    log: Annotated[Path | None, typer.Option(help="CSV file with the time at which each message was published")] = None
    lockstep: Annotated[
        bool, typer.Option("--lockstep", help="ignore the timing: publish each cloud after dpm2/odom of the one before")
    ] = False


class BagPlayer:
    """Publishes all topics of a bag whose message types are available.

    Raises:
        UsageError: the bag cannot be read, has none of the topics, or nothing of it can be published.
    """

    def __init__(self, node: Any, options: Options) -> None:
        self._node, self._options = node, options
        if not options.bag.exists():
            raise UsageError(f"{options.bag}: no such file or folder")
        self._bag: Bag = open_bag(options.bag)
        if missing := [topic for topic in options.topics or () if topic not in self._bag.types]:
            raise UsageError(f"{options.bag}: no topic {', '.join(missing)}; topics: {', '.join(self._bag.types)}")
        # A CameraInfo that was recorded only once was latched.
        single = [topic for topic in self._bag.topics(CAMERA_INFO) if self._bag.counts[topic] == 1]
        self._latched = (*LATCHED, *single)
        self._publishers = self._make_publishers()
        self._timed = [topic for topic in self._publishers if topic not in self._latched]
        self._last_read_time: float | None = None  # time of the last message read from these topics, s from the first
        has_clock = CLOCK in self._publishers
        if has_clock:
            node.get_logger().info(f"{CLOCK} is that of the recording")
        self._clock = node.create_publisher(Clock, CLOCK, 10) if options.clock and not has_clock else None
        self._lockstep = Lockstep(node, self._bag, self._publishers) if options.lockstep else None
        self._frames: set[str] = set()  # frames whose transforms are left to a node
        self._published: list[str] = []  # lines of the log
        self._clouds = 0

    def play(self) -> None:
        """Play to the end, or until a signal, and log the number of messages.

        Raises:
            UsageError: the requested part of the recording has no message.
            Dpm2Error: the log cannot be written; in lockstep, there is no odometry, or not of every cloud.
        """
        self._publish_latched()
        self._await_subscribers()
        if not self._options.topics:
            self._leave_out_published()
        if self._lockstep is not None:
            self._lockstep.begin()
        count = played = self._play_once()
        while played and self._options.loop and not STOP.is_set():
            self._node.get_logger().info(f"{self._options.bag}: again from the start")
            count += (played := self._play_once())
        if self._options.loop and not self._timed:  # latched messages remain available
            STOP.wait()
        self._await_delivery()
        for note in self._bag.notes:
            self._node.get_logger().warning(note)
        if not count and self._timed and not STOP.is_set():
            raise UsageError(f"{self._options.bag}: {self._no_message_reason()}")
        if self._options.log is not None:
            with atomic_write(self._options.log) as file:
                file.writelines(["topic,log_time_ns,published_ns\n", *self._published])
        if self._lockstep is not None:
            self._lockstep.conclude()
        self._node.get_logger().info(f"{self._options.bag}: {count} messages played, {self._clouds} of them clouds")

    def _make_publishers(self) -> dict[str, Any]:
        """Publishers by topic. Latched ones come first: a subscriber that has discovered a later one then has these."""
        requested = self._options.topics or tuple(self._bag.types)
        publishers = {}
        for topic in sorted(requested, key=lambda topic: topic not in self._latched):
            if self._options.lockstep and topic == self._node.resolve_topic_name(ODOMETRY):
                self._node.get_logger().warning(f"{topic} is left out: the node publishes it now")
                continue
            kind = self._bag.types[topic]
            if (message_class := message_type(kind)) is None:
                hint = "; dpm2 convert makes a recording with PointCloud2 of it" if kind in CLOUDS else ""
                self._node.get_logger().warning(
                    f"{printable(topic)} is left out: no message type {printable(kind)}{hint}"
                )
                continue
            durability = DurabilityPolicy.TRANSIENT_LOCAL if topic in self._latched else DurabilityPolicy.VOLATILE
            qos = QoSProfile(depth=100, reliability=ReliabilityPolicy.RELIABLE, durability=durability)
            publishers[topic] = self._node.create_publisher(message_class, topic, qos)
        if not publishers:
            raise UsageError(f"{self._options.bag}: nothing to publish")
        return publishers

    def _publish_latched(self) -> None:
        """Publish every latched message at once: calibration must precede the first cloud, wherever playing starts.

        Of /tf_static only the last transform of each frame is published, all together: a recording may repeat them
        thousands of times, and a subscriber receives only the last hundred messages or so.
        """
        by_frame = dict[str, Any]()
        for topic, _, data in self._bag.playable([topic for topic in self._latched if topic in self._publishers]):
            if (topic, self._bag.types[topic]) == _STATIC:
                by_frame |= self._transforms(bytes(data))
            else:
                self._publishers[topic].publish(bytes(data))
        transforms = list(by_frame.values())
        for first in range(0, len(transforms), MAX_TRANSFORMS):
            message = TFMessage(transforms=transforms[first : first + MAX_TRANSFORMS])
            self._publishers[naming.TF_STATIC].publish(message)

    def _transforms(self, data: bytes) -> dict[str, Any]:
        """The transforms of a message, by child frame; an invalid one is left out, with a warning."""
        out, log = dict[str, Any](), self._node.get_logger()
        try:
            message = deserialize_message(data, TFMessage)
        except Exception as error:  # rclpy raises RMWError or RuntimeError
            log.warning(f"{naming.TF_STATIC}: a message is left out: {printable(str(error))}", once=True)
            return out
        for stamped in message.transforms:
            child = stamped.child_frame_id
            try:
                rigid_parts(stamped.transform)
            except UsageError as error:
                log.warning(f"{naming.TF_STATIC}: {printable(child)} is left out: {error}", once=True)
            else:
                out[frame_name(child)] = stamped
        return out

    def _await_subscribers(self) -> None:
        """Wait, at most for `Options.wait`, until the clouds (or, without any, the other topics) have subscribers."""
        options, log = self._options, self._node.get_logger()
        inputs = [topic for topic in self._publishers if not is_result(topic)] or list(self._publishers)
        clouds = [topic for topic in inputs if self._bag.types[topic] in CLOUDS] or inputs
        awaited = "a subscriber" if options.subscribers == 1 else f"{options.subscribers} subscribers"
        awaited += f" named {options.listener}" * bool(options.listener) + f" to {', '.join(clouds)}"
        began, is_logged = time.monotonic(), False
        while self._count_subscribers(clouds) < options.subscribers:
            waited = time.monotonic() - began
            if waited >= options.wait:
                log.warning(f"playing without {awaited} yet")
                break
            if waited > 1.0 and not is_logged:
                log.info(f"waiting {options.wait:g} s at most for {awaited}")
                is_logged = True
            if STOP.wait(0.02):
                return
        if self._lockstep is not None:
            self._lockstep.find(began + options.wait)
        STOP.wait(0.2)  # other topics of the same subscriber are matched within moments of each other

    def _leave_out_published(self) -> None:
        """Leave out the topics that nodes of dpm2 publish now."""
        omitted = published_here(self._node, self._timed)
        if not omitted:
            return
        self._frames = odometry_frames(self._bag, omitted)
        for topic in omitted:
            self._timed.remove(topic)
            self._node.destroy_publisher(self._publishers.pop(topic))
        frames = f"; so are transforms from and to {', '.join(sorted(self._frames))}" if self._frames else ""
        self._node.get_logger().warning(f"{', '.join(omitted)}: left out, as nodes publish these now{frames}")

    def _count_subscribers(self, topics: Sequence[str]) -> int:
        """Number of subscriptions or, if a node's name is given, of nodes with it: a robot may have two LiDARs."""
        if not self._options.listener:
            return sum(self._publishers[topic].get_subscription_count() for topic in topics)
        found = [info for topic in topics for info in self._node.get_subscriptions_info_by_topic(topic)]
        return len({info.node_namespace for info in found if info.node_name == self._options.listener})

    def _await_delivery(self) -> None:
        """Wait until the last messages have arrived, above all the clouds; clouds that do not arrive are reported.

        The acknowledgment of the last message, if it is small, may arrive only seconds after the message.
        """
        began = time.monotonic()
        for topic in sorted(self._publishers, key=lambda topic: self._bag.types[topic] not in CLOUDS):
            cloud = self._bag.types[topic] in CLOUDS
            end = began + (DELIVERY if cloud else 1.0)
            while not STOP.is_set() and not self._publishers[topic].wait_for_all_acked(Duration(seconds=0.1)):
                if time.monotonic() >= end:
                    if cloud:
                        self._node.get_logger().warning(f"{topic}: not every cloud has arrived within {DELIVERY:g} s")
                    break

    def _play_once(self) -> int:
        count, now, origin = 0, 0, (0, 0.0)
        messages = self._selected_messages()
        for topic, log_time, data in prefetch(messages if self._lockstep is None else self._lockstep.order(messages)):
            if not count:
                origin = log_time, time.monotonic()
            if self._lockstep is None:
                origin = self._pace(log_time, *origin)
            else:
                self._lockstep.await_turn(topic, data)
            if STOP.is_set():
                return count
            now = max(now, log_time) if self._lockstep is None else log_time
            if self._lockstep is None or self._lockstep.awaits(topic):  # in lockstep, other messages may be ahead
                self._publish_clock(now)
            published = time.monotonic_ns()
            self._publishers[topic].publish(data)
            count += 1
            self._clouds += self._bag.types[topic] in CLOUDS
            if self._options.log is not None:
                self._published.append(f"{topic},{log_time},{published}\n")
        return count

    def _pace(self, log_time: int, origin: int, began: float) -> tuple[int, float]:
        """Wait until a message is due, if `origin` ns of the recording was played at `began` s; returns both.

        If it was due long ago, since the process was stopped or the disk was slow, both are set to this message: all
        messages that were due in the meantime, sent at once, would be more than the subscribers' queues can store.
        """
        due = began + (log_time - origin) * 1e-9 / self._options.rate
        while (remaining := due - time.monotonic()) > 0 and not STOP.is_set():
            self._publish_clock(log_time - round(remaining * self._options.rate * 1e9))
            STOP.wait(min(remaining, CLOCK_PERIOD))
        if remaining >= -HELD_UP:
            return origin, began
        text = f"{-remaining:.1f} s behind (process stopped or disk slow): playing continues from there"
        self._node.get_logger().warning(text, throttle_duration_sec=5)
        return log_time, time.monotonic()

    def _selected_messages(self) -> Iterator[tuple[str, int, bytes]]:
        """The messages of the requested part of the recording."""
        origin = first = last = None
        for topic, log_time, data in self._bag.playable(self._timed):
            if origin is None or first is None:
                origin, first = log_time, log_time + round(self._options.start * 1e9)
                last = None if self._options.duration is None else first + round(self._options.duration * 1e9)
            self._last_read_time = (log_time - origin) * 1e-9
            if last is not None and log_time > last:
                return
            if log_time < first:
                continue
            played = bytes(data)
            if topic == naming.TF and self._frames:
                played = without_frames(played, self._frames)
            if played:
                yield topic, log_time, played

    def _no_message_reason(self) -> str:
        start, duration, at = self._options.start, self._options.duration, self._last_read_time
        if at is None:
            return f"no message of {', '.join(self._timed)}"
        end = "on" if duration is None else f"to {start + duration:g} s"
        return f"no message from {start:g} s {end}; the {'last' if at < start else 'next'} one is at {at:.1f} s"

    def _publish_clock(self, now: int) -> None:
        if self._clock is not None:
            self._clock.publish(Clock(clock=stamp_to_msg(now)))


def main(arguments: Sequence[str]) -> int:
    """`bag_player BAG [options] [--ros-args ...]`."""
    app = typer.Typer(add_completion=False, pretty_exceptions_enable=False)
    app.command()(Options)
    ros_context(arguments)
    nodes = list[Any]()
    try:
        own_arguments = remove_ros_args(["bag_player", *arguments])[1:]
        options = app(args=own_arguments, standalone_mode=False, prog_name="bag_player")
        if not isinstance(options, Options):  # --help
            return int(options or 0)
        if options.lockstep and options.rate != 1.0:
            raise UsageError("--lockstep plays as fast as the node: it cannot be combined with --rate")
        nodes.append(rclpy.create_node("bag_player"))
        BagPlayer(nodes[0], options).play()
        return 0
    finally:
        end_ros(*nodes)
