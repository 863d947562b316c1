# SPDX-License-Identifier: Apache-2.0
"""Plays a bag with bag_player into slam_node, two processes over real DDS, and records the output with a subscriber."""

from __future__ import annotations

import csv
import os
import random
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing, suppress
from dataclasses import dataclass, field
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dpm2_core.data.bags import BagSource
from dpm2_core.data.messages import decode_points, stamp_ns
from dpm2_core.data.transforms import transform_matrix
from dpm2_core.errors import Dpm2Error
from dpm2_core.frame import Array, Points
from dpm2_ros.runtime import end_ros, ros_context

Nanoseconds = NDArray[np.int64]


@dataclass(eq=False)
class Replay:
    """Input and output of a replay.

    Attributes:
        published: time at which each cloud was published, ns of the monotonic clock, in the order of the bag.
        poses: stamp (ns) to T_odom_base (4, 4). received: stamp to the time of arrival, ns of the monotonic clock.
        keyframes: stamps of the keyframes.
        map: the last /dpm2/map; None if none arrived.
        maps, loops: number of messages on /dpm2/map and /dpm2/loop_closure.
        tf: "parent -> child" received on /tf.
        diagnostics: the last values of the odometry's status.
        base_frame: child_frame_id of the odometry.
        saved: folder of the map that the node has saved; None if it has not.
        exit_codes: exit codes of the processes, by name.
    """

    published: Nanoseconds = field(default_factory=lambda: np.zeros(0, np.int64))
    poses: dict[int, Array] = field(default_factory=dict)
    received: dict[int, int] = field(default_factory=dict)
    keyframes: list[int] = field(default_factory=list)
    map: Points | None = None
    maps: int = 0
    loops: int = 0
    tf: set[str] = field(default_factory=set)
    diagnostics: dict[str, str] = field(default_factory=dict)
    base_frame: str = ""
    saved: Path | None = None
    exit_codes: dict[str, int] = field(default_factory=dict)


def ros_environment(domain: int | None = None) -> dict[str, str]:
    """The environment of this process, limited to this machine, in a domain that is hardly used by others."""
    return os.environ | {
        "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
        "ROS_DOMAIN_ID": str(random.randint(1, 100) if domain is None else domain),
        "PYTHONUNBUFFERED": "1",
    }


def start(name: str, arguments: Sequence[str], environment: Mapping[str, str], log: Path) -> subprocess.Popen[bytes]:
    """Start one of the executables as a process; its output is written to `log`."""
    with log.open("wb") as file:
        command = [sys.executable, "-m", "dpm2_ros.executables", name, *arguments]
        return subprocess.Popen(command, env=environment, stdout=file, stderr=subprocess.STDOUT)


def stop(process: subprocess.Popen[bytes], timeout: float = 60.0) -> int:
    """Send SIGINT and return the exit code; the process is killed if it does not end."""
    with suppress(ProcessLookupError):
        process.send_signal(signal.SIGINT)
    try:
        return process.wait(timeout)
    except subprocess.TimeoutExpired:
        process.kill()
        return process.wait()


def replay(
    source: BagSource,
    out: Path,
    rate: float = 1.0,
    parameters: Mapping[str, object] | None = None,
    progress: Callable[[int], None] = lambda frames: None,
    watched: bool = False,
) -> Replay:
    """Play the bag into slam_node; returns when both processes have ended. Logs and the map are written to `out`.

    Args:
        source: the bag.
        rate: playback rate.
        parameters: parameters of slam_node.
        progress: called from time to time with the number of poses received.
        watched: subscribe to every topic of slam_node, so that it computes all its output.

    Raises:
        Dpm2Error: a process ended too early; the message has the end of its log.
    """
    environment = ros_environment()
    os.environ.update(environment)  # the subscriber in this process reads it when rclpy starts
    defaults = {"use_sim_time": True, "input.points_topic": source.points_topic, "ros.map_directory": str(out / "map")}
    pairs = [f"{name}:={_yaml(value)}" for name, value in (defaults | dict(parameters or {})).items()]
    arguments = ["--ros-args", *(part for pair in pairs for part in ("-p", pair))]
    times = out / "published.csv"
    slam = start("slam_node", arguments, environment, out / "slam_node.log")
    player: subprocess.Popen[bytes] | None = None
    result, maps = Replay(), set((out / "map").glob("*/map.ply"))
    try:
        with closing(_Listener(result)) as listener:
            while not listener.connected():  # else the first poses would be sent before there is a subscriber
                _check_alive(slam, out)
                listener.spin(0.1)
            if watched:
                listener.watch_all()
            player_arguments = [str(source.path), "--rate", str(rate), "--wait", "60", "--log", str(times)]
            player = start("bag_player", player_arguments, environment, out / "bag_player.log")
            while player.poll() is None:
                _check_alive(slam, out)
                listener.spin(0.2)
                progress(len(result.poses))
            if player.returncode:
                raise Dpm2Error(f"bag_player ended with {player.returncode}: {_tail(out / 'bag_player.log')}")
            result.published = _published(times, source.points_topic)
            _drain(listener, result)
            progress(len(result.poses))
    finally:
        if player is not None:
            result.exit_codes["bag_player"] = stop(player) if player.poll() is None else player.returncode
        result.exit_codes["slam_node"] = stop(slam)
    result.saved = next((ply.parent for ply in set((out / "map").glob("*/map.ply")) - maps), None)
    return result


