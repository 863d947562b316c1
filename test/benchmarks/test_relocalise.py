# SPDX-License-Identifier: Apache-2.0
"""The relocalization benchmark on a short road: one scan, at any heading, is localized in the map of that road."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from rich.progress import Progress

from benchmarks import relocalise_open
from benchmarks.harness import Options
from benchmarks.relocalise import bench_relocalise
from benchmarks.relocalise_open import open_roads
from dpm2_core.data.trajectory import write_kitti
from dpm2_core.geometry import se3
from dpm2_core.network.pretrained import load_network
from dpm2_core.slam.settings import SlamSettings


@pytest.mark.slow
@pytest.mark.weights
def test_a_scan_finds_itself_on_a_short_road(tmp_path: Path) -> None:
    way = se3.exp(np.arange(40)[:, None] * np.array([0, 0.002, 0, 0, 0, 1.0]))  # KITTI: z is ahead
    write_kitti(tmp_path / "road.txt", way)
    results = bench_relocalise(Options(sources=[tmp_path / "road.txt"], pairs=1, threads=1)).results
    assert results["keyframes"] >= 5
    assert results["wrong"] == 0
    assert results["right"] == 1


@pytest.mark.long
@pytest.mark.weights
def test_where_every_place_looks_alike_there_is_no_answer_rather_than_a_wrong_one(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """On a highway and in a tunnel, an ambiguous pose is not accepted, with images or without."""
    monkeypatch.setattr(relocalise_open, "LENGTH", 250.0)
    with Progress(disable=True) as progress:
        found = open_roads(SlamSettings(), load_network("small", 1), progress, spacing=50, visits=1)
    assert set(found) == {"highway", "tunnel"}
    for road in found.values():
        assert road["keyframes"] >= 4
        for kind in ("without images", "with images"):
            assert road[kind]["wrong"] == 0
            assert road[kind]["visits"] == 1
