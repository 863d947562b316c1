# SPDX-License-Identifier: Apache-2.0
"""Detects returns from airborne particles near the sensor: fog, dust, smoke, spray, snow.

They move with the sensor. If they are most of a scan, they fit a map of other such points, best of all at rest.
"""

from __future__ import annotations

from math import log, sqrt

import numpy as np
from numba import boolean, float32, int32, int64, types
from numpy.typing import NDArray

from dpm2_core.frame import Points
from dpm2_core.geometry.compiled import READ_F4, compiled

_NEAR = 8.0  # m: farther away too few particles return enough light
_CELLS = 80  # along each edge of a cube around the sensor: of 0.7 to 1.4 degrees
_DENSE = 40_000  # points; smaller scans get larger cells
_ENOUGH, _LEAST = 15, 5  # points of a strip: it is lengthened until it has _ENOUGH; fewer than _LEAST are not used
_LONGEST = 12  # cells on either side
_LIKE, _LONGER = 0.03, 0.2  # tolerance of equal ranges, times range + _SHIFT; its growth per further cell
_SHIFT = 0.5  # m: the noise of ranges is more than 3 % of short ones
_ALONE, _CHANCE = 0.3, 2.5
"""A point is isolated if, in both of its strips, fewer than this share of the other points have its range, and not more
than in all directions, by this many standard deviations. On a surface one strip has more, even at a grazing angle."""
_PAIR = 2.0  # points of equal range: fewer count as none, whatever the share in all directions
_BIN = 0.01  # of ln(range + _SHIFT)
_BINS = int(log((_NEAR + _SHIFT) / _SHIFT) / _BIN) + 1
MANY = 0.2
"""Share of the near points: fewer occlude nothing, and do not stop an odometry whose map is as sparse as on streets."""
_SOME, _LEAST_NEAR = 6000, 100  # points that are sampled to see whether there are many; least number of near ones
_PATCH = 4  # cells: the sampled points are from square patches of directions with this edge


