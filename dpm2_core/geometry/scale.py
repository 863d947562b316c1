# SPDX-License-Identifier: Apache-2.0
"""Classifies a scan as indoor or outdoor from the amount of visible surface and its distance.

And the resulting scale for the network, which was trained on streets: an enlarged room looks like one.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Generic, TypeVar

import numpy as np

from dpm2_core.frame import Array, Points
from dpm2_core.geometry.scatter import scattered
from dpm2_core.geometry.voxel import voxel_first

_CELL = 0.5  # m: surface in one cell counts once, however many beams hit it
_MAX_POINTS = 20_000  # points are enough
_MIN_RANGE = 0.3  # m
# Number of visible cells, and the distance of three quarters of them, m. Measured: rooms and offices 130 to 530 cells
# within 8 m; streets, tunnels, highways and car parks, also with 16 beams, 1,900 to 11,000 within 14 m and more. A hall
# shows 740 to 925 within 10 m with 16 beams; a yard of 18 by 20 m, seen by a LiDAR 70 degrees wide, 2,300 and more.
_ROOM = (800, 18.0)
_HALL_DISTANCE = 10.0
_OPEN = (1300, 25.0)
_MAX_ENCLOSED_RANGE = 2.0  # m: working rooms are larger than this in all directions
_SECTORS = 6  # per half revolution: a LiDAR that looks only ahead cannot show what is behind it
_ENCLOSED_POINTS = 2000  # points
_MIN_CELLS = 30  # cells: fewer are not enough to decide
ROOM_SCALE = 5.0
"""Scale of indoor scans. Measured, 16 beams, share of pairs up to 1 / 1 to 2 m apart registered to 0.3 m and 3 degrees:
67 to 100 / 20 to 47 % unscaled, 100 / 73 to 93 % enlarged, with a fifth of the error; 4 to 8 give the same."""

T = TypeVar("T")


def is_room(points: Points) -> bool | None:
    """True for a room, a corridor or a hall, False for a street or a tunnel, None if it may be either.

    Args:
        points: (N, 4) a scan in the LiDAR frame, or a keyframe's cloud; NaN and zeros are ignored.
    """
    return look(points)[0]


def look(points: Points) -> tuple[bool | None, int]:
    """Like `is_room`; also the approximate number of points that are not airborne particles."""
    step = max(1, len(points) // _MAX_POINTS)
    sample = points[::step]
    ranges = np.linalg.norm(sample[:, :3], axis=1)
    valid = (ranges > _MIN_RANGE) & (ranges < 1e4)  # False for NaN
    sample, ranges = sample[valid], ranges[valid]
    is_solid = ~scattered(sample)
    sample, ranges = sample[is_solid], ranges[is_solid]
    cells = voxel_first(sample, _CELL) if len(sample) else np.zeros(0, int)
    return _classify(ranges[cells]), len(sample) * step


def _classify(ranges: Array) -> bool | None:
    """See `is_room`; `ranges` (C,): distances of the visible cells, m."""
    if len(ranges) < _MIN_CELLS:
        return None
    distance = float(np.percentile(ranges, 75))
    if len(ranges) >= _OPEN[0] or distance >= _OPEN[1]:
        return False
    return True if distance <= _HALL_DISTANCE or (len(ranges) <= _ROOM[0] and distance <= _ROOM[1]) else None


@dataclass(frozen=True)
class ByScale(Generic[T]):
    """An outdoor variant, also used if the scan may be either, and an indoor variant."""

    outdoor: T
    indoor: T

    def suited_to(self, points: Points) -> T:
        """The variant for a scan (N, 4), or a keyframe's cloud."""
        return self.indoor if is_room(points) else self.outdoor


def scale_of(points: Points) -> float:
    """The factor by which a scan (N, 4), or a keyframe's cloud, is enlarged for the network: 1 outdoors."""
    return ByScale(1.0, ROOM_SCALE).suited_to(points)


def is_enclosed(points: Points) -> bool:
    """Whether a scan (N, 4) shows only close surfaces, all around: an elevator car, which may move with the sensor."""
    sample = points[:: max(1, len(points) // _ENCLOSED_POINTS)]
    ranges = np.linalg.norm(sample[:, :3], axis=1)
    valid = ranges > 0  # False for NaN
    if valid.sum() < _ENCLOSED_POINTS // 4 or np.percentile(ranges[valid], 99) > _MAX_ENCLOSED_RANGE:
        return False
    heading = np.arctan2(sample[valid, 1], sample[valid, 0])
    return len(np.unique(np.floor(heading / (np.pi / _SECTORS)))) >= 2 * _SECTORS
