# SPDX-License-Identifier: Apache-2.0
"""Fuses wheel odometry: where the wheels say the robot is, the search for the pose begins.

python examples/wheel_odometry.py RECORDING STEP

Takes every STEP-th scan of a recording with ground truth, makes noisy wheel odometry from that (2 % of the way), and
prints the error of the odometry by points alone, without and with the wheels. Between scans that are 10 m apart the
points know nothing of the way; with the wheels they need not.
"""

import itertools
import sys
from collections.abc import Iterable
from dataclasses import replace
from typing import Any

import numpy as np

from dpm2_core import Frame, OdometryResult, SlamSettings, open_source
from dpm2_core.geometry import se3
from dpm2_core.slam.build import make_registration
from dpm2_core.slam.odometry.keyframe_selection import KeyframeSelector
from dpm2_core.slam.odometry.odometry import Odometry
from dpm2_core.slam.registration.protocol import Prediction, ScanRegistration


class WithWheels:
    """A registration whose prediction comes from wheels; for all else it is the one that it is put around.

    `wheels` gives T_start_base (4, 4) at a stamp (ns), drifting as wheels do, in the LiDAR's frame here.
    """

    def __init__(self, registration: ScanRegistration, wheels: dict[int, np.ndarray]) -> None:
        self._registration, self._wheels = registration, wheels
        self._before: tuple[int, np.ndarray] | None = None  # stamp and pose of the last scan that was registered
        self._stamp = 0

    def __getattr__(self, name: str) -> Any:
        return getattr(self._registration, name)  # clear, rejection, uses_images

    def __len__(self) -> int:
        return len(self._registration)

    def fresh(self) -> "WithWheels":
        """As the protocol says; the wheels are the same."""
        return WithWheels(self._registration.fresh(), self._wheels)

    def prepare(self, frame: Frame, twist: np.ndarray) -> Any:
        """Notes which scan comes now."""
        self._stamp = frame.stamp
        return self._registration.prepare(frame, twist)

    def register(self, scan: Any, prediction: Prediction) -> Any:
        """From where the wheels are, to 5 cm and half a degree, and 3 % of the way."""
        if self._before is not None:
            stamp, T_odom_before = self._before
            T_before_now = se3.inverse(self._wheels[stamp]) @ self._wheels[self._stamp]
            sigma = 0.05 + 0.03 * float(np.linalg.norm(T_before_now[:3, 3]))
            information = np.diag(np.repeat([np.radians(0.5), sigma], 3) ** -2.0)
            prediction = replace(prediction, starts=[T_odom_before @ T_before_now], information=information)
        return self._registration.register(scan, prediction)

    def update(self, scan: Any, T_odom_lidar: np.ndarray) -> bool:
        """The scan was registered there."""
        self._before = self._stamp, T_odom_lidar
        return self._registration.update(scan, T_odom_lidar)


def wheels_of(poses: np.ndarray, noise: np.random.Generator) -> np.ndarray:
    """(N, 4, 4) true poses as wheels measure them: each step is 2 % off, and each turn 0.05 degrees."""
    measured = [poses[0]]
    for before, now in itertools.pairwise(poses):
        step = se3.log(se3.inverse(before) @ now)
        step[3:] *= 1 + noise.normal(0, 0.02)
        step[2] += noise.normal(0, np.radians(0.05))
        measured.append(measured[-1] @ se3.exp(step))
    return np.array(measured)


def drive(frames: Iterable[Frame], registration: ScanRegistration, settings: SlamSettings) -> list[OdometryResult]:
    """Odometry with a registration."""
    # The vehicle may change its motion much between scans that are a second apart.
    odometry = Odometry(settings.odometry, registration, KeyframeSelector(settings.keyframes))
    return [odometry.process(frame) for frame in frames]


def main() -> None:
    """Compare without and with the wheels."""
    source, step = open_source(sys.argv[1]), int(sys.argv[2])
    if source.poses is None:
        sys.exit(f"{sys.argv[1]}: no ground truth to make wheel odometry from")
    settings = SlamSettings(registration="geometric")
    frames = list(source.frames())[::step]
    truth = source.poses[::step]
    wheels = wheels_of(truth, np.random.default_rng(0))
    by_stamp = {frame.stamp: T for frame, T in zip(frames, wheels, strict=True)}
    both = {
        "points alone": make_registration(settings),
        "with wheels": WithWheels(make_registration(settings), by_stamp),
    }
    for name, registration in both.items():
        results = drive(frames, registration, settings)
        T_last = se3.inverse(truth[0]) @ truth[-1]
        error = np.linalg.norm(results[-1].T_odom_lidar[:3, 3] - T_last[:3, 3])
        failed = sum(not result.registration.ok for result in results)
        print(f"{name}: {error:.2f} m off after {len(frames)} scans, {failed} of them not registered")


main()
