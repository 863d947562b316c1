# SPDX-License-Identifier: Apache-2.0
"""Plays a rosbag2 recording with its own timing, for machines without `ros2 bag`. Messages pass through undecoded."""

from __future__ import annotations

import importlib
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import rclpy
import typer
from rclpy.duration import Duration
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.utilities import remove_ros_args
from rosgraph_msgs.msg import Clock

from dpm2_core.data import topics
from dpm2_core.data.bag_file import Bag, open_bag
from dpm2_core.data.prefetch import prefetch
from dpm2_core.errors import UsageError
from dpm2_core.files import atomic_write
from dpm2_ros.conversions import stamp_to_msg
from dpm2_ros.runtime import STOP, ros_context

LATCHED = (topics.TF_STATIC, topics.VERTICAL_ANGLE_CORRECTION)
CLOCK_PERIOD = 0.01
"""Seconds between two /clock messages."""
_CLOUD = "sensor_msgs/msg/PointCloud2"


@dataclass(frozen=True)
class Options:
    """What is played, and how."""

    bag: Path
    rate: float
    start: float
    duration: float | None
    loop: bool
    topics: tuple[str, ...]
    wait: float
    subscribers: int
    clock: bool
    log: Path | None


class BagPlayer:
    """Publishers of everything in a bag that can be published here.

    Raises:
        UsageError: the bag cannot be read, has none of the topics, or nothing of it can be published.
    """

    def __init__(self, node: Any, options: Options) -> None:
        self._node, self._options = node, options
        if not options.bag.exists():
            raise UsageError(f"{options.bag}: no such file or folder")
        self._bag: Bag = open_bag(options.bag)
        if missing := [topic for topic in options.topics if topic not in self._bag.types]:
            raise UsageError(f"{options.bag}: no topic {', '.join(missing)}; topics: {', '.join(self._bag.types)}")
        self._publishers = self._make_publishers()
        self._clock = node.create_publisher(Clock, "/clock", 10) if options.clock else None
        self._published: list[str] = []  # lines of the log

    def play(self) -> int:
        """Play to the end, or until a signal; returns the number of messages.

        Raises:
            Dpm2Error: the log cannot be written.
        """
        self._publish_latched()
        self._await_subscribers()
        count = 0
        while True:
            count += self._play_once()
            if STOP.is_set() or not self._options.loop:
                break
            self._node.get_logger().info(f"{self._options.bag}: again from the start")
        self._await_delivery(seconds=0.0 if STOP.is_set() else 1.0)
        for note in self._bag.notes:
            self._node.get_logger().warning(note)
        if self._options.log is not None:
            with atomic_write(self._options.log) as file:
                file.writelines(["topic,log_time_ns,published_ns\n", *self._published])
        return count

    def _make_publishers(self) -> dict[str, Any]:
        """Latched topics first: whoever knows of a later one then knows of these."""
        wanted = self._options.topics or tuple(self._bag.types)
        publishers = {}
        for topic in sorted(wanted, key=lambda topic: topic not in LATCHED):
            kind = self._bag.types[topic]
            package, _, name = kind.replace("/msg/", "/").partition("/")
            try:
                message_type = getattr(importlib.import_module(f"{package}.msg"), name)
            except (ImportError, AttributeError):
                self._node.get_logger().warning(f"{topic} is left out: no message type {kind} here")
                continue
            durability = DurabilityPolicy.TRANSIENT_LOCAL if topic in LATCHED else DurabilityPolicy.VOLATILE
            qos = QoSProfile(depth=100, reliability=ReliabilityPolicy.RELIABLE, durability=durability)
            publishers[topic] = self._node.create_publisher(message_type, topic, qos)
        if not publishers:
            raise UsageError(f"{self._options.bag}: nothing to publish")
        return publishers

    def _publish_latched(self) -> None:
        """Every latched message at once: calibration is wanted before the first cloud, from wherever one starts."""
        for topic, _, data in self._bag.messages([topic for topic in LATCHED if topic in self._publishers]):
            self._publishers[topic].publish(bytes(data))

    def _await_subscribers(self) -> None:
        """Until the clouds (or, without any, everything) have their subscribers; not for ever."""
        options = self._options
        clouds = [topic for topic in self._publishers if self._bag.types[topic] == _CLOUD] or list(self._publishers)
        end = time.monotonic() + options.wait
        while waiting := [t for t in clouds if self._publishers[t].get_subscription_count() < options.subscribers]:
            if time.monotonic() >= end:
                self._node.get_logger().warning(f"playing, though nobody listens to {', '.join(waiting)} yet")
                return
            if STOP.wait(0.02):
                return
        STOP.wait(0.2)  # other topics of the same subscriber are matched within moments of each other

    def _await_delivery(self, seconds: float) -> None:
        """What is on its way must not end with the process. A last receipt may come only seconds later."""
        end = time.monotonic() + seconds
        for publisher in self._publishers.values():
            publisher.wait_for_all_acked(Duration(seconds=max(0.0, end - time.monotonic())))

    def _play_once(self) -> int:
        count, origin, began, ticked = 0, None, 0.0, 0.0
        for topic, log_time, data in prefetch(self._selected()):
            if origin is None:
                origin, began = log_time, time.monotonic()
            due = began + (log_time - origin) * 1e-9 / self._options.rate
            while (left := due - time.monotonic()) > 0:
                now = log_time - round(left * self._options.rate * 1e9)
                self._tick(now)
                if STOP.wait(min(left, CLOCK_PERIOD)):
                    return count
            if time.monotonic() - ticked > CLOCK_PERIOD or topic not in LATCHED:
                self._tick(log_time)
                ticked = time.monotonic()
            if STOP.is_set():
                return count
            published = time.monotonic_ns()
            self._publishers[topic].publish(data)
            count += 1
            if self._options.log is not None:
                self._published.append(f"{topic},{log_time},{published}\n")
        return count

    def _selected(self) -> Iterator[tuple[str, int, bytes]]:
        """The messages of the stretch that is asked for."""
        first = last = None
        for topic, log_time, data in self._bag.messages([t for t in self._publishers if t not in LATCHED]):
            if first is None:
                first = log_time + round(self._options.start * 1e9)
                last = None if self._options.duration is None else first + round(self._options.duration * 1e9)
            if last is not None and log_time > last:
                return
            if log_time >= first:
                yield topic, log_time, bytes(data)

    def _tick(self, now: int) -> None:
        if self._clock is not None:
            self._clock.publish(Clock(clock=stamp_to_msg(now)))


