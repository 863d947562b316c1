# SPDX-License-Identifier: Apache-2.0
"""What two scans cannot show of the motion between them: errors of calibration, which grow with the motion.

Residuals say how well two scans fit each other. They say nothing of the axes of the sensor, which turn every way by the
same angle, nor of sweeps whose motion is not undone to the last, which make every turn too short. On the KITTI excerpts
the points, the network and the odometry agree over 10 to 20 m within 1 to 5 cm, and are 10 to 30 cm off the truth.
The two constants below were chosen on those excerpts, whose truth has errors of its own; no other drive tested them.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from dpm2_core.estimates import Registration, isotropic
from dpm2_core.frame import Array
from dpm2_core.geometry import se3

_AXES = 0.006
"""Standard deviation of each coordinate by the distance: a third of a degree of the axes, or 0.6 % of the ranges."""
_SWEEP = 0.015
"""Standard deviation of the rotation by the sine of the angle between the scans, rad: at 36 deg/s a sweep of 0.1 s
covers 1 % more than a turn, and is taken for one where its motion is not undone. Who meets a place again facing the
same way, or the other one, is not turning there."""


def with_calibration(result: Registration, T_near_source: Array) -> Registration:
    """A registration whose covariance is that of the fit alone, with these errors in it.

    Args:
        T_near_source: (4, 4) the source in the nearest scan of the target.
    """
    meters, degrees = se3.magnitude(T_near_source)
    floor = _SWEEP * float(np.sin(np.radians(degrees))), _AXES * meters
    return replace(result, covariance=result.covariance + isotropic(*floor), floor=floor)
