# SPDX-License-Identifier: Apache-2.0
"""A replay loses nothing, and what is lost all the same is counted; in lockstep it is exact."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from nav_msgs.msg import Odometry
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore
from sensor_msgs.msg import PointCloud2

from dpm2_core.commands.run import run
from dpm2_core.config import load_settings
from dpm2_core.data import topics
from dpm2_core.data.bag_file import open_bag
from dpm2_core.data.bags import BagSource
from dpm2_core.data.frames import FrameBuilder
from dpm2_core.data.messages import stamp_ns
from dpm2_core.data.settings import InputSettings
from dpm2_core.data.trajectory import read_trajectory
from dpm2_core.data.transforms import transform_matrix
from dpm2_core.errors import Dpm2Error
from dpm2_core.frame import Frame
from dpm2_core.slam.build import make_slam
from dpm2_core.slam.settings import Config
from dpm2_ros import lockstep
from dpm2_ros.bag_player import BagPlayer, Options
from dpm2_ros.conversions import pose_to_msg
from dpm2_ros.guard import GuardedNode
from dpm2_ros.settings import RosSettings
from dpm2_ros.slam_node import SlamNode
from dpm2_ros.subscriptions import Inputs
from tools.replay import ros_environment, start, stop

OPTIONS = Options(
    bag=Path(), rate=1.0, start=0.0, duration=None, loop=False, topics=(), wait=20.0, subscribers=1, clock=False,
    log=None, lockstep=True,
)  # fmt: skip
MS = 1_000_000
PROFILE, SEGMENT = "FASTRTPS_DEFAULT_PROFILES_FILE", 32 * 2**20


@pytest.fixture
def processes() -> Iterator[list[subprocess.Popen[bytes]]]:
    """To be killed at the end."""
    started: list[subprocess.Popen[bytes]] = []
    yield started
    for process in started:
        process.kill()
        process.wait()


def wait_until_idle(process: subprocess.Popen[bytes]) -> None:
    """Until a node takes less than 0.2 s of processor time in a second; a cloud takes more, also on a busy machine."""
    before = 0.0
    for _ in range(60):
        fields = Path(f"/proc/{process.pid}/stat").read_text().rpartition(")")[2].split()
        used = (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")
        if used - before < 0.2:
            return
        before = used
        time.sleep(1.0)
    pytest.fail("the node is not idle after a minute")


def test_started_at_the_same_moment_nothing_is_lost(
    processes: list[Any], bag: Path, drive: Any, domain: int, tmp_path: Path
) -> None:
    """The node subscribes when it is ready; no cloud waits for an import. Then too fast: what is dropped is counted."""
    imports = {"PYTHONPROFILEIMPORTTIME": "1"}  # each is a line of the log
    arguments, environment = ["--ros-args", "-p", "ros.map_directory:=''"], ros_environment(domain)
    node = start("slam_node", arguments, environment | imports, tmp_path / "node")
    processes.append(node)
    for rate, name in (("1", "in time"), ("20", "too fast")):
        processes.append(start("bag_player", [str(bag), "--rate", rate], environment, tmp_path / name))
        assert processes[-1].wait(60) == 0
        assert f"{drive.frames} of them clouds" in (tmp_path / name).read_text()
        if rate == "1":
            ready, _, driving = (tmp_path / "node").read_text().partition("waiting for clouds")
    assert "import time:" in ready
    assert "import time:" not in driving
    wait_until_idle(node)  # the last clouds are on their way through it
    assert stop(node) == 0
    account = re.search(r"(\d+) clouds sent: (\d+) processed, (.*)", (tmp_path / "node").read_text())
    assert account is not None
    parts = [int(number) for number in re.findall(r"\d+", account[3])]
    assert int(account[1]) == int(account[2]) + sum(parts) == 2 * drive.frames
    assert drive.frames < int(account[2]) < 2 * drive.frames  # all of the first time
    assert "lost on the way" in account[3]


def test_losses_are_in_diagnostics(ros: Callable[..., Any], drive: Any) -> None:
    """Real ones: while the executor is held up, DDS keeps as many clouds as the queue may hold, and no more."""
    harness = ros("input.images:=false", "ros.queue_depth:=2")
    lidar, odometry = harness.publisher(PointCloud2, topics.POINTS), harness.hear(Odometry, "/dpm2/odom")
    diagnostics = harness.hear(DiagnosticArray, "/diagnostics")
    node = harness.add(SlamNode())
    harness.wait(lambda: lidar.get_subscription_count() and node.count_subscribers("/dpm2/odom"), "the node")
    lidar.publish(drive.cloud(0))
    harness.wait(lambda: odometry, "the first")
    holding = threading.Event()
    harness.node.create_timer(0.05, lambda: holding.is_set() or (holding.set(), time.sleep(1.0)))
    harness.wait(holding.is_set, "the executor to be held up")
    for n in range(1, drive.frames):
        lidar.publish(drive.cloud(n))
        time.sleep(0.02)
    harness.wait(lambda: stamp_ns(odometry[-1].header) == drive.stamp(drive.frames - 1), "the last")
    seen = len(diagnostics)
    harness.wait(lambda: len(diagnostics) > seen + 1, "diagnostics of the end")
    (status,) = [one for one in diagnostics[-1].status if one.name.endswith("odometry")]
    values = {value.key: value.value for value in status.values}
    dropped, lost = int(values["dropped (queue full)"]), int(values["lost on the way"])
    assert int(values["processed"]) + dropped + lost == int(values["received"]) + lost == drive.frames
    assert lost >= 5
    info = [one.message for message in diagnostics for one in message.status]
    assert any(f"{lost} clouds lost on the way" in text for text in info)


Shots = list[tuple[int, int]]
"""Stamps of images and the log times at which they were recorded, ns."""


def with_shots(bag: Path, folder: Path, shots: Shots, later: int) -> Path:
    """The drive with images of these times, each different, and its calibration recorded `later` (ns)."""
    types = get_typestore(Stores.ROS2_JAZZY)
    source, rng = open_bag(bag), np.random.default_rng(2)
    out: list[tuple[int, str, bytes]] = []
    for topic, log_time, data in source.messages(list(source.types)):
        if topic != topics.IMAGE:
            out.append((log_time + later * (topic == topics.CAMERA_INFO), topic, data))
    image = source.first(topics.IMAGE)
    assert image is not None
    for stamp, log_time in shots:
        image.header.stamp.sec, image.header.stamp.nanosec = stamp // 10**9, stamp % 10**9
        gray = cv2.GaussianBlur(rng.integers(0, 255, (40, 120), np.uint8), (0, 0), 2)
        pixels = np.repeat(cv2.normalize(gray, None, 0, 255, cv2.NORM_MINMAX)[..., None], 3, 2)
        message = replace(image, data=pixels.reshape(-1))
        out.append((log_time, topics.IMAGE, bytes(types.serialize_cdr(message, source.types[topics.IMAGE]))))
    with Writer(folder, version=Writer.VERSION_LATEST, storage_plugin=StoragePlugin.MCAP) as writer:
        connections = {t: writer.add_connection(t, kind, typestore=types) for t, kind in source.types.items()}
        for log_time, topic, data in sorted(out, key=lambda message: message[0]):
            writer.write(connections[topic], log_time, data)
    return folder


@pytest.fixture(scope="module")
def fast_camera(bag: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The drive with three images a cloud, recorded 30 ms after their stamps: the nearest is the second, which comes
    after the cloud; and with a calibration that comes only after the first cloud."""
    stamps = BagSource(bag).stamps.tolist()
    shots = [(stamp + shift * MS, stamp + (shift + 30) * MS) for stamp in stamps for shift in (-20, 12, 45)]
    return with_shots(bag, tmp_path_factory.mktemp("fast") / "camera", shots, 45 * MS)


