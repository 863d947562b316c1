# SPDX-License-Identifier: Apache-2.0
"""Motion in directions that scans do not constrain, with an IMU: while both agree the scans are used, else the IMU.

Not every direction with a large covariance is unconstrained: a few objects next to a road determine the motion all the
same, to some centimeters. Along a smooth tunnel a scan fits best where the map has the same density, at the previous
position: within a second that contradicts the accelerations.
"""

from __future__ import annotations

import numpy as np

from dpm2_core.frame import Array
from dpm2_core.slam.odometry.inertial import Reckoned

_DISTANCE_SIGMA, _SPEED_SIGMA = 0.1, 0.1  # m and m/s, of the distance by scans, and of the speed that they show
_MIN_SPAN = 1.0  # s over which the two are compared
_GAIN = 0.5  # fraction of the difference by which the speed is then corrected
_MAX_SIGMAS = 3.0


class OpenWay:
    """Position by an IMU alone from a registered frame on, with the velocity that scans show second by second.

    Attributes:
        velocity: (3,) m/s in the odometry's frame.
        leads: whether scans have contradicted it; from then on it is used.
        sigma: m, of the distance from the start. gained: increase by the last frame.
    """

    def __init__(self, T: Array, velocity: Array) -> None:
        """Start at T (4, 4), with a `velocity` (3,) m/s in its axes."""
        self.velocity, self.leads = T[:3, :3] @ velocity, False
        self.sigma = self.gained = self._sigma_before = 0.0
        self._position, self._seconds = T[:3, 3], 0.0

    def follow(self, T_before: Array, T: Array, along: Array, step: Reckoned, seconds: float) -> Array:
        """Offset (3,) m from a registered frame to this position in unconstrained directions, in the odometry's axes.

        Args:
            T: (4, 4) of the frame; T_before: of the last one, `seconds` before it. step: the motion between by the IMU.
            along: (3, 3) projection onto the unconstrained directions, in the axes of T.
        """
        R, projection = T_before[:3, :3], T[:3, :3] @ along @ T[:3, :3].T
        self._position = self._position + self.velocity * seconds + R @ step.gained[0]
        by_scans = (T[:3, 3] - T_before[:3, 3]) / seconds
        self.velocity = by_scans + projection @ (self.velocity + R @ step.gained[1] - by_scans)
        self._seconds += seconds
        offset = np.asarray(projection @ (self._position - T[:3, 3]))
        self._position = T[:3, 3] + offset
        t = self._seconds
        allowed = _MAX_SIGMAS * float(np.linalg.norm([_DISTANCE_SIGMA, _SPEED_SIGMA * t, 0.5 * step.sigma * t**2]))
        self.leads |= float(np.linalg.norm(offset)) > allowed
        # Before the two contradict each other the error may be this large, each time in the same direction.
        self.gained = max(0.0, self._sigma_before + allowed - self.sigma)
        self.sigma += self.gained
        if not self.leads and t >= _MIN_SPAN:
            self.velocity = self.velocity - _GAIN * offset / t
            self._position, self._seconds, self._sigma_before = T[:3, 3], 0.0, self.sigma
        return offset
