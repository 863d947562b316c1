# SPDX-License-Identifier: Apache-2.0
"""Grid of free and occupied cells that keyframes observe; it is updated as poses change.

The observation of a keyframe is stored as a fan: the free distance in each direction, and the obstacles. A fan is drawn
at the keyframe's pose. When the pose changes, the fan is removed and drawn anew: 1 to 2 ms, a tenth of the time to read
the cloud. If the map needs cells of another size, all fans are drawn anew, and the previous grid is returned until
then: a robot that plans in it does not lose information.

The last observation of a place counts for more than earlier ones: when the robot returns, things that were moved
disappear, and new ones appear.
"""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from dpm2_core.config import Settings
from dpm2_core.frame import Array, Points
from dpm2_core.geometry import se3
from dpm2_core.geometry.compiled import compiled
from dpm2_core.geometry.ground import ground_below
from dpm2_core.slam.mapping.redundancy import LAP
from dpm2_core.slam.store.cloud_store import CloudStore

_DIRECTIONS = 720
_MARGIN = 20.0  # m around the cells that are needed, for the next keyframes
_BORDER = 2.0  # m, for rounding
_PLACE_SIZE = np.array([6.0, 6.0, 3.0])  # m: keyframes in a box of this size see about the same
_BOX_NUMBER = 1 << np.array([42, 21, 0])  # encodes a box as one number, for sorting
_VISIT_FACTOR, _MAX_VISITS = 3, 3  # a fan counts as three of the previous visit; all with 3 or more later visits equal
OCCUPIED, FREE, UNKNOWN = 0, 254, 205  # gray values of map_server


class OccupancySettings(Settings):
    """The grid for navigation."""

    resolution: float = Field(0.1, ge=0.01, le=1000)
    """Edge of a cell, m."""
    lowest: float = Field(0.25, ge=0)
    """Points less than this above the ground belong to it, m."""
    highest: float = 2.0
    """Points more than this above the ground are no obstacles, m; more than `lowest`."""
    reach: float = Field(30.0, gt=0, le=1000)
    """Points farther from the robot than this are not used, m."""

    @model_validator(mode="after")
    def _ordered(self) -> OccupancySettings:
        if not self.lowest < self.highest:  # else nothing would be an obstacle
            raise ValueError(f"want lowest < highest, got {self.lowest} and {self.highest}")
        return self


@dataclass(frozen=True, eq=False)
class Grid:
    """Cells (rows, columns) uint8, the first row has the largest y; `origin` is x, y of the lower left corner, m."""

    cells: NDArray[np.uint8]
    origin: tuple[float, float]
    resolution: float


@dataclass(frozen=True, eq=False)
class Fan:
    """The observation of a keyframe around its LiDAR, in the map's axes for a keyframe heading of `yaw` (rad).

    Attributes:
        origin: (2,) m, position of the LiDAR relative to the keyframe.
        free: (720,) m, free distance in each direction. stands: (K, 2) m, positions of obstacles.
    """

    yaw: float
    origin: Array
    free: NDArray[np.float32]
    stands: NDArray[np.float32]


def fan_of(cloud: Points, T_map_kf: Array, settings: OccupancySettings, lidar: Array) -> Fan:
    """The fan of a cloud (M, 4), seen from `lidar` (3,) in the keyframe's frame, at T_map_kf (4, 4).

    All of it is within `reach` of the keyframe; it is empty if the LiDAR is not.
    """
    near = np.einsum("ij,ij->i", cloud[:, :2], cloud[:, :2]) < settings.reach**2
    points = np.asarray(se3.transform(T_map_kf, cloud[near].astype(np.float64)), np.float64)
    yaw, size, origin = _yaw(T_map_kf), settings.resolution, T_map_kf[:2, :3] @ lidar
    if not len(points) or np.linalg.norm(lidar[:2]) > settings.reach:
        return Fan(yaw, np.zeros(2), np.zeros(_DIRECTIONS, np.float32), np.zeros((0, 2), np.float32))
    height = points[:, 2] - ground_below(points[:, :3])
    stands, ground = (height > settings.lowest) & (height < settings.highest), height < settings.lowest
    offsets = points[:, :2] - T_map_kf[:2, 3] - origin
    distance = np.linalg.norm(offsets, axis=1)
    direction = ((np.arctan2(offsets[:, 1], offsets[:, 0]) / (2 * np.pi) % 1.0) * _DIRECTIONS).astype(
        np.intp
    ) % _DIRECTIONS
    blocked, seen = np.full(_DIRECTIONS, np.inf), np.zeros(_DIRECTIONS)
    np.minimum.at(blocked, direction[stands], distance[stands])
    np.maximum.at(seen, direction[ground], distance[ground])
    # Up to the farthest ground, but not beyond an obstacle; an obstacle shows that the ground before it is free.
    seen = np.where(np.isfinite(blocked), np.minimum(np.maximum(seen, blocked), blocked - size), seen)
    cells = np.unique(np.floor(offsets[stands] / (size / 2)).astype(np.int64), axis=0)
    return Fan(yaw, origin, seen.astype(np.float32), ((cells + 0.5) * (size / 2)).astype(np.float32))


