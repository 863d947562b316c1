# SPDX-License-Identifier: Apache-2.0
"""A replay loses nothing, and any loss is counted."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from diagnostic_msgs.msg import DiagnosticStatus
from sensor_msgs.msg import PointCloud2

from dpm2_core.data import naming
from dpm2_core.data.bag_file import open_bag
from test.helpers.rig import Rig
from tools.replay import ros_environment, start, stop

from ..helpers.diagnostics import figures

PROFILE, SEGMENT = "FASTRTPS_DEFAULT_PROFILES_FILE", 32 * 2**20


def all_gone(sent: int) -> Callable[[DiagnosticStatus], bool]:
    """Whether each of `sent` clouds has been processed, dropped, rejected or lost."""
    ends = ("processed", "dropped", "rejected", "lost on the way")
    return lambda status: sum(int(n) for what, n in figures(status).items() if what.startswith(ends)) == sent


def test_started_at_the_same_moment_nothing_is_lost(
    ros: Callable[..., Any], bag: Path, drive: Any, tmp_path: Path
) -> None:
    """If player and node start at the same time, no cloud is lost, since the node subscribes only once it is ready. At
    high speed, dropped clouds are counted."""
    harness = ros()
    diagnostics = harness.diagnostics
    arguments = ["--ros-args", "-p", "ros.map_directory:=''"]
    node = harness.start("slam_node", arguments, tmp_path / "node", PYTHONPROFILEIMPORTTIME="1")  # imports in the log
    # Slow enough for a busy machine, on which 0.1 s may be too short for a cloud.
    player = harness.start("bag_player", [str(bag), "--wait", "90", "--rate", "0.3"], tmp_path / "player")
    assert player.wait(180) == 0
    assert f"{drive.frames} of them clouds" in (tmp_path / "player").read_text()
    ready, _, driving = (tmp_path / "node").read_text().partition("waiting for clouds")
    gone = harness.status("slam_node: odometry", all_gone(drive.frames), since=0)
    assert figures(gone)["processed"] == str(drive.frames)
    assert "import time:" in ready
    assert "import time:" not in driving
    # Too fast, regardless of delays in any process: the node is stopped until all clouds have been published.
    lidar = harness.publisher(PointCloud2, naming.POINTS)
    harness.wait(lidar.get_subscription_count, "the subscription to the clouds")
    harness.find("slam_node")
    node.send_signal(signal.SIGSTOP)
    for _, _, data in open_bag(bag).messages([naming.POINTS]):
        lidar.publish(bytes(data))
    node.send_signal(signal.SIGCONT)
    harness.status("slam_node: odometry", all_gone(2 * drive.frames), since=len(diagnostics))
    assert stop(node, 180) == 0
    account = re.search(r"(\d+) clouds sent: (\d+) processed, (.*)", (tmp_path / "node").read_text())
    assert account is not None
    parts = [int(number) for number in re.findall(r"\d+", account[3])]
    assert int(account[1]) == int(account[2]) + sum(parts) == 2 * drive.frames
    assert drive.frames < int(account[2]) < 2 * drive.frames
    assert "lost on the way" in account[3]


def test_losses_are_in_diagnostics(rig: Callable[..., Rig], drive: Any) -> None:
    """Losses are counted: while the executor is blocked, DDS keeps no more clouds than ten times the queue depth."""
    r = rig("ros.queue_depth:=1")
    r.send_and_wait(0)
    holding, going_on = threading.Event(), threading.Event()
    r.harness.node.create_timer(0.05, lambda: holding.is_set() or (holding.set(), going_on.wait(120)))
    r.wait(holding.is_set, "the executor to be held up")
    try:
        for n in range(1, drive.frames):
            r.send(n)
        time.sleep(0.5)  # until DDS has delivered them
    finally:
        going_on.set()
    r.wait(lambda: r.stamps()[-1] == drive.stamp(drive.frames - 1), "the last")
    values = figures(r.status("odometry", all_gone(drive.frames)))
    dropped, lost = int(values["dropped (queue full)"]), int(values["lost on the way"])
    assert int(values["processed"]) + dropped + lost == int(values["received"]) + lost == drive.frames
    assert lost >= 5
    info = [one.message for message in r.diagnostics for one in message.status]
    assert any(f"{lost} clouds lost on the way" in text for text in info)


def segments(process: subprocess.Popen[bytes]) -> list[int]:
    """Sizes in bytes of the shared memory segments that Fast DDS has in a process."""
    maps = Path(f"/proc/{process.pid}/maps").read_text().splitlines()
    spans = [line.split()[0].split("-") for line in maps if "/dev/shm/fastrtps_" in line and "port" not in line]
    return [int(end, 16) - int(begin, 16) for begin, end in spans]


def test_the_dds_profile_is_used_unless_the_user_has_one(
    processes: list[Any], bag: Path, domains: Iterator[int], tmp_path: Path
) -> None:
    """A profile of the user takes precedence, named by either variable; the same holds for a configuration by another
    variable."""
    shipped = Path(__file__).parents[2] / "config" / "fastdds.xml"
    own = tmp_path / "own.xml"
    own.write_text(shipped.read_text().replace(str(SEGMENT), str(SEGMENT // 2)))
    inherited = {name: value for name, value in ros_environment().items() if name != PROFILE}
    found: dict[str, list[int]] = {}
    environments: dict[str, dict[str, str]] = {
        "none": {},
        "own": {PROFILE: str(own)},
        "newer name": {"FASTDDS_DEFAULT_PROFILES_FILE": str(own)},
        "transports": {"FASTDDS_BUILTIN_TRANSPORTS": "UDPv4"},
    }
    for name, more in environments.items():
        alone = {"ROS_DOMAIN_ID": str(next(domains))}  # each process sees the memory of those in its domain
        given = [str(bag), "--wait", "120"]
        processes.append(start("bag_player", given, inherited | alone | more, tmp_path / name))
    for name, process in zip(environments, processes, strict=True):
        end = time.monotonic() + 90
        while "waiting 120 s" not in (tmp_path / name).read_text():
            assert time.monotonic() < end, (tmp_path / name).read_text()
            time.sleep(0.05)
        found[name] = segments(process)
        process.send_signal(signal.SIGINT)
    assert max(found["none"]) >= SEGMENT, found
    for name in ("own", "newer name"):  # there may be segments of other processes in that domain
        assert any(SEGMENT // 2 <= size < SEGMENT for size in found[name]), found
    assert max(found["transports"], default=0) < SEGMENT // 2, found


def test_this_process_uses_it_too(ros: Callable[..., Any]) -> None:
    ros()
    assert Path(os.environ[PROFILE]).name == "fastdds.xml"
