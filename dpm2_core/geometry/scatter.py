# SPDX-License-Identifier: Apache-2.0
"""Returns from what floats in the air near the sensor: fog, dust, smoke, spray, snow.

They move along with the sensor. Where they are the greater part of a scan they fit a map of others of their kind, best
of all at rest.
"""

from __future__ import annotations

from math import atan2, degrees, log, sqrt

import numpy as np
from numba import boolean
from numpy.typing import NDArray

from dpm2_core.frame import Points
from dpm2_core.geometry.compiled import READ_F4, compiled

_NEAR = 8.0  # m: farther away they return too little to be many
_LONG, _SHORT = 24, 4  # degrees, edges of a strip of directions
_ROWS = 180 // _SHORT, -(-180 // _LONG)  # of strips along the horizon and across
_STRIPS = max(360 // _LONG * _ROWS[0], 360 // _SHORT * _ROWS[1])
_FINEST, _SHIFT = 0.04, 0.5  # of ln(range + 0.5 m): the noise of ranges is more than 4 % of short ones
_BINS = int(log((_NEAR + _SHIFT) / _SHIFT) / _FINEST) + 3  # with an empty one at either end
_LEAST = 5  # points of a strip; fewer say nothing
_ALONE, _CHANCE = 0.3, 3.0
"""A point is alone where fewer of the others are as far away in both of its strips; or not more than there are in all
directions, by so many standard deviations. Of a surface one strip has more, even if it is seen at a grazing angle."""
MANY = 0.2
"""Of what is near: less hides nothing, and does not hold an odometry whose map is as sparse as those of streets."""
_SOME, _LEAST_NEAR = 6000, 100  # points tell whether there are many; of these so many must be near


def scattered(points: Points, least: float = MANY) -> NDArray[np.bool_]:
    """Which of (N, 4) valid points in the LiDAR frame float in the air (N,).

    Measured: 74 to 99 % of them are found where 60 % of the pulses meet fog, and some other points: in clean scans 0 to
    5 % of what is near in rooms, up to 14 % in towns, 23 % where a scan has few points and many plants.

    Args:
        least: fraction of what is near. None are found where fewer are.
    """
    every = max(1, len(points) // _SOME) if least > 0 else 1
    some = np.ascontiguousarray(points[::every])
    alone = _alone(some)
    if least > 0:
        near = np.einsum("ij,ij->i", some[:, :3], some[:, :3]) < _NEAR**2
        if near.sum() < _LEAST_NEAR or alone[near].mean() < least:
            return np.zeros(len(points), np.bool_)
    return alone if every == 1 else _alone(np.ascontiguousarray(points))


@compiled(boolean[::1](READ_F4))
def _alone(points: Points) -> NDArray[np.bool_]:
    """Which of (N, 4) points are near, and unlike the others in two strips of directions through them: one along the
    horizon, one across."""
    strip, distance = np.empty((2, len(points)), np.int32), np.zeros(len(points), np.int32)
    count, total = np.zeros((2, _STRIPS, _BINS), np.int32), np.zeros((2, _STRIPS), np.int32)
    for i in range(len(points)):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        flat = sqrt(x * x + y * y)
        azimuth = min(degrees(atan2(y, x)) + 180, 359.9)
        elevation = min(degrees(atan2(z, flat)) + 90, 179.9)
        away = sqrt(flat * flat + z * z)
        if away < _NEAR:
            distance[i] = 1 + int(log((away + _SHIFT) / _SHIFT) / _FINEST)
        for way in range(2):
            wide, high = (_LONG, _SHORT) if way == 0 else (_SHORT, _LONG)
            strip[way, i] = int(azimuth / wide) * _ROWS[way] + int(elevation / high)
            total[way, strip[way, i]] += 1
            count[way, strip[way, i], distance[i]] += distance[i] > 0
    usual = np.bincount(distance, minlength=_BINS) / max(len(points), 1)
    usual[0] = 0
    alone = np.zeros(len(points), np.bool_)
    for i in range(len(points)):
        here = distance[i]
        if here == 0:
            continue
        expected = usual[here - 1] + usual[here] + usual[here + 1]
        known = found = False
        for way in range(2):
            others = total[way, strip[way, i]] - 1
            if others >= _LEAST:
                at = count[way, strip[way, i]]
                like = (at[here - 1] + at[here] + at[here + 1] - 1) / others
                known = True
                found |= like >= min(_ALONE, expected + _CHANCE * sqrt(expected * (1 - expected) / others))
        alone[i] = known and not found
    return alone
