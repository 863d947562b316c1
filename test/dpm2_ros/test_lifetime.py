# SPDX-License-Identifier: Apache-2.0
"""Processes end cleanly, with the map saved, however often they are interrupted."""

from __future__ import annotations

import os
import re
import signal
import sqlite3
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

import pytest
import rclpy
from nav_msgs.msg import Odometry
from nav_msgs.msg import Path as PathMsg
from sensor_msgs.msg import PointCloud2

from dpm2_core.data import naming
from dpm2_core.data.bags import BagSource
from dpm2_core.data.messages import stamp_ns
from dpm2_core.data.settings import InputSettings
from dpm2_core.errors import Dpm2Error, UsageError
from dpm2_core.evaluation.metrics import ape_rmse
from dpm2_ros.mapping import KEEP_ALL, LAST_ONE
from dpm2_ros.runtime import Stop, end_ros, ros_context
from dpm2_ros.slam_node import SlamNode
from tools.demo import evaluate_replay, map_poses
from tools.replay import replay, ros_environment, start

from ..helpers.harness import Harness
from ..helpers.rig import Rig

QUICK = {"input.images": False, "slam.loops.descriptors": False, "slam.registration": "geometric"}
"""Neither camera nor network: it starts in half the time."""
GEOMETRIC = [part for name, value in QUICK.items() for part in ("-p", f"{name}:={str(value).lower()}")]
SAVED = ["map.ply", "pose_graph.g2o", "trajectory.tum"]


@contextmanager
def running(harness: Harness, lidar: Any, folder: Path, *parameters: str) -> Iterator[subprocess.Popen[bytes]]:
    """slam_node as a process, from the time it subscribes: its map is in `folder`/map, its log in `folder`/log. The
    log must contain no traceback."""
    given = [part for parameter in (f"ros.map_directory:={folder / 'map'}", *parameters) for part in ("-p", parameter)]
    process = harness.start("slam_node", ["--ros-args", *given, *GEOMETRIC], folder / "log")
    harness.wait(lidar.get_subscription_count, "slam_node")
    harness.find("slam_node")
    yield process
    assert "Traceback" not in (folder / "log").read_text()


def test_slam_node_saves_its_map_when_stopped(ros: Callable[..., Any], drive: Any, tmp_path: Path) -> None:
    """`ros2 launch` sends two SIGINT: the map is saved nevertheless."""
    harness = ros()
    odometry = harness.hear(Odometry, "/dpm2/odom")
    lidar = harness.publisher(PointCloud2, naming.POINTS)
    with running(harness, lidar, tmp_path) as process:
        for n in range(8):
            lidar.publish(drive.cloud(n))
        harness.wait(lambda: odometry, "odometry")
        for _ in range(2):
            process.send_signal(signal.SIGINT)
            time.sleep(0.02)
        assert process.wait(180) == 0
    assert f"saved in {tmp_path / 'map' / 'drive'}" in (tmp_path / "log").read_text()
    assert sorted(path.name for path in (tmp_path / "map").iterdir()) == ["drive", "drive.dpm2map"]
    assert sorted(path.name for path in (tmp_path / "map" / "drive").iterdir()) == SAVED


def test_stopped_while_it_imports(tmp_path: Path, domain: int) -> None:
    """A signal ends the process cleanly from the moment Python runs the entry point; no map is begun."""
    saving = ["--ros-args", "-p", f"ros.map_directory:={tmp_path / 'map'}"]
    process = start("slam_node", saving, ros_environment(domain), tmp_path / "log")
    while not _handles_sigint(process) and process.poll() is None:
        time.sleep(0.01)
    process.send_signal(signal.SIGINT)
    assert process.wait(180) == 0
    assert (tmp_path / "log").read_text() == ""
    assert not (tmp_path / "map").exists()


