# SPDX-License-Identifier: Apache-2.0
"""`python -m benchmarks.smooth_tunnels`: position error of a car in tunnels in which no scan shows the motion along
the road, with an IMU and without.

Simulated, without intensities, at 10 m/s with changes of up to 2 m/s2. For the first 6 s another odometry gives the
motion.
"""

from __future__ import annotations

import sys
from collections.abc import Iterable
from dataclasses import replace

import numpy as np

from dpm2_core.commands.options import run_command
from dpm2_core.console import Console, tracked
from dpm2_core.frame import Array, Frame, Guess
from dpm2_core.geometry import se3
from dpm2_core.sim.settings import ImuConfig, LidarConfig
from dpm2_core.sim.simulated_drive import Ride, TurningRobot
from dpm2_core.sim.world import build_world
from dpm2_core.slam.build import make_odometry
from dpm2_core.slam.settings import SlamSettings
from dpm2_core.tables import FigureTable

SEEDS = (3, 4, 5, 7, 8, 9)
"""Seeds of the tunnels."""
KNOWN = 60
"""Frames for which another odometry gives the motion; after them there is none."""
AFTER = (40, 70)
"""Frames without it after which the error is measured, at 10 frames per second."""


def bench() -> int:
    """Errors in each tunnel."""
    headings = [f"{variant} IMU, m after {n / 10:g} s" for variant in ("with", "without") for n in AFTER]
    table = FigureTable("Smooth tunnels", names=["tunnel"], figures=headings)
    for seed in tracked(SEEDS, "tunnels"):
        frames, truth = drive(seed)
        without_imu = (replace(f, imu=None) for f in frames)
        table.add_row(
            str(seed), *(f"{error:.2f}" for inputs in (frames, without_imu) for error in errors(inputs, truth))
        )
    Console().print(table)
    return 0


def drive(seed: int) -> tuple[list[Frame], Array]:
    """Frames, of which the first `KNOWN` have a guess from another odometry, and true poses (N, 4, 4)."""
    world = build_world("straight", "tunnel", seed=seed, length=200.0)
    lidar = LidarConfig(beams=16, columns=512)
    car = TurningRobot(world, KNOWN + max(AFTER), Ride(10.0, slows=0.8), lidar, ImuConfig())
    without_intensity = [
        replace(frame, points=frame.points * np.array([1, 1, 1, 0], np.float32)) for frame in car.frames()
    ]
    with_guess = (
        replace(frame, guess=Guess(T)) for frame, T in zip(without_intensity[:KNOWN], car.poses, strict=False)
    )
    return [*with_guess, *without_intensity[KNOWN:]], car.poses


def errors(frames: Iterable[Frame], truth: Array) -> list[float]:
    """Position error, m, after each of `AFTER`."""
    settings = SlamSettings.model_validate({"registration": "geometric"})
    poses = np.array([t.T_odom_lidar for t in map(make_odometry(settings).process, frames)])
    T_error = se3.inverse(se3.inverse(truth[:1]) @ truth) @ se3.inverse(poses[:1]) @ poses
    return [float(np.linalg.norm(T_error[KNOWN + n - 1, :3, 3])) for n in AFTER]


if __name__ == "__main__":
    sys.exit(run_command(bench))
