# SPDX-License-Identifier: Apache-2.0
"""Sampling: evenly spaced indices, farthest points, hybrid neighbor query."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from dpm2_core.frame import Points
from dpm2_core.geometry.compiled import compiled
from dpm2_core.geometry.point_grid import PointGrid

Index = NDArray[np.int64]

_CHUNK = 128  # points that are updated together: 64 and 256 are slower for scans
_HALVINGS = 5  # of the cloud, to find the start of the sampling


def evenly(count: int, most: int) -> Index:
    """At most `most` of the numbers below `count`, evenly spaced from the first to the last; empty for 0."""
    return np.arange(count) if count <= most else np.linspace(0, count - 1, most).astype(np.int64)


def farthest_points(points: Points, count: int, grid: PointGrid) -> Index:
    """Farthest point sampling of (N, 3) points: min(N, count) indices, in sampling order.

    Deterministic for a cloud. A prefix of the result is the farthest point sampling of that length: one call serves all
    levels of a pyramid.

    Args:
        grid: of these points; any cell size.
    """
    count = min(count, len(points))
    if count <= 1:
        return np.arange(count)
    start = _start_point(points.copy(), np.arange(len(points)))
    order = grid.order
    return order[_farthest(points[order], int(np.flatnonzero(order == start)[0]), count)].astype(np.int64)


@compiled("i8(f4[:, ::1], i8[::1])")
def _start_point(points: Points, index: Index) -> int:
    """The first point of the lowest cell when the cloud is repeatedly halved at the mean of its widest axis.

    Samplings in training started at this point. Both arrays are reordered.
    """
    count = len(points)
    for _ in range(_HALVINGS):
        axis, widest, total = 0, np.float32(0), np.float32(0)
        for a in range(3):
            width = points[:count, a].max() - points[:count, a].min()
            if width > widest:
                axis, widest = a, width
        for i in range(count):
            total += points[i, axis]
        middle, i, j = total / np.float32(count), 0, count - 1
        while i <= j:
            if points[i, axis] < middle:
                i += 1
            elif points[j, axis] >= middle:
                j -= 1
            else:
                for a in range(3):
                    points[i, a], points[j, a] = points[j, a], points[i, a]
                index[i], index[j] = index[j], index[i]
                i, j = i + 1, j - 1
        count = max(i, 1)
    return index[0]


@compiled("void(f4, f4, f4, f4[:, ::1], f4[:, ::1], f4[::1])")
def _squared_box_distances(
    x: float, y: float, z: float, low: Points, high: Points, squared: NDArray[np.float32]
) -> None:
    """Squared distances (M,) of a point from boxes, given by their corners (3, M)."""
    low_x, low_y, low_z, high_x, high_y, high_z = low[0], low[1], low[2], high[0], high[1], high[2]
    zero = np.float32(0)
    for c in range(len(squared)):
        dx = max(max(low_x[c] - x, x - high_x[c]), zero)
        dy = max(max(low_y[c] - y, y - high_y[c]), zero)
        dz = max(max(low_z[c] - z, z - high_z[c]), zero)
        squared[c] = dx * dx + dy * dy + dz * dz


@compiled("i8[::1](f4[:, ::1], i8, i8)")
def _farthest(points: Points, start: int, count: int) -> Index:
    """`farthest_points`, from a start, for points in an order in which neighbors are close to each other.

    A chunk needs no update if its farthest point is closer to the points so far than to the new one. Distances are
    compared as the integers of their bits, which are in the same order: the compiler vectorizes that.
    """
    n, chunks = len(points), (len(points) + _CHUNK - 1) // _CHUNK
    xyz = np.empty((chunks, 3, _CHUNK), np.float32)
    low, high = np.full((3, chunks), np.float32(np.inf)), np.full((3, chunks), np.float32(-np.inf))
    for c in range(chunks):
        for a in range(3):
            for i in range(_CHUNK):
                value = points[min(c * _CHUNK + i, n - 1), a]  # the last chunk is padded with the last point
                xyz[c, a, i] = value
                low[a, c], high[a, c] = min(low[a, c], value), max(high[a, c], value)
    squared, farthest = np.full((chunks, _CHUNK), np.float32(np.inf)), np.full(chunks, np.float32(np.inf))
    bits, farthest_bits = squared.view(np.int32), farthest.view(np.int32)
    bound, chosen, current = np.empty(chunks, np.float32), np.empty(count, np.int64), start
    for sample in range(count):
        chosen[sample] = current
        x, y, z = points[current, 0], points[current, 1], points[current, 2]
        _squared_box_distances(x, y, z, low, high, bound)
        for c in range(chunks):
            if bound[c] < farthest[c]:
                chunk_squared, chunk_bits, xs, ys, zs = squared[c], bits[c], xyz[c, 0], xyz[c, 1], xyz[c, 2]
                for i in range(_CHUNK):
                    dx, dy, dz = xs[i] - x, ys[i] - y, zs[i] - z
                    s = dx * dx + dy * dy + dz * dz
                    chunk_squared[i] = s if s < chunk_squared[i] else chunk_squared[i]
                farthest_bits[c] = chunk_bits.max()
        most, c, current = farthest_bits.max(), 0, 0
        while farthest_bits[c] != most:
            c += 1
        while bits[c, current] != most:
            current += 1
        current = min(c * _CHUNK + current, n - 1)
    return chosen


def interleaved(points: Points, special: Points, first: int) -> Points:
    """The (N, 3) points with (k, 3) special ones evenly spaced among the `first` of them; as many are cut at the end.

    Any prefix within `first` has both in the same ratio. k is at most `first` and N.
    """
    out = np.empty_like(points)
    is_special = np.zeros(len(points), bool)
    spacing = min(first, len(points)) / max(len(special), 1)
    is_special[((np.arange(len(special)) + 0.5) * spacing).astype(np.int64)] = True
    out[is_special], out[~is_special] = special, points[: len(points) - len(special)]
    return out


def neighbours(grid: PointGrid, queries: NDArray[np.floating], k: int, radius: float) -> Index:
    """(M, k) indices of the neighbors of each query, nearest first; neighbors beyond `radius` m repeat the nearest.

    The hybrid of a ball query and k nearest neighbors, in the cloud of which the grid was built.
    """
    return grid.order[grid.neighbors(queries.astype(np.float64), k, radius)].astype(np.int64)
