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
    at = np.floor(points[:, :2] / cell).astype(np.int64)
    at -= at.min(0)
    lowest = np.full(at.max(0) + 1, np.inf, np.float32)
    np.minimum.at(lowest, (at[:, 0], at[:, 1]), points[:, 2])
    around = minimum_filter(lowest, 2 * reach + 1, mode="constant", cval=np.inf)
    return points[:, 2] - around[at[:, 0], at[:, 1]]
