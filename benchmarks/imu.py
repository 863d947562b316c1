# SPDX-License-Identifier: Apache-2.0
"""Benefit of an IMU for a robot that rotates at 100 deg/s, and for a car, also one whose LiDAR pauses: the same scans
with an IMU, without, and with one that stops."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.console import Group

from benchmarks.gaps import evaluated, gaps, summary
from benchmarks.harness import Options, Report, settings_of
from dpm2_core.console import progress_bar
from dpm2_core.data.trajectory import FRAME_PERIOD
from dpm2_core.evaluation.metrics import evaluate, path_length
from dpm2_core.frame import Array, Frame
from dpm2_core.geometry import se3
from dpm2_core.sim.sensors import real_sensor
from dpm2_core.sim.settings import ImuConfig, LidarConfig, PresetName
from dpm2_core.sim.simulated_drive import Ride, TurningRobot
from dpm2_core.sim.world import build_world
from dpm2_core.slam.build import make_odometry
from dpm2_core.slam.settings import SlamSettings
from dpm2_core.tables import FigureTable, record_table

WORLDS: dict[str, tuple[PresetName, int, float, float]] = {
    "building": ("indoor", 910, 1.2, 0.0),
    "car park": ("car_park", 911, 3.0, 90.0),
    "suburb": ("suburb", 912, 2.0, 90.0),
    "streets": ("city", 914, 10.0, 0.0),
}
"""Type of environment, seed, speed in m/s, and angle in degrees by which the robot also rotates to either side."""
FRAMES = 200
LIDAR = LidarConfig(beams=16, columns=1024, height=0.8, car_body=False, min_range=0.4)
LENGTHS = (5.0, 10.0)
"""Lengths of the KITTI metric's segments, m."""
VARIANTS: dict[str, Callable[[Frame], Frame]] = {
    "without": lambda frame: replace(frame, imu=None),
    "with": lambda frame: frame,
    "stops": lambda frame: frame if frame.index < FRAMES // 2 else replace(frame, imu=None),
}
"""The input of the odometry for each frame."""
CAR_FRAMES = 260
CAR_LIDAR = LidarConfig()
CAR = Ride(10.0, slows=0.8)  # accelerations of up to 2 m/s2
_PAUSE_VARIANTS = ("without", "with")


def bench_imu(options: Options) -> Report:
    """Each world once, the odometry alone with default settings."""
    settings, results = settings_of(options), dict[str, Any]()
    imu = ImuConfig()
    with progress_bar() as progress:
        for name, (preset, seed, speed, swings) in WORLDS.items():
            world = build_world("loop", preset, seed)
            robot = TurningRobot(world, FRAMES, Ride(speed, swings), real_sensor(LIDAR), imu)
            frames = list(progress.track(robot.frames(), total=FRAMES, description=name))
            rates = _angular_rates(robot.poses)
            results[name] = {
                "frames": FRAMES,
                "path_length_m": path_length(robot.poses),
                "fastest_turn_deg_s": float(rates.max()),
                "frames_above_50_deg_s": int((rates > 50).sum()),
                **{variant: _drive(map(change, frames), robot.poses, settings) for variant, change in VARIANTS.items()},
            }
            results[name]["ratio"] = results[name]["with"]["ape_rmse_m"] / results[name]["without"]["ape_rmse_m"]
            progress.console.print(f"{name}: {results[name]}", soft_wrap=True)
        car = TurningRobot(build_world("loop", "suburb", 3), CAR_FRAMES, CAR, CAR_LIDAR, imu)
        frames = list(progress.track(car.frames(), total=CAR_FRAMES, description="car"))
        pauses = {
            variant: _pauses([VARIANTS[variant](frame) for frame in frames], car.poses, settings)
            for variant in _PAUSE_VARIANTS
        }
    known = {"beams": LIDAR.beams, "imu": imu.model_dump(), "lengths_m": LENGTHS}
    return Report({**known, "worlds": results, "pauses": pauses}, Group(_table(results), _table_of_pauses(pauses)))


def _pauses(frames: Sequence[Frame], truth: Array, settings: SlamSettings) -> dict[str, Any]:
    """Results after each of many gaps, and the error up to 3 s later, summarized by the length of the gap."""
    rows = [
        evaluated(frames, truth, gap, settings, warm=len(frames)) for gap in gaps([frame.stamp for frame in frames])
    ]
    found = summary(rows)
    for name, row in found.items():
        errors = [r["error_m"]["last"] for r in rows if name in ("all", f"{r['seconds']:g} s")]
        row |= {"median_error_m": float(np.median(errors)), "worst_error_m": max(errors)}
    return found


def _drive(frames: Iterable[Frame], truth: Array, settings: SlamSettings) -> dict[str, Any]:
    tracked = list(map(make_odometry(settings).process, frames))
    poses = np.array([one.T_odom_lidar for one in tracked])
    metrics = evaluate(truth, poses, LENGTHS)
    return {
        "failed_frames": sum(not one.registration.ok for one in tracked),
        "frames_with_imu": sum(one.imu == "" for one in tracked),
        "ape_rmse_m": metrics.ape_rmse_m,
        "t_err_percent": metrics.t_err_percent,
        "rpe_rot_deg": metrics.rpe_rot_deg,
        "worst_tilt_deg": float(_tilt(poses, truth).max()),
    }


def _angular_rates(poses: Array) -> NDArray[np.float64]:
    """Angular rate of each step, deg/s."""
    return np.degrees(se3.angle(se3.inverse(poses[:-1]) @ poses[1:])) / FRAME_PERIOD


def _tilt(poses: Array, truth: Array) -> NDArray[np.float64]:
    """Angle between the vertical of each pose and the true one, degrees."""
    up = np.einsum("nij,nkj->nik", poses[:, :3, :3], truth[:, :3, :3])[:, 2, 2]
    return np.degrees(np.arccos(np.clip(up, -1, 1)))


def _table(worlds: dict[str, Any]) -> FigureTable:
    columns = {f"APE m, {variant}": f"{{{variant}[ape_rmse_m]:.3f}}" for variant in VARIANTS}
    columns |= {f"worst tilt deg, {variant}": f"{{{variant}[worst_tilt_deg]:.3f}}" for variant in VARIANTS}
    columns |= {"with / without": "{ratio:.2f}"}
    return record_table(f"{LIDAR.beams} beams, rotations of 100 deg/s; streets: a car", ["world"], columns, worlds)


def _table_of_pauses(pauses: dict[str, Any]) -> FigureTable:
    columns = {"number": "{gaps}", "bridged": "{bridged}", "silently wrong": "{silently_wrong}",
               "median error up to 3 s after, m": "{median_error_m:.2f}", "worst": "{worst_error_m:.2f}"}  # fmt: skip
    return record_table(f"A car, {CAR_LIDAR.beams} beams, around a block", ["IMU", "pause"], columns, pauses)
