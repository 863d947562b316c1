# SPDX-License-Identifier: Apache-2.0
"""Random messages on every topic of slam_node and mapper_node, during a drive that they must not affect.

The fuzzer reads topics and types from the ROS graph. It leaves out messages that, if well formed, act as commands
whoever sends them: transforms of real frames. A readable cloud on the topic of a drive would be part of that drive; the
fuzzer's clouds are hardly ever readable, and never in the drive's frame.

The test takes six seconds; `make fuzz` takes a minute, sends a thousand messages per second, and checks memory too.
"""

from __future__ import annotations

import importlib
import os
import subprocess
import threading
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticStatus
from nav_msgs.msg import Odometry
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.serialization import serialize_message
from sensor_msgs.msg import PointCloud2

from dpm2_core.data.messages import stamp_ns
from dpm2_core.data.open import open_source
from dpm2_core.data.settings import InputSettings
from dpm2_core.data.transforms import transform_matrix
from dpm2_core.estimates import OdometryResult
from dpm2_core.frame import Frame
from dpm2_core.slam.build import make_odometry
from dpm2_core.slam.settings import SlamSettings
from dpm2_core.slam.store.cloud_codec import pack_cloud, unpack_cloud
from dpm2_core.slam.store.map_data import load_map
from dpm2_core.slam.store.map_store import MapStore
from dpm2_ros.conversions import cloud_to_msg

from ..helpers.diagnostics import figures

SECONDS = float(os.environ.get("DPM2_FUZZ_SECONDS", "6"))
RATE = float(os.environ.get("DPM2_FUZZ_RATE", "400"))
LONG = SECONDS >= 30
GROWTH = 20_000_000  # bytes
START = 1_700_000_000_000_000_000
SETTINGS = {"keyframes": {"distance": 2.0}, "registration": "geometric"}  # the network describes keyframes


FLOATS = (0.0, -0.0, 1.0, -1.0, np.nan, np.inf, -np.inf, 1e308, -1e308, 5e-324, 1e-9, 12345.678)
TEXTS = (
    *("", "a", "x", "y", "z", "/", "//", " ", "../../../etc/passwd", "C:\\con", "%s%n%x", "\n\r\t\x1b[31m", "<script>"),
    *(
        "\u00fcn\u00efc\u00f6d\u00e9 \u96ea",
        "x" * 10_000,
        "a/" * 500,
        "{}",
        "None",
        "map",
        "odom",
        "rgb8",
        "jpeg",
        "plumb_bob",
    ),
    *("kf_", "kf_" + "9" * 4000, "kf_-1.5f3a9c01", "kf_4294967296.5f3a9c01", "kf_0.00000000", "robot/kf_0", "feature"),
)
LENGTHS = (0, 0, 1, 1, 2, 3, 7, 40, 500)
KEPT = 60  # messages of each topic; one in ten of those sent is new


def message_class(name: str) -> Any:
    """The class of a type name such as sensor_msgs/msg/PointCloud2."""
    package, kind, message = name.split("/")
    return getattr(importlib.import_module(f"{package}.{kind}"), message)


