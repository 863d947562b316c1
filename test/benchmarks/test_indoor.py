# SPDX-License-Identifier: Apache-2.0
"""The benchmark of buildings on a few scans: errors of odometry and SLAM, and loops, by the drive's ground truth."""

from __future__ import annotations

from pathlib import Path

import pytest

from benchmarks import indoor, indoor_places
from benchmarks.harness import Options


@pytest.mark.long
def test_a_few_scans_of_a_building_are_evaluated(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(indoor, "WORLDS", {"building": ("indoor", 900, 12)})
    monkeypatch.setattr(indoor, "LENGTHS", (0.5,))
    monkeypatch.setattr(indoor_places, "VISITS", 4)
    options = Options(threads=1, out=tmp_path, overrides=["slam.loops.descriptors=false"])
    results = indoor.bench_indoor(options).results
    assert results["beams"] == indoor.BEAMS
    row = results["worlds"]["building"]
    assert (row["frames"], row["failed_frames"], row["breaks"]) == (12, 0, 0)
    assert row["keyframes"] >= 1
    assert row["loops"] >= row["wrong_loops"] == 0
    assert (row["relocalisation"]["visits"], sum(row["joins"].values())) == (4, 6)
    assert (row["relocalisation_in_dust"]["visits"], row["relocalisation_in_dust"]["wrong"]) == (4, 0)
    for kind in ("odometry", "slam"):
        assert 0 < row[kind]["ape_rmse_m"] < 0.1  # m, in a room
