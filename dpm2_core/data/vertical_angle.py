# SPDX-License-Identifier: Apache-2.0
"""Correction of the elevation of LiDAR points, needed for KITTI's scans."""

from __future__ import annotations

import numpy as np

from dpm2_core.errors import UsageError
from dpm2_core.frame import Points

HDL64_CORRECTION_DEG = 0.205
"""Elevation error of KITTI's scans, from its HDL-64's intrinsic calibration (J.-E. Deschaud, "IMLS-SLAM", 2018)."""

_MAX_ELEVATION = 5.0  # degrees above horizontal: 1.7 more than any point beyond _MIN_DISTANCE...
_MIN_DISTANCE = 10.0  # ...m, in the drives 00 and 04
_MAX_HIGH_POINTS = 100, 0.005  # largest number, and largest share of the far points, above _MAX_ELEVATION


def may_be_hdl64(points: Points) -> bool:
    """Whether (N, 4) points can be of KITTI's LiDAR, whose highest beam is 2 degrees above horizontal. Most other
    LiDARs have beams at 10 degrees or more."""
    distance = np.hypot(points[:, 0], points[:, 1])
    far = distance > _MIN_DISTANCE  # False for NaN
    high = points[far, 2] > distance[far] * np.float32(np.tan(np.radians(_MAX_ELEVATION)))
    return bool(high.sum() <= max(_MAX_HIGH_POINTS[0], _MAX_HIGH_POINTS[1] * len(high)))


def checked_correction(value: float, where: str) -> float:
    """A correction from a file or a message, checked against the bounds of the setting.

    Raises:
        UsageError: it is out of bounds; the message begins with `where`.
    """
    if not abs(value) <= 5:
        raise UsageError(f"{where}: want a vertical angle correction of -5 to 5 degrees, got {value}")
    return value


def correct_vertical_angle(points: Points, degrees: float) -> Points:
    """Raise the elevation of each of (N, 4) points by `degrees`, keeping range and azimuth; invalid ones stay so."""
    if not degrees:
        return points
    cos, sin = np.float32(np.cos(np.radians(degrees))), np.float32(np.sin(np.radians(degrees)))
    x, y, z = points[:, 0], points[:, 1], points[:, 2]
    rho = np.sqrt(x * x + y * y)
    out = np.empty_like(points)
    with np.errstate(invalid="ignore"):  # infinite points become NaN, which is also invalid
        scale = cos - sin * z / np.maximum(rho, np.float32(1e-6))
        np.multiply(x, scale, out=out[:, 0])
        np.multiply(y, scale, out=out[:, 1])
        np.add(z * cos, rho * sin, out=out[:, 2])
    out[:, 3] = points[:, 3]
    return out
