# SPDX-License-Identifier: Apache-2.0
"""Finds points of a cloud on things that have moved away: other keyframes see through the place where they were.

A cloud is compared with range images of neighboring keyframes. If a neighbor sees nothing at or before a point but
something well behind it, the point was not there at that time. One such witness may be chance (leaves, glass, the rim
of a pole), so two are required, and more than the neighbors that saw something at the point.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.ndimage import minimum_filter
from scipy.spatial import cKDTree

from dpm2_core.descriptors import levelling
from dpm2_core.frame import Array, Points, Up
from dpm2_core.geometry import se3
from dpm2_core.geometry.ground import height_above_ground
from dpm2_core.geometry.tilt import tilt_of

Mask = NDArray[np.bool_]

_PIXEL = np.radians(1.0)
_COLUMNS = 360
_MIN_ELEVATION, _ROWS = np.radians(-45.0), 90
_HALF_WINDOWS = (1, 2, 4)  # half sizes, pixels, of the windows in which a close return counts
_CLEARANCE = 0.25  # m above the local ground: lower points are kept, since the ground is seen at grazing angles
_MIN_WITNESSES = 2  # neighbors that must see through the place of a point
_MIN_GAP = (0.5, 0.03)  # m, and per meter of range: minimum distance of their return behind the point
_FOOTPRINT = 0.3  # m: a return within this of the line of sight counts as seeing the point
_TOUCH_DISTANCE = 0.7  # m: points this close to a moving one move with it, unless neighbors saw them...
_MAX_EXTENT = 2.0  # ...and so on, up to this distance, m, from those that were seen through: not along a whole wall


class RangeImage:
    """The closest return in each direction from a sensor, one degree per pixel; inf if there is none."""

    def __init__(self, points: Points) -> None:
        """(M, 4) in the sensor's frame."""
        r, row, column = _spherical(points[:, :3])
        self._closest = _closest_returns(r, row, column)
        # The ground before an object is within any window around it, but occludes nothing.
        above = height_above_ground(points) > _CLEARANCE
        closest_object = _closest_returns(r[above], row[above], column[above])
        self._closest_around = [
            minimum_filter(closest_object, 2 * half + 1, mode=("nearest", "wrap")) for half in _HALF_WINDOWS
        ]

    def compare(self, points: Points) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
        """Masks of (M, 3+) points in the sensor's frame: which are seen through, and which are seen."""
        r, row, column = _spherical(points[:, :3])
        margin = _MIN_GAP[0] + _MIN_GAP[1] * r
        window = np.searchsorted(_HALF_WINDOWS[:-1], _FOOTPRINT / np.maximum(r, 0.1) / _PIXEL)
        closest_around = np.choose(window, [image[row, column] for image in self._closest_around])
        closest = self._closest[row, column]
        through = np.isfinite(closest) & (np.minimum(closest, closest_around) > r + margin) & (r > 2.0)
        return through, np.abs(closest_around - r) <= margin


def _closest_returns(r: Points, row: NDArray[np.intp], column: NDArray[np.intp]) -> Points:
    image = np.full((_ROWS, _COLUMNS), np.inf, np.float32)
    np.minimum.at(image, (row, column), r)
    return image


def find_moving(cloud: Points, T_map_kf: Array, others: Sequence[tuple[RangeImage, Array]]) -> NDArray[np.bool_]:
    """Which of the (M, 4) points of a keyframe are on moving objects.

    Args:
        cloud: in the keyframe's frame, which is level, and whose origin is the LiDAR. T_map_kf: (4, 4).
        others: range image and T_map_kf of the other keyframes.

    Returns:
        (M,) bool.
    """
    through, seen = np.zeros(len(cloud), np.int16), np.zeros(len(cloud), np.int16)
    candidates = np.flatnonzero(height_above_ground(cloud) > _CLEARANCE)
    points = cloud[candidates]
    for image, T_map_other in others:
        is_through, is_seen = image.compare(se3.transform(se3.inverse(T_map_other) @ T_map_kf, points))
        through[candidates] += is_through
        seen[candidates] += is_seen
    moving = (through >= _MIN_WITNESSES) & (through > seen)
    return _grow(moving, cloud, candidates[through[candidates] >= seen[candidates]])


