# SPDX-License-Identifier: Apache-2.0
"""Cells that keyframes see through, and cells in which they see something stand; kept up to date as poses change.

What a keyframe sees is kept as a fan: how far it is free in each direction, and where something stands. A fan is drawn
at the keyframe's pose, and, when that changes, taken back and drawn anew: 1 to 2 ms, where reading the cloud takes ten
times as long. Where the map needs cells of another size all are drawn anew, and the grid that was there is shown until
then: a robot that plans in it does not lose what it knew.

How a place was last seen counts for more than how it looked before: when the robot comes by again, what was moved goes,
and what is new appears.
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
_MARGIN = 20.0  # m around what is needed: the next keyframes fit as well
_BORDER = 2.0  # m: what is seen is rounded
_PLACE = np.array([6.0, 6.0, 3.0])  # m: keyframes in a box of this size see about the same
_BOX_NUMBER = 1 << np.array([42, 21, 0])  # a box as one number, by which keyframes are sorted
_NEWER, _VISITS = 3, 3  # a fan counts for three of the visit before; beyond the third all count the same
OCCUPIED, FREE, UNKNOWN = 0, 254, 205  # gray values of map_server


class OccupancySettings(Settings):
    """The grid that robots plan in."""

    resolution: float = Field(0.1, ge=0.01, le=1000)
    """Edge of a cell, m."""
    lowest: float = Field(0.25, ge=0)
    """Points nearer to the ground than this belong to it, m."""
    highest: float = 2.0
    """Points higher above the ground than this are no obstacle, m; above `lowest`."""
    reach: float = Field(30.0, gt=0, le=1000)
    """Points farther from the robot than this are not used, m."""

    @model_validator(mode="after")
    def _ordered(self) -> OccupancySettings:
        if not self.lowest < self.highest:  # else nothing would be an obstacle
            raise ValueError(f"want lowest < highest, got {self.lowest} and {self.highest}")
        return self


@dataclass(frozen=True, eq=False)
class Grid:
    """Cells (rows, columns) uint8, the row of the largest y first; `origin` is x, y of the lower left corner, m."""

    cells: NDArray[np.uint8]
    origin: tuple[float, float]
    resolution: float


@dataclass(frozen=True, eq=False)
class Fan:
    """What a keyframe sees around its LiDAR, along the axes of the map while its heading is `yaw` (rad).

    Attributes:
        origin: (2,) m, where the LiDAR is beside the keyframe.
        free: (720,) m that each direction is free. stands: (K, 2) m, places where something stands.
    """

    yaw: float
    origin: Array
    free: NDArray[np.float32]
    stands: NDArray[np.float32]


def fan_of(cloud: Points, T_map_kf: Array, settings: OccupancySettings, lidar: Array) -> Fan:
    """Of a cloud (M, 4) that was seen from `lidar` (3,), in the keyframe's frame, at T_map_kf (4, 4).

    All of it is within `reach` of the keyframe: empty, if the LiDAR is not.
    """
    near = np.einsum("ij,ij->i", cloud[:, :2], cloud[:, :2]) < settings.reach**2
    points = np.asarray(se3.transform(T_map_kf, cloud[near].astype(np.float64)), np.float64)
    yaw, size, origin = _yaw(T_map_kf), settings.resolution, T_map_kf[:2, :3] @ lidar
    if not len(points) or np.linalg.norm(lidar[:2]) > settings.reach:
        return Fan(yaw, np.zeros(2), np.zeros(_DIRECTIONS, np.float32), np.zeros((0, 2), np.float32))
    height = points[:, 2] - ground_below(points[:, :3])
    stands, ground = (height > settings.lowest) & (height < settings.highest), height < settings.lowest
    away = points[:, :2] - T_map_kf[:2, 3] - origin
    distance = np.linalg.norm(away, axis=1)
    direction = ((np.arctan2(away[:, 1], away[:, 0]) / (2 * np.pi) % 1.0) * _DIRECTIONS).astype(np.intp) % _DIRECTIONS
    blocked, seen = np.full(_DIRECTIONS, np.inf), np.zeros(_DIRECTIONS)
    np.minimum.at(blocked, direction[stands], distance[stands])
    np.maximum.at(seen, direction[ground], distance[ground])
    # To the farthest ground, but not beyond an obstacle; one is seen as well as the ground before it.
    seen = np.where(np.isfinite(blocked), np.minimum(np.maximum(seen, blocked), blocked - size), seen)
    cells = np.unique(np.floor(away[stands] / (size / 2)).astype(np.int64), axis=0)
    return Fan(yaw, origin, seen.astype(np.float32), ((cells + 0.5) * (size / 2)).astype(np.float32))


@dataclass(eq=False)
class _Entry:
    """A keyframe: its fan, the mask of moving points without which it was made, and how much it counts and the pose
    (4, 4) at which it is drawn."""

    fan: Fan
    moving: bytes | None
    count: int = 0
    T: Array | None = None


class OccupancyMap:
    """The grid of a map that grows and whose poses change.

    Args:
        settings: of the grid.
        most: cells at most; a larger map has cells of twice, four times, ... the edge.
    """

    def __init__(self, settings: OccupancySettings, most: int) -> None:
        self._settings, self._most = settings, most
        self._entries: dict[int, _Entry] = {}  # by node
        self._low, self._size = np.zeros(2, np.int64), 0.0
        self._hits = self._seen = np.zeros((0, 0), np.int32)
        self._before: Grid | None = None  # shown until everything is drawn in cells of another size

    def update(
        self,
        clouds: CloudStore,
        poses: Array,
        seconds: float = np.inf,
        placed: NDArray[np.bool_] | None = None,
    ) -> bool:
        """Bring it up to date, the newest keyframes first; False if there is more to do than `seconds` allow.

        Args:
            clouds: at `poses` (N, 4, 4) T_map_kf.
            placed: (N,) which of them are drawn, at least one; None: all.
        """
        end = time.monotonic() + seconds
        placed = np.ones(len(poses), np.bool_) if placed is None else placed
        self._make_room(poses[placed])
        counts = _counts(poses, placed & clouds.kept[: len(poses)])
        for node in [node for node in self._entries if not counts[node]]:
            self._take_back(node)
            del self._entries[node]
        for node in np.flatnonzero(counts)[::-1].tolist():
            entry, count, moving = self._entries.get(node), int(counts[node]), clouds.moving(node)
            if entry is not None and (entry.count, entry.moving) == (count, moving) and self._near(entry, poses[node]):
                continue
            if time.monotonic() > end:
                return False
            self._take_back(node)
            if entry is None or entry.moving is not moving:
                fan = fan_of(clouds.seen(node), poses[node], self._settings, clouds.seen_from(node))
                entry = self._entries[node] = _Entry(fan, moving)
            entry.count, entry.T = count, poses[node].copy()
            self._draw(entry, entry.T, 1)
        self._before = None
        return True

    def grid(self) -> Grid:
        """What is known by now: a cell is occupied where at least half of the counts that see it see something."""
        if self._before is not None:
            return self._before
        cells = np.full(self._seen.shape, UNKNOWN, np.uint8)
        cells[self._seen > 0] = FREE
        cells[(self._hits > 0) & (2 * self._hits >= self._seen)] = OCCUPIED
        known = cells != UNKNOWN
        spans = [np.flatnonzero(known.any(1 - axis)) for axis in (0, 1)]
        (x, columns), (y, rows) = [(s[0], s[-1] + 1) if len(s) else (0, 1) for s in spans]
        corner = np.round((self._low + np.array([x, y])) * self._size, 6)
        cut = np.ascontiguousarray(cells[x:columns, y:rows].T[::-1])
        return Grid(cut, (float(corner[0]), float(corner[1])), self._size)

    def _make_room(self, poses: Array) -> None:
        """For these keyframes; in cells of another size, if there would be too many."""
        size, end = self._settings.resolution, self._low + self._seen.shape
        first, last = self._corners(poses, size)
        while np.prod(last - first) > self._most:
            size *= 2
            first, last = self._corners(poses, size)
        if size == self._size and (first >= self._low).all() and (last <= end).all():
            return
        if size == self._size:  # what is drawn stays, even where it is to be drawn elsewhere
            both = self._corners(np.array([*poses, *(e.T for e in self._entries.values() if e.T is not None)]), size)
            if np.prod(both[1] - both[0]) <= self._most:
                self._move(*both)
                return
        if self._seen.any():
            self._before = self.grid()
        for entry in self._entries.values():
            entry.T = None
        self._size, self._hits, self._seen = size, *(np.zeros((0, 0), np.int32) for _ in range(2))
        self._move(first, last)

    def _corners(self, poses: Array, size: float) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """First cell, and that after the last, of all that fans at (N, 4, 4) reach."""
        reach = self._settings.reach + _BORDER
        low, high = poses[:, :2, 3].min(0) - reach, poses[:, :2, 3].max(0) + reach
        return np.floor(low / size).astype(np.int64), np.ceil(high / size).astype(np.int64)

    def _move(self, first: NDArray[np.int64], last: NDArray[np.int64]) -> None:
        """Have cells from a corner to another, with a margin, if there is room for one; those that are there stay."""
        width, height = (last - first).tolist()
        room = (((width - height) ** 2 + 4 * self._most) ** 0.5 - width - height) / 4  # on each side
        margin = int(max(0.0, min(_MARGIN / self._size, room)))
        low, shape, before = first - margin, last - first + 2 * margin, (self._hits, self._seen)
        self._hits, self._seen = (np.zeros(shape, np.int32) for _ in range(2))
        a, b = np.maximum(low, self._low), np.minimum(low + shape, self._low + before[0].shape)
        new, old = (tuple(map(slice, a - corner, b - corner)) for corner in (low, self._low))
        if (a < b).all():
            self._hits[new], self._seen[new] = before[0][old], before[1][old]
        self._low = low

    def _take_back(self, node: int) -> None:
        entry = self._entries.get(node)
        if entry is not None and entry.T is not None:
            self._draw(entry, entry.T, -1)
            entry.T = None

    def _near(self, entry: _Entry, T_now: Array) -> bool:
        """Whether a fan is drawn so near to T_now (4, 4) that it may stay."""
        if entry.T is None:
            return False
        meters = float(np.abs(entry.T[:2, 3] - T_now[:2, 3]).max())
        turn = abs(_wrapped(_yaw(entry.T) - _yaw(T_now)))
        return meters + turn * self._settings.reach / 2 < self._size / 2

    def _draw(self, entry: _Entry, T: Array, sign: int) -> None:
        fan, times = entry.fan, sign * entry.count
        turn = _yaw(T) - fan.yaw
        cos, sin = np.cos(turn), np.sin(turn)
        low, (x, y) = self._low * self._size, (T[:2, 3] + [[cos, -sin], [sin, cos]] @ fan.origin).tolist()
        _draw_fan(self._hits, self._seen, x - low[0], y - low[1], turn, self._size, fan.free, fan.stands, times)


def _counts(poses: Array, drawn: NDArray[np.bool_]) -> NDArray[np.int64]:
    """(N,) how much each of (N, 4, 4) keyframes counts by how often the robot was there later; 0 if it is not `drawn`.

    Places are boxes, in all eight ways to lay them half a box apart: two keyframes that are near share one of them.
    """
    nodes, counts = np.flatnonzero(drawn), np.zeros(len(poses), np.int64)
    later = np.zeros(len(nodes), np.int64)
    for shift in np.ndindex(2, 2, 2):
        box = np.floor(poses[nodes, :3, 3] / _PLACE + np.array(shift) / 2).astype(np.int64) @ _BOX_NUMBER
        order = np.argsort(box, kind="stable")
        first = np.diff(box[order], prepend=box[order[:1]] - 1) != 0
        visit = np.cumsum(first | (np.diff(nodes[order], prepend=0) > LAP))
        last = np.append(visit[np.flatnonzero(first)[1:] - 1], visit[-1:])[np.cumsum(first) - 1]
        later[order] = np.maximum(later[order], last - visit)
    counts[nodes] = _NEWER ** (_VISITS - np.minimum(later, _VISITS))
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
    """Add `times` to every cell that a fan at x, y (m from the corner of the grids), turned by `turn` (rad), sees."""
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