@dataclass(eq=False)
class _Entry:
    """A keyframe: its fan, the mask of moving points that the fan leaves out, its count, and the pose (4, 4) at which
    it is drawn."""

    fan: Fan
    moving: bytes | None
    count: int = 0
    T: Array | None = None


class OccupancyMap:
    """The grid of a growing map with changing poses.

    Args:
        settings: of the grid.
        most: maximum number of cells; a larger map has cells with twice, four times, ... the edge.
    """

    def __init__(self, settings: OccupancySettings, most: int) -> None:
        self._settings, self._max_cells = settings, most
        self._entries: dict[int, _Entry] = {}  # by node
        self._first_cell, self._size = np.zeros(2, np.int64), 0.0
        self._hits = self._seen = np.zeros((0, 0), np.int32)
        self._previous_grid: Grid | None = None  # returned until everything is drawn with another cell size

    def update(
        self,
        clouds: CloudStore,
        poses: Array,
        seconds: float = np.inf,
        placed: NDArray[np.bool_] | None = None,
    ) -> bool:
        """Update the grid, the newest keyframes first; False if there is more to do than `seconds` allow.

        Args:
            clouds: at `poses` (N, 4, 4) T_map_kf.
            placed: (N,) mask of the keyframes that are drawn, at least one; None: all.
        """
        end = time.monotonic() + seconds
        placed = np.ones(len(poses), np.bool_) if placed is None else placed
        self._make_room(poses[placed])
        counts = _visit_weights(poses, placed & clouds.kept[: len(poses)])
        for node in [node for node in self._entries if not counts[node]]:
            self._erase(node)
            del self._entries[node]
        for node in np.flatnonzero(counts)[::-1].tolist():
            entry, count, moving = self._entries.get(node), int(counts[node]), clouds.moving(node)
            if (
                entry is not None
                and (entry.count, entry.moving) == (count, moving)
                and self._is_current(entry, poses[node])
            ):
                continue
            if time.monotonic() > end:
                return False
            self._erase(node)
            if entry is None or entry.moving is not moving:
                fan = fan_of(clouds.seen(node), poses[node], self._settings, clouds.seen_from(node))
                entry = self._entries[node] = _Entry(fan, moving)
            entry.count, entry.T = count, poses[node].copy()
            self._draw(entry, entry.T, 1)
        self._previous_grid = None
        return True

    def grid(self) -> Grid:
        """The current grid: a cell is occupied if at least half of the counts that see it see an obstacle."""
        if self._previous_grid is not None:
            return self._previous_grid
        cells = np.full(self._seen.shape, UNKNOWN, np.uint8)
        cells[self._seen > 0] = FREE
        cells[(self._hits > 0) & (2 * self._hits >= self._seen)] = OCCUPIED
        known = cells != UNKNOWN
        spans = [np.flatnonzero(known.any(1 - axis)) for axis in (0, 1)]
        (x, columns), (y, rows) = [(s[0], s[-1] + 1) if len(s) else (0, 1) for s in spans]
        corner = np.round((self._first_cell + np.array([x, y])) * self._size, 6)
        cut = np.ascontiguousarray(cells[x:columns, y:rows].T[::-1])
        return Grid(cut, (float(corner[0]), float(corner[1])), self._size)

    def _make_room(self, poses: Array) -> None:
        """Make room for these keyframes; with another cell size, if there would be too many cells."""
        size, end = self._settings.resolution, self._first_cell + self._seen.shape
        first, last = self._corners(poses, size)
        while np.prod(last - first) > self._max_cells:
            size *= 2
            first, last = self._corners(poses, size)
        if size == self._size and (first >= self._first_cell).all() and (last <= end).all():
            return
        if size == self._size:  # fans that are drawn stay, even if they are to be drawn at another pose
            both = self._corners(np.array([*poses, *(e.T for e in self._entries.values() if e.T is not None)]), size)
            if np.prod(both[1] - both[0]) <= self._max_cells:
                self._resize(*both)
                return
        if self._seen.any():
            self._previous_grid = self.grid()
        for entry in self._entries.values():
            entry.T = None
        self._size, self._hits, self._seen = size, *(np.zeros((0, 0), np.int32) for _ in range(2))
        self._resize(first, last)

    def _corners(self, poses: Array, size: float) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """First cell, and the one after the last, within reach of fans at (N, 4, 4)."""
        reach = self._settings.reach + _BORDER
        low, high = poses[:, :2, 3].min(0) - reach, poses[:, :2, 3].max(0) + reach
        return np.floor(low / size).astype(np.int64), np.ceil(high / size).astype(np.int64)

    def _resize(self, first: NDArray[np.int64], last: NDArray[np.int64]) -> None:
        """Resize the grid to these corners, with a margin if there is room for it; existing cells are kept."""
        width, height = (last - first).tolist()
        room = (((width - height) ** 2 + 4 * self._max_cells) ** 0.5 - width - height) / 4  # on each side
        margin = int(max(0.0, min(_MARGIN / self._size, room)))
        low, shape, before = first - margin, last - first + 2 * margin, (self._hits, self._seen)
        self._hits, self._seen = (np.zeros(shape, np.int32) for _ in range(2))
        a, b = np.maximum(low, self._first_cell), np.minimum(low + shape, self._first_cell + before[0].shape)
        new, old = (tuple(map(slice, a - corner, b - corner)) for corner in (low, self._first_cell))
        if (a < b).all():
            self._hits[new], self._seen[new] = before[0][old], before[1][old]
        self._first_cell = low

    def _erase(self, node: int) -> None:
        entry = self._entries.get(node)
        if entry is not None and entry.T is not None:
            self._draw(entry, entry.T, -1)
            entry.T = None

    def _is_current(self, entry: _Entry, T_now: Array) -> bool:
        """Whether a fan is drawn so close to T_now (4, 4) that it need not be redrawn."""
        if entry.T is None:
            return False
        meters = float(np.abs(entry.T[:2, 3] - T_now[:2, 3]).max())
        turn = abs(_wrapped(_yaw(entry.T) - _yaw(T_now)))
        return meters + turn * self._settings.reach / 2 < self._size / 2

    def _draw(self, entry: _Entry, T: Array, sign: int) -> None:
        fan, times = entry.fan, sign * entry.count
        turn = _yaw(T) - fan.yaw
        cos, sin = np.cos(turn), np.sin(turn)
        low, (x, y) = self._first_cell * self._size, (T[:2, 3] + [[cos, -sin], [sin, cos]] @ fan.origin).tolist()
        _draw_fan(self._hits, self._seen, x - low[0], y - low[1], turn, self._size, fan.free, fan.stands, times)


