# SPDX-License-Identifier: Apache-2.0
"""Exact nearest neighbors in a grid of two levels: built in linear time, searched faster than a k-d tree."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from dpm2_core.frame import Array
from dpm2_core.geometry.compiled import compiled

Index = NDArray[np.int32]
_Grid = tuple[Array, Array, Index, Index]
_GRID = "Tuple((f8[:, ::1], f8[::1], i4[:, :, ::1], i4[::1]))"

_SIDE = 4  # cells along the edge of a block
_BLOCK_CELLS = _SIDE**3
_MAX_BLOCKS = 1 << 20  # largest number; clouds of larger extent have larger cells
_ROUNDING = 1e-9  # m, of the borders of cells
_FIRST_REACH = 0.8  # cells: first search distance of `neighbors`


class PointGrid:
    """Spatial index of the (M, 3) float64 points of a cloud; all finite.

    The occupied blocks are numbered in a dense table; the points of a block are consecutive, cell by cell.

    Attributes:
        order: (M,) input index of each point in the grid's order. points: (M, 3), in that order.
    """

    def __init__(self, points: Array, cell: float) -> None:
        """`cell` is the edge of the cells, m: about the distance of the neighbors that will be queried."""
        low = points.min(0) if len(points) else np.zeros(3)
        extent = points.max(0) - low if len(points) else np.zeros(3)
        while np.prod(blocks := np.floor(extent / (_SIDE * cell)) + 1) > _MAX_BLOCKS:
            cell *= 2
        corner = np.append(low, cell)
        block = np.full(blocks.astype(np.int64), -1, np.int32)
        start, self.order = _sort_into_blocks(points, corner, block)
        self.points: Array = points[self.order]
        self._grid = self.points, corner, block, start

    def nearest(self, queries: Array, radius: float) -> Index:
        """Index (Q,) in `points` of the nearest one closer than `radius` m to each of the (Q, 3) queries, -1 if
        none."""
        return _nearest(np.ascontiguousarray(queries), radius, self._grid)

    def neighbors(self, queries: Array, k: int, radius: float = np.inf) -> Index:
        """Indices (Q, k) in `points` of the k nearest to each of the finite (Q, 3) queries, nearest first.

        If there are fewer, or fewer within `radius`, m, the nearest one is repeated; it may be farther than `radius`.

        Raises:
            ValueError: the cloud is empty.
        """
        if not len(self.points):
            raise ValueError("an empty cloud has no neighbors")
        return _neighbors(np.ascontiguousarray(queries), k, radius, self._grid)


@compiled("Tuple((i4[::1], i4[::1]))(f8[:, ::1], f8[::1], i4[:, :, ::1])")
def _sort_into_blocks(points: Array, corner: Array, block: Index) -> tuple[Index, Index]:
    """Number the occupied blocks in `block`; returns the start of each of their cells, and the order of the points."""
    m, scale, occupied = len(points), 1 / corner[3], 0
    nx, ny, nz = block.shape
    cell = np.empty(m, np.int64)
    for i in range(m):
        x = min(int((points[i, 0] - corner[0]) * scale), nx * _SIDE - 1)  # rounding at the upper border
        y = min(int((points[i, 1] - corner[1]) * scale), ny * _SIDE - 1)
        z = min(int((points[i, 2] - corner[2]) * scale), nz * _SIDE - 1)
        at = block[x // _SIDE, y // _SIDE, z // _SIDE]
        if at < 0:
            at = block[x // _SIDE, y // _SIDE, z // _SIDE] = occupied
            occupied += 1
        cell[i] = at * _BLOCK_CELLS + ((x % _SIDE) * _SIDE + y % _SIDE) * _SIDE + z % _SIDE
    start = np.zeros(occupied * _BLOCK_CELLS + 1, np.int32)
    for i in range(m):
        start[cell[i] + 1] += 1
    for c in range(occupied * _BLOCK_CELLS):
        start[c + 1] += start[c]
    next_free = start[:-1].copy()
    order = np.empty(m, np.int32)
    for i in range(m):
        order[next_free[cell[i]]] = i
        next_free[cell[i]] += 1
    return start, order


@compiled("i8(f8, i8)")
def _clipped(x: float, size: int) -> int:
    """floor(x), within 0..size - 1."""
    return 0 if x < 0 else (size - 1 if x >= size else int(x))


@compiled("f8(f8, f8, f8)")
def _squared_gap(x: float, low: float, edge: float) -> float:
    """Squared distance of x from the interval low..low + edge."""
    d = max(low - x, x - low - edge, 0.0)
    return d * d


@compiled(f"Tuple((i8, f8))(f8[::1], f8, f8, {_GRID})")
def _nearest_within(query: Array, reach: float, best: float, grid: _Grid) -> tuple[int, float]:
    """The nearest point in cells within `reach` m and its squared distance; -1 if that is not below `best`, m2."""
    points, corner, block, start = grid
    found, cell, r = -1, corner[3], reach + _ROUNDING
    nx, ny, nz = block.shape[0] * _SIDE, block.shape[1] * _SIDE, block.shape[2] * _SIDE
    x, y, z = query[0] - corner[0], query[1] - corner[1], query[2] - corner[2]
    if x + r < 0 or y + r < 0 or z + r < 0 or x - r > nx * cell or y - r > ny * cell or z - r > nz * cell:
        return found, best
    z_first, z_last = _clipped((z - r) / cell, nz), _clipped((z + r) / cell, nz)
    for cx in range(_clipped((x - r) / cell, nx), _clipped((x + r) / cell, nx) + 1):
        off_x = _squared_gap(x, cx * cell, cell) - _ROUNDING
        for cy in range(_clipped((y - r) / cell, ny), _clipped((y + r) / cell, ny) + 1):
            off_xy = off_x + _squared_gap(y, cy * cell, cell)
            if off_xy > best:
                continue
            for cz in range(z_first, z_last + 1):
                at = block[cx // _SIDE, cy // _SIDE, cz // _SIDE]
                if at < 0 or off_xy + _squared_gap(z, cz * cell, cell) > best:
                    continue
                c = at * _BLOCK_CELLS + ((cx % _SIDE) * _SIDE + cy % _SIDE) * _SIDE + cz % _SIDE
                for i in range(start[c], start[c + 1]):
                    dx, dy, dz = points[i, 0] - query[0], points[i, 1] - query[1], points[i, 2] - query[2]
                    squared = dx * dx + dy * dy + dz * dz
                    if squared < best:
                        best, found = squared, i
    return found, best


@compiled(f"i4[::1](f8[:, ::1], f8, {_GRID})")
def _nearest(queries: Array, radius: float, grid: _Grid) -> Index:
    """See `PointGrid.nearest`: searches within half a cell, then as far as the point that was found, or twice as
    far."""
    index = np.full(len(queries), -1, np.int32)
    for q in range(len(queries)):
        query = queries[q]
        if not np.isfinite(query[0] + query[1] + query[2]):
            continue
        found, best, reach = -1, radius * radius, min(radius, grid[1][3] / 2)
        while True:
            closer, best = _nearest_within(query, reach, best, grid)
            if closer >= 0:
                found = closer
            if reach >= radius or (found >= 0 and best <= (reach + _ROUNDING) ** 2):
                break
            reach = min(radius, np.sqrt(best) if found >= 0 else 2 * reach)
        index[q] = found
    return index


@compiled(f"i8(f8[::1], f8, {_GRID}, f8[::1], i4[::1])")
def _all_within(query: Array, reach: float, grid: _Grid, squared: Array, index: Index) -> int:
    """Number of points within `reach` m; their squared distances and indices are written."""
    points, corner, block, start = grid
    found, limit, r = 0, reach * reach, reach + _ROUNDING
    side = 1 if reach < _SIDE * corner[3] else _SIDE  # single cells, or whole blocks
    edge, cells = side * corner[3], _SIDE // side
    nx, ny, nz = block.shape[0] * cells, block.shape[1] * cells, block.shape[2] * cells
    x, y, z = query[0] - corner[0], query[1] - corner[1], query[2] - corner[2]
    z_first, z_last = _clipped((z - r) / edge, nz), _clipped((z + r) / edge, nz)
    for cx in range(_clipped((x - r) / edge, nx), _clipped((x + r) / edge, nx) + 1):
        off_x = _squared_gap(x, cx * edge, edge) - _ROUNDING
        for cy in range(_clipped((y - r) / edge, ny), _clipped((y + r) / edge, ny) + 1):
            off_xy = off_x + _squared_gap(y, cy * edge, edge)
            if off_xy > limit:
                continue
            row = ((cx % _SIDE) * _SIDE + cy % _SIDE) * _SIDE
            for bz in range(z_first // cells, z_last // cells + 1):
                at = block[cx // cells, cy // cells, bz]
                if at < 0:
                    continue
                c, end = at * _BLOCK_CELLS, (at + 1) * _BLOCK_CELLS
                if side == 1:  # the cells of a row, whose points are consecutive
                    end = c + row + min(z_last - bz * _SIDE, _SIDE - 1) + 1
                    c += row + max(z_first - bz * _SIDE, 0)
                for i in range(start[c], start[end]):
                    dx, dy, dz = points[i, 0] - query[0], points[i, 1] - query[1], points[i, 2] - query[2]
                    squared[found], index[found] = dx * dx + dy * dy + dz * dz, i
                    found += squared[found] <= limit
    return found


@compiled("void(f8[::1], i4[::1], i8, i8)")
def _select(squared: Array, index: Index, count: int, k: int) -> None:
    """Move the k smallest of the first `count` to the front, sorted, each with its index."""
    first, last = 0, count - 1
    while first < last:  # quickselect
        pivot = squared[(first + last) // 2]
        i, j = first, last
        while i <= j:
            while squared[i] < pivot:
                i += 1
            while squared[j] > pivot:
                j -= 1
            if i <= j:
                squared[i], squared[j] = squared[j], squared[i]
                index[i], index[j] = index[j], index[i]
                i += 1
                j -= 1
        if k <= j:
            last = j
        elif k >= i:
            first = i
        else:
            break
    for i in range(1, k):  # insertion sort
        s, index_of_s, j = squared[i], index[i], i
        while j > 0 and squared[j - 1] > s:
            squared[j], index[j] = squared[j - 1], index[j - 1]
            j -= 1
        squared[j], index[j] = s, index_of_s


@compiled(f"i4[:, ::1](f8[:, ::1], i8, f8, {_GRID})")
def _neighbors(queries: Array, k: int, radius: float, grid: _Grid) -> Index:
    """See `PointGrid.neighbors`: all points within a distance that is increased until there are enough."""
    out = np.empty((len(queries), k), np.int32)
    squared, index = np.empty(len(grid[0]) + 1), np.empty(len(grid[0]) + 1, np.int32)
    count = min(k, len(grid[0]))
    for q in range(len(queries)):
        reach = min(_FIRST_REACH * grid[1][3], radius)
        found = _all_within(queries[q], reach, grid, squared, index)
        while found == 0 or (found < count and reach < radius):
            reach = 2 * reach if found == 0 else min(min(2.0, 1.2 * np.sqrt(count / found)) * reach, radius)
            found = _all_within(queries[q], reach, grid, squared, index)
        _select(squared, index, found, min(count, found))
        for j in range(k):
            out[q, j] = index[j] if j < found and squared[j] <= radius * radius else index[0]
    return out
