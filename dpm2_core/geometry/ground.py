# SPDX-License-Identifier: Apache-2.0
"""Height above the ground where nothing is known about the ground."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import minimum_filter

Points = NDArray[np.float32]


def height_above_ground(points: Points, cell: float = 1.0, reach: int = 2) -> Points:
    """(M,) m of (M, 3+) points above the lowest one within `reach` cells of `cell` m around them."""
    if not len(points):
        return np.zeros(0, np.float32)
    x, y = (np.floor(points[:, axis] / cell).astype(np.int64) for axis in (0, 1))
    x, y, z = x - x.min(), y - y.min(), np.ascontiguousarray(points[:, 2])
    shape = int(x.max()) + 1, int(y.max()) + 1
    at = x * shape[1] + y  # one index is twice as fast as two
    lowest = np.full(shape, np.inf, np.float32)
    np.minimum.at(lowest.reshape(-1), at, z)
    around = minimum_filter(lowest, 2 * reach + 1, mode="constant", cval=np.inf)
    return z - around.reshape(-1)[at]
