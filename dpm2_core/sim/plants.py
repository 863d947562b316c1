# SPDX-License-Identifier: Apache-2.0
"""Trees, bushes and grass: rough and partly transparent for a LiDAR, like real ones."""

from __future__ import annotations

import numpy as np

from dpm2_core.sim.materials import Label, Material, Surface
from dpm2_core.sim.mesh import Mesh, merge
from dpm2_core.sim.shapes import blob, leaves, rod

GREENS = np.array(
    [(72, 104, 42), (92, 120, 50), (58, 86, 44), (110, 124, 52), (84, 96, 60), (136, 120, 50), (66, 96, 60)]
)


def _leaf_surface(color: np.ndarray) -> Surface:
    return Surface(Label.VEGETATION, Material.LEAF, color)


def _green_color(rng: np.random.Generator) -> np.ndarray:
    return GREENS[rng.integers(len(GREENS))] * rng.uniform(0.8, 1.15)


def tree(rng: np.random.Generator, leafage: float = 1.0) -> Mesh:
    """A broad-leaved or a coniferous tree of 5 to 16 m, its foot at the origin.

    `leafage` scales the number of leaf clusters, and inversely their area: a lower value is enough farther away.
    """
    return _conifer(rng, leafage) if rng.random() < 0.2 else _broadleaf(rng, leafage)


def _broadleaf(rng: np.random.Generator, leafage: float) -> Mesh:
    height, clear = rng.uniform(5, 15), rng.uniform(1.6, 3.4)
    girth, green = 0.012 * height + rng.uniform(0.05, 0.14), _green_color(rng)
    bark = Surface(Label.TRUNK, Material.BARK, np.array((96, 84, 70)) * rng.uniform(0.7, 1.2))
    lean = np.array([*rng.normal(0, 0.25, 2), clear + 0.3 * (height - clear)])
    parts = [
        rod((0, 0, -0.5), (*lean[:2] * 0.3, clear), (girth * 1.3, girth), 8, bark),
        rod((*lean[:2] * 0.3, clear), lean, (girth, girth * 0.5), 6, bark),
    ]
    spread = rng.uniform(0.22, 0.42) * height
    for _ in range(rng.integers(3, 7)):
        angle, distance = rng.uniform(0, 6.3), spread * rng.uniform(0.2, 0.75)
        tip = np.array([distance * np.cos(angle), distance * np.sin(angle), rng.uniform(clear + 0.6, height * 0.8)])
        parts.append(rod((*lean[:2] * 0.3, clear * rng.uniform(0.85, 1.1)), tip, (girth * 0.45, 0.03), 5, bark))
        size = np.array([1, 1, rng.uniform(0.6, 1.0)]) * spread * rng.uniform(0.4, 0.7)
        parts.append(blob(tip, size * 0.6, 0.22, rng, _leaf_surface(green * 0.75)))
        shell = rng.normal(size=(int(45 * leafage * spread), 3))
        shell *= rng.uniform(0.5, 1.2, (len(shell), 1)) / np.linalg.norm(shell, axis=1, keepdims=True)
        parts.append(leaves(tip + shell * size, 0.45 / leafage**0.5, rng, green))
    return merge(parts)


def _conifer(rng: np.random.Generator, leafage: float) -> Mesh:
    height, foot, green = rng.uniform(5, 14), rng.uniform(0.3, 1.5), _green_color(rng) * (0.7, 0.8, 0.8)
    radius = height * rng.uniform(0.14, 0.25)
    bark = Surface(Label.TRUNK, Material.BARK, (84, 70, 58))
    parts = [rod((0, 0, -0.5), (0, 0, height * 0.9), (0.18, 0.04), 6, bark)]
    ratio = rng.beta(1, 1.6, int(34 * leafage * height))
    angle = rng.uniform(0, 6.3, len(ratio))
    out = radius * (1 - ratio) * rng.uniform(0.5, 1.1, len(ratio))
    centers = np.stack([out * np.cos(angle), out * np.sin(angle), foot + ratio * (height - foot)], -1)
    parts += [
        leaves(centers, 0.5 / leafage**0.5, rng, green),
        rod((0, 0, foot), (0, 0, height), (radius * 0.75, 0.02), 9, _leaf_surface(green * 0.7)),
    ]
    return merge(parts)


def bush(rng: np.random.Generator) -> Mesh:
    """A shrub of 0.5 to 2.5 m, its foot at the origin."""
    green, size = _green_color(rng), rng.uniform(0.4, 1.3)
    parts = []
    for _ in range(rng.integers(1, 4)):
        at = np.array([*rng.normal(0, 0.45 * size, 2), size * rng.uniform(0.4, 0.8)])
        radii = size * rng.uniform(0.5, 0.9, 3)
        parts.append(blob(at, radii * 0.65, 0.25, rng, _leaf_surface(green * 0.8)))
        shell = rng.normal(size=(int(70 * size), 3))
        parts.append(leaves(at + shell / np.linalg.norm(shell, axis=1, keepdims=True) * radii, 0.28, rng, green))
    return merge(parts)


def tuft(rng: np.random.Generator) -> Mesh:
    """A patch of tall grass and weeds about 1.5 m across, 0.1 to 0.6 m high."""
    n, height = int(rng.integers(10, 26)), rng.uniform(0.1, 0.6)
    centers = np.concatenate([rng.normal(0, 0.5, (n, 2)), rng.uniform(0, height, (n, 1))], -1)
    return leaves(centers, 0.5 * height, rng, _green_color(rng) * (1.25, 1.1, 1.0))
