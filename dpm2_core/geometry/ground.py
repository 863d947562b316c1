# SPDX-License-Identifier: Apache-2.0
"""Height above the ground without prior knowledge of the ground."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import grey_opening, minimum_filter

from dpm2_core.frame import Array

_CELL, _OPENING = 1.0, 7  # m; number of cells over which the ground below is searched
_FARTHEST = 500  # cells from the origin on each side: bounds memory against stray points
_BESIDE = np.array([[1, 1, 1], [1, 0, 1], [1, 1, 1]], bool)


def height_above_ground(points: NDArray[np.floating], cell: float = 1.0, reach: int = 2) -> NDArray[np.floating]:
    """(M,) m of (M, 3+) points above the lowest point within `reach` cells of `cell` m around them.

    A cell that is lower than all its neighbors by more than its edge is not ground: reflections in a window or a puddle
    appear below it. One such point in a real scan raises all heights within 5 m by 10 m.

    Points more than 500 cells from the origin, the sensor, are collected in the outermost cells.
    """
    if not len(points):
        return np.zeros(0, points.dtype)
    x, y = (np.clip(np.floor(points[:, axis] / cell), -_FARTHEST, _FARTHEST).astype(np.int64) for axis in (0, 1))
    x, y, z = x - x.min(), y - y.min(), np.ascontiguousarray(points[:, 2])
    shape = int(x.max()) + 1, int(y.max()) + 1
    at = x * shape[1] + y  # one flat index is twice as fast as two
    lowest = np.full(shape, np.inf, points.dtype)
    np.minimum.at(lowest.reshape(-1), at, z)
    beside = minimum_filter(lowest, footprint=_BESIDE, mode="constant", cval=np.inf)
    pit = np.isfinite(beside) & (lowest < beside - cell)
    lowest[pit] = beside[pit]
    around = minimum_filter(lowest, 2 * reach + 1, mode="constant", cval=np.inf)
    return z - around.reshape(-1)[at]


def ground_below(points: Array) -> Array:
    """(M,) height of the ground under (M, 3) points, m: the lowest around, which a roof alone cannot raise."""
    at = np.floor(points[:, :2] / _CELL).astype(np.int64)
    at -= at.min(0)
    lowest = np.full(at.max(0) + 1, np.inf)
    np.minimum.at(lowest, (at[:, 0], at[:, 1]), points[:, 2])
    # The opening must not see cells without points as low: they are filled with the greatest height.
    hole = ~np.isfinite(lowest)
    lowest[hole] = points[:, 2].max()
    return grey_opening(lowest, (_OPENING, _OPENING))[at[:, 0], at[:, 1]]
