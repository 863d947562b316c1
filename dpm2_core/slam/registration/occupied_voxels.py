# SPDX-License-Identifier: Apache-2.0
"""Approximate fit of a scan to a map at hundreds of poses: the number of its points in occupied voxels.

After E. Olson, "Real-time correlative scan matching", ICRA 2009, in three dimensions.
"""

from __future__ import annotations

import numpy as np

from dpm2_core.frame import Array

_VOXEL = 0.5  # m
_RANGE, _HEIGHT = 60.0, 15.0  # m from the center: points farther away hardly constrain the position
_OCCUPIED_VALUE, _NEIGHBOR_VALUE = 2, 1  # value of a point in an occupied voxel, and in one next to it


class OccupiedVoxels:
    """The voxels around a center that contain map points."""

    def __init__(self, points: Array, center: Array) -> None:
        """`points` (M, 3) and `center` (3,) in the map frame, m."""
        half = np.array([_RANGE, _RANGE, _HEIGHT])
        self._origin = center - half
        shape = np.ceil(2 * half / _VOXEL).astype(int)
        near = (np.abs(points - center) < half - 2 * _VOXEL).all(1)
        x, y, z = ((points[near] - self._origin) / _VOXEL).astype(int).T
        self._value = np.zeros(shape, np.uint8)
        for dx in (-1, 0, 1):
            for dy in (-1, 0, 1):
                for dz in (-1, 0, 1):
                    self._value[x + dx, y + dy, z + dz] = _NEIGHBOR_VALUE
        self._value[x, y, z] = _OCCUPIED_VALUE

    def fit(self, source: Array, poses: Array) -> Array:
        """Mean value of the voxels that contain the points (N, 3) of a scan, at each of the poses (P, 4, 4)."""
        R, t = poses[:, :3, :3].astype(np.float32), (poses[:, :3, 3] - self._origin).astype(np.float32)
        moved = np.einsum("pij,nj->pni", R, source.astype(np.float32), optimize=True) + t[:, None]
        inside = ((moved >= 0) & (moved < np.float32(_VOXEL) * np.array(self._value.shape, np.float32))).all(-1)
        moved[~inside] = 0  # a corner, which is empty; coordinates outside may exceed any integer
        cell = (moved / np.float32(_VOXEL)).astype(np.int32)
        value = self._value[cell[..., 0], cell[..., 1], cell[..., 2]]
        return np.asarray(value.mean(1))
