# SPDX-License-Identifier: Apache-2.0
"""Point sampling: farthest points, hybrid neighbor query."""

from __future__ import annotations

import fpsample
import numpy as np
from numpy.typing import NDArray

from dpm2_core.geometry.point_grid import PointGrid

Points = NDArray[np.float32]
Index = NDArray[np.int64]


def farthest_points(points: Points, count: int) -> Index:
    """Farthest point sampling of (N, 3) points: min(N, count) indices, in sampling order.

    The start is the same for the same cloud; which point it is follows from the tree, not from `start_idx` alone.
    A prefix of the result is the farthest point sampling of that length: one call serves all levels of a pyramid.
    """
    count = min(count, len(points))
    if count <= 1:
        return np.arange(count)
    height = min(5, len(points).bit_length() - 1)  # of the bucket tree; 5 is fastest around 15,000 points
    return fpsample.bucket_fps_kdline_sampling(points, count, h=height, start_idx=0).astype(np.int64)


def interleaved(points: Points, special: Points, first: int) -> Points:
    """The (N, 3) points with (k, 3) special ones spread evenly among the `first` of them; the last ones fall out.

    Any prefix within `first` holds both in the same ratio. k is at most `first` and N.
    """
    out = np.empty_like(points)
    slot = np.zeros(len(points), bool)
    every = min(first, len(points)) / max(len(special), 1)
    slot[((np.arange(len(special)) + 0.5) * every).astype(np.int64)] = True
    out[slot], out[~slot] = special, points[: len(points) - len(special)]
    return out


def neighbours(grid: PointGrid, queries: Points, k: int, radius: float) -> Index:
    """(M, k) indices of the neighbors of each query, nearest first; those beyond `radius` m repeat the nearest.

    The hybrid of a ball query and k nearest neighbors, in the cloud that the grid was made of.
    """
    return grid.order[grid.neighbors(queries.astype(np.float64), k, radius)].astype(np.int64)