class Maker:
    """Random messages of any type; `names` returns strings that mean something to the receiving nodes."""

    def __init__(self, seed: int, names: Callable[[], Sequence[str]]) -> None:
        self.random = np.random.default_rng(seed)
        self._names = names

    def message(self, kind: Any, names: bool = True) -> Any:
        """One message with random values in all fields."""
        out = kind()
        for field, type_name in kind.get_fields_and_field_types().items():
            value = self.value(type_name, getattr(out, field), names)
            try:
                setattr(out, field, value)
            except (AssertionError, ValueError, TypeError, OverflowError):
                continue  # bounded strings and similar fields keep their default
        return out

    def value(self, type_name: str, default: Any, names: bool) -> Any:
        if type_name.startswith("sequence<"):
            inner = type_name[len("sequence<") : -1].split(",")[0]
            return self.many(inner, int(self.random.choice(LENGTHS)), names)
        if type_name.endswith("]"):
            return self.many(type_name[: type_name.index("[")], len(default), names)
        return self.one(type_name, names)

    def many(self, inner: str, count: int, names: bool) -> Any:
        if inner in ("uint8", "octet", "char"):
            return self.random.bytes(count * (100 if self.random.random() < 0.1 else 1))
        return [self.one(inner, names) for _ in range(min(count, 40 if "/" in inner else 500))]

    def one(self, type_name: str, names: bool) -> Any:
        r = self.random
        if type_name == "builtin_interfaces/Time" and r.random() < 0.7:  # others are mostly rejected early
            seconds = (0, 1, 2**31 - 1, START // 10**9 + int(r.integers(-5, 5)))
            return Time(sec=seconds[r.integers(4)], nanosec=int(r.integers(10**9)))
        if "/" in type_name:
            package, message = type_name.split("/")
            return self.message(message_class(f"{package}/msg/{message}"), names)
        if type_name.startswith(("string", "wstring")):
            real = self._names() if names else ()
            return str(r.choice(real)) if real and r.random() < 0.5 else str(TEXTS[r.integers(len(TEXTS))])
        if type_name in ("float", "double", "float32", "float64"):
            value = FLOATS[r.integers(len(FLOATS))] if r.random() < 0.5 else float(r.normal(0, 10 ** r.uniform(-3, 6)))
            with np.errstate(over="ignore"):
                return float(np.float32(value)) if type_name in ("float", "float32") else value
        if type_name in ("bool", "boolean"):
            return bool(r.integers(2))
        if type_name in ("octet", "byte", "char"):
            return r.bytes(1) if type_name != "char" else int(r.integers(256))
        bits = int("".join(filter(str.isdigit, type_name)))
        low, high = (0, 2**bits - 1) if type_name.startswith("u") else (-(2 ** (bits - 1)), 2 ** (bits - 1) - 1)
        extreme = (low, high, 0, 1, high // 2, low + 1)
        return (
            int(extreme[r.integers(6)])
            if r.random() < 0.5
            else int(r.integers(low, high, dtype=np.int64 if low else np.uint64))
        )

    def mangled(self, data: bytes) -> bytes:
        """A message that is damaged in transit."""
        r, out = self.random, bytearray(data)
        for _ in range(int(r.integers(1, 8))):
            at = int(r.integers(4, max(len(out), 5)))
            if at < len(out):
                out[at] = int(r.choice((0, 255, int(r.integers(256)))))
        return bytes(out[: int(r.integers(4, len(out) + 1))] if r.random() < 0.5 else out)


class Fuzzer:
    """A thread that publishes; `names` as for `Maker`."""

    def __init__(
        self, node: Node, targets: Sequence[tuple[str, str]], names: Callable[[], Sequence[str]], rate: float
    ) -> None:
        """`targets`: name and namespace of the nodes. `rate`: total messages per second."""
        self._node, self._rate = node, rate
        self._maker = Maker(1, names)
        self.sent: dict[str, int] = {}
        self._topics: list[tuple[str, Any, Any, list[bytes]]] = []
        for topic, kinds in sorted(
            {(t, tuple(k)) for n, s in targets for t, k in node.get_subscriber_names_and_types_by_node(n, s)}
        ):
            kind = message_class(kinds[0])
            self._topics.append((topic, kind, node.create_publisher(kind, topic, self._qos(topic)), []))
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._run)

    @property
    def topics(self) -> list[str]:
        """The topics that are fuzzed."""
        return [topic for topic, *_ in self._topics]

    def __enter__(self) -> Fuzzer:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._ended.set()
        self._thread.join()

    def _qos(self, topic: str) -> QoSProfile:
        """Reliable, and latched if a subscriber requests it: thus it reaches every subscriber."""
        requested = [info.qos_profile.durability for info in self._node.get_subscriptions_info_by_topic(topic)]
        latched = DurabilityPolicy.TRANSIENT_LOCAL in requested
        durability = DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE
        return QoSProfile(depth=5, reliability=ReliabilityPolicy.RELIABLE, durability=durability)

    def _run(self) -> None:
        count, due = 0, time.monotonic()
        while not self._ended.is_set():
            topic, kind, publisher, kept = self._topics[count % len(self._topics)]
            publisher.publish(self._next(kind, kept))
            self.sent[topic] = self.sent.get(topic, 0) + 1
            count += 1
            # No burst to make up for a delay: it would push an unread scan out of the node's queue.
            due = max(due + 1 / self._rate, time.monotonic())
            self._ended.wait(due - time.monotonic())

    def _next(self, kind: Any, kept: list[bytes]) -> bytes:
        r = self._maker.random
        if len(kept) < KEPT or r.random() < 0.1:
            transforms = kind.__name__ == "TFMessage"
            new = bytes(serialize_message(self._maker.message(kind, names=not transforms)))
            if len(kept) < KEPT:
                kept.append(new)
            else:
                kept[r.integers(KEPT)] = new
        data = kept[r.integers(len(kept))]
        return self._maker.mangled(data) if r.random() < 0.2 else data


@pytest.fixture(scope="module")
def street_scans(recording: Path) -> list[np.ndarray]:
    """Scans of a street; in the long run the robot then stands still, so that no more keyframes are added."""
    drive = [frame.points[::2] for frame in open_source(recording, InputSettings(images=False)).frames(0, 24)]
    return drive + 3 * len(drive) * drive[-1:] if LONG else drive


@pytest.fixture(scope="module")
def alone(street_scans: list[np.ndarray]) -> list[OdometryResult]:
    """The odometry of the drive, without a fuzzer."""
    odometry = make_odometry(SlamSettings.model_validate(SETTINGS), "red")
    return [odometry.process(Frame(START + n * 10**8, points, index=n)) for n, points in enumerate(street_scans)]


class Nodes:
    """slam_node of robot red, and a mapper_node, as processes; and a LiDAR."""

    def __init__(self, harness: Any, folder: Path) -> None:
        self.harness, self.file = harness, folder / "map.dpm2map"
        common = ("-p", "ros.map_directory:=''")
        robot = ["input.points_topic:=points", "ros.embed_mapper:=false", "slam.keyframes.distance:=2.0",
                 "slam.registration:=geometric",
                 "ros.queue_depth:=100",  # with ten, other messages would push an unread scan out during a delay
                 "input.vertical_angle_correction_deg:='0.0'"]  # fmt: skip
        pairs = [part for pair in robot for part in ("-p", pair)]
        mapper = ("-p", f"ros.map_file:={self.file}")
        self.logs = {name: folder / f"{name}.log" for name in ("slam_node", "mapper_node")}
        given = {"slam_node": ("-r", "__ns:=/red", *common, *pairs), "mapper_node": (*common, *mapper)}
        self.processes: dict[str, subprocess.Popen[bytes]] = {
            name: harness.start(name, ["--ros-args", *words], self.logs[name]) for name, words in given.items()
        }
        self.lidar = harness.publisher(PointCloud2, "/red/points")
        self.odom = harness.hear(Odometry, "/red/dpm2/odom")
        self.poses = harness.hear(Odometry, "/red/dpm2/keyframe_odom")
        self.diagnostics = harness.diagnostics
        harness.wait(self.lidar.get_subscription_count, "the subscription to the clouds")
        for name in ("red/slam_node", "mapper_node"):
            harness.find(name)

    def names(self) -> list[str]:
        """What a hostile participant can learn: frames, sessions, and past and future keyframes."""
        real = {
            m.child_frame_id
            for m in self.poses[-500:]
            if m.child_frame_id.startswith("red/kf_") and len(m.child_frame_id) < 30
        }
        sessions = {name.rpartition(".")[2] for name in real if "." in name}
        future = [f"red/kf_{n}.{session}" for session in sessions for n in range(14)]
        return [*sorted(real), *sorted(sessions), *future, "red/odom", "base_link", "red"]

    def pose(self, n: int) -> np.ndarray | None:
        """The node's pose of scan n: messages of others on that topic have other stamps."""
        found = [m for m in list(self.odom) if stamp_ns(m.header) == START + n * 10**8]
        return transform_matrix(found[0].pose.pose) if found else None

    def resident(self) -> dict[str, int]:
        """Resident memory of each process, bytes."""
        page = os.sysconf("SC_PAGE_SIZE")
        return {n: int(Path(f"/proc/{p.pid}/statm").read_text().split()[1]) * page for n, p in self.processes.items()}


@pytest.fixture
def nodes(ros: Callable[..., Any], tmp_path: Path) -> Nodes:
    return Nodes(ros(), tmp_path)


def rejections(status: DiagnosticStatus) -> int:
    """Messages that a node has rejected so far."""
    return sum(int(value) for key, value in figures(status).items() if key != "internal errors")


def test_a_drive_does_not_notice_what_else_is_sent(
    nodes: Nodes, street_scans: list[np.ndarray], alone: list[OdometryResult]
) -> None:
    wait, resident = nodes.harness.wait, []

    def drive(n: int) -> None:
        nodes.lidar.publish(cloud_to_msg(street_scans[n], START + n * 10**8, "red/lidar"))
        wait(lambda: nodes.pose(n) is not None, f"scan {n}")

    drive(0)
    wait(lambda: nodes.names()[0].startswith("red/kf_0"), "the first keyframe")
    targets = [("slam_node", "/red"), ("mapper_node", "/")]
    with Fuzzer(nodes.harness.node, targets, nodes.names, RATE) as fuzzer:
        assert {"/red/points", "/red/initialpose", "/red/dpm2/keyframe", "/red/dpm2/keyframes_received"} <= set(
            fuzzer.topics
        )
        began = time.monotonic()
        for n in range(1, len(street_scans)):
            drive(n)
            time.sleep(max(0.0, began + n * SECONDS / len(street_scans) - time.monotonic()))
            resident.append(nodes.resident())
        sent = sum(fuzzer.sent.values())
    print(f"{sent} messages in {time.monotonic() - began:.1f} s on {len(fuzzer.topics)} topics")
    logs = {name: log.read_text(errors="replace")[-3000:] for name, log in nodes.logs.items()}
    assert all(process.poll() is None for process in nodes.processes.values()), logs

    np.testing.assert_allclose(
        [nodes.pose(n) for n in range(len(street_scans))], [t.T_odom_lidar for t in alone], atol=1e-6
    )
    keyframes = [tracked.keyframe for tracked in alone if tracked.keyframe is not None]

    def stored() -> Any:
        with MapStore.open(nodes.file) as store:
            return load_map(store, descriptors=False)

    wait(lambda: len(stored()) >= len(keyframes), "all keyframes in the map file")
    data = stored()
    assert [(k.robot, k.id) for k in data.keyframes] == [("red", k.id) for k in keyframes]
    np.testing.assert_allclose(data.poses, [k.T_odom_kf for k in keyframes], atol=1e-6)
    with MapStore.open(nodes.file) as store:
        clouds = load_map(store, descriptors=False).clouds
        for node, keyframe in enumerate(keyframes):  # downsampled to the limit of a message, otherwise unchanged
            measured = set(map(bytes, unpack_cloud(pack_cloud(keyframe.cloud))))
            kept = set(map(bytes, clouds.whole(node)))
            assert kept <= measured
            assert len(kept) > 3000

    for name in ("red/slam_node: messages", "mapper_node: messages"):
        rejected = nodes.harness.status(name, lambda status: rejections(status) > 0.1 * sent)
        print(name, figures(rejected))
        assert figures(rejected)["internal errors"] == "0", logs
    begin = len(resident) // 2  # the robot stands, all imports are done, every queue has been full
    growth = {name: max(r[name] for r in resident[begin:]) - resident[begin][name] for name in nodes.processes}
    print("growth of memory in the second half, MB:", {name: round(grown / 1e6, 1) for name, grown in growth.items()})
    assert not LONG or max(growth.values()) < GROWTH
