# SPDX-License-Identifier: Apache-2.0
"""A small drive, and real nodes over real DDS: in this process for their logic, as processes for their lives."""

from __future__ import annotations

import fcntl
import os
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future
from functools import cache, partial
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from rcl_interfaces.srv import GetParameters
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import PointCloud2

from dpm2_core.data.convert import convert
from dpm2_core.data.kitti import KittiSource
from dpm2_core.estimates import Keyframe
from dpm2_core.frame import Array, Points
from dpm2_core.geometry import se3
from dpm2_ros.conversions import cloud_to_msg, keyframe_name
from dpm2_ros.runtime import end_ros, ros_context
from test.helpers.rig import Rig
from tools.replay import ros_environment, start

os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = ros_environment()["ROS_AUTOMATIC_DISCOVERY_RANGE"]


def _own_domains() -> Iterator[int]:
    """ROS domains from 1 to 100, over and over: a fifth of them that no other run of the tests beside this one has."""
    for fifth in range(5):
        lock = (Path(tempfile.gettempdir()) / f"dpm2_test_domains_{fifth}.lock").open("w")
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            lock.close()
            continue
        while True:  # the lock is held for as long as the generator lives
            yield from range(1 + 20 * fifth, 21 + 20 * fifth)
    yield from (1 + (7 * os.getpid() + n) % 100 for n in count())  # six runs at once


_domains = _own_domains()

FRAMES, PERIOD, STEP = 16, 100_000_000, 0.8  # scans, ns and m between them
START = 1_700_000_000_000_000_000
LATCHED = QoSProfile(depth=10, durability=DurabilityPolicy.TRANSIENT_LOCAL, reliability=ReliabilityPolicy.RELIABLE)


def new_domain() -> int:
    """One that neither another test of this run nor a run beside it uses."""
    return next(_domains)


def scan(T_world_lidar: Array) -> Points:
    """(N, 4) points of a street within 40 m: ground, house fronts, side walls. The same points from everywhere."""
    world = _street()
    local = se3.transform(se3.inverse(T_world_lidar), world)
    return local[np.einsum("ij,ij->i", local[:, :3], local[:, :3]) < 40.0**2]


@cache
def _street() -> Points:
    rng = np.random.default_rng(0)
    x = np.arange(-60, 120, 0.35, dtype=np.float32)
    ground = np.stack(np.meshgrid(x, np.arange(-12, 12.1, 0.7)), -1).reshape(-1, 2)
    parts = [np.column_stack([ground, np.full(len(ground), -1.7)])]
    for side in (-1, 1):
        for house in range(-6, 12):
            front = 8 + rng.uniform(0, 4)
            along, up = np.meshgrid(10 * house + np.arange(0, 9, 0.35), np.arange(-1.7, 5, 0.5))
            parts.append(np.column_stack([along.ravel(), np.full(along.size, side * front), up.ravel()]))
            depth, up = np.meshgrid(np.arange(front, front + 4, 0.35), np.arange(-1.7, 5, 0.5))
            parts.append(np.column_stack([np.full(depth.size, 10.0 * house), side * depth.ravel(), up.ravel()]))
    points = np.concatenate(parts)
    return np.column_stack([points, rng.uniform(0, 1, len(points))]).astype(np.float32)


def pose(n: int) -> Array:
    """T_world_lidar of the n-th scan: straight on with a slight turn."""
    return se3.exp([0, 0, 0.004 * n, STEP * n, 0, 0])


class Drive:
    """The drive, scan by scan."""

    frames, period, start = FRAMES, PERIOD, START

    def stamp(self, n: int) -> int:
        """ns."""
        return START + n * PERIOD

    def pose(self, n: int) -> Array:
        """T_start_lidar (4, 4)."""
        return se3.inverse(pose(0)) @ pose(n)

    def cloud(self, n: int, frame_id: str = "lidar") -> PointCloud2:
        """The n-th scan as a message."""
        return cloud_to_msg(scan(pose(n)), self.stamp(n), frame_id)