def test_stopped_while_it_loads_the_network(ros: Callable[..., Any], tmp_path: Path) -> None:
    """A signal ends the process cleanly when its node exists, but does not subscribe yet."""
    harness = ros()
    process = harness.start("slam_node", [], tmp_path / "log")
    harness.wait(lambda: "slam_node" in harness.node.get_node_names(), "the node")
    process.send_signal(signal.SIGINT)
    assert process.wait(180) == 0
    assert "Traceback" not in (tmp_path / "log").read_text()


def test_a_second_signal_that_comes_while_python_ends(bag: Path, tmp_path: Path, domain: int) -> None:
    """The exit takes hundreds of ms; signals every 5 ms arrive in each phase of it, and the exit code stays 0."""
    log = tmp_path / "log"
    process = start("bag_player", [str(bag), "--wait", "90"], ros_environment(domain), log)
    try:
        Harness.wait(lambda: "waiting 90 s" in log.read_text(), "the player")
        process.send_signal(signal.SIGTERM)
        while process.poll() is None:
            process.send_signal(signal.SIGINT)
            time.sleep(0.005)
    finally:
        process.kill()
    assert process.wait() == 0, log.read_text()


STOPPED = """
import faulthandler, random, signal
from dpm2_ros.runtime import Stop
faulthandler.dump_traceback_later(60, exit=True)
for _ in range(2000):
    stop = Stop()
    signal.signal(signal.SIGALRM, lambda *_: stop.set())
    signal.setitimer(signal.ITIMER_REAL, random.uniform(1e-5, 5e-4))
    while not stop.wait(1e-5):
        pass
"""


def test_a_signal_may_meet_each_moment_of_a_wait() -> None:
    """`Stop.wait` returns whenever a signal arrives. With `threading.Event` one wait of some hundred did not return,
    with `queue.SimpleQueue` one of some thousand; `bag_player` waits a hundred times per second."""
    subprocess.run([sys.executable, "-c", STOPPED], check=True, timeout=120)


def test_who_waits_is_woken_and_later_waits_end_at_once() -> None:
    stop = Stop()
    assert not stop.wait(0)
    waiting = [threading.Thread(target=stop.wait) for _ in range(3)]
    for thread in waiting:
        thread.start()
    stop.set()
    for thread in waiting:
        thread.join(60)
    assert not any(thread.is_alive() for thread in waiting)
    assert stop.wait()
    assert stop.is_set()


@pytest.mark.parametrize("given", [{}, {"ROS_LOG_DIR": "/proc"}])
def test_without_a_folder_for_logs_it_says_what_to_set(domain: int, given: dict[str, str]) -> None:
    """The error names ROS_LOG_DIR and HOME if there is no HOME, as in a systemd unit, or if the folder cannot be
    written, as after a start as root. /proc is a folder that nobody can write."""
    environment = {name: text for name, text in ros_environment(domain).items() if name not in ("HOME", "ROS_LOG_DIR")}
    environment |= given
    command = [sys.executable, "-m", "dpm2_ros.executables", "bag_player"]
    ended = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=180, check=False)
    assert ended.returncode == 2
    assert re.search(r"^error: ROS does not start: .*; set ROS_LOG_DIR or HOME$", ended.stderr, re.MULTILINE)


def test_arguments_that_a_node_does_not_know_are_errors(
    run: Callable[..., subprocess.CompletedProcess[str]],
) -> None:
    """Previously, every parameter without `--ros-args` was silently ignored. Both nodes parse their arguments in the
    same way."""
    done = run("slam_node", "-p", "slam.registration:=geometric")
    assert (done.returncode, done.stdout) == (2, "")
    assert "error: unknown argument -p; those of ROS, such as -p, come after --ros-args" in done.stderr
    assert "error: unknown argument --lifecycl;" in run("mapper_node", "--lifecycl", "--ros-args").stderr
    assert run("mapper_node", "--help").stdout.startswith("usage: mapper_node [--lifecycle]")


def _handles_sigint(process: subprocess.Popen[bytes]) -> bool:
    """Whether SIGTERM is caught: Python itself catches SIGINT only."""
    status = Path(f"/proc/{process.pid}/status").read_text()
    caught = next(line.split()[1] for line in status.splitlines() if line.startswith("SigCgt"))
    return bool(int(caught, 16) >> (signal.SIGTERM - 1) & 1)


