# SPDX-License-Identifier: Apache-2.0
"""All clouds of a map as one, with no more memory than this one takes."""

from __future__ import annotations

from collections.abc import Generator, Iterable

import numpy as np

from dpm2_core.frame import NO_POINTS, Array, Points
from dpm2_core.geometry import se3
from dpm2_core.geometry.voxel import VoxelCells
from dpm2_core.slam.store.cloud_store import CloudStore

_BATCH = 50  # clouds between two pauses


def map_cloud(clouds: CloudStore, poses: Array, voxel: float, nodes: Iterable[int] | None = None) -> Points:
    """The cloud (M, 4) float32 of a map in its frame, one point per voxel of `voxel` m.

    `nodes`: keyframes whose clouds are included; None: all.
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
    """`map_cloud` with a pause after every 50 clouds, about 0.1 s of work; other code may use the clouds in a pause."""
    cells, parts = VoxelCells(voxel), [NO_POINTS]
    for count, node in enumerate(nodes, 1):
        if clouds.loan(node) is None:
            cloud = se3.transform(poses[node], clouds[node])
            parts.append(cloud[cells.first(cloud)])
        if count % _BATCH == 0:
            yield
    return np.concatenate(parts)
