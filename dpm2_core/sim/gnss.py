# SPDX-License-Identifier: Apache-2.0
"""A GNSS receiver that moves along given poses: positions with the errors of a real receiver."""

from __future__ import annotations

import numpy as np

from dpm2_core.frame import Array
from dpm2_core.geometry import geodesy, se3
from dpm2_core.sim.settings import GnssConfig

ORIGIN = (49.0, 8.4, 110.0)
"""Position of every world: latitude and longitude, deg, altitude above the ellipsoid, m. Its x axis points east."""
_FIRST_FIX = 0.03  # s after the first scan: a fix is between two scans


class Receiver:
    """A receiver, with the position of its world on Earth and of its antenna on the LiDAR.

    Attributes:
        T_ecef_world: (4, 4): x is east, y north, z up at the origin. antenna: (3,) m, in the LiDAR frame.
    """

    def __init__(self, config: GnssConfig, rng: np.random.Generator) -> None:
        """`rng` draws the noise."""
        self.config, self._rng = config, rng
        self.T_ecef_world: Array = geodesy.enu_frame(ORIGIN)
        self.antenna = np.array(config.antenna, np.float64)
        self.sigmas = np.hypot(config.noise, config.wander) * np.array([1.0, 1.0, 2.0])

    def times(self, end: float) -> Array:
        """(K,) s up to the end, at its rate."""
        return np.arange(_FIRST_FIX, end, 1 / self.config.rate)

    def measure(self, T_world_lidar: Array) -> Array:
        """(K, 3) latitude and longitude, deg, and altitude, m, for (K, 4, 4) poses at its times."""
        c, count = self.config, len(T_world_lidar)
        noise, wander = self._rng.standard_normal((2, count, 3)) * [1.0, 1.0, 2.0]
        correlation = np.exp(-1 / (c.rate * c.wander_time))
        for k in range(1, count):  # Gauss-Markov: the same standard deviation at all times
            wander[k] = correlation * wander[k - 1] + np.sqrt(1 - correlation**2) * wander[k]
        local = (T_world_lidar @ np.append(self.antenna, 1))[:, :3] + c.noise * noise + c.wander * wander
        return geodesy.geodetic(se3.transform(self.T_ecef_world, local))
