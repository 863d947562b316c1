# SPDX-License-Identifier: Apache-2.0
"""Height above the ground without prior knowledge of the ground."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import grey_opening, minimum_filter

from dpm2_core.frame import Array

_CELL, _OPENING_CELLS = 1.0, 7  # m; number of cells over which the ground below is searched
_MAX_CELLS = 500  # cells from the origin on each side: bounds memory against stray points
_NEIGHBOR_CELLS = np.array([[1, 1, 1], [1, 0, 1], [1, 1, 1]], bool)


def height_above_ground(points: NDArray[np.floating], cell: float = 1.0, reach: int = 2) -> NDArray[np.floating]:
    """(M,) m of (M, 3+) points above the lowest point within `reach` cells of `cell` m around them.

    A cell that is lower than all its neighbors by more than its edge is not ground: reflections in a window or a puddle
    appear below it. One such point in a real scan raises all heights within 5 m by 10 m.

    Points more than 500 cells from the origin, the sensor, are collected in the outermost cells.
    """
    if not len(points):
        return np.zeros(0, points.dtype)
    x, y = (np.clip(np.floor(points[:, axis] / cell), -_MAX_CELLS, _MAX_CELLS).astype(np.int64) for axis in (0, 1))
    x, y, z = x - x.min(), y - y.min(), np.ascontiguousarray(points[:, 2])
    shape = int(x.max()) + 1, int(y.max()) + 1
    index = x * shape[1] + y  # one flat index is twice as fast as two
    lowest = np.full(shape, np.inf, points.dtype)
    np.minimum.at(lowest.reshape(-1), index, z)
    neighbors = minimum_filter(lowest, footprint=_NEIGHBOR_CELLS, mode="constant", cval=np.inf)
    is_pit = np.isfinite(neighbors) & (lowest < neighbors - cell)
    lowest[is_pit] = neighbors[is_pit]
    ground = minimum_filter(lowest, 2 * reach + 1, mode="constant", cval=np.inf)
    return z - ground.reshape(-1)[index]


def ground_below(points: Array) -> Array:
    """(M,) height of the ground under (M, 3) points, m: the lowest around, which a roof alone cannot raise."""
    cell = np.floor(points[:, :2] / _CELL).astype(np.int64)
    cell -= cell.min(0)
    lowest = np.full(cell.max(0) + 1, np.inf)
    np.minimum.at(lowest, (cell[:, 0], cell[:, 1]), points[:, 2])
    # The opening must not see cells without points as low: they are filled with the greatest height.
    is_empty = ~np.isfinite(lowest)
    lowest[is_empty] = points[:, 2].max()
    return grey_opening(lowest, (_OPENING_CELLS, _OPENING_CELLS))[cell[:, 0], cell[:, 1]]
