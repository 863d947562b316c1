# SPDX-License-Identifier: Apache-2.0
"""A small drive, and real nodes over real DDS: in this process for their logic, as processes for start and end."""

from __future__ import annotations

import fcntl
import gc
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from functools import cache
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from sensor_msgs.msg import PointCloud2

from dpm2_core.data.convert import convert
from dpm2_core.data.kitti import KittiSource
from dpm2_core.estimates import Keyframe
from dpm2_core.frame import Array, Points
from dpm2_core.geometry import se3
from dpm2_ros.conversions import cloud_to_msg, keyframe_name
from test.helpers.harness import Harness
from test.helpers.rig import Rig
from tools.replay import ros_environment

os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = ros_environment()["ROS_AUTOMATIC_DISCOVERY_RANGE"]


def _own_domains() -> Iterator[int]:
    """ROS domains from 1 to 100, over and over: a fifth of them that no other test run on this machine uses."""
    for fifth in range(5):
        lock = (Path(tempfile.gettempdir()) / f"dpm2_test_domains_{fifth}.lock").open("w")
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            lock.close()
            continue
        while True:  # the lock is held for as long as the generator lives
            yield from range(1 + 20 * fifth, 21 + 20 * fifth)
    yield from (1 + (7 * os.getpid() + n) % 100 for n in count())  # a sixth run at the same time


_domains = _own_domains()

FRAMES, PERIOD, STEP = 16, 100_000_000, 0.8  # number of scans; ns and m between them
START = 1_700_000_000_000_000_000


def new_domain() -> int:
    """A ROS domain that neither another test of this run nor a parallel run uses."""
    return next(_domains)


def scan(T_world_lidar: Array) -> Points:
    """(N, 4) points of a street within 40 m: ground, house fronts, side walls. The same points from every pose."""
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
    """T_world_lidar of the n-th scan: straight ahead with a slight rotation."""
    return se3.exp([0, 0, 0.004 * n, STEP * n, 0, 0])


class Drive:
    """The scans of the drive, with stamps and poses."""

    frames, period, start = FRAMES, PERIOD, START

    def stamp(self, n: int) -> int:
        """Stamp of the n-th scan, ns."""
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


@pytest.fixture
def no_earlier_nodes() -> None:
    """For tests that listen to /rosout: when a node is destroyed, ROS ends /rosout for all nodes of its name, and a
    node of an earlier test is destroyed only when Python collects it."""
    gc.collect()


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
    if the test's parameter is true."""
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
    """Runs one of the executables until it exits: run("slam_node", *arguments)."""

    def finish(name: str, *arguments: str, timeout: float = 180.0) -> subprocess.CompletedProcess[str]:
        command = [sys.executable, "-m", "dpm2_ros.executables", name, *arguments]
        environment = ros_environment(new_domain())
        return subprocess.run(command, env=environment, capture_output=True, text=True, timeout=timeout, check=False)

    return finish


@pytest.fixture
def processes() -> Iterator[list[subprocess.Popen[bytes]]]:
    """Processes that are killed when the test ends."""
    started: list[subprocess.Popen[bytes]] = []
    yield started
    for process in started:
        process.kill()
        process.wait()


@pytest.fixture
def domain() -> int:
    """A ROS domain that only this test uses."""
    return new_domain()


@pytest.fixture
def domains() -> Iterator[int]:
    """More such domains, for a test whose processes must not discover each other."""
    return _domains


@pytest.fixture
def drive() -> Drive:
    """The scans of the drive, with stamps and poses."""
    return Drive()


@pytest.fixture
def rig(ros: Callable[..., Any], drive: Any, monkeypatch: pytest.MonkeyPatch) -> Callable[..., Rig]:
    """Makes a Rig whose node sends diagnostics ten times per second and never reports a sensor as silent: on a busy
    machine, much time may pass between a cloud and the next check of its result."""
    monkeypatch.setattr("dpm2_ros.diagnostics.PERIOD", 0.1)
    monkeypatch.setattr("dpm2_ros.slam_diagnostics.SILENT", 300.0)
    return lambda *parameters, **options: Rig(ros, drive, *parameters, **options)