def _grow(moving: Mask, cloud: Points, candidates: NDArray[np.intp]) -> Mask:
    """Add the candidates that touch a moving point: the rest of a car, against the sky or outside of their view."""
    grown = moving.copy()
    edge = np.flatnonzero(moving)
    candidates = _within(_MAX_EXTENT, candidates, edge, cloud)
    while len(edge):
        edge = _within(_TOUCH_DISTANCE, candidates, edge, cloud)
        edge = edge[~grown[edge]]
        grown[edge] = True
    return grown


def _within(reach: float, these: NDArray[np.intp], others: NDArray[np.intp], cloud: Points) -> NDArray[np.intp]:
    """Those of some points that are within `reach`, m, of one of the others."""
    if not len(these) or not len(others):
        return these[:0]
    near, _ = cKDTree(cloud[others, :3]).query(cloud[these, :3], distance_upper_bound=reach)
    return these[np.isfinite(near)]


class MovingWindow:
    """The last keyframes of a drive: each is checked once as many keyframes are after it as before it."""

    def __init__(self, window: int) -> None:
        """`window`: see `MapSettings.moving_window`."""
        self._window = window
        self._recent: deque[tuple[int, Points, RangeImage, Array]] = deque(maxlen=2 * window + 1)
        self._next = 0  # the first node that has not been checked

    def add(
        self, node: int, cloud: Points, poses: Array, origin: ArrayLike = (0.0, 0.0, 0.0), up: Up | None = None
    ) -> Iterator[tuple[int, NDArray[np.bool_]]]:
        """Add the whole cloud (M, 4) of the next node; yields the node that can be checked now, and its mask.

        `poses` (N, 4, 4) are T_map_kf of all nodes so far, `origin` (3,) is the position of the LiDAR in the node's
        frame, `up` the up direction there, if it is known.
        """
        if self._window:
            T_kf_level = se3.make(levelling(tilt_of(cloud, up)).T, origin)
            cloud = se3.transform(se3.inverse(T_kf_level), cloud)
            self._recent.append((node, cloud, RangeImage(cloud), T_kf_level))
            if len(self._recent) > self._window:
                yield from self._compare(self._recent[-1 - self._window][0], poses)

    def finish(self, poses: Array) -> Iterator[tuple[int, NDArray[np.bool_]]]:
        """Check the keyframes at the end of the drive against those that are available."""
        if self._recent:
            yield from self._compare(self._recent[-1][0], poses)

    def _compare(self, last: int, poses: Array) -> Iterator[tuple[int, NDArray[np.bool_]]]:
        for node, cloud, _, T_kf_level in self._recent:
            if self._next <= node <= last:
                others = [(image, poses[n] @ T) for n, _, image, T in self._recent if n != node]
                yield node, find_moving(cloud, poses[node] @ T_kf_level, others)
                self._next = node + 1


def _spherical(xyz: Points) -> tuple[Points, NDArray[np.intp], NDArray[np.intp]]:
    """Range (M,) m, row and column (M,) of the range image for (M, 3) points."""
    r = np.sqrt(np.einsum("ij,ij->i", xyz, xyz))
    elevation = np.arcsin(np.clip(xyz[:, 2] / np.maximum(r, 1e-6), -1, 1))
    row = np.clip((elevation - _MIN_ELEVATION) / _PIXEL, 0, _ROWS - 1).astype(np.intp)
    column = (np.arctan2(xyz[:, 1], xyz[:, 0]) / _PIXEL).astype(np.float64) % _COLUMNS
    return r, row, np.minimum(column.astype(np.intp), _COLUMNS - 1)
