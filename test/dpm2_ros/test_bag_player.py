# SPDX-License-Identifier: Apache-2.0
"""The messages of the bag are published unchanged, in order and at the right time."""

from __future__ import annotations

import csv
import math
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rclpy
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import CameraInfo, Image, PointCloud2

from dpm2_core.data import naming
from dpm2_core.data.bag_messages import transforms
from dpm2_core.data.bags import BagSource
from dpm2_core.data.image_messages import decode_image
from dpm2_core.data.messages import decode_points, stamp_ns
from dpm2_core.data.settings import InputSettings
from dpm2_core.errors import exit_code
from dpm2_ros.bag_player import main
from dpm2_ros.tf_message import TFMessage
from test.helpers.lockstep import play
from test.helpers.recordings import write_bag

LATCHED_DEPTH = 10


class Listener:
    """Subscribers to the KITTI topics, and the player as a process."""

    def __init__(self, harness: Any, log: Path) -> None:
        from rclpy.qos import DurabilityPolicy, QoSProfile

        self.harness, self._log = harness, log
        self.clouds = harness.hear(PointCloud2, naming.POINTS)
        self.images = harness.hear(Image, naming.IMAGE)
        self.infos = harness.hear(CameraInfo, f"{naming.KITTI.camera}/camera_info")
        self.clock = harness.hear(Clock, "/clock", 1000)
        latched = QoSProfile(depth=LATCHED_DEPTH, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self.static = harness.hear(TFMessage, naming.TF_STATIC, latched)

    def play(self, *arguments: str) -> subprocess.Popen[bytes]:
        process: subprocess.Popen[bytes] = self.harness.start("bag_player", arguments, self._log)
        return process

    def output(self) -> str:
        return self._log.read_text()

    def hear_here(self, bag: Path, **options: Any) -> None:
        """Play to the end in this process: if the separate process does not matter, this saves the imports."""
        play(bag, lockstep=False, clock=True, **options)


@pytest.fixture
def listener(ros: Callable[..., Any], tmp_path: Path) -> Listener:
    return Listener(ros(), tmp_path / "player.log")


def test_everything_arrives_as_recorded(listener: Listener, bag: Path, drive: Any) -> None:
    player = listener.play(str(bag), "--wait", "90", "--rate", "2")
    assert player.wait(180) == 0, listener.output()
    wait = listener.harness.wait
    wait(lambda: len(listener.clouds) == len(listener.images) == drive.frames, "every cloud and image")
    wait(lambda: len(listener.infos) == drive.frames and listener.static, "the calibration")
    source = BagSource(bag, InputSettings(vertical_angle_correction_deg=0.0))
    for message, image, frame in zip(listener.clouds, listener.images, source.frames(), strict=True):
        assert stamp_ns(message.header) == frame.stamp
        np.testing.assert_array_equal(decode_points(message)[0], frame.points)
        np.testing.assert_array_equal(decode_image(image), frame.images[0].pixels)
    assert {t.child_frame_id for t in listener.static[0].transforms} >= {"velo_link", "camera_color_left"}
    ticks = lambda: [message.clock.sec * 10**9 + message.clock.nanosec for message in listener.clock]  # noqa: E731
    wait(lambda: ticks()[-1:] == [source.stamps[-1]], "the last of /clock")
    now = np.array(ticks())
    assert len(now) > 50
    assert (np.diff(now) >= -20_000_000).all()  # while waiting, the clock is measured and may be slightly ahead
    assert now[0] >= source.stamps[0] - 20_000_000
    assert now[-1] == source.stamps[-1]


class VirtualTime:
    """Replaces the player's `time` and `STOP`, as on a machine where only waiting takes time."""

    def __init__(self) -> None:
        self.now = 100.0

    def monotonic(self) -> float:
        self.now += 1e-6  # otherwise, waiting for other nodes, which take real time, would never end
        return self.now

    def monotonic_ns(self) -> int:
        return round(self.now * 1e9)

    def wait(self, seconds: float) -> bool:
        self.now += seconds
        return False

    def is_set(self) -> bool:
        return False


def test_each_message_goes_out_when_it_is_due(
    listener: Listener, bag: Path, drive: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Messages are published at the right time at double speed; the test uses virtual time, without delays of a busy
    machine."""
    virtual = VirtualTime()
    for name in ("time", "STOP"):
        monkeypatch.setattr(f"dpm2_ros.bag_player.{name}", virtual)
    listener.hear_here(bag, rate=2.0, log=tmp_path / "times.csv")
    with (tmp_path / "times.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert sum(row["topic"] == naming.POINTS for row in rows) == drive.frames
    recorded, published = (np.array([int(row[key]) for row in rows]) for key in ("log_time_ns", "published_ns"))
    late = (published - published[0]) - (recorded - recorded[0]) / 2
    assert np.abs(late).max() < 1e6  # ns: a microsecond for each look at the clock


def test_after_a_stop_the_rest_keeps_its_pace(
    listener: Listener, bag: Path, drive: Any, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """After Ctrl-Z in a terminal or a slow disk, the clouds of the pause are not published all at once. After a shorter
    delay, the player catches up."""
    for seconds in (0.5, 4.0):
        virtual, log = VirtualTime(), tmp_path / f"{seconds}.csv"
        began, stopped = virtual.now, seconds

        def monotonic(virtual: VirtualTime = virtual, began: float = began) -> float:
            nonlocal stopped
            virtual.now += 1e-6
            if virtual.now > began + 0.72 and stopped:  # in the middle of the drive
                virtual.now, stopped = virtual.now + stopped, 0.0
            return virtual.now

        monkeypatch.setattr(virtual, "monotonic", monotonic)
        for name in ("time", "STOP"):
            monkeypatch.setattr(f"dpm2_ros.bag_player.{name}", virtual)
        listener.hear_here(bag, log=log, topics=(naming.POINTS,))
        with log.open() as file:
            rows = list(csv.DictReader(file))
        recorded, published = (np.array([int(r[key]) * 1e-9 for r in rows]) for key in ("log_time_ns", "published_ns"))
        late = (published - published[0]) - (recorded - recorded[0])
        assert len(rows) == drive.frames
        assert late[-1] == pytest.approx(0.0 if seconds < 1 else 4.0, abs=0.1)  # s: a period
        assert (np.diff(published).min() < 0.01) == (seconds < 1)


def test_start_duration_and_topics(listener: Listener, bag: Path, drive: Any) -> None:
    listener.hear_here(bag, start=0.45, duration=0.4, topics=(naming.POINTS, naming.TF_STATIC))
    listener.harness.wait(lambda: len(listener.clouds) >= 4, "four clouds")
    listener.harness.wait(lambda: listener.static, "the calibration")  # it is sent for any start time
    stamps = BagSource(bag, InputSettings(images=False)).stamps.tolist()
    assert [stamp_ns(message.header) for message in listener.clouds] == stamps[5:9]
    assert listener.images == []


def test_it_loops_until_it_is_stopped(listener: Listener, bag: Path, drive: Any) -> None:
    player = listener.play(str(bag), "--wait", "90", "--loop", "--rate", "8")
    listener.harness.wait(lambda: len(listener.clouds) > 2 * drive.frames, "a third round")
    player.send_signal(signal.SIGINT)
    player.send_signal(signal.SIGINT)
    assert player.wait(60) == 0
    assert "Traceback" not in listener.output()
    stamps = [stamp_ns(message.header) for message in listener.clouds]
    assert stamps[drive.frames : 2 * drive.frames] == stamps[: drive.frames]


def test_what_is_latched_alone_stays_there_until_it_is_stopped(listener: Listener, bag: Path) -> None:
    """If only latched messages are played in a loop, they are published once. Previously, they were repeated thousands
    of times per second, each time with a line in the log."""
    player = listener.play(str(bag), "--wait", "90", "--loop", "--topics", naming.TF_STATIC)
    listener.harness.wait(lambda: listener.static, "the transforms")
    time.sleep(0.5)
    player.send_signal(signal.SIGINT)
    assert player.wait(60) == 0
    assert "again from the start" not in listener.output()


def test_of_many_static_transforms_a_subscriber_gets_the_last_of_each_frame(listener: Listener, tmp_path: Path) -> None:
    """As from a robot whose camera repeats its transform. The last valid transform counts: one message is damaged, and
    one transform is invalid."""
    types = get_typestore(Stores.ROS2_JAZZY)
    kind = "tf2_msgs/msg/TFMessage"
    links = [("lidar", 1.5), *(("camera", 0.1 * n) for n in range(150)), ("lidar", math.nan)]
    out = [(len(links), naming.TF_STATIC, b"\0\1\0\0\xff")]
    for at, (child, x) in enumerate(links):
        T = np.eye(4)
        T[0, 3] = x
        message = transforms(at, {child: ("base_link", T)})
        out.append((at, naming.TF_STATIC, types.serialize_cdr(message, kind)))
    recording = write_bag(tmp_path / "bag", {naming.TF_STATIC: kind}, out)
    player = listener.play(str(recording), "--wait", "90", "--loop")
    placed = lambda: {t.child_frame_id: t.transform.translation.x for m in listener.static for t in m.transforms}  # noqa: E731
    listener.harness.wait(lambda: len(placed()) == 2, "both frames")
    assert placed() == {"lidar": 1.5, "camera": 0.1 * 149}
    player.send_signal(signal.SIGINT)
    assert player.wait(60) == 0
    assert "/tf_static: lidar is left out: no rigid transform" in listener.output()
    assert "/tf_static: a message is left out" in listener.output()


def test_a_recorded_clock_is_the_only_one(
    listener: Listener, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    """If the bag contains /clock, as from a simulation, the player publishes no other clock."""
    types = get_typestore(Stores.ROS2_JAZZY)
    Time, RecordedClock = types.types["builtin_interfaces/msg/Time"], types.types["rosgraph_msgs/msg/Clock"]
    kind, out = RecordedClock.__msgtype__, list[tuple[int, str, bytes]]()
    for n in range(5):
        out.append((10**18 + n * 10**8, "/clock", types.serialize_cdr(RecordedClock(Time(100 + n, 0)), kind)))
    listener.hear_here(write_bag(tmp_path / "bag", {"/clock": kind}, out))
    listener.harness.wait(lambda: len(listener.clock) == 5, "the clock")
    assert [message.clock.sec for message in listener.clock] == [100, 101, 102, 103, 104]
    assert "/clock is that of the recording" in capfd.readouterr().err


def test_it_waits_for_subscribers(ros: Callable[..., Any], bag: Path, tmp_path: Path, drive: Any) -> None:
    """A subscriber that starts after the player loses no message."""
    harness = ros()
    player = harness.start("bag_player", [str(bag), "--wait", "90", "--rate", "4"], tmp_path / "log")
    harness.wait(lambda: "waiting 90 s" in (tmp_path / "log").read_text(), "the player")
    clouds = harness.hear(PointCloud2, naming.POINTS)
    assert player.wait(180) == 0
    harness.wait(lambda: len(clouds) == drive.frames, "every cloud")


def test_it_waits_for_the_nodes_that_it_is_told(ros: Callable[..., Any], bag: Path, tmp_path: Path, drive: Any) -> None:
    """Two nodes of one name in different namespaces; a subscriber of another name, such as RViz, starts nothing."""
    harness = ros()
    clouds = harness.hear(PointCloud2, naming.POINTS)
    awaited = ["--for", "robot", "--subscribers", "2", "--wait", "90", "--rate", "4"]
    player = harness.start("bag_player", [str(bag), *awaited], tmp_path / "log")
    says = f"waiting 90 s at most for 2 subscribers named robot to {naming.POINTS}"
    harness.wait(lambda: says in (tmp_path / "log").read_text(), "the player")
    received: list[list[Any]] = [[], []]
    for n, heard in enumerate(received):
        assert not clouds
        node = rclpy.create_node("robot", namespace=f"robot_{n}", context=harness.node.context)
        node.create_subscription(PointCloud2, naming.POINTS, heard.append, 100)
        node.close = lambda: None  # type: ignore[attr-defined]
        harness.add(node)
        time.sleep(1.0)  # with one of the two, the player does not start
    assert player.wait(180) == 0
    harness.wait(lambda: [len(heard) for heard in received] == [drive.frames] * 2, "every cloud, twice")


def play_here(*arguments: str) -> int:
    """Play in this process: quicker, if nothing needs to be received."""
    return exit_code(lambda: main(arguments))


def test_without_a_subscriber_it_says_so_and_plays(
    bag: Path, domain: int, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("ROS_DOMAIN_ID", str(domain))  # nobody subscribes there
    assert play_here(str(bag), "--wait", "0.3", "--duration", "0.1") == 0
    assert f"playing without a subscriber to {naming.POINTS} yet" in capfd.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["/no/such/bag"], "/no/such/bag: no such file or folder"),
        ([], "Missing argument"),
        (["BAG", "--rate", "0"], "--rate"),
        (["BAG", "--no-such-option"], "--no-such-option"),
        (["BAG", "--topics", "/nothing"], "no topic /nothing; topics: "),
        (["BAG", "--ros-args", "--nonsense"], "nonsense"),
        (["BAG", "--wait", "0", "--start", "100"], "no message from 100 s on; the last one is at 1.5 s"),
        (["BAG", "--wait", "0", "--start", "100", "--loop"], "no message from 100 s on; the last one is at 1.5 s"),
        (
            ["BAG", "--wait", "0", "--start", "0.51", "--duration", "0.02"],
            "no message from 0.51 s to 0.53 s; the next one is at 0.6 s",
        ),
    ],
)
def test_mistakes_end_with_2_and_one_line(
    bag: Path, capsys: pytest.CaptureFixture[str], arguments: list[str], says: str
) -> None:
    assert play_here(*(str(bag) if argument == "BAG" else argument for argument in arguments)) == 2
    (line,) = [line for line in capsys.readouterr().err.splitlines() if line.startswith("error: ")]
    assert says in line.replace("'", "")


def test_a_truncated_bag_plays_what_is_left(
    listener: Listener, bag: Path, tmp_path: Path, drive: Any, capfd: pytest.CaptureFixture[str]
) -> None:
    (whole,) = bag.glob("*.mcap")
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(whole.read_bytes()[: whole.stat().st_size * 6 // 10])
    listener.hear_here(cut, rate=4.0)
    listener.harness.wait(lambda: listener.clouds, "what is left")
    assert len(listener.clouds) < drive.frames
    assert "truncated" in capfd.readouterr().err


def test_a_type_is_imported_from_the_packages_of_ros_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    """A bag that names a module in the working directory does not import it: its topic is left out, and that is
    reported."""
    package = tmp_path / "evil" / "msg"
    package.mkdir(parents=True)
    (package.parent / "__init__.py").write_text("")
    (package / "__init__.py").write_text("print('imported')\nclass Thing: pass\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    writer = Writer(tmp_path / "bag", version=9, storage_plugin=StoragePlugin.MCAP)
    with writer:
        for topic, kind in (("/evil", "evil/msg/Thing"), ("/os", "os/msg/path"), ("/said", "std_msgs/msg/String")):
            connection = writer.add_connection(topic, kind, msgdef="string data\n", rihs01="RIHS01_" + 64 * "0")
            writer.write(connection, 1, b"\0\1\0\0\2\0\0\0a\0")
    assert play_here(str(tmp_path / "bag"), "--wait", "0") == 0
    info = capfd.readouterr()
    assert "/evil is left out: no message type evil/msg/Thing" in info.err
    assert "/os is left out: no message type os/msg/path" in info.err
    assert "1 messages played" in info.err
    assert "imported" not in info.out
    assert "evil" not in sys.modules


def test_messages_of_ros1_that_ros2_defines_differently_are_left_out(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    """Previously, such messages were sent empty. An example is Range, which has a variance in ROS 2."""
    from rosbags.rosbag1 import Writer as Ros1Writer

    noetic = get_typestore(Stores.ROS1_NOETIC)
    header = noetic.types["std_msgs/msg/Header"](0, noetic.types["builtin_interfaces/msg/Time"](1, 0), "sonar")
    sonar = noetic.types["sensor_msgs/msg/Range"](header, 0, 0.1, 0.1, 5.0, 2.0)
    with Ros1Writer(tmp_path / "b.bag") as writer:
        for topic, message in (("/sonar", sonar), ("/said", noetic.types["std_msgs/msg/String"]("here"))):
            connection = writer.add_connection(topic, message.__msgtype__, typestore=noetic)
            for time_ns in (1, 2):
                writer.write(connection, time_ns, noetic.serialize_ros1(message, message.__msgtype__))
    assert play_here(str(tmp_path / "b.bag"), "--wait", "0") == 0
    said = capfd.readouterr().err
    assert said.count("/sonar: messages that do not match sensor_msgs/msg/Range of ROS 2 Jazzy are left out") == 1
    assert "2 messages played" in said
