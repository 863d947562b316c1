# SPDX-License-Identifier: Apache-2.0
"""Voxel-grid sampling fast enough for every frame: linear in the points, no sorting."""

from __future__ import annotations

import numpy as np
from numba import float32, float64, int64
from numpy.typing import NDArray

from dpm2_core.geometry.compiled import READ_F4, READ_F8, compiled

_HALF = 1 << 20  # cells per axis on either side of the origin: 21 bits each fit one int64 key


def voxel_first(points: NDArray[np.floating], size: float, near: float = 0.0, far: float = np.inf) -> NDArray[np.int64]:
    """Ascending indices of the first of the (N, 3+) points in each cubic cell of `size` m; the grid is fixed at 0.

    Only points between `near` and `far` m from the origin count.

    Keeping a measured point, not the mean, keeps surfaces sharp; and points put first stay when a map grows.
    Coordinates of those must be within 2^20 cells of the origin; NaN is never in range, and inf only if `far` is.
    """
    dtype = points.dtype.type
    return _first_in_cells(np.ascontiguousarray(points), dtype(1 / size), dtype(near * near), dtype(far * far))


@compiled([int64[::1](READ_F4, *[float32] * 3), int64[::1](READ_F8, *[float64] * 3)])
def _first_in_cells(
    points: NDArray[np.floating], scale: np.floating, least: np.floating, most: np.floating
) -> NDArray[np.int64]:
    """`voxel_first` by a hash table of the cells seen so far; `least` and `most` are squared distances."""
    bits = 10
    while (1 << bits) < 2 * len(points):
        bits += 1
    table = np.full(1 << bits, -1, np.int64)
    mask, shift = (1 << bits) - 1, np.uint64(64 - bits)
    first, count, before = np.empty(len(points), np.int64), 0, np.int64(-1)
    for i in range(len(points)):
        squared = points[i, 0] * points[i, 0] + points[i, 1] * points[i, 1] + points[i, 2] * points[i, 2]
        if not (squared >= least and squared <= most):
            continue
        x, y, z = np.floor(points[i, 0] * scale), np.floor(points[i, 1] * scale), np.floor(points[i, 2] * scale)
        key = (np.int64(x) + _HALF << 42) | (np.int64(y) + _HALF << 21) | (np.int64(z) + _HALF)
        if key == before:  # as its neighbor on the beam's ring
            continue
        before = key
        slot = np.int64(np.uint64(key) * np.uint64(0x9E3779B97F4A7C15) >> shift)
        while table[slot] >= 0 and table[slot] != key:
            slot = (slot + 1) & mask
        if table[slot] < 0:
            table[slot] = key
            first[count] = i
            count += 1
    return first[:count].copy()
