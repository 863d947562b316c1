# SPDX-License-Identifier: Apache-2.0
"""Sweeps in motion: raw scans, with the time of each point, of LiDARs on a car, on foot, on legs and in the air.

No IMU. The velocity changes within each sweep, which distorts its scan; measured is the step from scan to scan.
"""

from __future__ import annotations

from collections.abc import Iterable
from functools import partial
from typing import Any

import numpy as np

from benchmarks.harness import Options, Report, installed, settings_of
from dpm2_core.console import progress_bar
from dpm2_core.data.trajectory import FRAME_PERIOD
from dpm2_core.experiments.peers import KissIcp
from dpm2_core.frame import Array, Frame
from dpm2_core.geometry import se3
from dpm2_core.sim.sensors import real_sensor
from dpm2_core.sim.settings import LidarConfig, PresetName
from dpm2_core.sim.simulated_drive import RIDES, TurningRobot
from dpm2_core.sim.world import build_world
from dpm2_core.slam.build import make_odometry
from dpm2_core.slam.settings import SlamSettings
from dpm2_core.tables import FigureTable, record_table

WORLDS: dict[str, tuple[PresetName, int, int, tuple[str, ...]]] = {
    "suburb": ("suburb", 920, 32, tuple(RIDES)),
    "building": ("indoor", 921, 16, ("walking", "waved", "legged")),
}
"""Type of environment, seed, beams, and the rides through it."""
FRAMES = 150
OURS, BASELINE = ("dpm2", "dpm2 geometric"), "kiss-icp"
_FIRST_EVALUATED = 20  # frames, after which all shakes have begun


def bench_motion(options: Options) -> Report:
    """Each ride once: the odometry alone with default settings, without the network, and KISS-ICP."""
    results = dict[str, Any]()
    settings = [settings_of(options), settings_of(options, "slam.registration=geometric")]
    with progress_bar() as progress:
        for place, (preset, seed, beams, rides) in WORLDS.items():
            world = build_world("loop", preset, seed)
            for name in rides:
                lidar = LidarConfig(beams=beams, columns=1024, height=1.4, car_body=False, min_range=0.4)
                robot = TurningRobot(world, FRAMES, RIDES[name], real_sensor(lidar))
                task = f"{place}, {name}"
                frames = list(progress.track(robot.frames(), total=FRAMES, description=task))
                results[task] = {variant: _ours(frames, robot, s) for variant, s in zip(OURS, settings, strict=True)}
                results[task] |= installed({BASELINE: partial(_kiss, frames, robot, options.threads)})
                progress.console.print(f"{task}: {results[task]}", soft_wrap=True)
    return Report({"frames": FRAMES, "rides": results}, _table(results))


def _ours(frames: Iterable[Frame], robot: TurningRobot, settings: SlamSettings) -> dict[str, Any]:
    tracked = list(map(make_odometry(settings).process, frames))
    failed = sum(not one.registration.ok for one in tracked)
    return {**_errors(np.array([one.T_odom_lidar for one in tracked]), robot.poses), "failed_frames": failed}


def _kiss(frames: Iterable[Frame], robot: TurningRobot, threads: int) -> dict[str, Any]:
    """Compared with the truth in the middle and at the end of the sweeps; the better result counts.

    Raises:
        MissingPackageError: it is not installed.
    """
    peer = KissIcp(threads, deskew=True)
    for frame in frames:
        peer.add(frame)
    at_end = robot.pose(robot.times + FRAME_PERIOD / 2)
    return min((_errors(peer.poses(), truth) for truth in (robot.poses, at_end)), key=lambda e: float(e["rpe_m"]))


def _errors(poses: Array, truth: Array) -> dict[str, float]:
    """Errors of the steps from scan to scan: root mean square, and largest."""
    steps, true = (se3.inverse(T[:-1]) @ T[1:] for T in (poses, truth))
    differences = np.array([se3.magnitude(T) for T in (se3.inverse(true) @ steps)[_FIRST_EVALUATED:]])
    rms, worst = np.sqrt((differences**2).mean(0)), differences.max(0)
    return dict(zip(("rpe_m", "rpe_deg", "worst_m", "worst_deg"), [*rms.tolist(), *worst.tolist()], strict=True))


def _table(rides: dict[str, Any]) -> FigureTable:
    methods = [*OURS, *([BASELINE] if all(BASELINE in r for r in rides.values()) else [])]
    columns = {f"{unit}, {name}": f"{{{name}[rpe_{unit}]:.3f}}" for unit in ("m", "deg") for name in methods}
    return record_table("from scan to scan, root mean square", ["ride"], columns, rides)
