# SPDX-License-Identifier: Apache-2.0
"""The way along what scans leave open, where an IMU knows it: while the two agree scans are believed, else the IMU.

Not all is open that a covariance calls so: the little that stands beside a road shows the way all the same, to some
centimeters. Along a smooth tunnel a scan fits best where the map is as dense as it is, which is where the robot was:
within a second that contradicts the accelerations.
"""

from __future__ import annotations

import numpy as np

from dpm2_core.frame import Array
from dpm2_core.slam.odometry.inertial import Reckoned

_SCANS, _SPEED = 0.1, 0.1  # m and m/s, standard deviations of the way by scans, and of the speed that they have shown
_SPAN = 1.0  # s over which the two are compared
_GAIN = 0.5  # of what the speed is corrected then
_CONTRADICTS = 3.0  # standard deviations


class OpenWay:
    """From a registered frame on, by an IMU alone, with the velocity that scans show second by second.

    Attributes:
        velocity: (3,) m/s in the odometry's frame.
        leads: whether scans have contradicted it, from then on.
        sigma: m, that of the way from where it began. gained: what the last frame added.
    """

    def __init__(self, T: Array, velocity: Array) -> None:
        """At T (4, 4), at a `velocity` (3,) m/s along its axes."""
        self.velocity, self.leads = T[:3, :3] @ velocity, False
        self.sigma = self.gained = self._sigma_before = 0.0
        self._position, self._seconds = T[:3, 3], 0.0

    def follow(self, T_before: Array, T: Array, along: Array, step: Reckoned, seconds: float) -> Array:
        """How far (3,) m a registered frame is from here, along what it leaves open and the axes of the odometry.

        Args:
            T: (4, 4) of the frame; T_before: of the last one, `seconds` before it. step: the way between by the IMU.
            along: (3, 3) onto what is open, along the axes of T.
        """
        R, left = T_before[:3, :3], T[:3, :3] @ along @ T[:3, :3].T
        self._position = self._position + self.velocity * seconds + R @ step.gained[0]
        by_scans = (T[:3, 3] - T_before[:3, 3]) / seconds
        self.velocity = by_scans + left @ (self.velocity + R @ step.gained[1] - by_scans)
        self._seconds += seconds
        off = np.asarray(left @ (self._position - T[:3, 3]))
        self._position = T[:3, 3] + off
        t = self._seconds
        allowed = _CONTRADICTS * float(np.linalg.norm([_SCANS, _SPEED * t, 0.5 * step.sigma * t**2]))
        self.leads |= float(np.linalg.norm(off)) > allowed
        # So far off it may be before the two contradict each other, each time to the same side.
        self.gained = max(0.0, self._sigma_before + allowed - self.sigma)
        self.sigma += self.gained
        if not self.leads and t >= _SPAN:
            self.velocity = self.velocity - _GAIN * off / t
            self._position, self._seconds, self._sigma_before = T[:3, 3], 0.0, self.sigma
        return off