def test_lockstep_gives_the_trajectory_of_dpm2_run(
    ros: Callable[..., Any], processes: list[Any], fast_camera: Path, drive: Any, tmp_path: Path
) -> None:
    """Bit for bit, images included: here every pose is moved by the image of its cloud."""
    settings = ["slam.visual.sigma=0.0001", "slam.visual.min_correlation=0.0", "slam.visual.distinct=0.0"]
    settings.append("slam.loops.descriptors=false")  # for which the network would be loaded
    harness = ros()
    odometry, diagnostics = harness.hear(Odometry, "/dpm2/odom"), harness.hear(DiagnosticArray, "/diagnostics")
    environment = ros_environment(harness.node.context.get_domain_id())
    given = [*(text.replace("=", ":=") for text in settings), "ros.base_frame:=velo_link", "ros.map_directory:=''"]
    arguments = ["--ros-args", *(part for one in given for part in ("-p", one))]
    processes.append(start("slam_node", arguments, environment, tmp_path / "node"))
    # the diagnostics say that the node knows this listener: its odometry of the first clouds would be lost otherwise
    harness.wait(lambda: diagnostics, "the diagnostics")
    player = start("bag_player", [str(fast_camera), "--lockstep"], environment, tmp_path / "player")
    processes.append(player)
    assert player.wait(60) == 0, (tmp_path / "player").read_text()
    assert f"each of {drive.frames} clouds had its odometry" in (tmp_path / "player").read_text()
    harness.wait(lambda: len(odometry) == drive.frames, "the odometry")

    def expected(*more: str) -> list[Any]:
        config = load_settings(Config, None, [*settings, *more])
        slam = make_slam(config.slam)
        tracked = [slam.process(frame).odometry for frame in BagSource(fast_camera, config.input).frames()]
        return [pose_to_msg(one.T_odom_lidar) for one in tracked]

    assert [message.pose.pose for message in odometry] == expected()
    assert [message.pose.pose for message in odometry] != expected("input.image_time_offset=-0.03")  # other images
    run(fast_camera, tmp_path / "out", settings=settings)
    written = read_trajectory(tmp_path / "out" / "trajectory.tum")
    assert written.keys.tolist() == [stamp_ns(message.header) for message in odometry]
    poses = [transform_matrix(message.pose.pose) for message in odometry]
    np.testing.assert_allclose(written.poses, poses, rtol=0, atol=1e-10)  # it has 12 digits