@pytest.fixture(scope="session")
def sequence(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The drive as a KITTI sequence, with images of noise."""
    import cv2

    root = tmp_path_factory.mktemp("drive")
    (root / "velodyne").mkdir()
    (root / "image_2").mkdir()
    rng = np.random.default_rng(1)
    for n in range(FRAMES):
        scan(pose(n)).tofile(root / "velodyne" / f"{n:06d}.bin")
        cv2.imwrite(str(root / "image_2" / f"{n:06d}.png"), rng.integers(0, 255, (40, 120, 3), np.uint8))
    Tr = np.array([[0, -1, 0, 0.0], [0, 0, -1, -0.08], [1, 0, 0, -0.27], [0, 0, 0, 1]])
    P = "70 0 60 0 0 70 20 0 0 0 1 0"
    lines = [*(f"P{i}: {P}" for i in range(4)), "Tr: " + " ".join(map(str, Tr[:3].ravel()))]
    (root / "calib.txt").write_text("\n".join(lines) + "\n")
    (root / "times.txt").write_text("".join(f"{n * PERIOD * 1e-9:.6e}\n" for n in range(FRAMES)))
    poses = [Tr @ se3.inverse(pose(0)) @ pose(n) @ se3.inverse(Tr) for n in range(FRAMES)]
    np.savetxt(root / "poses.txt", np.array(poses)[:, :3].reshape(-1, 12))
    return root


@pytest.fixture(scope="session")
def bag(sequence: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The drive as a bag."""
    out = tmp_path_factory.mktemp("bags") / "drive"
    convert(KittiSource(sequence), out)
    return out


class Harness:
    """Nodes under test and a tester's node, spun by one thread."""

    def __init__(self, parameters: Sequence[str], domain: int, namespace: str) -> None:
        # Without the network, which takes most of the time, unless a test says otherwise: how a node handles scans and
        # keyframes is the same. Drives through nodes as they are by default: test_replay.py and test_lockstep.py.
        quick = ("ros.map_directory:=''", "slam.registration:=geometric", "slam.loops.descriptors:=false")
        pairs = [part for pair in (*quick, *parameters) for part in ("-p", pair)]
        remap = ["-r", f"__ns:={namespace}"] if namespace else []
        ros_context(["--ros-args", *pairs, *remap], domain)
        self.node = rclpy.create_node("tester", use_global_arguments=False)
        self.received: dict[str, list[Any]] = {}
        self._clients: dict[str, Any] = {}
        self._executor = SingleThreadedExecutor()
        self._executor.add_node(self.node)
        self._closing: list[Any] = []
        self._processes: list[subprocess.Popen[bytes]] = []
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._spin)
        self._thread.start()

    def _spin(self) -> None:
        while not self._ended.is_set():
            self._executor.spin_once(timeout_sec=1.0)  # what is added and the end wake it

    def add(self, node: Node) -> Any:
        """Spin and in the end close a node."""
        self._executor.add_node(node)
        self._executor.wake()
        self._closing.append(node)
        return node

    def remove(self, node: Node) -> None:
        """Close a node under test before the end."""
        self._closing.remove(node)

        def end() -> None:
            self._executor.remove_node(node)
            node.close()  # type: ignore[attr-defined]
            node.destroy_node()

        self._between_waits(end, f"the end of {node.get_name()}")

    def start(self, name: str, arguments: Sequence[str], log: Path, **variables: str) -> subprocess.Popen[bytes]:
        """One of the executables as a process that sees these nodes, and in the end is killed."""
        environment = ros_environment(self.node.context.get_domain_id()) | variables
        self._processes.append(start(name, arguments, environment, log))
        return self._processes[-1]

    def hear(self, kind: type, topic: str, qos: Any = 100) -> list[Any]:
        """The messages of a topic, as they come."""
        messages = self.received.setdefault(topic, [])
        self.node.create_subscription(kind, topic, messages.append, qos)
        self._executor.wake()
        return messages

    def found_by(self, node: Node, topic: str) -> bool:
        """Whether a node has found the tester's subscription; it may have one of its own."""
        return any(one.node_name == self.node.get_name() for one in node.get_subscriptions_info_by_topic(topic))

    def publisher(self, kind: type, topic: str, reliable: bool = True, latched: bool = False) -> Any:
        """A publisher."""
        reliability = ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT
        durability = DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE
        return self.node.create_publisher(
            kind, topic, QoSProfile(depth=50, reliability=reliability, durability=durability)
        )

    def call(self, kind: type, name: str, **fields: Any) -> Any:
        """The reply of a node's service, of which the request goes out once: it need not be one that may come twice.

        Fast DDS drops a reply where the server has not found the client's reader within 0.1 s, as may be on a busy
        machine, and does not tell the client. Readers are announced in the order in which they were made: once the node
        has replied to one that was made later, it knows the first.
        """
        if name not in self._clients:
            self._clients[name] = self.node.create_client(kind, name)
            probe = self.node.create_client(GetParameters, f"{name.rpartition('/')[0]}/get_parameters")
            self._reply(probe, GetParameters.Request(), again=3.0)
        return self._reply(self._clients[name], kind.Request(**fields))

    def _reply(self, client: Any, request: Any, again: float = float("inf")) -> Any:
        """`again`: s without a reply after which the request is sent once more."""
        self.wait(client.service_is_ready, client.srv_name)
        sent, futures = 0.0, list[Any]()

        def replies() -> list[Any]:
            nonlocal sent
            if not futures or time.monotonic() - sent > again:
                sent = time.monotonic()
                futures.append(client.call_async(request))
            return [future.result() for future in futures if future.done()]

        self.wait(replies, f"the reply of {client.srv_name}")
        return replies()[0]

    @property
    def diagnostics(self) -> list[DiagnosticArray]:
        """What has come of /diagnostics, since this was asked for first."""
        topic = "/diagnostics"
        return self.received[topic] if topic in self.received else self.hear(DiagnosticArray, topic)

    def status(
        self, part: str, condition: Callable[[DiagnosticStatus], Any] = bool, since: int | None = None
    ) -> DiagnosticStatus:
        """The first status for which something holds, once there is one.

        A message may tell of the time before what a test has just done: the condition says what is waited for.

        Args:
            part: how its name ends. since: number of the first message that counts; None: the last that has come.
        """
        heard = self.diagnostics
        begin = max(len(heard) - 1, 0) if since is None else since
        last, found = "none", list[DiagnosticStatus]()

        def look() -> bool:
            nonlocal begin, last
            for message in heard[begin:]:
                begin += 1
                statuses = [status for status in message.status if status.name.endswith(part)]
                found.extend(filter(condition, statuses))
                last = repr(statuses[-1]) if statuses else last
            return bool(found)

        try:
            self.wait(look, f"a status of {part}")
        except AssertionError as error:
            raise AssertionError(f"{error}; the last: {last}") from None
        return found[0]

    def find(self, name: str) -> None:
        """Until a node elsewhere has found all that is heard here; what it sends before that is lost.

        A reader that was announced after the others has its diagnostics.
        """
        told: list[str] = []
        add = lambda message: told.extend(status.name for status in message.status)  # noqa: E731
        reader = self.node.create_subscription(DiagnosticArray, "/diagnostics", add, 10)
        self._executor.wake()
        self.wait(lambda: any(one.startswith(f"{name}: ") for one in told), f"the diagnostics of {name}")
        self.destroy(reader)

    def destroy(self, entity: Any) -> None:
        """A publisher or subscription of the tester."""
        is_publisher = entity in list(self.node.publishers)
        destroy = self.node.destroy_publisher if is_publisher else self.node.destroy_subscription
        self._between_waits(partial(destroy, entity), "the end of a publisher or subscription")

    def _between_waits(self, work: Callable[[], Any], what: str) -> None:
        """In the thread that spins, between two of its waits: rclpy raises in that thread where it is about to wait for
        something that another thread destroys, and no callback is to meet a node that another thread is closing."""
        done = Future[Any]()

        def run() -> None:
            try:
                done.set_result(work())
            except BaseException as error:
                done.set_exception(error)

        self._executor.create_task(run)
        self.wait(done.done, what)
        done.result()

    @staticmethod
    def wait(condition: Callable[[], Any], what: str, timeout: float = 90.0) -> None:
        """Until it holds; fails saying what was waited for."""
        end = time.monotonic() + timeout
        while True:
            began = time.thread_time()
            if condition():
                return
            assert time.monotonic() < end, f"waited {timeout} s for {what}"
            # A condition that reads a map leaves the processors to what is waited for.
            time.sleep(max(0.01, 5 * (time.thread_time() - began)))

    def close(self) -> None:
        """Kill the processes, end the thread that spins, close the nodes under test, as programs do, and the rest."""
        for process in self._processes:
            process.kill()
            process.wait()
        self._ended.set()
        self._executor.wake()
        self._thread.join()
        try:
            for node in self._closing:
                node.close()
        finally:
            self._executor.shutdown()
            end_ros(*self._closing, self.node)


