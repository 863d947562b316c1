# SPDX-License-Identifier: Apache-2.0
"""Buildings: facades with windows, shops, bays and balconies under flat or pitched roofs."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dpm2_core.sim.materials import Label, Material, Surface
from dpm2_core.sim.mesh import Mesh, make, merge
from dpm2_core.sim.shapes import box, relief, turned

WALL_COLORS = np.array([
    (205, 196, 178), (222, 214, 200), (188, 170, 140), (196, 150, 110), (160, 92, 74), (146, 110, 92), (214, 202, 150),
    (176, 184, 178), (150, 154, 160), (228, 222, 214), (202, 168, 150), (132, 84, 70), (170, 178, 150), (190, 196, 206),
])  # fmt: skip
ROOF_COLORS = np.array([(150, 78, 58), (120, 66, 52), (92, 84, 82), (110, 104, 100), (136, 92, 70)])
FLOOR = 2.9
"""Height of a story, m."""
FOUNDATION = 2.0
"""Depth of walls below the ground at their origin, m, for slopes."""


class Style(NamedTuple):
    """Common properties of the sides of a house.

    Attributes:
        floors: number. wall: color (3,). material: of the walls.
        bay: distance between windows, m. glass: fraction of it that a window takes. shop: on the ground floor.
    """

    floors: int
    wall: NDArray
    material: Material
    bay: float
    glass: float
    shop: bool


def building(width: float, depth: float, floors: int, rng: np.random.Generator) -> Mesh:
    """A house with its front at y = 0, x from -width/2 to width/2, and its back at y = depth; the ground is z = 0."""
    style = Style(
        floors,
        wall=np.clip(WALL_COLORS[rng.integers(len(WALL_COLORS))] + rng.normal(0, 10, 3), 30, 240),
        material=Material.BRICK if rng.random() < 0.3 else Material.PLASTER,
        bay=rng.uniform(2.1, 3.6),
        glass=rng.uniform(0.35, 0.6),
        shop=rng.random() < 0.3 and floors > 2,
    )
    sides = [
        turned(_facade(width, style, rng, front=True), 0.0, (0, 0, 0)),
        turned(_facade(depth, style, rng), np.pi / 2, (width / 2, depth / 2, 0)),
        turned(_facade(width, style, rng), np.pi, (0, depth, 0)),
        turned(_facade(depth, style, rng), -np.pi / 2, (-width / 2, depth / 2, 0)),
    ]
    return merge([*sides, *_roof(width, depth, floors * FLOOR + 0.5, rng)])


def _facade(width: float, style: Style, rng: np.random.Generator, front: bool = False) -> Mesh:
    """One wall from -width/2 to width/2 along x, facing -y, with a grid of windows."""
    bays = max(1, round(width / (style.bay if front else 4.5)))
    pitch, floors = width / bays, style.floors
    glass = style.glass if front else 0.3
    left = -width / 2 + pitch * (np.arange(bays) + 0.5 - glass / 2)
    x = np.concatenate([[-width / 2], np.stack([left, left + pitch * glass], -1).ravel(), [width / 2]])
    sills = np.arange(floors) * FLOOR + rng.uniform(0.7, 1.1)
    z = np.concatenate(
        [[-FOUNDATION], np.stack([sills, sills + rng.uniform(1.2, 1.6)], -1).ravel(), [floors * FLOOR + 0.5]]
    )
    shape = (len(x) - 1, len(z) - 1)
    depth, materials = np.zeros(shape), np.full(shape, style.material)
    color = np.broadcast_to(style.wall, (*shape, 3)).copy()
    window = np.zeros(shape, bool)
    window[1::2, 1::2] = rng.random((bays, floors)) > (0.06 if front else 0.5)
    if front:
        _features(style, depth, window, color, rng)
    shutters = rng.random(shape) < 0.12
    depth[window] += rng.uniform(0.1, 0.3)
    materials[window & ~shutters] = Material.GLASS
    color[window & ~shutters] = (70, 84, 98) * rng.uniform(0.6, 1.3, (int((window & ~shutters).sum()), 1))
    color[window & shutters] = style.wall * rng.uniform(0.4, 0.8)
    return relief(x, z, depth, materials, color.clip(0, 255))


def _features(
    style: Style, depth: NDArray, window: NDArray[np.bool_], color: NDArray, rng: np.random.Generator
) -> None:
    """Write doors, shops, bays, recesses and balconies into the cells of a front."""
    bays = len(depth) // 2
    door = 1 + 2 * int(rng.integers(bays))
    depth[door, :2] += rng.uniform(0.3, 0.8)
    window[door, :2] = False
    color[door, :2] = rng.uniform(40, 140, 3)
    if style.shop:
        window[1:-1, 0:2] |= rng.random((2 * bays - 1, 1)) < 0.8
        window[door, :2] = False
        color[:, 2] = rng.uniform(40, 220, 3)  # the sign above the shop
    for start in range(1, 2 * bays, 2):
        draw = rng.random()
        if draw < 0.08:
            depth[start, 2:] -= rng.uniform(0.4, 0.9)  # an oriel from the first floor up
        elif draw < 0.16:
            depth[start, 1:] += rng.uniform(0.6, 1.5)  # a loggia
        elif draw < 0.3 and style.floors > 1:
            depth[max(start - 1, 0) : start + 2, 2:-1:2] -= rng.uniform(0.6, 1.3)  # balconies: slab and parapet
        elif draw < 0.4:
            depth[start + 1, :] += rng.uniform(0.1, 0.4)  # a pilaster gap or drain pipe
    if rng.random() < 0.4:
        depth[:, 0] -= 0.08  # plinth
        color[:, 0] *= 0.7
    if rng.random() < 0.25 and bays > 3:
        depth[: 2 * int(rng.integers(1, bays - 1)) + 1] += rng.uniform(0.5, 2.0)  # a part that is set back


def _roof(width: float, depth: float, top: float, rng: np.random.Generator) -> list[Mesh]:
    color = ROOF_COLORS[rng.integers(len(ROOF_COLORS))] + rng.normal(0, 8, 3)
    w, eaves = width / 2 + 0.3, 0.4
    if rng.random() < 0.3 or depth > 18:
        flat = Surface(Label.BUILDING, Material.ROOF, color * 0.8)
        metal = Surface(Label.BUILDING, Material.METAL, (130,) * 3)
        parts = [box((-w, -eaves / 2, top), (w, depth + eaves / 2, top + 0.3), flat)]
        for _ in range(rng.integers(0, 4)):
            at = rng.uniform((-w + 1, 1), (w - 2, depth - 2))
            parts.append(box((*at, top), (*(at + rng.uniform(0.6, 2, 2)), top + rng.uniform(0.6, 2)), metal))
        return parts
    ridge = top + depth / 2 * rng.uniform(0.5, 1.0)
    hip = rng.choice([0.0, 0.0, width / 4])
    corners = np.array([
        (-w, -eaves, top - 0.2), (w, -eaves, top - 0.2), (w, depth + eaves, top - 0.2), (-w, depth + eaves, top - 0.2),
        (-w + hip, depth / 2, ridge), (w - hip, depth / 2, ridge),
    ])  # fmt: skip
    faces = [[0, 1, 5], [0, 5, 4], [2, 3, 4], [2, 4, 5], [1, 2, 5], [3, 0, 4], [0, 2, 1], [0, 3, 2]]
    roof = make(corners, faces, Label.BUILDING, Material.ROOF, color)
    chimney = rng.uniform((-w + 1, depth * 0.3), (w - 1, depth * 0.7))
    brick = Surface(Label.BUILDING, Material.BRICK, (130, 80, 66))
    return [roof, box((*chimney, top), (*(chimney + 0.6), ridge + 0.8), brick)]