def _visit_weights(poses: Array, drawn: NDArray[np.bool_]) -> NDArray[np.int64]:
    """(N,) weight of each of (N, 4, 4) keyframes, by the number of later visits to its place; 0 if it is not `drawn`.

    Places are boxes, in all eight arrangements shifted by half a box: two close keyframes share one of them.
    """
    nodes, counts = np.flatnonzero(drawn), np.zeros(len(poses), np.int64)
    later = np.zeros(len(nodes), np.int64)
    for shift in np.ndindex(2, 2, 2):
        box = np.floor(poses[nodes, :3, 3] / _PLACE_SIZE + np.array(shift) / 2).astype(np.int64) @ _BOX_NUMBER
        order = np.argsort(box, kind="stable")
        first = np.diff(box[order], prepend=box[order[:1]] - 1) != 0
        visit = np.cumsum(first | (np.diff(nodes[order], prepend=0) > LAP))
        last = np.append(visit[np.flatnonzero(first)[1:] - 1], visit[-1:])[np.cumsum(first) - 1]
        later[order] = np.maximum(later[order], last - visit)
    counts[nodes] = _VISIT_FACTOR ** (_MAX_VISITS - np.minimum(later, _MAX_VISITS))
    return counts


@compiled("void(i4[:,::1], i4[:,::1], f8, f8, f8, f8, f4[::1], f4[:,::1], i8)")
def _draw_fan(  # noqa: PLR0913
    hits: NDArray[np.int32],
    seen: NDArray[np.int32],
    x: float,
    y: float,
    turn: float,
    size: float,
    free: NDArray[np.float32],
    stands: NDArray[np.float32],
    times: int,
) -> None:
    """Add `times` to all cells that a fan at x, y (m from the corner of the grids), rotated by `turn` (rad), sees."""
    reach = float(free.max())
    for k in range(len(stands)):
        reach = max(reach, float(np.hypot(stands[k, 0], stands[k, 1])))
    radius = int(reach / size) + 2
    first, second = int(np.floor(x / size)) - radius, int(np.floor(y / size)) - radius
    marks = np.zeros((2 * radius + 1, 2 * radius + 1), np.uint8)
    for d in range(len(free)):
        angle = (d + 0.5) / len(free) * 2 * np.pi + turn
        dx, dy = np.cos(angle) * size / 2, np.sin(angle) * size / 2
        for step in range(int(np.ceil(free[d] / (size / 2)))):
            marks[int(np.floor((x + step * dx) / size)) - first, int(np.floor((y + step * dy) / size)) - second] |= 1
    cos, sin = np.cos(turn), np.sin(turn)
    for k in range(len(stands)):
        px, py = x + cos * stands[k, 0] - sin * stands[k, 1], y + sin * stands[k, 0] + cos * stands[k, 1]
        marks[int(np.floor(px / size)) - first, int(np.floor(py / size)) - second] |= 2
    for i in range(max(0, -first), min(len(marks), seen.shape[0] - first)):
        for j in range(max(0, -second), min(len(marks), seen.shape[1] - second)):
            seen[first + i, second + j] += times * (marks[i, j] & 1)
            hits[first + i, second + j] += times * (marks[i, j] >> 1)


def _yaw(T: Array) -> float:
    return float(np.arctan2(T[1, 0], T[0, 0]))


def _wrapped(angle: float) -> float:
    return (angle + np.pi) % (2 * np.pi) - np.pi
