# SPDX-License-Identifier: Apache-2.0
"""SLAM in buildings with the settings of nobody: 16 beams that err as real ones, rooms, corridors, halls and stairs.

Then visits to each, at random places and headings: each is looked for in all maps and should be found in its own alone.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np
from rich.console import Group
from rich.progress import Progress

from benchmarks.harness import Options, Report, settings_of
from benchmarks.relocalise import success_rates
from dpm2_core.data.kitti import KittiSource
from dpm2_core.data.settings import InputSettings
from dpm2_core.evaluation.metrics import evaluate
from dpm2_core.frame import Array, Frame, Keyframe
from dpm2_core.geometry import se3
from dpm2_core.sim.drive import fitting_length, simulate
from dpm2_core.sim.lidar import Lidar
from dpm2_core.sim.sensors import real_sensor
from dpm2_core.sim.settings import DriveConfig, LidarConfig, PresetName
from dpm2_core.sim.world import build_world
from dpm2_core.slam.build import make_localizer, make_slam
from dpm2_core.slam.loops.relocalization import downsampled
from dpm2_core.slam.mapping.mapper import Mapper
from dpm2_core.slam.output import TrajectoryRecorder
from dpm2_core.slam.preprocess import Preprocessor
from dpm2_core.slam.settings import SlamSettings
from dpm2_core.tables import FigureTable

WORLDS: dict[str, tuple[PresetName, int, int]] = {
    "building A": ("indoor", 900, 500), "building B": ("indoor", 901, 500),
    "car park A": ("car_park", 902, 300), "car park B": ("car_park", 903, 300),
}  # fmt: skip
"""Kind of world, its seed, and frames at 10 Hz."""
BEAMS, HEIGHT = 16, 0.8
LENGTHS = (5.0, 10.0, 20.0)
"""Of the KITTI metric's segments, m."""
WRONG_M, WRONG_DEG = 0.5, 5.0
"""A loop that is off by more than either is wrong: the next room."""
VISITS, VISITS_SEED = 60, 5
"""Random places and headings in each world."""


@dataclass(frozen=True)
class Visit:
    """A scan as the SLAM keeps it, and T_map_lidar (4, 4) in the map of its own world."""

    keyframe: Keyframe
    truth: Array


def bench_indoor(options: Options) -> Report:
    """Each world once, with default settings: frames registered, errors, loops; then visits to each."""
    settings, results = settings_of(options), dict[str, Any]()
    mappers, visits = dict[str, Mapper](), dict[str, list[Visit]]()
    with Progress(transient=True) as progress, tempfile.TemporaryDirectory() as folder:
        for name, (preset, seed, frames) in WORLDS.items():
            lidar = real_sensor(LidarConfig(beams=BEAMS, height=HEIGHT))
            config = DriveConfig(frames=frames, seed=seed, road="loop", preset=preset, images=False, lidar=lidar)
            simulate(Path(folder) / str(seed), config)
            results[name], mappers[name] = _drive(Path(folder) / str(seed), settings, progress, name)
            progress.console.print(f"{name}: {results[name]}", soft_wrap=True)
            suited = settings.indoors() if results[name]["preset"] == "indoor" else settings
            visits[name] = list(_visits(config, suited))
        for name, mapper in mappers.items():
            found = _found(settings, mapper, visits, name)
            results[name]["relocalisation"] = found
            progress.console.print(f"{name}: {found}", soft_wrap=True)
    table = Group(_table(results), _relocalisation_table(results))
    return Report({"beams": BEAMS, "height_m": HEIGHT, "lengths_m": LENGTHS, "worlds": results}, table)


