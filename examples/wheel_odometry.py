# SPDX-License-Identifier: Apache-2.0
"""LiDAR odometry that starts its search for the pose at the pose of the wheel odometry.

python examples/wheel_odometry.py RECORDING STEP

Takes every STEP-th scan of a recording with ground truth, simulates noisy wheel odometry from it (2 % of the distance),
and prints the error of odometry by point-to-plane registration alone, without and with the wheels. If scans are 10 m
apart, the points do not determine the motion; the wheels provide it.
"""

import itertools
import sys
from dataclasses import replace

import numpy as np

from dpm2_core import Guess, SlamSettings, make_odometry, open_source
from dpm2_core.geometry import se3


def wheels_of(poses: np.ndarray, noise: np.random.Generator) -> np.ndarray:
    """Simulated wheel odometry (N, 4, 4) from true poses (N, 4, 4): errors of 2 % and 0.05 degrees per step."""
    measured = [poses[0]]
    for before, now in itertools.pairwise(poses):
        step = se3.way(before, now)
        step[3:] *= 1 + noise.normal(0, 0.02)
        step[2] += noise.normal(0, np.radians(0.05))
        measured.append(measured[-1] @ se3.exp(step))
    return np.array(measured)


def main() -> None:
    """Compare the odometry without and with the wheels."""
    source, step = open_source(sys.argv[1]), int(sys.argv[2])
    if source.poses is None:
        sys.exit(f"{sys.argv[1]}: no ground truth to make wheel odometry from")
    settings = SlamSettings(registration="geometric")
    frames = list(source.frames())[::step]
    truth = source.poses[::step]
    wheels = wheels_of(truth, np.random.default_rng(0))
    with_wheels = [replace(frame, guess=Guess(T)) for frame, T in zip(frames, wheels, strict=True)]
    for name, drive in (("points alone", frames), ("with wheels", with_wheels)):
        odometry = make_odometry(settings)
        results = [odometry.process(frame) for frame in drive]
        T_last = se3.inverse(truth[0]) @ truth[-1]
        error = np.linalg.norm(results[-1].T_odom_lidar[:3, 3] - T_last[:3, 3])
        failed = sum(not result.registration.ok for result in results)
        print(f"{name}: {error:.2f} m off after {len(frames)} scans, {failed} of them not registered")


main()