@pytest.fixture
def ros() -> Iterator[Callable[..., Harness]]:
    """Makes a `Harness`: ros(*"name:=value" parameters, namespace="")."""
    made: list[Harness] = []

    def make(*parameters: str, namespace: str = "") -> Harness:
        made.append(Harness(parameters, new_domain(), namespace))
        return made[-1]

    yield make
    for harness in made:
        harness.close()


@pytest.fixture
def mapper(
    ros: Callable[..., Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, request: pytest.FixtureRequest
) -> Any:
    """Harness with a mapper_node that saves to tmp_path/map, and `send(name, T, cloud)` for keyframes; with the network
    where its parameter says so."""
    from dpm2_ros.mapper_node import MapperNode  # these import the whole SLAM
    from test.helpers.mapping import Wires

    monkeypatch.setattr("dpm2_ros.diagnostics.PERIOD", 0.1)
    described = str(getattr(request, "param", False)).lower()
    harness = ros(f"ros.map_directory:={tmp_path / 'map'}", f"slam.loops.descriptors:={described}")
    harness.mapper = harness.add(MapperNode())
    wires = Wires(harness)
    wires.wait()

    def send(id: int, T: np.ndarray, points: np.ndarray, cloud_first: bool = False, name: str = "") -> None:
        keyframe = Keyframe(id, 1000 + id, id, T, points.astype(np.float32))
        wires.send(keyframe, name or keyframe_name("", id), cloud_first=cloud_first)

    harness.send, harness.wires = send, wires
    return harness


@pytest.fixture
def run() -> Callable[..., subprocess.CompletedProcess[str]]:
    """Runs one of the executables to its end: run("slam_node", *arguments)."""

    def finish(name: str, *arguments: str, timeout: float = 180.0) -> subprocess.CompletedProcess[str]:
        command = [sys.executable, "-m", "dpm2_ros.executables", name, *arguments]
        environment = ros_environment(new_domain())
        return subprocess.run(command, env=environment, capture_output=True, text=True, timeout=timeout, check=False)

    return finish


@pytest.fixture
def processes() -> Iterator[list[subprocess.Popen[bytes]]]:
    """To be killed at the end."""
    started: list[subprocess.Popen[bytes]] = []
    yield started
    for process in started:
        process.kill()
        process.wait()


@pytest.fixture
def domain() -> int:
    """A ROS domain of this test's own."""
    return new_domain()


@pytest.fixture
def domains() -> Iterator[int]:
    """More of them, for a test whose processes must not meet."""
    return _domains


@pytest.fixture
def drive() -> Drive:
    """The drive, scan by scan."""
    return Drive()


@pytest.fixture
def rig(ros: Callable[..., Any], drive: Any, monkeypatch: pytest.MonkeyPatch) -> Callable[..., Rig]:
    """Makes a Rig whose node sends diagnostics ten times a second, and takes no sensor for silent: a busy machine may
    take its time between a cloud and the next look at what came of it."""
    monkeypatch.setattr("dpm2_ros.diagnostics.PERIOD", 0.1)
    monkeypatch.setattr("dpm2_ros.slam_diagnostics.SILENT", 300.0)
    return lambda *parameters, **options: Rig(ros, drive, *parameters, **options)
