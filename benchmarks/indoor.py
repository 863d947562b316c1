# SPDX-License-Identifier: Apache-2.0
"""SLAM in buildings with default settings: 16 beams with realistic errors; rooms, corridors, halls and stairs.

Then possible silent errors: visits to each world, at random positions and headings, are searched in all maps, also in
dust. And each third of a drive is added to one map as a drive of its own; most of them show different parts of a
building that looks alike everywhere.
"""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Group
from rich.progress import Progress

from benchmarks.harness import Options, Report, settings_of
from benchmarks.indoor_places import (
    DUST,
    HEIGHT,
    Visit,
    is_wrong,
    join_table,
    joins,
    relocalise_table,
    relocalised,
    visits_to,
)
from benchmarks.loops import error_of
from dpm2_core.console import progress_bar
from dpm2_core.data.kitti import KittiSource
from dpm2_core.data.settings import InputSettings
from dpm2_core.evaluation.metrics import evaluate
from dpm2_core.pipeline import OfflineRun
from dpm2_core.sim.drive import simulate
from dpm2_core.sim.sensors import real_sensor
from dpm2_core.sim.settings import DriveConfig, LidarConfig, PresetName
from dpm2_core.slam.mapping.mapper import Mapper
from dpm2_core.slam.settings import Config, SlamSettings
from dpm2_core.tables import FigureTable

WORLDS: dict[str, tuple[PresetName, int, int]] = {
    "building A": ("indoor", 900, 500), "building B": ("indoor", 901, 500),
    "car park A": ("car_park", 902, 300), "car park B": ("car_park", 903, 300),
}  # fmt: skip
"""Type of environment, seed, and number of frames at 10 Hz."""
BEAMS = 16
LENGTHS = (5.0, 10.0, 20.0)
"""Lengths of the KITTI metric's segments, m."""


def bench_indoor(options: Options) -> Report:
    """Each world with default settings: its drive, visits to it, and thirds of the drive in one map."""
    settings, results = settings_of(options), dict[str, Any]()
    mappers, visits, dusty = dict[str, Mapper](), dict[str, list[Visit]](), dict[str, list[Visit]]()
    with progress_bar() as progress, tempfile.TemporaryDirectory() as folder:
        for name, (preset, seed, frames) in WORLDS.items():
            lidar = real_sensor(LidarConfig(beams=BEAMS, height=HEIGHT))
            config = DriveConfig(frames=frames, seed=seed, road="loop", preset=preset, images=False, lidar=lidar)
            simulate(Path(folder) / str(seed), config)
            results[name], mappers[name] = _drive(Path(folder) / str(seed), settings, progress, name)
            progress.console.print(f"{name}: {results[name]}", soft_wrap=True)
            visit_settings = settings.indoors() if results[name]["preset"] == "indoor" else settings
            visits[name], dusty[name] = visits_to(config, visit_settings)
            results[name]["joins"] = joins(Path(folder) / str(seed), settings)
        for name, mapper in mappers.items():
            results[name]["relocalisation"] = found = relocalised(settings, mapper, visits, name)
            results[name]["relocalisation_in_dust"] = found_in_dust = relocalised(settings, mapper, dusty, name)
            progress.console.print(f"{name}: {found}, in dust {found_in_dust}", soft_wrap=True)
    title = "relocalization from one scan, without a prior"
    clean = relocalise_table(results, "relocalisation", title)
    in_dust = relocalise_table(results, "relocalisation_in_dust", f"{title}, dust in {DUST:.0%} of the pulses")
    data = {"beams": BEAMS, "height_m": HEIGHT, "lengths_m": LENGTHS, "dust": DUST, "worlds": results}
    return Report(data, Group(_table(results), clean, in_dust, join_table(results)))


def _drive(path: Path, settings: SlamSettings, progress: Progress, name: str) -> tuple[dict[str, Any], Mapper]:
    source = KittiSource(path, InputSettings(images=False))
    assert source.poses is not None
    task = progress.add_task(name, total=len(source))
    with OfflineRun(source, Config(slam=settings)) as run:
        result = run.run(lambda _: progress.advance(task))
    mapper = result.mapper
    alone = result.recorder.poses(np.array([k.T_odom_kf for k in mapper.keyframes]))
    errors = {"odometry": evaluate(source.poses, alone, LENGTHS),
              "slam": evaluate(source.poses, result.poses, LENGTHS)}  # fmt: skip
    truth = source.poses[[k.index for k in mapper.keyframes]]
    loops = [loop for loop in mapper.loops if loop.ok]
    return {
        "preset": run.slam.odometry.scale,
        "frames": len(source),
        "failed_frames": result.methods["failed"],
        "breaks": result.recorder.breaks,
        "path_length_m": errors["slam"].path_length_m,
        **{kind: {"t_err_percent": m.t_err_percent, "ape_rmse_m": m.ape_rmse_m} for kind, m in errors.items()},
        "keyframes": len(mapper.keyframes),
        "loops": len(loops),
        "wrong_loops": sum(is_wrong(truth, loop) for loop in loops),
        "worst_loop_m": max((error_of(loop, truth)[0] for loop in loops), default=None),
    }, mapper


def _table(worlds: dict[str, Any]) -> FigureTable:
    figures = ("preset", "registered", "path m", "t_err %", "APE m", "loops", "wrong")
    title = f"{BEAMS} beams with a real one's errors, {HEIGHT} m above the floor; odometry alone -> SLAM"
    table = FigureTable(title, names=["world"], figures=figures)
    for name, r in worlds.items():
        errors = [f"{r['odometry'][e]:.3f} -> {r['slam'][e]:.3f}" for e in ("t_err_percent", "ape_rmse_m")]
        registered = f"{r['frames'] - r['failed_frames']}/{r['frames']}"
        table.add_row(name, r["preset"], registered, f"{r['path_length_m']:.0f}", *errors, str(r["loops"]),
                      str(r["wrong_loops"]))  # fmt: skip
    return table
