# SPDX-License-Identifier: Apache-2.0
"""Cars, vans, trucks, cyclists and people: x ahead, the ground at z = 0, the origin in the middle."""

from __future__ import annotations

import numpy as np

from dpm2_core.sim.materials import Label, Material, Surface
from dpm2_core.sim.mesh import Mesh, merge
from dpm2_core.sim.shapes import blob, box, extrusion, rod

PAINTS = np.array([
    (28, 30, 34), (66, 70, 76), (150, 154, 158), (196, 198, 200), (232, 232, 230),
    (150, 24, 26), (30, 52, 110), (44, 76, 60), (190, 170, 60), (120, 88, 62),
])  # fmt: skip

# length, width, height in m; side profiles of the body and the glazed part above, front to rear, as fractions of them
_BODIES: dict[str, tuple[tuple[float, float, float], list[tuple[float, float]], list[tuple[float, float]]]] = {
    "hatchback": (
        (4.0, 1.72, 1.48),
        [(0.5, 0.14), (0.5, 0.42), (0.44, 0.55), (0.2, 0.64), (-0.47, 0.66), (-0.5, 0.4), (-0.5, 0.16)],
        [(0.22, 0.62), (0.05, 0.98), (-0.36, 1.0), (-0.48, 0.64)],
    ),
    "sedan": (
        (4.6, 1.8, 1.45),
        [(0.5, 0.14), (0.5, 0.42), (0.45, 0.54), (0.2, 0.63), (-0.3, 0.66), (-0.48, 0.64), (-0.5, 0.2)],
        [(0.21, 0.62), (0.05, 0.97), (-0.18, 1.0), (-0.36, 0.65)],
    ),
    "estate": (
        (4.7, 1.82, 1.5),
        [(0.5, 0.14), (0.5, 0.42), (0.45, 0.54), (0.22, 0.62), (-0.49, 0.64), (-0.5, 0.2)],
        [(0.22, 0.61), (0.07, 0.97), (-0.44, 0.99), (-0.49, 0.63)],
    ),
    "suv": (
        (4.6, 1.88, 1.72),
        [(0.5, 0.18), (0.5, 0.5), (0.45, 0.58), (0.22, 0.64), (-0.49, 0.66), (-0.5, 0.2)],
        [(0.24, 0.63), (0.1, 0.98), (-0.42, 1.0), (-0.49, 0.65)],
    ),
    "van": (
        (5.2, 1.98, 2.3),
        [(0.5, 0.12), (0.5, 0.34), (0.42, 0.5), (0.4, 0.52), (0.12, 0.54), (0.1, 0.99), (-0.49, 1.0), (-0.5, 0.14)],
        [(0.41, 0.5), (0.27, 0.97), (0.1, 0.99), (0.1, 0.52)],
    ),
}


def car(rng: np.random.Generator) -> Mesh:
    """A passenger car or a van."""
    kind = str(rng.choice(list(_BODIES), p=[0.32, 0.24, 0.18, 0.16, 0.1]))
    size, body, cabin = _BODIES[kind]
    length, width, height = np.asarray(size) * rng.uniform(0.93, 1.07, 3)
    paint = Surface(Label.CAR, Material.PAINT, PAINTS[rng.integers(len(PAINTS))] * rng.uniform(0.85, 1.1))
    scale = np.array([length, height])
    half = np.where(np.asarray(body)[:, 1] < 0.2, 0.94, 1.0) * width / 2
    roof = np.where(np.asarray(cabin)[:, 1] > 0.8, 0.78 if kind != "van" else 0.92, 0.97) * width / 2
    parts = [
        extrusion(np.asarray(body) * scale, half, paint),
        extrusion(np.asarray(cabin) * scale, roof, Surface(Label.CAR, Material.GLASS, (38, 44, 52))),
    ]
    front, back = np.asarray(cabin)[1] * scale, np.asarray(cabin)[2] * scale
    parts.append(box((back[0], -roof[1] * 1.01, front[1] - 0.03), (front[0], roof[1] * 1.01, height + 0.02), paint))
    return merge([*parts, *_wheels(length, width, 0.31), *_lights(length, width, height)])


def _wheels(length: float, width: float, radius: float) -> list[Mesh]:
    tire, inner, outer = Surface(Label.CAR, Material.RUBBER, (26,) * 3), width / 2 - 0.2, width / 2 + 0.02
    return [
        rod((x * length, y * inner, radius), (x * length, y * outer, radius), (radius, radius), 12, tire)
        for x in (0.31, -0.29)
        for y in (1, -1)
    ]


