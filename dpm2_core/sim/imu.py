# SPDX-License-Identifier: Apache-2.0
"""An IMU that moves along given poses: angular rates and specific forces with the errors of a real sensor."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.spatial.transform import Rotation

from dpm2_core.frame import Array
from dpm2_core.geometry import se3
from dpm2_core.sim.settings import ImuConfig

GRAVITY = 9.81
RATE = 100.0
"""Samples per second; each is the mean over two periods, which simulates the sensor's low-pass filter."""
_MOUNT_YAW = 90.0  # deg to the left, of the mount: its axes differ from those of the LiDAR


class Imu:
    """One sensor, with its own biases.

    Attributes:
        R_lidar_imu: (3, 3) rotation from the calibration, without the mount's error.
    """

    def __init__(self, config: ImuConfig, rng: np.random.Generator) -> None:
        """`rng` draws the sensor's errors, and then its noise."""
        self.config, self._rng = config, rng
        self.R_lidar_imu: Array = Rotation.from_euler("z", _MOUNT_YAW, degrees=True).as_matrix()
        R_misaligned = Rotation.from_rotvec(np.radians(config.misaligned) * rng.standard_normal(3)).as_matrix()
        self._R_imu_lidar = (self.R_lidar_imu @ R_misaligned).T
        self._gyro_scale, self._force_scale = 1 + config.scale * rng.standard_normal((2, 3))
        self._gyro_bias = config.gyro_bias * rng.standard_normal(3)
        self._force_bias = config.acceleration_bias * rng.standard_normal(3)

    def times(self, start: float, end: float) -> Array:
        """(K,) s from start to end, at its rate."""
        return np.arange(round(start * RATE), round(end * RATE) + 1) / RATE

    def measure(self, times: Array, poses: Callable[[Array], Array]) -> tuple[Array, Array]:
        """Rates (K, 3) rad/s and forces (K, 3) m/s2 along its own axes.

        Args:
            times: (K,) s, evenly spaced. poses: T_world_lidar (M, 4, 4) at times (M,) s; z is up.
        """
        c, period, count = self.config, 1 / RATE, len(times)
        T = poses(np.concatenate([times[:1] - period, times, times[-1:] + period]))
        rates = se3.way(T[:-2], T[2:])[:, :3] / (2 * period)
        accelerations = (T[2:, :3, 3] - 2 * T[1:-1, :3, 3] + T[:-2, :3, 3]) / period**2
        forces = np.einsum("nji,nj->ni", T[1:-1, :3, :3], accelerations + np.array([0, 0, GRAVITY]))
        drift = np.cumsum(self._rng.standard_normal((count, 3)), 0) * 0.01 * c.gyro_bias * period**0.5
        rates = rates @ self._R_imu_lidar.T * self._gyro_scale + self._gyro_bias + drift
        forces = forces @ self._R_imu_lidar.T * self._force_scale + self._force_bias
        noise = self._rng.standard_normal((2, count, 3))
        return rates + c.gyro_noise * noise[0], forces + c.acceleration_noise * noise[1]
