# SPDX-License-Identifier: Apache-2.0
"""Compares the errors of the simulated LiDAR with a real one: the same figures for both, and for the clean sensor."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import numpy as np

from benchmarks.figures import lines_png
from benchmarks.harness import Options, Report, drives
from benchmarks.scan_statistics import RANGES, statistics
from dpm2_core.geometry.sampling import evenly
from dpm2_core.sim.lidar import Lidar
from dpm2_core.sim.settings import HDL64E, LidarConfig, PresetName
from dpm2_core.sim.world import build_world
from dpm2_core.tables import FigureTable, cells_of

_SCANS = 20
_SEEDS = (900_500, 900_501)
_KINDS: tuple[PresetName, ...] = ("city", "suburb")


def bench_sensor(options: Options) -> Report:
    """Statistics of the real scans, of `HDL64E` and of the clean sensor in the same worlds, and a figure of them.

    Raises:
        UsageError: there is no drive.
    """
    real = []
    with drives(options) as sources:
        for source in sources.values():
            chosen = evenly(len(source), _SCANS // len(sources)).tolist()
            real += [frame.points for i, frame in enumerate(source.frames()) if i in chosen]
    results = {
        "real": statistics(real),
        "HDL64E": statistics(_simulated(HDL64E)),
        "clean": statistics(_simulated(LidarConfig())),
    }
    _figure(options, results)
    return Report({"ranges_m": RANGES, "sensors": results}, _table(results))


def _simulated(config: LidarConfig) -> list[np.ndarray]:
    """Scans of drives in towns, similar to the drives of the excerpt."""
    lidar, out = Lidar(config), []
    for kind in _KINDS:
        for seed in _SEEDS:
            world, rng = build_world("random", kind, seed, 300.0), np.random.default_rng(seed)
            for time in np.linspace(0, 15, _SCANS // (len(_KINDS) * len(_SEEDS))).tolist():
                out.append(lidar.drive_scan(world, lidar.pose(world, time), time, rng).points)
    return out


def _figure(options: Options, results: dict[str, Any]) -> None:
    middle = [float(np.sqrt(a * b)) for a, b in pairwise(RANGES)]
    gaps = {name: (-np.diff(row["elevations_deg"])).tolist() for name, row in results.items()}
    panels: dict[str, dict[str, tuple[list[float], list[float | None]]]] = {
        "gap to the next ring, deg, by ring": {
            name: ([float(k) for k in range(len(row))], row) for name, row in gaps.items()
        },
        "noise along a ring, m, by range": {n: (middle, row["ring_range_noise_m"]) for n, row in results.items()},
        "distance of ground to its plane, m, by range": {n: (middle, r["plane_rms_m"]) for n, r in results.items()},
        "pulses lost between two of one surface, by range": {n: (middle, r["lost"]) for n, r in results.items()},
        "intensity, fraction of returns": {
            n: (np.linspace(0.025, 0.975, 20).tolist(), r["intensity"]["histogram"]) for n, r in results.items()
        },
    }
    lines_png(options.out / "sensor.png", panels, "A real LiDAR (KITTI) and the simulated one")


_ROWS = {
    "points": "points",
    "gap between upper rings, deviation, deg": "ring_gap_deg[0][1]",
    "gap between lower rings, deviation, deg": "ring_gap_deg[1][1]",
    "origin of the upper beams over the sensor's, m": "upper_origin_m",
    "elevation beside that, deviation, deg": "wobble_deg",
    "mean of a ring over the ground, deviation, m": "ring_bias_m",
    "noise along a ring at 10 to 15 m, m": "ring_range_noise_m[1]",
    "at 30 to 45 m, m": "ring_range_noise_m[4]",
    "lost at 5 to 10 m": "lost[0]",
    "lost at 45 to 75 m": "lost[5]",
    "intensity 0": "intensity[zeros]",
}


def _table(results: dict[str, Any]) -> FigureTable:
    table = FigureTable("The sensor's own errors", names=["figure"], figures=list(results))
    for name, figure in _ROWS.items():
        table.add_row(name, *(cells_of(of, [f"{{{figure}:.3g}}"])[0] for of in results.values()))
    return table