def _lights(length: float, width: float, height: float) -> list[Mesh]:
    x, y, z = length / 2, width / 2, height
    white, red, plate = (Surface(Label.CAR, Material.SIGN, c) for c in ((235, 235, 225), (190, 30, 25), (240,) * 3))
    parts = []
    for side in (-1, 1):
        low, high = sorted((side * y * 0.95, side * y * 0.6))
        parts.append(box((x - 0.1, low, 0.4 * z), (x + 0.03, high, 0.5 * z), white))
        parts.append(box((-x - 0.03, low, 0.45 * z), (-x + 0.1, high, 0.55 * z), red))
    parts.append(box((-x - 0.03, -0.26, 0.3 * z), (-x + 0.1, 0.26, 0.38 * z), plate))
    return parts


def truck(rng: np.random.Generator) -> Mesh:
    """A truck or a bus of 7 to 12 m."""
    length, height = rng.uniform(7, 12), rng.uniform(2.9, 3.8)
    paint, load = (Surface(Label.TRUCK, Material.PAINT, PAINTS[rng.integers(len(PAINTS))]) for _ in range(2))
    tire = Surface(Label.TRUCK, Material.RUBBER, (26,) * 3)
    x = length / 2
    cab = [(x, 0.4), (x, 1.4), (x - 0.25, 2.7), (x - 2.0, 2.7), (x - 2.0, 0.4)]
    parts = [
        extrusion(cab, 1.2, paint),
        box((x - 0.3, -1.1, 1.45), (x - 0.02, 1.1, 2.4), Surface(Label.TRUCK, Material.GLASS, (40, 46, 54))),
        box((-x, -1.25, 0.9), (x - 2.2, 1.25, height), load),
        box((-x, -1.0, 0.5), (x - 1, 1.0, 0.9), Surface(Label.TRUCK, Material.METAL, (50,) * 3)),
    ]
    for along in (x - 1.2, -x + 1.2, -x + 2.4):
        for side in (-1, 1):
            parts.append(rod((along, side * 0.9, 0.5), (along, side * 1.24, 0.5), (0.5, 0.5), 12, tire))
    return merge(parts)


def person(rng: np.random.Generator, label: Label = Label.PERSON, saddle: float = 0.0) -> Mesh:
    """A person of 1.5 to 1.95 m in mid-stride, or sitting `saddle` m higher."""
    size, step = rng.uniform(1.5, 1.95) / 1.75, rng.uniform(0.1, 0.32)
    colors = rng.uniform(30, 220, 3), rng.uniform(20, 120, 3), np.array((205, 165, 140)) * rng.uniform(0.5, 1.1)
    shirt, trousers, skin = (Surface(label, Material.CLOTH, color) for color in colors)
    hip, top = 0.88 * size, 1.45 * size
    parts = [
        rod((step, 0.1, 0.02), (0, 0.09, hip), (0.07, 0.09), 6, trousers),
        rod((-step, -0.1, 0.02), (0, -0.09, hip), (0.07, 0.09), 6, trousers),
        rod((-step * 0.7, 0.24, hip), (0, 0.2, top), (0.04, 0.06), 5, shirt),
        rod((step * 0.7, -0.24, hip), (0, -0.2, top), (0.04, 0.06), 5, shirt),
        blob((0, 0, (hip + top) / 2), (0.15, 0.22, (top - hip) / 2 + 0.1), 0.02, rng, shirt),
        blob((0, 0, top + 0.2 * size), (0.11, 0.1, 0.14), 0.02, rng, skin),
    ]
    mesh = merge(parts)
    mesh.vertices[:, 2] += saddle
    return mesh


def cyclist(rng: np.random.Generator) -> Mesh:
    """A person on a bicycle."""
    frame = Surface(Label.BICYCLIST, Material.METAL, rng.uniform(20, 200, 3))
    tire = Surface(Label.BICYCLIST, Material.RUBBER, (30,) * 3)
    bars = [
        ((-0.5, 0, 0.35), (0, 0, 0.3)),
        ((0, 0, 0.3), (0.4, 0, 0.85)),
        ((0.52, 0, 0.35), (0.4, 0, 0.95)),
        ((0, 0, 0.3), (-0.2, 0, 0.9)),
    ]
    parts = [rod(a, b, (0.025, 0.025), 4, frame) for a, b in bars]
    parts += [rod((x, -0.02, 0.34), (x, 0.02, 0.34), (0.34, 0.34), 12, tire) for x in (-0.5, 0.52)]
    parts += [person(rng, Label.BICYCLIST, 0.25), rod((0.4, -0.28, 0.98), (0.4, 0.28, 0.98), (0.02, 0.02), 4, frame)]
    return merge(parts)
