# SPDX-License-Identifier: Apache-2.0
"""examples/relocalise_action.py with a real node: it ends once the robot is localized, and reports if it is not."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from sensor_msgs.msg import PointCloud2

from dpm2_core.data import naming
from dpm2_core.data.open import open_source
from dpm2_core.data.settings import InputSettings
from dpm2_ros.conversions import cloud_to_msg
from dpm2_ros.slam_node import SlamNode

from ..helpers.command import dpm2
from ..helpers.drives import first_scans

EXAMPLE = Path(__file__).resolve().parents[2] / "examples" / "relocalise_action.py"
pytest.importorskip("py_trees", reason="no py_trees: pip install '.[test]'")


def action(harness: Any, timeout: float) -> subprocess.Popen[str]:
    """Start the example in the domain of a harness."""
    environment = {**os.environ, "ROS_DOMAIN_ID": str(harness.node.context.get_domain_id())}
    command = [sys.executable, str(EXAMPLE), str(timeout)]
    return subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, text=True)


@pytest.mark.slow
@pytest.mark.weights
def test_a_robot_that_is_lost_finds_itself(ros: Callable[..., Any], recording: Path, tmp_path: Path) -> None:
    drive = first_scans(recording, 10, tmp_path / "drive")
    quick = ("--set", "slam.registration=geometric")  # for the odometry only: the network recognizes the place
    made = dpm2("run", drive, "--out", tmp_path / "out", "--map", tmp_path / "street.dpm2map", *quick)
    assert made.returncode == 0, made.stderr
    finding = ("ros.localization_mode:=true", "slam.loops.descriptors:=true", "input.images:=false")
    harness = ros(f"ros.map_file:={tmp_path / 'street.dpm2map'}", *finding)
    lidar = harness.publisher(PointCloud2, naming.POINTS)
    harness.add(SlamNode())
    harness.wait(lidar.get_subscription_count, "the subscription to the clouds")
    process = action(harness, 150.0)
    (scan,) = open_source(drive, InputSettings(images=False)).frames(4, 5)
    stamp = 100 * 10**9
    while process.poll() is None:  # the robot stands still
        stamp += 10**8
        lidar.publish(cloud_to_msg(scan.points, stamp, "lidar"))
        time.sleep(0.2)
    assert process.stdout is not None
    said = process.stdout.read()
    assert process.returncode == 0, said
    assert said.startswith("success: ")


@pytest.mark.slow
def test_without_a_node_it_fails_after_its_time(ros: Callable[..., Any]) -> None:
    process = action(ros(), 1.0)
    said, _ = process.communicate(timeout=180)
    assert process.returncode == 1
    assert "not found within 1 s" in said
