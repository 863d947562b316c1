# SPDX-License-Identifier: Apache-2.0
"""Floor plans: rooms, corridors, halls and doors, or a car park's deck; and a closed path through them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from dpm2_core.errors import UsageError
from dpm2_core.frame import Array

RoomKind = Literal["room", "corridor", "hall", "stairs", "deck"]
_MIN_ROOM_WIDTH = 2.4
"""Smallest width of a room that is no corridor, m."""
AISLE = 6.2
"""Width of the lanes of a car park, m; the rows of cars between them are `ROW` deep."""
ROW = 10.0
PIPE = 0.57
"""Distance of the lowest pipe of a deck below its ceiling, m."""
_MAX_ATTEMPTS = 50  # attempts to plan a building with more than a single hall


@dataclass(frozen=True)
class Room:
    """An upright, empty box: `low` and `high` (x, y) m, `height` m."""

    kind: RoomKind
    low: tuple[float, float]
    high: tuple[float, float]
    height: float

    @property
    def center(self) -> Array:
        """Center (2,) m."""
        return (np.array(self.low) + self.high) / 2

    @property
    def size(self) -> Array:
        """Size (2,) m."""
        return np.array(self.high) - self.low


@dataclass(frozen=True)
class Door:
    """An opening in the wall that two rooms share.

    Attributes:
        rooms: numbers of both. axis: 0 for a wall at a constant x, 1 at a constant y. at: that constant, m.
        start, end: positions along the wall, m. top: height, m.
    """

    rooms: tuple[int, int]
    axis: int
    at: float
    start: float
    end: float
    top: float

    def point(self, towards: Array, away: float) -> Array:
        """(2,) point in front of the middle of the door, `away` m on the side of a position (2,)."""
        out = np.full(2, (self.start + self.end) / 2)
        out[self.axis] = self.at + away * np.sign(towards[self.axis] - self.at)
        return out


@dataclass(frozen=True)
class FloorPlan:
    """Rooms, the doors between them, and the corners (K, 2) of a closed path through all of them."""

    rooms: list[Room]
    doors: list[Door]
    way: Array

    @property
    def headroom(self) -> float:
        """Smallest height along the path, m: of doors, or of the pipe below the ceiling of a deck."""
        decks = [room.height - PIPE for room in self.rooms if room.kind == "deck"]
        return min([door.top for door in self.doors] + decks)


def office(length: float, rng: np.random.Generator) -> FloorPlan:
    """A floor of rooms, corridors, halls and a staircase, with a path of very roughly `length` m through it.

    Raises:
        UsageError: too short for two rooms.
    """
    area, aspect = 1.8 * length, rng.uniform(0.8, 1.8)
    size = np.sqrt([area * aspect, area / aspect])
    for _ in range(_MAX_ATTEMPTS):
        rooms = _split((0.0, 0.0), (float(size[0]), float(size[1])), rng)
        if len(rooms) > 1:  # a single hall has no door, and so no path
            break
    else:
        raise UsageError(f"a building for a route of {length:g} m has a single room; want a longer route: more frames")
    kinds = [
        k for k, room in enumerate(rooms) if room.kind == "room" and room.size.min() > 3.2 and room.size.max() > 4.5
    ]
    if kinds:
        k = kinds[int(rng.integers(len(kinds)))]
        rooms[k] = Room("stairs", rooms[k].low, rooms[k].high, rooms[k].height + 3)
    tree, others = _connect(rooms, rng)
    return FloorPlan(rooms, tree + others, _tour(rooms, tree))


def car_park(length: float, rng: np.random.Generator) -> FloorPlan:
    """A deck with rows of parked cars, and a path around one to four of them."""
    pitch, rows = AISLE + ROW, int(np.clip(round(length / 110), 1, 4))
    reach = max(length / 2 - rows * pitch, 24.0)
    high = (reach + AISLE, rows * pitch + AISLE)
    deck = Room("deck", (-5.2, -5.2), (high[0] + 5.2, high[1] + 5.2), float(rng.uniform(2.3, 3.2)))
    a, b = AISLE / 2, rows * pitch + AISLE / 2
    return FloorPlan([deck], [], np.array([(a, a), (reach + a, a), (reach + a, b), (a, b)]))


def _split(low: tuple[float, float], high: tuple[float, float], rng: np.random.Generator) -> list[Room]:
    """Rooms that fill a rectangle: split at random, sometimes along a corridor, until they have usual sizes."""
    size = np.array(high) - low
    axis = int(size[1] > size[0])
    area, min_size = float(size.prod()), 2 * _MIN_ROOM_WIDTH
    hall = area < 220 and size.min() > 7 and rng.random() < 0.2
    if hall or size[axis] < min_size + 0.5 or area < rng.uniform(12, 55):
        kind: RoomKind = "hall" if hall else "corridor" if size.min() < _MIN_ROOM_WIDTH else "room"
        height = rng.uniform(4, 7) if hall else rng.uniform(2.4, 3.3)
        return [Room(kind, low, high, float(height))]
    width = float(rng.uniform(1.6, 2.3)) if size[axis] > 9 and rng.random() < 0.6 else 0.0
    cut = float(rng.uniform(low[axis] + _MIN_ROOM_WIDTH, high[axis] - _MIN_ROOM_WIDTH - width))
    first_high, second_low = list(high), list(low)
    first_high[axis], second_low[axis] = cut, cut + width
    out = _split(low, (first_high[0], first_high[1]), rng) + _split((second_low[0], second_low[1]), high, rng)
    if width:
        corridor_low, corridor_high = list(low), list(high)
        corridor_low[axis], corridor_high[axis] = cut, cut + width
        out.append(
            Room(
                "corridor",
                (corridor_low[0], corridor_low[1]),
                (corridor_high[0], corridor_high[1]),
                float(rng.uniform(2.4, 3.0)),
            )
        )
    return out


def _connect(rooms: list[Room], rng: np.random.Generator) -> tuple[list[Door], list[Door]]:
    """Doors that connect all rooms in a tree, through corridors if possible, and a few more."""
    found = [door for i in range(len(rooms)) for j in range(i + 1, len(rooms)) if (door := _door(rooms, i, j, rng))]
    corridors = [any(rooms[k].kind == "corridor" for k in door.rooms) for door in found]
    order = np.argsort(rng.random(len(found)) - 2 * np.array(corridors, float))
    group, tree, others = list(range(len(rooms))), [], []
    for k in order:
        a, b = (group[r] for r in found[k].rooms)
        if a != b:
            group = [b if g == a else g for g in group]
            tree.append(found[k])
        elif rng.random() < 0.2:
            others.append(found[k])
    return tree, others


def _door(rooms: list[Room], i: int, j: int, rng: np.random.Generator) -> Door | None:
    a, b = rooms[i], rooms[j]
    for axis in (0, 1):
        along = 1 - axis
        for first, second in ((a, b), (b, a)):
            if abs(first.high[axis] - second.low[axis]) > 1e-6:
                continue
            low, high = max(first.low[along], second.low[along]) + 0.3, min(first.high[along], second.high[along]) - 0.3
            width = min(float(rng.choice([0.9, 1.0, 1.3, 2.0], p=[0.3, 0.3, 0.25, 0.15])), high - low)
            if width < 0.85:
                continue
            start = float(rng.uniform(low, high - width))
            top = min(float(rng.uniform(2.0, 2.3)), a.height, b.height)
            return Door((i, j), axis, first.high[axis], start, start + width, top)
    return None


def _tour(rooms: list[Room], tree: list[Door]) -> Array:
    """Corners of a closed path along the tree of doors and back; in a room with one door, around the room."""
    doors: list[list[Door]] = [[] for _ in rooms]
    for door in tree:
        for k in door.rooms:
            doors[k].append(door)
    path: list[Array] = []

    def visit(k: int, entry: Door | None) -> None:
        middle = rooms[k].center
        exits = [door for door in doors[k] if door is not entry]
        if entry is not None and not exits:
            path.extend(_around_room(rooms[k], entry))
        for door in exits:
            other = door.rooms[1] if door.rooms[0] == k else door.rooms[0]
            other_center = rooms[other].center
            path.extend([middle, door.point(middle, 0.7), door.point(other_center, 0.7)])
            visit(other, door)
            path.extend([door.point(other_center, 0.7), door.point(middle, 0.7)])
        if exits:
            path.append(middle)

    visit(int(np.argmax([room.size.prod() for room in rooms])), None)
    return np.array(path)


def _around_room(room: Room, door: Door) -> list[Array]:
    """Four corners around the middle of a room, starting with the one nearest to the door."""
    reach = np.maximum(room.size / 2 - 1.1, 0.35)
    corners = [room.center + reach * direction for direction in ((-1, -1), (1, -1), (1, 1), (-1, 1))]
    first = int(np.argmin([np.linalg.norm(corner - door.point(room.center, 0.7)) for corner in corners]))
    return [corners[(first + k) % 4] for k in range(4)]
