# SPDX-License-Identifier: Apache-2.0
"""The local map that a scan is registered to: recent points, with planes that are fitted when they are needed."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from dpm2_core.config import Settings
from dpm2_core.frame import Array
from dpm2_core.geometry import se3
from dpm2_core.geometry.planes import fit_planes
from dpm2_core.geometry.point_grid import PointGrid
from dpm2_core.geometry.voxel import voxel_first
from dpm2_core.slam.registration.occupied_voxels import OccupiedVoxels
from dpm2_core.slam.registration.point_to_plane import distances

_MAX_YOUNG_SCANS = 3
_SIGHT = (0.99, 1.1)  # quantile of the ranges of a scan, and factor on it: beyond, the map has no information
_NEIGHBORS = 15  # points that a plane is fitted to
_MAX_SCANS = 25  # scans after which points are dropped: it bounds memory, and traces of moving objects
_CELL = 3.0  # voxels: edge of the cells in which neighbors are searched


class LocalMapSettings(Settings):
    """The local map of the odometry."""

    spacing: float = Field(2.0, ge=0)
    """A scan enters the map after this much motion, m (or a rotation of 10 degrees)."""
    radius: float = Field(100.0, gt=0)
    """Points farther than this from the sensor are dropped, m."""


class LocalMap:
    """Points (M, 3) float64 in the odometry frame, empty until the first `insert`."""

    def __init__(self, settings: LocalMapSettings, voxel: float) -> None:
        """voxel: edge of the cells that contain one point each, m."""
        self._settings, self._voxel = settings, voxel
        self.points: Array = np.zeros((0, 3))
        self._scan_of_point: NDArray[np.int32] = np.zeros(0, np.int32)
        self._inserted = 0
        self._T_last: Array | None = None
        self._scan_poses = np.zeros((0, 4, 4))
        self._sight_ranges = np.zeros(0)  # m, range of the scans that have entered
        self._voxels: OccupiedVoxels | None = None  # computed when needed

    def fresh(self) -> LocalMap:
        """A new, empty map with the same settings."""
        return LocalMap(self._settings, self._voxel)

    def __len__(self) -> int:
        return len(self.points)

    @property
    def is_young(self) -> bool:
        """Whether few scans have entered: a new scan may show much that none of them did."""
        return self._inserted <= _MAX_YOUNG_SCANS

    def wants(self, T_odom_lidar: Array) -> bool:
        """Whether a scan at that pose shows enough that is new."""
        if self._T_last is None:
            return True
        meters, degrees = se3.apart(self._T_last, T_odom_lidar)
        return meters > self._settings.spacing or degrees > 10

    def in_sight(self, source: Array) -> Array:
        """The points of a scan (N, 3) that are not farther away than the scans of the map could see.

        When fog lifts or a door opens, most points of a scan are farther away and do not determine its pose.
        """
        squared, sight = np.einsum("ij,ij->i", source, source), _SIGHT[1] * self._sight_ranges.max(initial=0.0)
        return source if squared.max(initial=0.0) <= sight * sight else source[squared <= sight * sight]

    def from_nearest_scan(self, T_odom_lidar: Array) -> Array:
        """A pose (4, 4) relative to the nearest pose of a scan in the map."""
        away = self._scan_poses[:, :3, 3] - T_odom_lidar[:3, 3]
        return se3.inverse(self._scan_poses[np.einsum("ij,ij->i", away, away).argmin()]) @ T_odom_lidar

    def insert(self, points: NDArray[np.floating], T_odom_lidar: Array, taken: Array | None = None) -> None:
        """Add the (N, 3+) points of a scan where the map has none yet; drop those that are far away or old.

        Args:
            taken: (K, 4, 4) poses of the scans that the points are merged from, relative to T_odom_lidar.
        """
        away = np.linalg.norm(points[:, :3], axis=1)
        sight = np.quantile(away, _SIGHT[0]) if len(away) else 0.0
        self._sight_ranges = np.append(self._sight_ranges, sight)[-_MAX_SCANS:]
        taken = T_odom_lidar @ (np.eye(4)[None] if taken is None else taken)
        self._scan_poses = np.concatenate([self._scan_poses, taken])[-max(_MAX_SCANS, len(taken)) :]
        new = points[:, :3].astype(np.float64) @ T_odom_lidar[:3, :3].T + T_odom_lidar[:3, 3]
        joined = np.concatenate([self.points, new])
        entered = np.concatenate([self._scan_of_point, np.full(len(new), self._inserted, np.int32)])
        away = joined - T_odom_lidar[:3, 3]
        kept = np.einsum("ij,ij->i", away, away) < self._settings.radius**2
        kept &= entered > self._inserted - _MAX_SCANS
        joined, entered = joined[kept], entered[kept]
        first = voxel_first(joined, self._voxel)
        self._grid = PointGrid(joined[first], _CELL * self._voxel)
        self.points, self._scan_of_point = self._grid.points, entered[first][self._grid.order]
        self._inserted += 1
        self._T_last, self._voxels = T_odom_lidar, None
        self._normals = np.empty((len(self.points), 3))
        self._variances = np.full(len(self.points), np.nan)

    def match(self, queries: Array, radius: float) -> tuple[Array, Array, Array]:
        """The surface at the map point nearest to each of the (Q, 3) queries, among those within `radius`, m.

        Returns:
            Distance of the query from it (Q,), m, its unit normal (Q, 3) and the variance along that (Q,), m2; NaN
            if no point is within the radius.
        """
        index = self._grid.nearest(queries, radius)
        self._fit_planes(index[index >= 0])
        return distances(queries, index, self.points, self._normals, self._variances)

    def fit(self, source: Array, poses: Array) -> Array:
        """Approximate fit of a scan (N, 3) at each of the poses (P, 4, 4); see `OccupiedVoxels`."""
        if self._voxels is None:
            assert self._T_last is not None
            self._voxels = OccupiedVoxels(self.points, self._T_last[:3, 3])
        return self._voxels.fit(source, poses)

    def _fit_planes(self, index: NDArray[np.int32]) -> None:
        """Fit planes at these map points, if not done yet."""
        mask = np.zeros(len(self.points), bool)
        mask[index] = True
        requested = np.flatnonzero(mask & np.isnan(self._variances))
        if len(requested):
            k = min(_NEIGHBORS, len(self.points))
            around = self._grid.neighbors(self.points[requested], k)
            self._normals[requested], self._variances[requested] = fit_planes(self.points[around])