def _drive(path: Path, settings: SlamSettings, progress: Progress, name: str) -> tuple[dict[str, Any], Mapper]:
    source = KittiSource(path, InputSettings(images=False))
    assert source.poses is not None
    slam, recorder, failed = make_slam(settings), TrajectoryRecorder(), 0
    task = progress.add_task(name, total=len(source))
    for frame in source.frames():
        tracked = slam.process(frame).odometry
        recorder.add(tracked)
        failed += not tracked.registration.ok
        progress.advance(task)
    mapper = slam.mapper
    alone = recorder.poses(np.array([k.T_odom_kf for k in mapper.keyframes]))
    errors = {"odometry": evaluate(source.poses, alone, LENGTHS),
              "slam": evaluate(source.poses, recorder.poses(mapper.poses), LENGTHS)}  # fmt: skip
    truth = source.poses[[k.index for k in mapper.keyframes]]
    off = [_off(truth, loop.from_node, loop.to_node, loop.T_from_to) for loop in mapper.loops if loop.ok]
    return {
        "preset": slam.odometry.scale,
        "frames": len(source),
        "failed_frames": failed,
        "breaks": recorder.breaks,
        "path_length_m": errors["slam"].path_length_m,
        **{kind: {"t_err_percent": m.t_err_percent, "ape_rmse_m": m.ape_rmse_m} for kind, m in errors.items()},
        "keyframes": len(mapper.keyframes),
        "loops": len(off),
        "wrong_loops": sum(meters > WRONG_M or degrees > WRONG_DEG for meters, degrees in off),
        "worst_loop_m": max((meters for meters, _ in off), default=None),
    }, mapper


def _visits(config: DriveConfig, settings: SlamSettings) -> Iterator[Visit]:
    """Random visits to the world of a drive, whose map begins where the drive does."""
    world = build_world(config.road, config.preset, config.seed, fitting_length(config))
    lidar, rng = Lidar(config.lidar), np.random.default_rng(VISITS_SEED)
    T_map_world = se3.inverse(world.drive_pose(0.0, HEIGHT))
    for i in range(VISITS):
        T, time = world.sample_pose(rng, height=HEIGHT, sway=config.lidar.real.sway)
        T = T @ se3.exp(np.array([0, 0, rng.uniform(-np.pi, np.pi), 0, 0, 0]))
        points = Preprocessor(settings.preprocess).measured(
            Frame(0, lidar.scan(world, T, time, rng).points), np.zeros(6)
        )
        cloud = downsampled(points, settings.keyframes.voxel, settings.keyframes.range)
        yield Visit(Keyframe(i, 0, i, np.eye(4), cloud), T_map_world @ T)


def _found(settings: SlamSettings, mapper: Mapper, visits: dict[str, list[Visit]], home: str) -> dict[str, Any]:
    """Visits to the world of the map, and how many of those to the other worlds it takes for its own."""
    rows, mistaken = [], 0
    for name, of_world in visits.items():
        for visit in of_world:
            localizer, started = make_localizer(settings, mapper), perf_counter()
            found = localizer.add(visit.keyframe).registration
            if name == home:
                off = se3.magnitude(se3.inverse(found.T_target_source) @ visit.truth)
                rows.append((found.ok, *off, perf_counter() - started))
            else:
                mistaken += found.ok
    return {**success_rates(rows), "other_worlds": VISITS * (len(visits) - 1), "mistaken": mistaken}


def _off(truth: Array, a: int, b: int, T_a_b: Array) -> tuple[float, float]:
    return se3.magnitude(se3.inverse(se3.inverse(truth[a]) @ truth[b]) @ T_a_b)


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


def _relocalisation_table(worlds: dict[str, Any]) -> FigureTable:
    figures = ("right %", "no answer", "wrong", "median m", "other worlds' taken for it", "p95 s")
    table = FigureTable("relocalization from one scan, without a prior", names=["world"], figures=figures)
    for name, world in worlds.items():
        r = world["relocalisation"]
        median = "-" if r["median_error_m"] is None else f"{r['median_error_m']:.3f}"
        table.add_row(name, f"{100 * r['right']:.0f}", f"{r['no_answer']} of {r['visits']}", str(r["wrong"]), median,
                      f"{r['mistaken']} of {r['other_worlds']}", f"{r['seconds']['p95']:.2f}")  # fmt: skip
    return table