def scattered(points: Points, least: float = MANY) -> NDArray[np.bool_]:
    """Which of (N, 4) valid points in the LiDAR frame are airborne (N,): few other points in their direction have the
    same range. (Others count neighbors in a radius that grows with the range: N. Charron et al., "De-noising of Lidar
    Point Clouds Corrupted by Snowfall", CRV 2018. Their threshold depends on the sensor and the density of the snow.)

    Measured with 60 % of the pulses hitting fog: 91 to 97 % of them are found, and 0 to 3 % of the others within 8 m.
    In clean scans 0 to 2 %; 6 % with one point per degree, 10 % of a street that was thinned to one per 0.3 m.

    Args:
        least: fraction of the near points. If fewer are found, none are returned.
    """
    points = np.ascontiguousarray(points)
    every = max(1, len(points) // _SOME) if least > 0 else 1
    alone, near = _alone(points, every)
    if least > 0 and (near < _LEAST_NEAR or alone.sum() < least * near):
        return np.zeros(len(points), np.bool_)
    return alone if every == 1 else _alone(points, 1)[0]


@compiled(
    types.Tuple((int64[::1], int32[::1], float32[::1], float32[::1], int32[::1]))(READ_F4, int64, boolean[:, :, ::1])
)
def _in_cells(
    points: Points, edge: int, looked: NDArray[np.bool_]
) -> tuple[NDArray[np.int64], NDArray[np.int32], NDArray[np.float32], NDArray[np.float32], NDArray[np.int32]]:
    """The (M,) of (N, 4) points in the selected patches of directions (face, row, column); their cells and ranges (M,);
    the ranges sorted by cell; and the start of each cell. Around each face of the cube are cells without points."""
    side, count = edge + 2 * _LONGEST, 0
    which, cell, away = (
        np.empty(len(points), np.int64),
        np.empty(len(points), np.int32),
        np.empty(len(points), np.float32),
    )
    start = np.zeros(6 * side * side + 1, np.int32)
    for i in range(len(points)):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        if abs(z) >= max(abs(x), abs(y)):
            face, depth, u, v = (0 if z < 0 else 1), abs(z), x, y
        elif abs(x) >= abs(y):
            face, depth, u, v = (2 if x < 0 else 3), abs(x), y, z
        else:
            face, depth, u, v = (4 if y < 0 else 5), abs(y), x, z
        column = max(0, min(int((u / depth + 1) * (edge / 2)), edge - 1))  # 0 for NaN, too
        row = max(0, min(int((v / depth + 1) * (edge / 2)), edge - 1))
        if looked[face, row // _PATCH, column // _PATCH]:
            which[count], away[count] = i, sqrt(x * x + y * y + z * z)
            cell[count] = (face * side + row + _LONGEST) * side + column + _LONGEST
            start[cell[count] + 1] += 1
            count += 1
    for c in range(1, len(start)):
        start[c] += start[c - 1]
    of_cells, free = np.empty(count, np.float32), start.copy()
    for k in range(count):
        of_cells[free[cell[k]]] = away[k]
        free[cell[k]] += 1
    return which[:count], cell[:count], away[:count], of_cells, start


def _alone(points: Points, every: int) -> tuple[NDArray[np.bool_], int]:
    """Which of (N, 4) points are near and isolated, and how many are near; one in `every` patches of directions is
    examined."""
    edge = max(1, int(_CELLS * min(1.0, sqrt(len(points) / _DENSE))))
    patches, faces = np.arange(edge // _PATCH + 1), np.arange(6)[:, None, None]
    looked = (patches + 7 * patches[:, None] + 3 * faces) % every == 0
    which, cell, away, of_cells, start = _in_cells(points, edge, looked)
    near = np.flatnonzero(away < _NEAR)
    bins = (np.log((away[near] + _SHIFT) / _SHIFT) / _BIN).astype(np.int64)
    nearer = np.append(0, np.cumsum(np.bincount(bins, minlength=_BINS)))  # points closer than each bin
    alone = np.zeros(len(points), np.bool_)
    alone[which[near]] = _unlike(near, cell, away, of_cells, start, (bins, nearer, edge + 2 * _LONGEST))
    return alone, len(near)


@compiled("b1[::1](i8[::1], i4[::1], f4[::1], f4[::1], i4[::1], Tuple((i8[::1], i8[::1], i8)))")
def _unlike(
    near: NDArray[np.int64],
    cell: NDArray[np.int32],
    away: NDArray[np.float32],
    of_cells: NDArray[np.float32],
    start: NDArray[np.int32],
    ranges: tuple[NDArray[np.int64], NDArray[np.int64], int],
) -> NDArray[np.bool_]:
    """Which points are unlike those around them.

    Args:
        near: (M,) their indices. cell, away, of_cells, start: as returned by `_in_cells`.
        ranges: bins (M,) of their ranges, number of points closer than each bin, and number of cells in a row.
    """
    bins, nearer, row = ranges
    alone = np.zeros(len(near), np.bool_)
    for k in range(len(near)):
        i = near[k]
        for step in (1, row):  # to the next column, to the next row
            others, long = start[cell[i] + 1] - start[cell[i]] - 1, 0
            while long < _LONGEST and (long == 0 or others < _ENOUGH):
                long += 1
                for c in (cell[i] - long * step, cell[i] + long * step):
                    others += start[c + 1] - start[c]
            if others < _LEAST:
                continue
            share = _LIKE * (1 + _LONGER * (long - 1))
            within, reach, like = np.float32(share * (away[i] + _SHIFT)), int(share / _BIN), -1
            for c in range(cell[i] - long * step, cell[i] + long * step + 1, step):
                for j in range(start[c], start[c + 1]):
                    like += abs(of_cells[j] - away[i]) < within
            expected = (nearer[min(bins[k] + reach + 1, _BINS)] - nearer[max(bins[k] - reach, 0)]) / len(of_cells)
            chance = expected + _CHANCE * sqrt(expected * (1 - expected) / others)
            alone[k] = like < max(_PAIR, others * min(_ALONE, chance))
            if not alone[k]:
                break
    return alone
