# SPDX-License-Identifier: Apache-2.0
"""Fixtures shared by the tests of several packages."""

from __future__ import annotations

import gc
import os
import subprocess
import sys
from pathlib import Path
from typing import TYPE_CHECKING

import hypothesis
import pytest
from filelock import FileLock

from dpm2_core.openmp import wait_passively

if TYPE_CHECKING:
    import numpy as np

    from dpm2_core.network.model import DeepPointMap2

os.environ.setdefault("GOMP_SPINCOUNT", "0")  # parallel processes would spin for a third of all processor time
wait_passively()  # as the programs do, before a test imports numpy
os.environ.setdefault("OMP_NUM_THREADS", "1")  # unless a test requests more: its arrays are small
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)  # some hundred processes are started: compile their modules only once
KITTI = Path(os.environ.get("DPM2_KITTI", Path(__file__).resolve().parents[2] / "shared" / "kitti"))

gc.disable()  # until all is imported: a quarter of the time of test collection went to the garbage collector

ROS = Path(__file__).resolve().parent / "dpm2_ros"

# The same examples in every run, however slow the machine is.
hypothesis.settings.register_profile("dpm2", deadline=None, derandomize=True)
hypothesis.settings.load_profile("dpm2")


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Set markers before -m selects: `ros` for all tests in test/dpm2_ros, `slow` for long tests and those that unpack
    real scans.

    Tests of ROS run first. They wait half of their time, which the other processes fill with tests that compute. At the
    end, all processes would run them at once, and the processors would wait, too.
    """
    items.sort(key=lambda item: ROS not in item.path.parents)
    for item in items:
        if ROS in item.path.parents:
            item.add_marker("ros")
        if "kitti_root" in getattr(item, "fixturenames", ()) or item.get_closest_marker("long"):
            item.add_marker("slow")


def pytest_collection_finish() -> None:
    """Freeze all objects imported by now: the garbage collector need not scan them in every test."""
    gc.collect()
    gc.freeze()
    gc.enable()


def of_all_workers(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of this pytest run that its workers (pytest-xdist) share."""
    base = tmp_path_factory.getbasetemp()
    return base.parent if "PYTEST_XDIST_WORKER" in os.environ else base


@pytest.fixture(scope="session")
def kitti_excerpt() -> Path:
    """The packed real KITTI excerpt (its README.md lists the contents)."""
    if not (KITTI / "unpack.py").is_file():
        pytest.skip(f"no KITTI excerpt at {KITTI}; set DPM2_KITTI to its folder")
    return KITTI


@pytest.fixture(scope="session")
def kitti_root(kitti_excerpt: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The excerpt in KITTI odometry layout: sequences/{00,04} and poses/."""
    root = of_all_workers(tmp_path_factory) / "kitti"
    with FileLock(f"{root}.lock"):
        if not root.is_dir():  # unpacked by the first worker that needs it
            part = root.with_suffix(".part")
            command = [sys.executable, str(kitti_excerpt / "unpack.py"), str(part)]
            subprocess.run(command, check=True, capture_output=True)
            part.rename(root)
    return root


@pytest.fixture(scope="session")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """28 m of a simulated street in KITTI layout, 30 scans without images. Do not write to it."""
    from dpm2_core.sim.drive import simulate
    from dpm2_core.sim.settings import DriveConfig, LidarConfig

    root = of_all_workers(tmp_path_factory) / "recording"
    with FileLock(f"{root}.lock"):
        if not root.is_dir():
            lidar = LidarConfig(columns=900)
            drive = DriveConfig(frames=30, seed=2, road="straight", preset="suburb", images=False, lidar=lidar)
            simulate(root, drive)  # the folder appears only when it is complete
    return root


@pytest.fixture
def noise() -> np.random.Generator:
    """Random generator with a fixed seed."""
    import numpy as np

    return np.random.default_rng(7)


@pytest.fixture
def model() -> DeepPointMap2:
    """A tiny network with seeded random weights."""
    import torch

    from dpm2_core.network.model import DeepPointMap2

    from .helpers.networks import tiny

    torch.manual_seed(0)
    return DeepPointMap2(tiny()).eval()
