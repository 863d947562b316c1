# SPDX-License-Identifier: Apache-2.0
"""The benchmark of relocalization on a short road: one scan, at any heading, finds itself in the map of that road."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from benchmarks.harness import Options
from benchmarks.relocalise import bench_relocalise
from dpm2_core.data.trajectory import write_kitti
from dpm2_core.geometry import se3


@pytest.mark.slow
@pytest.mark.weights
def test_a_scan_finds_itself_on_a_short_road(tmp_path: Path) -> None:
    way = se3.exp(np.arange(40)[:, None] * np.array([0, 0.002, 0, 0, 0, 1.0]))  # KITTI: z is ahead
    write_kitti(tmp_path / "road.txt", way)
    results = bench_relocalise(Options(sources=[tmp_path / "road.txt"], pairs=1, threads=1)).results
    assert results["keyframes"] >= 5
    assert results["wrong"] == 0
    assert results["right"] == 1
