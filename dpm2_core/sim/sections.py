# SPDX-License-Identifier: Apache-2.0
"""Highway and tunnel: one cross-section along the whole road, so that no geometry constrains the motion along it."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial import cKDTree

from dpm2_core.sim import plants
from dpm2_core.sim.materials import Label, Material, Surface
from dpm2_core.sim.mesh import Mesh, placed, pose
from dpm2_core.sim.road import Path, Road
from dpm2_core.sim.terrain import Terrain, sheet

WALL = 5.5
"""Height of the noise barriers, m: within 80 m a beam at +2 deg does not reach above them; a camera sees trees."""


def swept(path: Path, terrain: Terrain, profile: ArrayLike, surface: Surface) -> Mesh:
    """A profile (K, 2), m to the left and above the road, extruded along a path."""
    profile = np.asarray(profile, float)
    every = slice(None, None, 4)  # 2 m
    xy = np.stack([path.at(path.s, y)[0][every] for y in profile[:, 0]], 1)
    z = terrain.height_at(path.xy[every])[:, None] + profile[None, :, 1]
    return sheet(np.concatenate([xy, z[..., None]], -1), surface)


def clear(meshes: Iterable[Mesh], road: Road, terrain: Terrain) -> Iterator[Mesh]:
    """The meshes without triangles that would block the drive, where a road from a file meets or crosses itself."""
    drive = cKDTree(road.drive.xy)
    for mesh in meshes:
        xy = mesh.vertices[:, :2]
        low = mesh.vertices[:, 2] < terrain.height_at(xy) + 3
        blocks_drive = low & (drive.query(xy, distance_upper_bound=1.5)[0] < 1.5)
        yield mesh.part(~blocks_drive[mesh.faces].any(1))


def highway(road: Road, terrain: Terrain, rng: np.random.Generator) -> Iterator[Mesh]:
    """A concrete median, guard rails and noise barriers; trees behind the barriers."""
    half = terrain.preset.half_width
    gray = (172, 170, 164)
    flank = [(0.1, 0.85), (0.15, 0.33), (0.32, 0.08), (0.32, 0)]
    median = [*((-y, z) for y, z in reversed(flank)), *flank]
    for street in road.streets[: road.main]:
        yield swept(street, terrain, median, Surface(Label.FENCE, Material.CONCRETE, gray))
        for side in (-1, 1):
            y = side * (half + 0.6)
            rail = [(y, 0.45), (y - side * 0.08, 0.52), (y, 0.6), (y - side * 0.08, 0.68), (y, 0.75)]
            yield swept(street, terrain, rail, Surface(Label.FENCE, Material.METAL, (150, 152, 155)))
            y = side * (half + rng.uniform(3, 5))
            wall = [(y, -0.3), (y, WALL), (y + side * 0.25, WALL), (y + side * 0.25, -0.3)]
            yield swept(street, terrain, wall, Surface(Label.STRUCTURE, Material.TILE, rng.uniform(110, 190, 3)))
    trees = [plants.tree(rng, 0.4) for _ in range(8)]
    for line in terrain.contour(half + 12):
        at = rng.integers(0, len(line.xy), len(line.xy) // 7)
        xy = line.xy[at] + line.outward[at] * rng.uniform(0, 25, (len(at), 1))
        xy = xy[terrain.edge_at(xy) > 10]  # not between two arms of a road
        for k, tree in enumerate(trees):
            positions = xy[k :: len(trees)]
            if len(positions):
                n = len(positions)
                yield placed(
                    tree,
                    pose(positions, terrain.height_at(positions), rng.uniform(0, 6.3, n), rng.uniform(0.9, 1.5, n)),
                    rng.integers(65536, size=n),
                )


def tunnel(road: Road, terrain: Terrain, rng: np.random.Generator) -> Iterator[Mesh]:
    """A vaulted tube with a raised walkway on each side and a line of light."""
    half, spring, rise = terrain.preset.half_width + 0.9, rng.uniform(2.2, 3.2), rng.uniform(1.5, 3.0)
    a = np.linspace(0, np.pi, 13)
    vault = [(half, 0.25), *zip(half * np.cos(a), spring + rise * np.sin(a), strict=True), (-half, 0.25)]
    walk = terrain.preset.half_width
    for street in road.streets[: road.main]:
        yield swept(street, terrain, vault, Surface(Label.STRUCTURE, Material.TILE, rng.uniform(130, 190, 3)))
        for side in (-1, 1):
            kerb = [(side * walk, -0.05), (side * walk, 0.25), (side * (half + 0.02), 0.25)]
            yield swept(street, terrain, kerb, Surface(Label.SIDEWALK, Material.CONCRETE, (150, 148, 142)))
        top = spring + rise - 0.12
        yield swept(
            street, terrain, [(0.2, top), (-0.2, top)], Surface(Label.STRUCTURE, Material.LAMP, (255, 250, 230))
        )
