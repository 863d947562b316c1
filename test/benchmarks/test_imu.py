# SPDX-License-Identifier: Apache-2.0
"""The IMU benchmark on a few scans of a robot with fast rotation: each method has its row, and its own samples."""

from __future__ import annotations

from pathlib import Path

import pytest

from benchmarks import imu
from benchmarks.harness import Options
from dpm2_core.sim.settings import LidarConfig


@pytest.mark.long
def test_each_way_is_given_the_samples_that_its_name_says(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(imu, "WORLDS", {"suburb": ("suburb", 912, 2.0, 90.0)})
    monkeypatch.setattr(imu, "FRAMES", 44)
    monkeypatch.setattr(imu, "LENGTHS", (1.0,))
    monkeypatch.setattr(imu, "LIDAR", LidarConfig(beams=16, columns=360, height=0.8, car_body=False, min_range=0.4))
    monkeypatch.setattr(imu, "CAR_FRAMES", 45)
    monkeypatch.setattr(imu, "CAR_LIDAR", LidarConfig(beams=16, columns=360))
    results = imu.bench_imu(Options(threads=1, out=tmp_path)).results
    row = results["worlds"]["suburb"]
    assert row["frames"] == 44
    assert row["fastest_turn_deg_s"] > 80  # it stands for 1.5 s, and rotates a second later
    assert row["frames_above_50_deg_s"] >= 5
    given = [row[way]["frames_with_imu"] for way in ("without", "stops", "with")]
    assert given[0] == 0
    assert 0 < given[1] < 30 < given[2]  # it stops at the 22nd scan
    assert row["with"]["ape_rmse_m"] < 0.1  # m, over a distance of 5 m
    assert row["ratio"] == row["with"]["ape_rmse_m"] / row["without"]["ape_rmse_m"]
    assert row["with"]["worst_tilt_deg"] < 3
    without, with_it = (results["pauses"][way] for way in ("without", "with"))
    assert list(without) == list(with_it) == ["1 s", "2 s", "all"]  # pauses that fit into 4.5 s, with surroundings
    assert without["all"]["gaps"] == 10
    assert with_it["all"]["bridged"] >= without["all"]["bridged"]
    assert with_it["all"]["median_error_m"] <= with_it["all"]["worst_error_m"] <= without["all"]["worst_error_m"] + 0.1
