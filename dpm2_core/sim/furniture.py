# SPDX-License-Identifier: Apache-2.0
"""Objects along a curb: x along the street, -y towards the road, z up from the ground."""

from __future__ import annotations

import numpy as np

from dpm2_core.sim.materials import Label, Material, Surface
from dpm2_core.sim.mesh import Mesh, make, merge
from dpm2_core.sim.shapes import box, rod

_METAL = Surface(Label.POLE, Material.METAL, (120, 122, 124))


def lamp(rng: np.random.Generator) -> Mesh:
    """A street lamp of 4.5 to 9 m that reaches over the road."""
    height, arm = rng.uniform(4.5, 9), rng.uniform(0.4, 2.0)
    return merge([
        rod((0, 0, -0.3), (0, 0, height), (0.09, 0.05), 8, _METAL),
        rod((0, 0, height), (0, -arm, height + 0.3), (0.05, 0.04), 6, _METAL),
        box((-0.15, -arm - 0.5, height + 0.2), (0.15, -arm, height + 0.36), _METAL._replace(color=(150,) * 3)),
    ])  # fmt: skip


def sign(rng: np.random.Generator) -> Mesh:
    """A traffic sign: disc, triangle, square or board, on a post."""
    height, radius = rng.uniform(1.9, 2.7), rng.uniform(0.28, 0.45)
    corners = int(rng.choice([3, 4, 8, 20]))
    color = np.array([(200, 30, 30), (30, 70, 170), (235, 235, 235), (230, 200, 40), (30, 120, 60)])[rng.integers(5)]
    a = np.arange(corners) * 2 * np.pi / corners + np.pi / 2
    rim = np.stack([np.full(corners, -0.05), radius * np.cos(a), height + radius * np.sin(a)], -1)
    inner = rim * (1, 0.7, 1) * (1, 1, 0.7) + (-0.004, 0, 0.3 * height)
    fan = np.array([[0, k, k + 1] for k in range(1, corners - 1)])
    return merge([
        rod((0, 0, -0.3), (0, 0, height + radius), (0.035, 0.035), 6, _METAL),
        make(rim, fan, Label.SIGN, Material.SIGN, color),
        make(inner, fan, Label.SIGN, Material.SIGN, (240, 240, 240) if color.max() < 230 else (30, 30, 30)),
    ])  # fmt: skip


def post(rng: np.random.Generator) -> Mesh:
    """A bollard, a reflector post or a wooden utility pole."""
    draw = rng.random()
    if draw < 0.6:
        concrete = Surface(Label.POLE, Material.CONCRETE, (215,) * 3)
        return rod((0, 0, -0.3), (0, 0, rng.uniform(0.7, 1.1)), (0.08, 0.07), 8, concrete)
    wood = Surface(Label.POLE, Material.WOOD, (110, 88, 66))
    return rod((0, 0, -0.5), (0, 0, rng.uniform(6, 9)), (0.14, 0.09), 8, wood)


def street_box(rng: np.random.Generator) -> Mesh:
    """An electric cabinet, bin, advertising board or post box."""
    size = rng.uniform((0.4, 0.3, 0.7), (1.3, 0.6, 1.5)) if rng.random() < 0.75 else np.array([1.4, 0.25, 2.5])
    metal = Surface(Label.OBJECT, Material.METAL, rng.uniform(40, 210, 3))
    return box((-size[0] / 2, -size[1] / 2, -0.2), (*(size[:2] / 2), size[2]), metal)


def bench(rng: np.random.Generator) -> Mesh:
    """A bench facing the road."""
    wood = Surface(Label.OBJECT, Material.WOOD, np.array((134, 98, 66)) * rng.uniform(0.7, 1.2))
    metal = Surface(Label.OBJECT, Material.METAL, (60,) * 3)
    legs = [box((x, -0.2, -0.1), (x + 0.08, 0.2, 0.42), metal) for x in (-0.8, 0.72)]
    return merge(
        [box((-0.9, -0.25, 0.42), (0.9, 0.2, 0.48), wood), box((-0.9, 0.2, 0.5), (0.9, 0.26, 0.9), wood), *legs]
    )


def shelter(rng: np.random.Generator) -> Mesh:
    """A bus stop: a roof on four posts with a glass back."""
    length = rng.uniform(2.5, 4.5)
    x, metal = length / 2, Surface(Label.STRUCTURE, Material.METAL, (90,) * 3)
    glass = Surface(Label.STRUCTURE, Material.GLASS, (90, 110, 120))
    return merge([
        *(rod((at, y, -0.2), (at, y, 2.3), (0.05, 0.05), 6, _METAL) for at in (-x, x) for y in (-0.6, 0.7)),
        box((-x - 0.1, -0.8, 2.3), (x + 0.1, 0.9, 2.42), metal),
        box((-x, 0.7, 0.3), (x, 0.73, 2.1), glass),
        box((-x, 0.25, 0.45), (x, 0.6, 0.52), Surface(Label.OBJECT, Material.WOOD, (120, 100, 80))),
    ])  # fmt: skip


FURNITURE = ((lamp, 0.28), (sign, 0.34), (post, 0.16), (street_box, 0.14), (bench, 0.06), (shelter, 0.02))
"""Objects along the curb, with their frequencies."""
