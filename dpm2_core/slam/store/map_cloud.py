# SPDX-License-Identifier: Apache-2.0
"""All clouds of a map as one, in memory no more than that one takes."""

from __future__ import annotations

from collections.abc import Generator, Iterable, Sequence

import numpy as np

from dpm2_core.frame import NO_POINTS, Array, Points
from dpm2_core.geometry import se3
from dpm2_core.geometry.voxel import voxel_first
from dpm2_core.slam.store.cloud_store import CloudStore

_TOGETHER = 50  # clouds that are thinned at once


def map_cloud(clouds: CloudStore, poses: Array, voxel: float, nodes: Iterable[int] | None = None) -> Points:
    """The cloud (M, 4) float32 of a map in its frame, one point in each voxel of `voxel` m.

    `nodes`: those whose clouds are in it; None: all.
    """
    steps = map_cloud_in_steps(clouds, poses, voxel, range(len(poses)) if nodes is None else nodes)
    while True:
        try:
            next(steps)
        except StopIteration as done:
            return done.value


def map_cloud_in_steps(
    clouds: CloudStore, poses: Array, voxel: float, nodes: Iterable[int]
) -> Generator[None, None, Points]:
    """`map_cloud` with a pause after every 50 clouds: the clouds may be worked with in it. Of 2,000 scans of KITTI the
    work in between takes 0.06 s as a rule, and 1.3 s where the largest parts are joined."""
    some: list[Points] = []
    parts: list[tuple[int, Points]] = []  # in parts, since memory is to be that of the map, not of all the clouds
    for node in nodes:
        if clouds.loan(node) is None:
            some.append(se3.transform(poses[node], clouds[node]))
        if len(some) == _TOGETHER:
            joined, size, some = _thinned(some, voxel), 1, []
            while parts and parts[-1][0] == size:  # equal ones: no point is thinned more than log2 of their number
                joined, size = _thinned([parts.pop()[1], joined], voxel), 2 * size
            parts.append((size, joined))
            yield
    return _thinned([NO_POINTS, *(cloud for _, cloud in parts), *some], voxel)


def _thinned(clouds: Sequence[Points], voxel: float) -> Points:
    """One after the other, the first point in each voxel."""
    cloud = np.concatenate(clouds)
    return cloud[voxel_first(cloud, voxel)]
