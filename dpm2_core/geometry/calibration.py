# SPDX-License-Identifier: Apache-2.0
"""Calibration errors, which the residuals between two scans do not show and which grow with the motion.

Residuals show how well two scans fit each other. They do not show an error of the sensor's axes, which rotates every
translation by the same angle, nor incomplete de-skewing, which makes every rotation too small. On the KITTI excerpts
point registration, network and odometry agree over 10 to 20 m within 1 to 5 cm, and are 10 to 30 cm off the truth.
The two constants below were chosen on those excerpts, whose truth has errors of its own; they were not tested on other
drives.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from dpm2_core.estimates import Registration, isotropic
from dpm2_core.frame import Array
from dpm2_core.geometry import se3

_AXES_SIGMA = 0.006
"""Standard deviation of each coordinate per distance: a third of a degree of the axes, or 0.6 % of the ranges."""
_SWEEP_SIGMA = 0.015
"""Standard deviation of the rotation, rad, per sine of the angle between the scans: at 36 deg/s a sweep of 0.1 s covers
1 % more than a revolution, and without de-skewing it is taken for exactly one. At a revisit in the same or the opposite
direction, where the sine is 0, the sensor is not turning."""


def with_calibration(result: Registration, T_near_source: Array) -> Registration:
    """A registration with these errors added to its covariance, which is that of the fit alone.

    Args:
        T_near_source: (4, 4) pose of the source in the nearest scan of the target.
    """
    meters, degrees = se3.magnitude(T_near_source)
    floor = _SWEEP_SIGMA * float(np.sin(np.radians(degrees))), _AXES_SIGMA * meters
    return replace(result, covariance=result.covariance + isotropic(*floor), floor=floor)