def main(arguments: Sequence[str]) -> int:
    """`bag_player BAG [options] [--ros-args ...]`."""
    app = typer.Typer(add_completion=False, pretty_exceptions_enable=False)
    app.command()(_play)
    ros_context(arguments)
    try:
        own = remove_ros_args(["bag_player", *arguments])[1:]
        return int(app(args=own, standalone_mode=False, prog_name="bag_player") or 0)
    finally:
        rclpy.try_shutdown()


def _play(
    bag: Annotated[Path, typer.Argument(help="rosbag2 folder, .mcap or .db3 file")],
    rate: Annotated[float, typer.Option(help="speed, 1 is that of the recording", min=0.001)] = 1.0,
    start: Annotated[float, typer.Option(help="seconds to skip at the start", min=0)] = 0.0,
    duration: Annotated[float | None, typer.Option(help="seconds to play, of the recording's time", min=0)] = None,
    loop: Annotated[bool, typer.Option("--loop", help="start again at the end, until stopped")] = False,
    topics: Annotated[list[str] | None, typer.Option(help="only these topics; may be repeated")] = None,
    wait: Annotated[float, typer.Option(help="longest wait for somebody to listen to the clouds, s", min=0)] = 2.0,
    subscribers: Annotated[int, typer.Option(help="how many listeners to wait for", min=1)] = 1,
    clock: Annotated[bool, typer.Option(help="publish /clock, for nodes with use_sim_time")] = True,
    log: Annotated[Path | None, typer.Option(help="CSV file for the moment at which each message went out")] = None,
) -> int:
    """Publish a recording. Exit code 2 for one that cannot be read."""
    node = rclpy.create_node("bag_player")
    try:
        options = Options(bag, rate, start, duration, loop, tuple(topics or ()), wait, subscribers, clock, log)
        count = BagPlayer(node, options).play()
        node.get_logger().info(f"{bag}: {count} messages played")
    finally:
        node.destroy_node()
    return 0
