# SPDX-License-Identifier: Apache-2.0
"""Missing parts of a machine are found, named, and distinguished from broken ones."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from dpm2_core.evaluation import machine
from dpm2_core.evaluation.self_test import SLOW_KEYFRAME, SLOW_ODOMETRY, SelfTest, self_test, street_scan
from dpm2_core.geometry import se3

from ...helpers.command import dpm2

GOOD = SelfTest(frames=9, error_m=0.01, failed=0, start_s=3.0, odometry_ms=20.0, keyframe_ms=250.0)


def test_a_full_disk() -> None:
    """Nothing can be written to /proc; other checks depend on the threshold."""
    found = machine.disk(Path("/proc"))
    assert found.level == "error"
    assert "cannot be written" in found.found
    assert machine.disk(Path(), enough=1e18).level == "warning"
    assert machine.shared_memory(enough=1e18).level == "warning"
    assert machine.shared_memory(Path("/no/such/folder")).level == "warning"
    assert machine.memory(enough=1e18).level == "warning"


@pytest.mark.skipif(os.geteuid() != 0, reason="mounts a small file system: root alone can")
def test_a_disk_that_is_full_in_truth(tmp_path: Path) -> None:
    if subprocess.run(["mount", "-t", "tmpfs", "-o", "size=1m", "none", str(tmp_path)], check=False).returncode:
        pytest.skip("mounts are not allowed here")
    try:
        with (tmp_path / "filled").open("wb") as file:
            file.write(bytes(900_000))
        found = machine.disk(tmp_path)
    finally:
        subprocess.run(["umount", str(tmp_path)], check=True)
    assert found.level == "error"
    assert "No space left" in found.found


def test_a_package_that_is_missing_is_an_error() -> None:
    found = machine.packages(("numpy", "no-such-package"))
    assert found.level == "error"
    assert "no-such-package missing" in found.found


@pytest.mark.slow
def test_a_missing_ros_is_a_warning() -> None:
    """If Python does not find rclpy, this is a warning."""
    program = (
        "import json, sys; from importlib.machinery import PathFinder\n"
        "find = PathFinder.find_spec\n"
        "def without(c, n, *a, **k): return None if n.startswith('rclpy') else find(n, *a, **k)\n"
        "PathFinder.find_spec = classmethod(without)\n"
        "from dpm2_core.evaluation import machine\n"
        "print(json.dumps([machine.ros().level, machine.dds().level]))"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert json.loads(done.stdout) == ["warning", "note"]


@pytest.mark.slow
def test_a_cloud_comes_back_over_dds_or_it_is_said() -> None:
    if machine.ros().level == "ok":
        found = machine.dds(timeout=120.0)  # s: two processes that import ROS, on a busy machine
        assert found.level == "ok", found
        assert machine.dds(timeout=0.01).level == "warning"
    else:
        assert machine.dds().level == "note"


@pytest.mark.parametrize(("change", "level", "word"), [
    ({}, "ok", "expected"),
    ({"odometry_ms": SLOW_ODOMETRY + 1}, "warning", "too slow for 10 Hz"),
    ({"keyframe_ms": SLOW_KEYFRAME + 1}, "warning", "late"),
    ({"failed": 1}, "error", "does not work"),
    ({"error_m": float("nan")}, "error", "does not work"),
    ({"error_m": 0.5}, "error", "does not work"),
])  # fmt: skip
def test_the_self_test_is_judged(change: dict[str, float], level: str, word: str) -> None:
    finding = replace(GOOD, **change).finding()  # type: ignore[arg-type]
    assert finding.level == level
    assert word in finding.advice


def test_a_scan_hits_the_ground_and_the_nearer_of_two_walls(noise: np.random.Generator) -> None:
    boxes = np.array([[[10.0, -50, 0], [11, 50, 20]], [[20.0, -50, 0], [21, 50, 20]]])
    points = street_scan(boxes, se3.make(np.eye(3), [0, 0, 1.7]), noise)
    ahead = points[(points[:, 0] > 9) & (np.abs(points[:, 1]) < 5)]
    assert ahead[:, 0].max() < 10.2  # more than five times the noise
    ground = points[points[:, 0] < 0]
    assert np.abs(ground[:, 2] + 1.7).max() < 0.2


@pytest.mark.slow
def test_the_self_test_finds_its_way() -> None:
    done = self_test(seconds=0.0)
    assert done.failed == 0
    assert done.error_m < 0.05
    assert done.keyframe_ms is not None


@pytest.mark.slow
def test_doctor(tmp_path: Path) -> None:
    done = dpm2("doctor", "--folder", tmp_path, "--no-test", "--json", "-")
    assert done.returncode == 0
    findings = {finding["what"]: finding for finding in json.loads(done.stdout)["findings"]}
    assert not [finding for finding in findings.values() if finding["level"] == "error"]
    assert "torch 2" in findings["packages"]["found"]
    assert f"Python 3.{sys.version_info[1]}" in findings["python"]["found"]
    assert f"disk of {tmp_path}" in findings
    assert "self-test" not in findings
    broken = dpm2("doctor", "--folder", "/proc", "--no-test")
    assert broken.returncode == 1
    assert "these do not work: disk" in broken.stderr
