# SPDX-License-Identifier: Apache-2.0
"""WGS84: geodetic positions to the Earth's frame (ECEF) and back, and local frames with axes east, north, up.

Source: NIMA TR8350.2, Department of Defense World Geodetic System 1984; the inverse is B. R. Bowring's, "The accuracy
of geodetic latitude and height equations", Survey Review 28 (1985): error below 1 mm for vehicles and aircraft.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from dpm2_core.frame import Array
from dpm2_core.geometry import se3

_A = 6378137.0  # m, equatorial radius
_F = 1 / 298.257223563  # flattening
_E2 = _F * (2 - _F)  # eccentricity squared
_B = _A * (1 - _F)


def ecef(geodetic: ArrayLike) -> Array:
    """(..., 3) latitude and longitude in degrees, altitude in m above the ellipsoid, to (..., 3) m."""
    degrees = np.asarray(geodetic, np.float64)
    latitude, longitude, altitude = np.radians(degrees[..., 0]), np.radians(degrees[..., 1]), degrees[..., 2]
    normal_radius = _A / np.sqrt(1 - _E2 * np.sin(latitude) ** 2)
    axis_distance = (normal_radius + altitude) * np.cos(latitude)
    z = (normal_radius * (1 - _E2) + altitude) * np.sin(latitude)
    return np.stack([axis_distance * np.cos(longitude), axis_distance * np.sin(longitude), z], -1)


def geodetic(ecef: ArrayLike) -> Array:
    """The inverse of `ecef`."""
    x, y, z = np.moveaxis(np.asarray(ecef, np.float64), -1, 0)
    p = np.hypot(x, y)
    r = np.hypot(p, z)
    reduced = np.arctan2(_B * z * (1 + _E2 / (1 - _E2) * _B / r), _A * p)
    numerator = z + _E2 / (1 - _E2) * _B * np.sin(reduced) ** 3
    latitude = np.arctan2(numerator, p - _E2 * _A * np.cos(reduced) ** 3)
    altitude = p * np.cos(latitude) + z * np.sin(latitude) - _A * np.sqrt(1 - _E2 * np.sin(latitude) ** 2)
    return np.stack([np.degrees(latitude), np.degrees(np.arctan2(y, x)), altitude], -1)


def enu_frame(origin: ArrayLike) -> Array:
    """T_ecef_enu (4, 4) of the frame east, north, up at a geodetic position (3,)."""
    latitude, longitude, _ = np.asarray(origin, np.float64)
    (sin_lat, sin_lon), (cos_lat, cos_lon) = (
        np.sin(np.radians([latitude, longitude])),
        np.cos(np.radians([latitude, longitude])),
    )
    east, north = [-sin_lon, cos_lon, 0.0], [-sin_lat * cos_lon, -sin_lat * sin_lon, cos_lat]
    up = [cos_lat * cos_lon, cos_lat * sin_lon, sin_lat]
    return se3.make(np.column_stack([east, north, up]), ecef(origin))
