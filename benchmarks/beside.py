# SPDX-License-Identifier: Apache-2.0
"""A robot with its own odometry, whose wheels slip and jump: the map with that odometry, and without it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from benchmarks.harness import Options, Report, settings_of
from benchmarks.imu import LIDAR
from dpm2_core.console import progress_bar
from dpm2_core.evaluation.metrics import ape_rmse
from dpm2_core.frame import Array, Frame, Guess
from dpm2_core.sim.sensors import real_sensor
from dpm2_core.sim.settings import PresetName
from dpm2_core.sim.simulated_drive import Ride, TurningRobot, wheel_odometry
from dpm2_core.sim.world import build_world
from dpm2_core.slam.build import make_slam
from dpm2_core.slam.settings import SlamSettings
from dpm2_core.tables import FigureTable, record_table

WORLDS: dict[str, tuple[str, PresetName, int, float]] = {
    "suburb": ("loop", "suburb", 920, 4.0),
    "car park": ("loop", "car_park", 921, 2.0),
    "building": ("loop", "indoor", 922, 1.2),
    "tunnel": ("straight", "tunnel", 923, 8.0),
}
"""Road, type of environment, seed, speed in m/s."""
FRAMES = 300
SLIP, JUMP = 0.02, 0.5
"""Fraction of the distance; and m, once in the middle."""
WAYS: dict[str, tuple[float, float, int] | None] = {
    "own": None,
    "slip": (SLIP, 0.0, FRAMES),
    "slip and jump": (SLIP, JUMP, FRAMES),
    "slip, then stops": (SLIP, 0.0, FRAMES // 2),
}
"""Slip, jump, and number of frames with the odometry; None: the SLAM runs alone."""


def bench_beside(options: Options) -> Report:
    """Each world once, with map and loops; no IMU."""
    settings, results = settings_of(options), dict[str, Any]()
    with progress_bar() as progress:
        for name, (road, preset, seed, speed) in WORLDS.items():
            robot = TurningRobot(build_world(road, preset, seed), FRAMES, Ride(speed), real_sensor(LIDAR))
            frames = list(progress.track(robot.frames(), total=FRAMES, description=name))
            results[name] = {way: _drive(_with(frames, robot.poses, wrong), robot.poses, settings)
                             for way, wrong in WAYS.items()}  # fmt: skip
            progress.console.print(f"{name}: {results[name]}", soft_wrap=True)
    known = {"beams": LIDAR.beams, "frames": FRAMES, "slip": SLIP, "jump_m": JUMP}
    return Report({**known, "worlds": results}, _table(results))


def _with(frames: Sequence[Frame], truth: Array, wrong: tuple[float, float, int] | None) -> Sequence[Frame]:
    if wrong is None:
        return frames
    slip, jump, count = wrong
    poses = wheel_odometry(truth, slip, jump)
    return [replace(frame, guess=Guess(poses[frame.index])) if frame.index < count else frame for frame in frames]


def _drive(frames: Sequence[Frame], truth: Array, settings: SlamSettings) -> dict[str, Any]:
    slam = make_slam(settings)
    tracked = [slam.process(frame).odometry for frame in frames]
    slam.finish()
    mapper = slam.mapper
    of = [keyframe.index for keyframe in mapper.keyframes]
    return {
        "failed_frames": sum(not one.registration.ok for one in tracked),
        "frames_led": sum(one.comparison is not None and one.comparison.used for one in tracked),
        "ape_rmse_m": ape_rmse(truth, np.array([one.T_odom_lidar for one in tracked])),
        "map_ape_rmse_m": ape_rmse(truth[of], np.array(mapper.poses)),
        "keyframes": len(of),
        "loops": sum(loop.ok for loop in mapper.loops),
    }


def _table(worlds: dict[str, Any]) -> FigureTable:
    columns = {f"map APE m, {way}": f"{{{way}[map_ape_rmse_m]:.3f}}" for way in WAYS}
    columns |= {f"frames led, {way}": f"{{{way}[frames_led]}}" for way in WAYS}
    return record_table(f"With another odometry of {100 * SLIP:g} % slip", ["world"], columns, worlds)
