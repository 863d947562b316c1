# SPDX-License-Identifier: Apache-2.0
"""SLAM on real roads: the synthetic city along trajectories of KITTI, with traffic, at full length."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Group
from rich.progress import Progress

from benchmarks.harness import Options, Report, excerpt, settings_of
from benchmarks.loops import check_loops
from dpm2_core.console import progress_bar
from dpm2_core.errors import UsageError
from dpm2_core.evaluation.metrics import evaluate
from dpm2_core.pipeline import OfflineRun
from dpm2_core.sim.settings import PresetName
from dpm2_core.sim.simulated_drive import SimulatedDrive
from dpm2_core.slam.settings import Config, SlamSettings
from dpm2_core.tables import FigureTable, record_table

ROADS: dict[str, PresetName] = {
    "00": "suburb", "05": "suburb", "06": "city", "07": "city", "08": "suburb", "09": "rural",
}  # fmt: skip
"""Sequences, and the type of environment along them."""
FIRST_SEED = 800_000
"""Worlds that were not used in training: the number of the sequence is added."""
_ERRORS = ("t_err_percent", "r_err_deg_per_100m", "ape_rmse_m", "final_drift_percent")


def bench_roads(options: Options) -> Report:
    """Odometry alone and SLAM on each road, and all loops that were tried.

    Raises:
        UsageError: there are no pose files.
    """
    settings = settings_of(options)
    roads: dict[str, Any] = {}
    with progress_bar() as progress:
        for path in road_files(options):
            roads[path.stem] = drive(path, settings, progress)
            progress.console.print(f"{path.stem}: {roads[path.stem]}", soft_wrap=True)
    results = {"worlds": {"presets": ROADS, "first_seed": FIRST_SEED}, "roads": roads, "summary": _summary(roads)}
    return Report(results, Group(_table(roads), str(results["summary"])))


def open_road(path: Path) -> SimulatedDrive:
    """The drive along a file of poses, in the world for that file."""
    number = int(path.stem) if path.stem.isdigit() else 99
    return SimulatedDrive(str(path), ROADS.get(path.stem, "suburb"), FIRST_SEED + number, name=path.stem)


def drive(path: Path, settings: SlamSettings, progress: Progress) -> dict[str, Any]:
    """One road: metrics of odometry alone and of the SLAM, and its loops."""
    source = open_road(path)
    task = progress.add_task(path.stem, total=len(source))
    with OfflineRun(source, Config(slam=settings)) as run:
        result = run.run(lambda _: progress.advance(task))
    mapper, failed = result.mapper, result.methods["failed"]
    keyframes = np.array([k.index for k in mapper.keyframes])
    alone = evaluate(source.poses, result.recorder.poses(np.array([k.T_odom_kf for k in mapper.keyframes])))
    corrected = evaluate(source.poses, result.poses, failed_frames=failed)
    return {
        "frames": len(source),
        "path_length_m": corrected.path_length_m,
        "failed_frames": failed,
        "keyframes": len(keyframes),
        "odometry": {name: getattr(alone, name) for name in _ERRORS},
        "slam": {name: getattr(corrected, name) for name in _ERRORS},
        "loops": check_loops(mapper.loops, source.poses[keyframes]),
    }


def road_files(options: Options) -> Sequence[Path]:
    """The pose files to drive along: those given, or `ROADS` from the KITTI excerpt.

    Raises:
        UsageError: one is missing.
    """
    if options.sources:
        return options.sources
    found = [excerpt() / "gt_poses" / f"{name}.txt" for name in ROADS]
    if missing := [path for path in found if not path.is_file()]:
        raise UsageError(f"{missing[0]}: no such pose file; set DPM2_KITTI, or give --source with files of KITTI poses")
    return found


def _summary(roads: dict[str, Any]) -> dict[str, Any]:
    """Loops of all roads combined."""
    total: dict[str, Any] = {"accepted": 0, "wrong": 0}
    for name in ("accepted", "wrong"):
        total[name] = sum(road["loops"][name] for road in roads.values())
    for kind in ("same", "reverse", "cross"):
        revisits = sum(road["loops"][kind]["revisits"] for road in roads.values())
        found = sum(road["loops"][kind]["found"] for road in roads.values())
        total[kind] = {"revisits": revisits, "found": found, "recall": round(found / revisits, 3) if revisits else None}
    return total


def _table(roads: dict[str, Any]) -> FigureTable:
    columns = {
        heading: f"{{odometry[{error}]:.3f}} -> {{slam[{error}]:.3f}}"
        for heading, error in zip(("t_err %", "r_err deg/100 m", "APE m"), _ERRORS, strict=False)
    }
    columns |= {"loops": "{loops[accepted]}", "wrong": "{loops[wrong]}"}
    columns |= {kind: f"{{loops[{kind}][found]}}/{{loops[{kind}][revisits]}}" for kind in ("same", "reverse", "cross")}
    return record_table("Odometry alone -> SLAM; KITTI metric, APE after alignment", ["road"], columns, roads)
