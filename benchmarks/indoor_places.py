# SPDX-License-Identifier: Apache-2.0
"""Indoor places: relocalization from one scan in a map, and drives joined into one map, or correctly left apart."""

from __future__ import annotations

import tempfile
from collections import Counter
from dataclasses import dataclass
from itertools import permutations
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.loops import error_of
from benchmarks.relocalise_visits import evaluate_visit, keyframe_cloud, preprocessed, success_rates
from dpm2_core.data.corrupt import in_dust
from dpm2_core.data.kitti import KittiSource
from dpm2_core.data.settings import InputSettings
from dpm2_core.estimates import Edge, Keyframe
from dpm2_core.frame import Array, Frame
from dpm2_core.geometry import se3
from dpm2_core.pipeline import OfflineRun
from dpm2_core.sim.drive import fitting_length
from dpm2_core.sim.lidar import Lidar
from dpm2_core.sim.settings import DriveConfig
from dpm2_core.sim.world import build_world
from dpm2_core.slam.build import make_localizer
from dpm2_core.slam.mapping.mapper import Mapper
from dpm2_core.slam.settings import Config, SlamSettings
from dpm2_core.tables import FigureTable, record_table

HEIGHT = 0.8
"""Height of the LiDAR above the floor, m."""
VISITS, VISITS_SEED = 60, 5
"""Number of random positions and headings in each world, and the seed."""
DUST = 0.3
"""Fraction of the pulses that hit dust in a second set of visits; the maps are made without dust."""
WRONG_M, WRONG_DEG = 0.5, 5.0
"""A loop with a larger error than either is wrong, such as to the next room."""


@dataclass(frozen=True)
class Visit:
    """A scan as the SLAM stores it, and T_map_lidar (4, 4) in the map of its own world."""

    keyframe: Keyframe
    truth: Array


def visits_to(config: DriveConfig, settings: SlamSettings) -> tuple[list[Visit], list[Visit]]:
    """Random visits to the world of a drive, whose map begins where the drive does; and the same scans in dust."""
    world = build_world(config.road, config.preset, config.seed, fitting_length(config))
    lidar, rng = Lidar(config.lidar), np.random.default_rng(VISITS_SEED)
    T_map_world, clean, dusty = se3.inverse(world.drive_pose(0.0, HEIGHT)), list[Visit](), list[Visit]()
    for i in range(VISITS):
        T, time = world.sample_pose(rng, height=HEIGHT, sway=config.lidar.real.sway)
        T = T @ se3.exp(np.array([0, 0, rng.uniform(-np.pi, np.pi), 0, 0, 0]))
        scan = lidar.scan(world, T, time, rng).points
        for visits, points in ((clean, scan), (dusty, in_dust(scan, DUST, np.random.default_rng(i)))):
            cloud = keyframe_cloud(preprocessed(Frame(0, points), settings), settings)
            visits.append(Visit(Keyframe(i, 0, i, np.eye(4), cloud), T_map_world @ T))
    return clean, dusty


def relocalised(settings: SlamSettings, mapper: Mapper, visits: dict[str, list[Visit]], home: str) -> dict[str, Any]:
    """Visits to the world of the map, and how many visits to other worlds are wrongly located in the map."""
    localizer, rows, mistaken = make_localizer(settings, mapper), [], 0
    for name, world_visits in visits.items():
        for visit in world_visits:
            localizer.restart()
            row = evaluate_visit(lambda keyframe: localizer.add(keyframe).registration, visit.keyframe, visit.truth)
            if name == home:
                rows.append(row)
            else:
                mistaken += row[0]
    return {**success_rates(rows), "other_worlds": VISITS * (len(visits) - 1), "mistaken": mistaken}


def joins(drive: Path, settings: SlamSettings) -> dict[str, int]:
    """Each ordered pair of thirds of a drive in one map: how many are joined correctly, wrongly, or not at all."""
    source = KittiSource(drive, InputSettings(images=False))
    config = Config(input=InputSettings(images=False), slam=settings)
    assert source.poses is not None
    third, found = len(source) // 3, Counter[str]()
    for first, second in permutations([(0, third), (third, 2 * third), (2 * third, 3 * third)], 2):
        with tempfile.TemporaryDirectory() as folder:
            file = Path(folder) / "map.dpm2map"
            with OfflineRun(drive, config, frames=first, map_file=file) as run:
                run.run()
            with OfflineRun(drive, config, frames=second, map_file=file, map_mode="extend") as run:
                run.run()
                found[_join_verdict(run.slam.mapper, source.poses)] += 1
    return {kind: found[kind] for kind in ("right", "apart", "wrong")}


def _join_verdict(mapper: Mapper, truth: Array) -> str:
    start = mapper.session_start
    truth = truth[[keyframe.index for keyframe in mapper.keyframes]]
    joining_loops = [loop for loop in mapper.loops if loop.ok and (loop.from_node < start) != (loop.to_node < start)]
    if not joining_loops:
        return "apart"
    return "wrong" if any(is_wrong(truth, loop) for loop in joining_loops) else "right"


def is_wrong(truth: Array, loop: Edge) -> bool:
    """Whether a loop between keyframes at `truth` (N, 4, 4) leads to another place, such as the next room."""
    meters, degrees = error_of(loop, truth)
    return meters > WRONG_M or degrees > WRONG_DEG


def relocalise_table(worlds: dict[str, Any], key: str, title: str) -> FigureTable:
    """The results of `relocalised` under a key."""
    figures = ("right %", "no answer", "wrong", "median m", "other worlds' taken for it", "p95 s")
    table = FigureTable(title, names=["world"], figures=figures)
    for name, world in worlds.items():
        r = world[key]
        median = "-" if r["median_error_m"] is None else f"{r['median_error_m']:.3f}"
        table.add_row(name, f"{100 * r['right']:.0f}", f"{r['no_answer']} of {r['visits']}", str(r["wrong"]), median,
                      f"{r['mistaken']} of {r['other_worlds']}", f"{r['seconds']['p95']:.2f}")  # fmt: skip
    return table


def join_table(worlds: dict[str, Any]) -> FigureTable:
    """The results of `joins`."""
    columns = {kind: f"{{joins[{kind}]}}" for kind in ("right", "apart", "wrong")}
    return record_table("two thirds of a drive in one map", ["world"], columns, worlds)
