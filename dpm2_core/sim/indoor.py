# SPDX-License-Identifier: Apache-2.0
"""Interiors of buildings: walls with doors and windows, floors, ceilings, stairs, furniture; a car park's deck."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from scipy.spatial import cKDTree

from dpm2_core.frame import Array
from dpm2_core.sim.buildings import WALL_COLORS
from dpm2_core.sim.floorplan import AISLE, ROW, FloorPlan, Room
from dpm2_core.sim.materials import Label, Material, Surface
from dpm2_core.sim.mesh import Mesh, merge, placed, pose
from dpm2_core.sim.shapes import box, rod
from dpm2_core.sim.vehicles import car

_HALF_WALL = 0.07
"""Half of the thickness of a wall, m: the part on the side of each room."""
_PATH_CLEARANCE = 0.55
"""Smallest distance of everything but walls from the path, m."""
_METAL = Surface(Label.OBJECT, Material.METAL, (120, 122, 126))


class Interior:
    """Draws the contents of the rooms of a plan; `meshes()` yields them. `path`: (K, 2) m, free of objects."""

    def __init__(self, plan: FloorPlan, path: Array, rng: np.random.Generator) -> None:
        self.plan, self.rng, self.path = plan, rng, cKDTree(path)
        bounds = np.array([[*room.low, *room.high] for room in plan.rooms])
        self.outside = (bounds[:, :2].min(0), bounds[:, 2:].max(0))

    def meshes(self) -> Iterator[Mesh]:
        """All meshes."""
        for number, room in enumerate(self.plan.rooms):
            yield from self._shell(number, room)
            if room.kind == "deck":
                yield from self._deck(room)
                continue
            yield from self._lamps(room)
            if room.kind == "hall":
                yield from self._pillars(room, 6.0)
            if room.kind == "stairs":
                yield from self._stairs(room)
            yield from self._along_walls(room)
            if room.kind != "corridor":
                yield from self._tables(room)

    def _shell(self, number: int, room: Room) -> Iterator[Mesh]:
        """Floor, ceiling, and four walls with their openings."""
        rng = self.rng
        stone = room.kind in ("corridor", "deck", "stairs")
        floor = (
            Material.CONCRETE if stone else Material.WOOD if rng.random() < 0.5 else Material.TILE,
            rng.uniform(70, 190, 3),
        )
        wall = np.clip(WALL_COLORS[rng.integers(len(WALL_COLORS))] + rng.normal(0, 12, 3), 30, 245)
        paint = Surface(Label.BUILDING, Material.CONCRETE if room.kind == "deck" else Material.PLASTER, wall)
        (x, y), (X, Y) = room.low, room.high
        yield box(
            (x, y, -0.2), (X, Y, 0), Surface(Label.PARKING if room.kind == "deck" else Label.OTHER_GROUND, *floor)
        )
        yield box((x, y, room.height), (X, Y, room.height + 0.2), paint._replace(color=(228, 228, 222)))
        for axis in (0, 1):
            for side, at in ((0, room.low[axis]), (1, room.high[axis])):
                yield from self._wall(number, room, axis, side, at, paint)

    def _wall(self, number: int, room: Room, axis: int, side: int, at: float, paint: Surface) -> Iterator[Mesh]:
        along = 1 - axis
        doors = [d for d in self.plan.doors if number in d.rooms and d.axis == axis and abs(d.at - at) < 1e-6]
        openings: list[tuple[float, float, float, float, Surface | None]]
        openings = [(d.start, d.end, 0.0, d.top, None) for d in doors]
        outer = abs(at - self.outside[side][axis]) < 1e-6
        if outer and not doors and room.kind in ("room", "hall") and self.rng.random() < 0.7:
            low, high = room.low[along] + 0.5, room.high[along] - 0.5
            glass = Surface(Label.BUILDING, Material.GLASS, (90, 110, 125))
            for start in np.arange(low, high - 1.2, self.rng.uniform(1.5, 3.0)):
                openings.append((float(start), float(start) + 1.1, 0.9, min(room.height - 0.3, 2.2), glass))
        inner = at + (_HALF_WALL if side == 0 else -_HALF_WALL)
        depth = (min(at, inner), max(at, inner))

        def piece(start: float, end: float, bottom: float, top: float, surface: Surface) -> Mesh:
            low, high = np.zeros(3), np.zeros(3)
            low[[axis, along, 2]], high[[axis, along, 2]] = (depth[0], start, bottom), (depth[1], end, top)
            return box(low, high, surface)

        cursor = room.low[along]
        for start, end, bottom, top, pane in sorted(openings, key=lambda o: o[:2]):
            if start > cursor:
                yield piece(cursor, start, 0, room.height, paint)
            if bottom > 0:
                yield piece(start, end, 0, bottom, paint)
            if top < room.height:
                yield piece(start, end, top, room.height, paint)
            if pane is not None:
                yield piece(start, end, bottom, top, pane)
            cursor = end
        yield piece(cursor, room.high[along], 0, room.height, paint)

    def _lamps(self, room: Room) -> Iterator[Mesh]:
        lamp = Surface(Label.BUILDING, Material.LAMP, (255, 250, 235))
        (x, y), (X, Y), z = room.low, room.high, room.height
        for at in np.arange(x + 1.2, X - 0.8, 2.8):
            yield box((at, (y + Y) / 2 - 0.1, z - 0.08), (min(at + 1.1, X), (y + Y) / 2 + 0.1, z - 0.02), lamp)

    def _pillars(self, room: Room, spacing: float) -> Iterator[Mesh]:
        shaft = Surface(Label.STRUCTURE, Material.CONCRETE, (170, 168, 160))
        half, round_ = self.rng.uniform(0.15, 0.35), self.rng.random() < 0.4
        for x in np.arange(room.low[0] + spacing / 2, room.high[0] - 1, spacing):
            for y in np.arange(room.low[1] + spacing / 2, room.high[1] - 1, spacing):
                if not self._is_free((x, y), half + _PATH_CLEARANCE):
                    continue
                if round_:
                    yield rod((x, y, 0), (x, y, room.height), (half, half), 12, shaft)
                else:
                    yield box((x - half, y - half, 0), (x + half, y + half, room.height), shaft)

    def _stairs(self, room: Room) -> Iterator[Mesh]:
        """Steps up along a wall, where the path leaves space."""
        stone = Surface(Label.STRUCTURE, Material.CONCRETE, (160, 156, 150))
        rise, run, width = self.rng.uniform(0.15, 0.19), self.rng.uniform(0.26, 0.3), 1.0
        axis = int(room.size[1] > room.size[0])
        for side in (0, 1):
            at = room.low[1 - axis] + _HALF_WALL if side == 0 else room.high[1 - axis] - _HALF_WALL - width
            steps = []
            for k, start in enumerate(np.arange(room.low[axis] + 0.8, room.high[axis] - 0.8, run)):
                low, high = np.zeros(3), np.zeros(3)
                low[[axis, 1 - axis]], high[[axis, 1 - axis]] = (start, at), (start + run, at + width)
                high[2] = min((k + 1) * rise, room.height)
                if self._is_free((low + high)[:2] / 2, 0.5 * width + 0.25):
                    steps.append(box(low, high, stone))
            yield from steps

    def _along_walls(self, room: Room) -> Iterator[Mesh]:
        """Cupboards, shelves, radiators, signs, extinguishers: flat objects with their backs to a wall."""
        rng = self.rng
        for _ in range(rng.poisson(room.size.sum() / (6 if room.kind == "corridor" else 2.5))):
            axis, side = int(rng.integers(2)), int(rng.integers(2))
            along = 1 - axis
            length, depth, bottom, top = _WALL_OBJECTS[int(rng.integers(len(_WALL_OBJECTS)))]
            length, depth = length * rng.uniform(0.7, 1.3), depth * rng.uniform(0.8, 1.2)
            if room.size[along] < length + 0.4 or top > room.height:
                continue
            start = rng.uniform(room.low[along] + 0.1, room.high[along] - length - 0.1)
            wall = room.low[axis] + _HALF_WALL if side == 0 else room.high[axis] - _HALF_WALL - depth
            low, high = np.zeros(3), np.zeros(3)
            low[[axis, along, 2]], high[[axis, along, 2]] = (wall, start, bottom), (wall + depth, start + length, top)
            blocks = any(d.axis == axis and d.start < start + length and d.end > start for d in self.plan.doors)
            if not blocks and (depth < 0.15 or self._is_free((low + high)[:2] / 2, length / 2 + 0.3)):
                material = (Material.WOOD, Material.METAL, Material.PLASTER, Material.SIGN)[
                    int(rng.choice(4, p=[0.45, 0.3, 0.15, 0.1]))
                ]
                yield box(low, high, Surface(Label.OBJECT, material, rng.uniform(30, 235, 3)))

    def _tables(self, room: Room) -> Iterator[Mesh]:
        """Tables with chairs, and boxes, where the path leaves space."""
        rng = self.rng
        for _ in range(rng.poisson(room.size.prod() / 7)):
            at = rng.uniform(np.array(room.low) + 0.9, np.array(room.high) - 0.9)
            if not self._is_free(at, 1.0 + _PATH_CLEARANCE):
                continue
            item = _table(rng) if rng.random() < 0.6 else _box(rng)
            yield placed(item, pose(at, 0.0, rng.uniform(0, 6.3)), rng.integers(65536, size=1))

    def _deck(self, deck: Room) -> Iterator[Mesh]:
        """Rows of cars on both sides of the lanes, pillars between them, a pipe and beams below the ceiling."""
        rng = self.rng
        models = [car(rng) for _ in range(8)]
        occupancy, pitch = rng.uniform(0.4, 0.95), AISLE + ROW
        rows = np.concatenate([[-2.6], *([k * pitch + AISLE + 2.5, k * pitch + AISLE + ROW - 2.5] for k in range(8))])
        for y in rows[rows < deck.high[1] - 2]:
            for x in np.arange(deck.low[0] + AISLE + 6.5, deck.high[0] - AISLE - 6, 2.6):
                if rng.random() < occupancy and self._is_free((x, y), 3.2):
                    yaw = np.pi / 2 + np.pi * rng.integers(2) + rng.normal(0, 0.03)
                    at = pose(np.array([x, y]) + rng.normal(0, 0.15, 2), 0.0, yaw)
                    tint = rng.uniform(0.7, 1.2, (1, 3))
                    yield placed(models[int(rng.integers(8))], at, rng.integers(65536, size=1), tint)
        yield from self._pillars(deck, float(rng.uniform(5.5, 8.0)))
        beam = Surface(Label.STRUCTURE, Material.CONCRETE, (150, 150, 146))
        for x in np.arange(deck.low[0] + 4, deck.high[0], 7.5):
            yield box((x, deck.low[1], deck.height - 0.25), (x + 0.3, deck.high[1], deck.height), beam)
        y = float(rng.uniform(deck.low[1] + 2, deck.high[1] - 2))
        yield rod((deck.low[0], y, deck.height - 0.45), (deck.high[0], y, deck.height - 0.45), (0.12, 0.12), 8, _METAL)
        yield from self._lamps(deck)

    def _is_free(self, xy: Array | tuple[float, float], radius: float) -> bool:
        """Whether the path is farther than `radius`, m, from a position (2,)."""
        return float(self.path.query(np.asarray(xy, float))[0]) > radius


_WALL_OBJECTS = (  # length, depth, bottom, top, m
    (1.2, 0.45, 0.0, 1.9), (0.9, 0.35, 0.0, 1.1), (1.6, 0.3, 0.0, 2.1), (1.1, 0.1, 0.15, 0.75), (0.5, 0.03, 1.3, 1.9),
    (0.3, 0.14, 0.8, 1.3), (0.8, 0.04, 1.1, 1.8),
)  # fmt: skip


def _table(rng: np.random.Generator) -> Mesh:
    length, width, height = rng.uniform((0.9, 0.6, 0.68), (1.9, 0.9, 0.78))
    wood = Surface(Label.OBJECT, Material.WOOD, np.array((150, 116, 82)) * rng.uniform(0.5, 1.4))
    x, y = length / 2, width / 2
    parts = [box((-x, -y, height - 0.04), (x, y, height), wood)]
    parts += [
        rod(
            (sx * (x - 0.06), sy * (y - 0.06), 0), (sx * (x - 0.06), sy * (y - 0.06), height), (0.025, 0.025), 5, _METAL
        )
        for sx in (-1, 1)
        for sy in (-1, 1)
    ]
    for side in rng.choice([-1, 1], rng.integers(0, 3), replace=False):
        chair = _chair(Surface(Label.OBJECT, Material.CLOTH, rng.uniform(20, 180, 3)))
        at = np.array([rng.uniform(-x / 2, x / 2), side * (y + 0.3)])
        parts.append(placed(chair, pose(at, 0.0, 0.0 if side > 0 else np.pi)))
    return merge(parts)


def _chair(cloth: Surface) -> Mesh:
    """A chair with its back at +y."""
    return merge([
        box((-0.22, -0.22, 0.42), (0.22, 0.22, 0.48), cloth), box((-0.22, 0.17, 0.48), (0.22, 0.23, 0.95), cloth),
        rod((0, 0, 0), (0, 0, 0.42), (0.04, 0.04), 6, _METAL),
    ])  # fmt: skip


def _box(rng: np.random.Generator) -> Mesh:
    size = rng.uniform((0.3, 0.3, 0.3), (0.9, 0.8, 1.4))
    paint = Surface(Label.OBJECT, Material.WOOD, rng.uniform(60, 220, 3))
    return box((-size[0] / 2, -size[1] / 2, 0), (*(size[:2] / 2), size[2]), paint)
