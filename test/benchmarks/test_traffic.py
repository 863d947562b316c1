# SPDX-License-Identifier: Apache-2.0
"""The traffic benchmark on a few scans: all methods are evaluated, a second run continues, diverged drives count."""

from __future__ import annotations

import json
from dataclasses import replace
from itertools import combinations
from pathlib import Path

import pytest

from benchmarks import traffic
from benchmarks.harness import Options
from dpm2_core.errors import UsageError
from dpm2_core.sim.settings import LidarConfig


@pytest.mark.long
def test_a_short_drive_is_evaluated_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(traffic, "PLACES", {"suburb": 20.0})
    monkeypatch.setattr(traffic, "FRAMES", 6)
    monkeypatch.setattr(traffic, "LIDAR", LidarConfig(columns=512))
    options = Options(repetitions=1, threads=1, only="geometric", out=tmp_path)
    results = traffic.bench_traffic(options).results
    row = results["summary"]["geometric"]
    assert row["none"]["drives"] == 1
    assert 0 <= row[traffic.ORACLE]["rpe_m"] < 0.05
    assert row["movers"]["ratio"]["rpe_m"] == pytest.approx(row["movers"]["rpe_m"] / row["none"]["rpe_m"])
    (drive,) = results["drives"].values()
    assert 0.05 < drive["share_moving"] < 0.7
    assert drive["runs"]["geometric"]["movers"]["filter_cpu_ms"] > 0
    assert "filter_cpu_ms" not in drive["runs"]["geometric"]["none"]
    monkeypatch.setattr(traffic, "build_world", None)  # all is in the file: no world is needed
    assert (
        traffic.bench_traffic(options).results["drives"]
        == json.loads((tmp_path / "traffic.json").read_text())["drives"]
    )
    for name, other in (("FRAMES", 7), ("PRETRAINED_DIR", tmp_path)):  # another recipe or other weights: started anew
        with monkeypatch.context() as changed:
            changed.setattr(traffic, name, other)
            with pytest.raises(TypeError):
                traffic.bench_traffic(options)


def test_the_summary_is_of_means_and_medians_and_counts_drives_that_strayed() -> None:
    def run(rpe: float) -> dict[str, float]:
        return {"rpe_trans_m": rpe, "rpe_rot_deg": 0.01, "ape_rmse_m": 0.0, "failed_frames": 0, "cpu_ms": 20.0}

    drives = {
        str(i): {"runs": {"refined": {"none": run(none), "movers": run(dynamic)}}}
        for i, (none, dynamic) in enumerate([(0.004, 0.002), (0.2, 0.003), (0.006, 0.004)])
    }
    found = traffic.summarized(drives)["refined"]
    assert found["none"]["diverged"] == 1
    assert found["movers"]["diverged"] == 0
    assert found["none"]["rpe_m"] == pytest.approx(0.07)
    assert found["movers"]["ratio"]["rpe_m"] == pytest.approx(0.003 / 0.07)
    assert found["movers"]["ratio"]["median_rpe_m"] == pytest.approx(0.5)


def test_other_weights_of_the_network_or_threads_are_another_recipe(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Drives are then measured again. Previously, figures of other weights were shown as theirs, and times with two
    threads next to those with one."""
    monkeypatch.setattr(traffic, "PLACES", {})  # no drive, only the recipe
    options = Options(threads=1, out=tmp_path)
    trained = tmp_path / "mine.safetensors"
    recipes = []
    for content in (b"weights", b"weights of another training"):
        trained.write_bytes(content)
        recipes.append(
            traffic.bench_traffic(replace(options, overrides=[f"slam.neural.weights={trained}"])).results["recipe"]
        )
    recipes += [traffic.bench_traffic(asked).results["recipe"] for asked in (options, replace(options, threads=2))]
    assert all(a != b for a, b in combinations(recipes, 2))
    assert traffic.bench_traffic(options).results["recipe"] == recipes[2]


def test_an_unknown_registration_is_an_error_of_use() -> None:
    with pytest.raises(UsageError, match="adaptive, geometric, neural, refined"):
        traffic.bench_traffic(Options(only="visual"))