def _check_alive(slam: subprocess.Popen[bytes], out: Path) -> None:
    """Raise an error if slam_node has ended."""
    if slam.poll() is not None:
        raise Dpm2Error(f"slam_node ended with {slam.returncode}: {_tail(out / 'slam_node.log')}")


def _drain(listener: _Listener, result: Replay) -> None:
    """Spin until all published clouds have a pose, or no more poses arrive; then until the last map has arrived."""
    previous_count, idle_time = -1, 0.0
    while len(result.poses) < len(result.published) and idle_time < 3.0:
        idle_time = 0.0 if len(result.poses) > previous_count else idle_time + 0.2
        previous_count = len(result.poses)
        listener.spin(0.2)
    end = time.monotonic() + 15.0
    while not (listener.map_is_complete() and result.diagnostics) and time.monotonic() < end:
        listener.spin(0.2)


class SpunNode:
    """A node in this process that is spun between other work."""

    def __init__(self, name: str) -> None:
        """Create it with its own context, configured by `os.environ`."""
        import rclpy
        from rclpy.executors import SingleThreadedExecutor

        ros_context([])
        self._node = rclpy.create_node(name)
        self._executor = SingleThreadedExecutor()
        self._executor.add_node(self._node)

    def spin(self, seconds: float) -> None:
        """Process messages that arrive during that time."""
        end = time.monotonic() + seconds
        while (remaining := end - time.monotonic()) > 0:
            self._executor.spin_once(timeout_sec=remaining)

    def close(self) -> None:
        """Destroy the node, and shut down ROS in this process."""
        self._executor.shutdown()
        end_ros(self._node)


class _Listener(SpunNode):
    """Subscribes to the output of slam_node."""

    def __init__(self, result: Replay) -> None:
        from diagnostic_msgs.msg import DiagnosticArray
        from nav_msgs.msg import Odometry
        from sensor_msgs.msg import PointCloud2

        from dpm2_ros.mapping import KEEP_ALL, LAST_ONE
        from dpm2_ros.tf_message import TFMessage

        super().__init__("replay_listener")
        self._result = result
        self._map_stamp = -1
        subscribe = self._node.create_subscription
        subscribe(Odometry, "/dpm2/odom", self._on_odom, 1000)
        subscribe(Odometry, "/dpm2/keyframe_odom", self._on_keyframe, KEEP_ALL)
        subscribe(Odometry, "/dpm2/loop_closure", self._on_loop, KEEP_ALL)
        subscribe(PointCloud2, "/dpm2/map", self._on_map, LAST_ONE)
        subscribe(DiagnosticArray, "/diagnostics", self._on_diagnostics, 10)
        if TFMessage is not None:
            subscribe(TFMessage, "/tf", self._on_tf, 1000)

    def watch_all(self) -> None:
        """Subscribe to the other topics of slam_node, too, without deserializing their messages."""
        from rclpy.qos import QoSProfile, ReliabilityPolicy

        profile = QoSProfile(depth=5, reliability=ReliabilityPolicy.BEST_EFFORT)
        subscribed = {subscription.topic_name for subscription in self._node.subscriptions}
        for topic, (kind, *_) in self._node.get_publisher_names_and_types_by_node("slam_node", "/"):
            if topic in subscribed:
                continue
            package, _, name = kind.split("/")
            message = getattr(import_module(f"{package}.msg"), name)
            self._node.create_subscription(message, topic, lambda _: None, profile, raw=True)

    def connected(self) -> bool:
        """Whether slam_node's diagnostics are received, and its other topics are discovered."""
        topics = ("/dpm2/odom", "/dpm2/keyframe_odom", "/dpm2/loop_closure", "/dpm2/map")
        return bool(self._result.diagnostics) and all(self._node.count_publishers(topic) for topic in topics)

    def map_is_complete(self) -> bool:
        """Whether the last map contains the last keyframe."""
        return bool(self._result.keyframes) and self._map_stamp == self._result.keyframes[-1]

    def _on_odom(self, message: Any) -> None:
        stamp = stamp_ns(message.header)
        self._result.received[stamp] = time.monotonic_ns()
        self._result.poses[stamp] = transform_matrix(message.pose.pose)
        self._result.base_frame = message.child_frame_id

    def _on_keyframe(self, message: Any) -> None:
        self._result.keyframes.append(stamp_ns(message.header))

    def _on_loop(self, _message: Any) -> None:
        self._result.loops += 1

    def _on_map(self, message: Any) -> None:
        self._result.map, _ = decode_points(message, time_field="", intensity_max=1.0)
        self._result.maps += 1
        self._map_stamp = stamp_ns(message.header)

    def _on_tf(self, message: Any) -> None:
        self._result.tf.update(f"{one.header.frame_id} -> {one.child_frame_id}" for one in message.transforms)

    def _on_diagnostics(self, message: Any) -> None:
        for status in message.status:
            if status.name.endswith("slam_node: odometry"):
                self._result.diagnostics = {"message": status.message} | {v.key: v.value for v in status.values}


def _published(times: Path, points_topic: str) -> Nanoseconds:
    with times.open() as file:
        rows = [int(row["published_ns"]) for row in csv.DictReader(file) if row["topic"] == points_topic]
    return np.array(rows, np.int64)


def _tail(log: Path) -> str:
    lines = [line for line in log.read_text(errors="replace").splitlines() if line.strip()]
    return lines[-1] if lines else "no output"


def _yaml(value: object) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    return f'"{value}"' if isinstance(value, str) else str(value)