def play(bag: Path) -> None:
    """In lockstep, to its end."""
    player = rclpy.create_node("player", use_global_arguments=False)
    try:
        BagPlayer(player, replace(OPTIONS, bag=bag)).play()
    finally:
        player.destroy_node()


class Listener(GuardedNode):
    """Makes frames as slam_node does, and publishes an odometry for each."""

    def __init__(self) -> None:
        super().__init__("listener")
        self.frames: list[Frame] = []
        self._odometry = self.create_publisher(Odometry, "dpm2/odom", 10)
        self._inputs = Inputs(self, InputSettings(), RosSettings(sync_timeout=0.3))
        self._builder = FrameBuilder(InputSettings(), self._inputs.calibration, self.get_logger().error)
        self._ended = threading.Event()
        self._worker = threading.Thread(target=self._work)
        self._worker.start()

    def _work(self) -> None:
        while not self._ended.is_set():
            if (bundle := self._inputs.take(0.1)) is not None:
                self.frames.append(self._builder.frame(bundle.stamp, bundle.cloud, len(self.frames), bundle.beside))
                self._odometry.publish(Odometry(header=bundle.cloud.header))

    def close(self) -> None:
        self._ended.set()
        self._worker.join()


def contents(frame: Frame) -> list[Any]:
    """All that is in it, bit for bit."""
    images = [
        (i.pixels.tobytes(), i.camera.K.tobytes(), i.camera.T_lidar_cam.tobytes(), i.camera.size, i.camera.distortion)
        for i in frame.images
    ]
    offset = None if frame.time_offset is None else frame.time_offset.tobytes()
    return [frame.index, frame.stamp, frame.problem, frame.points.tobytes(), offset, images]


@pytest.mark.parametrize("seed", range(4))
def test_lockstep_builds_the_frames_of_dpm2_run(ros: Callable[..., Any], bag: Path, tmp_path: Path, seed: int) -> None:
    """Of a camera with up to three images a cloud, whose stamps jitter by more than their distance, and at times one
    in the middle of two clouds; recorded from at once to 0.7 s later, and its calibration after the last cloud."""
    rng, shots = np.random.default_rng(seed), []
    for n, cloud in enumerate(BagSource(bag).stamps.tolist()):
        if n % 6 == 0:
            shots.append((cloud + 50 * MS, cloud + 150 * MS))
        elif n % 6 > 1:
            for jitter in rng.integers(-49, 50, rng.integers(0, 4)).tolist():
                stamp = cloud + jitter * MS
                shots.append((stamp, stamp + int(rng.choice([5, 60, 150, 400, 700])) * MS))
    recording = with_shots(bag, tmp_path / "camera", shots, 10_000 * MS)
    expected = list(BagSource(recording).frames())
    shown = [frame.images[0].pixels.tobytes() if frame.images else None for frame in expected]
    assert None in shown
    assert any(a == b and a is not None for a, b in pairwise(shown))
    harness = ros()
    node = harness.add(Listener())
    play(recording)
    assert [contents(frame) for frame in node.frames] == [contents(frame) for frame in expected]