def test_what_cannot_listen_leaves_no_map(ros: Callable[..., Any], tmp_path: Path) -> None:
    """If subscribing fails, the map file that was opened before is removed."""
    ros(f"ros.map_directory:={tmp_path / 'map'}", f"input.second_points_topic:={naming.POINTS}")
    with pytest.raises(UsageError, match="is that of the first LiDAR"):
        SlamNode()
    assert not (tmp_path / "map").exists()


def test_a_map_that_cannot_be_saved_at_the_end_is_an_error(rig: Callable[..., Rig], tmp_path: Path) -> None:
    """The next test checks the exit code."""
    (tmp_path / "map").write_text("in the way")
    r = rig(f"ros.map_directory:={tmp_path / 'map'}")
    r.send_and_wait(0)
    with pytest.raises(Dpm2Error, match=rf"^{tmp_path / 'map'}"):
        r.harness.remove(r.node)
    assert (tmp_path / "map").read_text() == "in the way"


def test_a_map_file_that_is_incomplete_at_the_end_is_exit_code_1(
    ros: Callable[..., Any], drive: Any, tmp_path: Path
) -> None:
    """Another program locks the map file, which acts as a full disk. Previously, only the folder that cannot be made
    was reported."""
    harness, path = ros(), tmp_path / "town.dpm2map"
    (tmp_path / "map").write_text("in the way")
    keyframes = harness.hear(Odometry, "/dpm2/keyframe_odom", KEEP_ALL)
    lidar = harness.publisher(PointCloud2, naming.POINTS)
    with (
        running(harness, lidar, tmp_path, f"ros.map_file:={path}") as process,
        closing(sqlite3.connect(path, isolation_level=None)) as other,
    ):
        other.execute("BEGIN IMMEDIATE")
        lidar.publish(drive.cloud(0))
        harness.wait(lambda: keyframes, "a keyframe")
        process.send_signal(signal.SIGINT)
        assert process.wait(180) == 1
    output = (tmp_path / "log").read_text()
    problem = rf"map file incomplete: {path}: .*locked; 1 keyframes are in memory only"
    assert len(re.findall(problem, output)) == 2  # immediately, and at the end
    assert re.search(rf"^error: {problem}$", output, re.MULTILINE)
    assert f"{tmp_path / 'map'}: no map saved" in output


def test_a_drive_through_player_slam_node_and_mapper_node(
    ros: Callable[..., Any], bag: Path, drive: Any, tmp_path: Path
) -> None:
    """Three processes, with a separate mapper: every cloud gets its odometry, and the mapper, which SIGTERM ends,
    saves the map of all keyframes."""
    harness = ros()
    odometry, keyframes = harness.hear(Odometry, "/dpm2/odom"), harness.hear(Odometry, "/dpm2/keyframe_odom", KEEP_ALL)
    paths = harness.hear(PathMsg, "/dpm2/path", LAST_ONE)

    def made() -> int:
        """Number of keyframes; one that the mapper has not acknowledged yet is sent again."""
        return len({message.child_frame_id for message in keyframes})

    apart = ["-p", "ros.embed_mapper:=false", "-p", "ros.map_directory:=''", "-p", "use_sim_time:=true"]
    saving = ["-p", f"ros.map_directory:={tmp_path / 'map'}"]
    slam = harness.start("slam_node", ["--ros-args", *apart, *GEOMETRIC], tmp_path / "slam.log")
    mapper = harness.start("mapper_node", ["--ros-args", *saving, *GEOMETRIC], tmp_path / "mapper.log")
    harness.wait(lambda: harness.node.count_subscribers("/dpm2/keyframe") == 1, "the mapper")
    harness.find("slam_node")
    slowly = ["--wait", "90", "--rate", "0.25"]  # so that nothing is dropped, even on a busy machine
    assert harness.start("bag_player", [str(bag), *slowly], tmp_path / "player.log").wait(180) == 0
    harness.wait(lambda: len(odometry) == drive.frames, "every pose")
    slam.send_signal(signal.SIGINT)
    assert slam.wait(180) == 0
    harness.wait(lambda: paths and len(paths[-1].poses) == made(), "the last keyframe in the map")
    mapper.send_signal(signal.SIGTERM)
    assert mapper.wait(180) == 0
    stamps = BagSource(bag, InputSettings(images=False)).stamps.tolist()
    assert [stamp_ns(message.header) for message in odometry] == stamps
    assert f"map of {made()} keyframes saved" in (tmp_path / "mapper.log").read_text()
    assert made() >= 3


