# SPDX-License-Identifier: Apache-2.0
"""Fixtures that several packages' tests share."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import hypothesis
import pytest

from dpm2_core.openmp import wait_passively

wait_passively()  # as the programs do, before a test imports numpy
KITTI = Path(os.environ.get("DPM2_KITTI", Path(__file__).resolve().parents[2] / "shared" / "kitti"))

ROS = Path(__file__).resolve().parent / "dpm2_ros"

# The same examples in every run, however slow the machine is.
hypothesis.settings.register_profile("dpm2", deadline=None, derandomize=True)
hypothesis.settings.load_profile("dpm2")


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Marker `ros` for all that lies in test/dpm2_ros, before -m selects."""
    for item in items:
        if ROS in item.path.parents:
            item.add_marker("ros")


@pytest.fixture(scope="session")
def kitti_excerpt() -> Path:
    """The packed real KITTI excerpt (its README.md lists what is in it)."""
    if not (KITTI / "unpack.py").is_file():
        pytest.skip(f"no KITTI excerpt at {KITTI}; set DPM2_KITTI to its folder")
    return KITTI


@pytest.fixture(scope="session")
def kitti_root(kitti_excerpt: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The excerpt in KITTI odometry layout: sequences/{00,04} and poses/."""
    root = tmp_path_factory.mktemp("kitti")
    subprocess.run([sys.executable, str(kitti_excerpt / "unpack.py"), str(root)], check=True, capture_output=True)
    return root
