# SPDX-License-Identifier: Apache-2.0
"""`make bench-ros`: the KITTI excerpt through bag, bag_player and slam_node at 10 Hz, with the node's own defaults.
First alone, then with an IMU, if the drive has one, and a subscriber for every topic; then with the network for each
scan.
"""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from benchmarks.harness import Options, Report, drives, write_report
from dpm2_core.commands.options import run_command
from dpm2_core.console import Console
from dpm2_core.data.bags import BagSource
from dpm2_core.data.convert import convert
from dpm2_core.data.kitti import KittiSource
from dpm2_core.data.settings import InputSettings
from dpm2_core.tables import record_table
from tools.demo import Evaluation, evaluate_replay
from tools.replay import replay

VARIANTS: dict[str, tuple[dict[str, object], bool]] = {
    "": ({"input.imu_topic": "/none"}, False),
    ", IMU and all topics": ({}, True),
    ", neural": ({"input.imu_topic": "/none", "slam.registration": "neural"}, False),
    ", refined": ({"input.imu_topic": "/none", "slam.registration": "refined"}, False),
}
"""Parameters of the node, and whether every topic that it publishes has a subscriber, as with RViz and Nav2."""
FIGURES = ("frames_in", "frames_out", "dropped", "latency_p50_ms", "latency_p95_ms", "ape_rmse_m", "rpe_trans_m")


def bench(
    sources: Annotated[list[Path] | None, typer.Option("--source", help="KITTI sequence, not the excerpt.")] = None,
    out: Annotated[Path, typer.Option(help="Folder for ros.json.")] = Path("benchmarks"),
    repetitions: Annotated[int, typer.Option(min=1, help="Replays of every drive.")] = 3,
) -> int:
    """Replay every drive at its own rate and evaluate the poses; medians, and the worst number of dropped clouds."""
    options = Options(sources=sources or (), repetitions=repetitions)
    results: dict[str, dict[str, float | int | None]] = {}
    with drives(options) as found, tempfile.TemporaryDirectory(prefix="dpm2_bench_ros_") as folder:
        for title, drive in found.items():
            assert isinstance(drive, KittiSource)
            bag, work = Path(folder) / f"bag_{title}", Path(folder) / title
            work.mkdir()
            convert(KittiSource(drive.path), bag)
            source = BagSource(bag, InputSettings(images=False))
            runs: dict[str, list[Evaluation]] = {name: [] for name in VARIANTS}
            for _ in range(repetitions):
                for name, (parameters, watched) in VARIANTS.items():
                    played = replay(source, work, parameters=parameters, watched=watched)
                    runs[name].append(evaluate_replay(source, played, work))
            results |= {f"{title}{name}": _figures(evaluations) for name, evaluations in runs.items()}
    columns = {name: f"{{{name}:.4g}}" for name in FIGURES} | {"failed checks": "{failed_checks:.4g}"}
    table = record_table("Bag -> bag_player -> slam_node -> /dpm2/odom", ["drive"], columns, results)
    write_report(out / "ros.json", Report({"drives": results}, table), options, "python -m benchmarks.ros")
    Console().print(table)
    return 1 if any(row["failed_checks"] for row in results.values()) else 0


def _figures(runs: Sequence[Evaluation]) -> dict[str, float | int | None]:
    medians = {name: _median([run.summary[name] for run in runs], worst=name == "dropped") for name in FIGURES}
    return medians | {"failed_checks": sum(not holds for run in runs for holds in run.checks.values())}


def _median(values: list[float | int | None], worst: bool) -> float | None:
    known = [value for value in values if value is not None]
    if len(known) < len(values):
        return None
    return float(max(known) if worst else np.median(known))


if __name__ == "__main__":
    sys.exit(run_command(bench))