def test_replay_is_checked_by_what_arrived(
    bag: Path, drive: Any, domain: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """This is what `make demo` does. All checks pass; if a pose is missing or events are in a wrong order, they
    fail."""
    parameters = {"ros.map_period": 0.5, "slam.keyframes.distance": 2.0, **QUICK}
    source = BagSource(bag, InputSettings(images=False))
    for name, value in ros_environment(domain).items():  # replay would draw a domain, which another test may use
        monkeypatch.setenv(name, value)
    monkeypatch.setattr("tools.replay.ros_environment", lambda: ros_environment(domain))
    # Slowly, so that nothing is dropped, even on a busy machine.
    result = replay(source, tmp_path, 0.25, parameters)
    outcome = evaluate_replay(source, result, tmp_path)
    assert all(outcome.checks.values()), outcome.checks
    summary = outcome.summary
    assert list(summary) == [
        "frames_in", "frames_out", "dropped", "latency_p50_ms", "latency_p95_ms",
        "ape_rmse_m", "rpe_trans_m", "rpe_rot_deg", "loops",
    ]  # fmt: skip
    assert (summary["frames_in"], summary["frames_out"], summary["dropped"]) == (drive.frames, drive.frames, 0)
    assert 0 < summary["latency_p50_ms"] <= summary["latency_p95_ms"]
    assert summary["ape_rmse_m"] < 0.05
    assert (tmp_path / "trajectory.png").is_file()
    poses = map_poses(source, result, source.stamps.tolist())
    assert ape_rmse(source.poses, poses) == pytest.approx(summary["ape_rmse_m"])
    lost = result.poses.pop(source.stamps.tolist()[3])
    outcome = evaluate_replay(source, result, tmp_path)
    assert not outcome.checks["every cloud has its odometry, with the same stamp"]
    assert (outcome.summary["frames_out"], outcome.summary["dropped"]) == (drive.frames - 1, 1)
    result.poses[12345] = lost
    assert not evaluate_replay(source, result, tmp_path).checks["no odometry without its cloud"]


def test_ros_ends_in_time_or_the_process_does(domain: int) -> None:
    """The process ends even if the code that hangs holds Python's lock, so that neither signals nor other threads
    run."""
    stuck = "ctypes.PyDLL(None).sleep(120)"
    code = f"""
import ctypes
from dpm2_ros.runtime import Stop, end_ros, ros_context
class Stuck:
    def destroy_node(self): {stuck}
ros_context([], {domain})
end_ros(Stuck(), within=1.0)
"""
    ended = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=False)
    assert ended.returncode == 1
    assert "in destroy_node" in ended.stderr


@pytest.mark.skipif(sys.platform != "linux", reason="processors can be chosen on Linux alone")
def test_after_the_end_of_ros_all_processors_are_used_again(domain: int) -> None:
    before = os.sched_getaffinity(0), os.getpriority(os.PRIO_PROCESS, threading.get_native_id())
    ros_context([], domain)
    seen = list[set[int]]()

    class Watched:
        def destroy_node(self) -> None:
            seen.append(os.sched_getaffinity(0))

    end_ros(Watched())
    assert [len(processors) for processors in seen] == [1]
    assert (os.sched_getaffinity(0), os.getpriority(os.PRIO_PROCESS, threading.get_native_id())) == before
    assert not rclpy.ok()
