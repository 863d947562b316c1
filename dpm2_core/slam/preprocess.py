# SPDX-License-Identifier: Apache-2.0
"""Prepares a raw scan for the odometry: its valid points, a subset of them for the map, and fewer for registration."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numba import float32, float64, int64, types
from numpy.typing import NDArray
from pydantic import Field, model_validator

from dpm2_core.config import Settings
from dpm2_core.descriptors import Descriptors, LazyDescriptors
from dpm2_core.frame import Array, Frame, Image, Points, Up
from dpm2_core.geometry.compiled import READ_F4, compiled
from dpm2_core.geometry.deskew import deskew, measured_turn
from dpm2_core.geometry.scatter import MANY, scattered
from dpm2_core.geometry.voxel import voxel_first
from dpm2_core.slam.filters import PointFilter


class PreprocessSettings(Settings):
    """Which points are used, and how densely."""

    min_range: float = 2.0
    """Closer returns are dropped (the vehicle itself), m."""
    max_range: float = 90.0
    """Farther returns are dropped, m."""
    scatter: float = Field(MANY, ge=0, le=1)
    """Floating particles (fog, dust, smoke, spray, snow) are removed if they are at least this fraction of the returns
    within 8 m. Denser maps are misled by fewer of them."""
    map_voxel: float = 0.5
    """Spacing of the points to register against, of the last scans or of the keyframes around a place, m."""
    source_voxel: float = 0.8
    """Spacing of the points that are registered, m; at least `map_voxel`."""
    deskew: bool = True
    """Undo the motion during a sweep, as estimated from the points or, if available, from an IMU (the rotation). Only
    for scans with a time per point; false for scans that are de-skewed already. Times that contradict the motion are
    not used."""

    @model_validator(mode="after")
    def _ordered(self) -> PreprocessSettings:
        if not 0 <= self.min_range < self.max_range:
            raise ValueError(f"want 0 <= min_range < max_range, got {self.min_range} and {self.max_range}")
        if not 0 < self.map_voxel <= self.source_voxel:
            raise ValueError(f"want 0 < map_voxel <= source_voxel, got {self.map_voxel} and {self.source_voxel}")
        return self


@dataclass(frozen=True, eq=False)
class Scan:
    """A prepared scan in the LiDAR frame at the reference time of its frame.

    Attributes:
        points: (P, 4) float32, all measured points within range that the filter, if any, kept.
        cloud: (M, 4) float32, points for the local map. source: (N, 3) float64, points to register. Both are empty if
            the registration uses descriptors only.
        seen: (N, 3) float64, the points to register as the LiDAR saw them, each at its own time: times (N,), s
            relative to the reference time of the frame. Both are empty if there is no motion to undo.
        description: neural descriptors, computed when they are needed; None if the registration uses none.
        images: images of the scan, if the registration uses images.
        up: see `Frame`, if the registration makes descriptors.
        twist: (6,) [rad/s, m/s] during the scan, as far as it was known, if the registration uses images.
    """

    points: Points
    cloud: Points = field(default_factory=lambda: np.zeros((0, 4), np.float32))
    source: Array = field(default_factory=lambda: np.zeros((0, 3)))
    seen: Array = field(default_factory=lambda: np.zeros((0, 3)))
    times: Array = field(default_factory=lambda: np.zeros(0))
    description: LazyDescriptors | None = None
    images: tuple[Image, ...] = ()
    twist: Array = field(default_factory=lambda: np.zeros(6))
    up: Up | None = None

    @property
    def descriptors(self) -> Descriptors | None:
        """The descriptors, computed now if they were not before; None if there are none."""
        return None if self.description is None else self.description.get()


class Preprocessor:
    """Removes invalid points, undoes the motion, filters and downsamples."""

    def __init__(self, settings: PreprocessSettings, point_filter: PointFilter | None = None) -> None:
        self._settings = settings
        self._filter = point_filter

    def measured(self, frame: Frame, motion: Array) -> tuple[Points, NDArray[np.int64]]:
        """The valid points (P, 4), and their indices in the frame (P,).

        `motion`, (6,) twist [rad/s, m/s] or (K, 6), see `curve.poses`, is the motion that deskewing undoes.

        Removed are NaN, inf and zero points, points out of range, floating particles if there are many, and the points
        that the filter rejects.
        """
        s = self._settings
        points, used = _in_range(np.ascontiguousarray(frame.points), s.min_range**2, s.max_range**2)
        floating = scattered(points, s.scatter)
        if floating.any():
            points, used = points[~floating], used[~floating]
        if s.deskew and frame.time_offset is not None:
            points = deskew(points, frame.time_offset[used], motion, measured_turn(frame))
        if self._filter is not None:
            kept = self._filter(points)
            points, used = points[kept], used[kept]
        return points, used

    def prepare(self, frame: Frame, motion: Array) -> Scan:
        """The scan of `measured`, downsampled for local map and registration."""
        points, used = self.measured(frame, motion)
        first = voxel_first(points, self._settings.map_voxel)
        cloud = points[first]
        sparse = voxel_first(cloud, self._settings.source_voxel)
        scan = Scan(points, cloud, cloud[sparse, :3].astype(np.float64))
        if frame.time_offset is None or not self._settings.deskew:
            return scan
        indices = used[first[sparse]]
        seen, times = (part[indices].astype(np.float64) for part in (frame.points[:, :3], frame.time_offset))
        return replace(scan, seen=seen, times=times)


@compiled(types.Tuple((float32[:, ::1], int64[::1]))(READ_F4, float64, float64))
def _in_range(points: Points, least: float, most: float) -> tuple[Points, NDArray[np.int64]]:
    """Points (P, 4) of (N, 4) with a squared distance from `least` to `most`, m2, and their indices; none at 0."""
    used, index, count = np.empty_like(points), np.empty(len(points), np.int64), 0
    for i in range(len(points)):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        squared = x * x + y * y + z * z
        used[count] = points[i]
        if not np.isfinite(points[i, 3]):
            used[count, 3] = 0  # an unknown intensity
        index[count] = i
        count += squared >= least and squared <= most and squared > 0  # False for NaN
    return used[:count], index[:count]
