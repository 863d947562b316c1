# SPDX-License-Identifier: Apache-2.0
"""Voxel-grid sampling fast enough for every frame: linear in the number of points, no sorting."""

from __future__ import annotations

import numpy as np
from numba import float32, float64, int64, uint64, void
from numpy.typing import NDArray

from dpm2_core.geometry.compiled import READ_F4, READ_F8, compiled

_HALF_EXTENT = 1 << 20  # cells per axis on either side of the origin: 21 bits each fit one int64 key


def voxel_first(points: NDArray[np.floating], size: float, near: float = 0.0, far: float = np.inf) -> NDArray[np.int64]:
    """Ascending indices of the first of the (N, 3+) points in each cubic cell of `size` m; the grid is fixed at 0.

    Only points between `near` and `far` m from the origin count.

    Keeping a measured point, not the mean, keeps surfaces sharp; and earlier points stay when a map grows. Coordinates
    of the points in range must be within 2^20 cells of the origin; NaN is never in range, and inf only if `far` is inf.
    """
    return _first(points, _empty_table(len(points)), size, near, far)


class VoxelCells:
    """`voxel_first` for a sequence of clouds: cells that already have a point are not filled again."""

    def __init__(self, size: float) -> None:
        """`size`: edge of a cell, m."""
        self._size, self._table, self._count = size, _empty_table(0), 0

    def first(self, points: NDArray[np.floating]) -> NDArray[np.int64]:
        """Ascending indices of the (N, 3+) points that are the first in their cells, among all clouds so far."""
        if len(self._table) < 2 * (self._count + len(points)):
            old_table, self._table = self._table, _empty_table(2 * (self._count + len(points)))
            _insert(old_table, self._table)
        found = _first(points, self._table, self._size, 0.0, np.inf)
        self._count += len(found)
        return found


def _empty_table(points: int) -> NDArray[np.int64]:
    """A hash table for the cells of `points` points: at least half of it stays empty."""
    return np.full(1 << max(2 * points - 1, 1023).bit_length(), -1, np.int64)


def _first(
    points: NDArray[np.floating], table: NDArray[np.int64], size: float, near: float, far: float
) -> NDArray[np.int64]:
    dtype = points.dtype.type
    return _first_in_cells(np.ascontiguousarray(points), table, dtype(1 / size), dtype(near * near), dtype(far * far))


@compiled(uint64(int64[::1]))
def _hash_shift(table: NDArray[np.int64]) -> np.uint64:
    """Number of bits by which a hash is shifted to a table index: its upper bits are mixed best."""
    shift = 64
    while (1 << 64 - shift) < len(table):
        shift -= 1
    return np.uint64(shift)


@compiled(int64(int64[::1], uint64, int64))
def _slot(table: NDArray[np.int64], shift: np.uint64, key: np.int64) -> np.int64:
    """Index of a key in a hash table, or of the free slot for it."""
    slot = np.int64(np.uint64(key) * np.uint64(0x9E3779B97F4A7C15) >> shift)
    while table[slot] >= 0 and table[slot] != key:
        slot = (slot + 1) & (len(table) - 1)
    return slot


@compiled(void(int64[::1], int64[::1]))
def _insert(keys: NDArray[np.int64], table: NDArray[np.int64]) -> None:
    """Insert the non-negative keys into a table that has none of them."""
    shift = _hash_shift(table)
    for key in keys:
        if key >= 0:
            table[_slot(table, shift, key)] = key


@compiled([int64[::1](READ_F4, int64[::1], *[float32] * 3), int64[::1](READ_F8, int64[::1], *[float64] * 3)])
def _first_in_cells(
    points: NDArray[np.floating],
    table: NDArray[np.int64],
    scale: np.floating,
    min_squared: np.floating,
    max_squared: np.floating,
) -> NDArray[np.int64]:
    """`voxel_first` with a hash table of the cells seen so far; between two squared distances."""
    shift = _hash_shift(table)
    first, count, last_key = np.empty(len(points), np.int64), 0, np.int64(-1)
    for i in range(len(points)):
        squared = points[i, 0] * points[i, 0] + points[i, 1] * points[i, 1] + points[i, 2] * points[i, 2]
        if not (squared >= min_squared and squared <= max_squared):
            continue
        x, y, z = np.floor(points[i, 0] * scale), np.floor(points[i, 1] * scale), np.floor(points[i, 2] * scale)
        key = (np.int64(x) + _HALF_EXTENT << 42) | (np.int64(y) + _HALF_EXTENT << 21) | (np.int64(z) + _HALF_EXTENT)
        if key == last_key:  # same cell as the point before, its neighbor on the beam's ring
            continue
        last_key = key
        slot = _slot(table, shift, key)
        if table[slot] < 0:
            table[slot] = key
            first[count] = i
            count += 1
    return first[:count].copy()