class Responder:
    """Publishes an odometry for clouds, as slam_node does, but only for those that it is asked for."""

    def __init__(self, harness: Any, responds: Callable[[int], bool]) -> None:
        self.harness, self._responds = harness, responds
        self.stamps: list[int] = []
        self.publisher = harness.publisher(Odometry, "/dpm2/odom")
        harness.node.create_subscription(PointCloud2, topics.POINTS, self._on_cloud, 10)

    def _on_cloud(self, message: PointCloud2) -> None:
        self.stamps.append(stamp_ns(message.header))
        if self._responds(len(self.stamps)):
            self.publisher.publish(Odometry(header=message.header))


def test_a_cloud_without_odometry_is_reported_and_the_next_goes_out(
    ros: Callable[..., Any], bag: Path, drive: Any, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(lockstep, "TIMEOUT", 0.5)
    node = Responder(ros(), lambda n: n != 5)
    with pytest.raises(Dpm2Error, match=f"1 of {drive.frames} clouds had no odometry"):
        play(bag)
    stamps = BagSource(bag).stamps.tolist()
    assert node.stamps == stamps
    assert f"no odometry within 0.5 s for the cloud at {stamps[4] * 1e-9:.3f} s" in capfd.readouterr().err


def test_a_node_that_goes_away_ends_it(ros: Callable[..., Any], bag: Path) -> None:
    harness = ros()

    def responds(n: int) -> bool:
        if n == 5:
            harness.node.destroy_publisher(node.publisher)
        return n < 5

    node = Responder(harness, responds)
    with pytest.raises(Dpm2Error, match="/dpm2/odom has no publisher any more"):
        play(bag)


def test_without_a_node_it_ends(run: Callable[..., Any], bag: Path) -> None:
    ended = run("bag_player", str(bag), "--lockstep", "--wait", "0.5")
    assert ended.returncode == 1
    assert f"error: lockstep: no node turns {topics.POINTS} into /dpm2/odom" in ended.stderr


def segments(process: subprocess.Popen[bytes]) -> list[int]:
    """Bytes of the shared memory that Fast DDS has in a process."""
    maps = Path(f"/proc/{process.pid}/maps").read_text().splitlines()
    spans = [line.split()[0].split("-") for line in maps if "/dev/shm/fastrtps_" in line and "port" not in line]
    return [int(end, 16) - int(begin, 16) for begin, end in spans]


def test_the_dds_profile_is_used_unless_the_user_has_one(
    processes: list[Any], bag: Path, domain: int, tmp_path: Path
) -> None:
    """The user's may be named by either variable, or Fast DDS be configured by another."""
    shipped = Path(__file__).parents[2] / "config" / "fastdds.xml"
    own = tmp_path / "own.xml"
    own.write_text(shipped.read_text().replace(str(SEGMENT), str(SEGMENT // 2)))
    inherited = {name: value for name, value in ros_environment(domain).items() if name != PROFILE}
    found: dict[str, list[int]] = {}
    environments: dict[str, dict[str, str]] = {
        "none": {},
        "own": {PROFILE: str(own)},
        "newer name": {"FASTDDS_DEFAULT_PROFILES_FILE": str(own)},
        "transports": {"FASTDDS_BUILTIN_TRANSPORTS": "UDPv4"},
    }
    for n, (name, more) in enumerate(environments.items()):
        alone = {"ROS_DOMAIN_ID": str(1 + (domain + n) % 100)}  # each sees the memory of those in its domain
        processes.append(start("bag_player", [str(bag)], inherited | alone | more, tmp_path / name))
    for name, process in zip(environments, processes, strict=True):
        end = time.monotonic() + 30
        while "waiting 30 s" not in (tmp_path / name).read_text() and time.monotonic() < end:
            time.sleep(0.05)
        found[name] = segments(process)
        process.send_signal(signal.SIGINT)
    assert max(found["none"]) >= SEGMENT, found
    for name in ("own", "newer name"):  # there may be others, of whoever else is in that domain
        assert any(SEGMENT // 2 <= size < SEGMENT for size in found[name]), found
    assert max(found["transports"], default=0) < SEGMENT // 2, found


def test_this_process_uses_it_too(ros: Callable[..., Any]) -> None:
    ros()
    assert Path(os.environ[PROFILE]).name == "fastdds.xml"
