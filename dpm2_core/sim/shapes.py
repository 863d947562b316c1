# SPDX-License-Identifier: Apache-2.0
"""Solids of which objects are composed, in m, z up."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
from numpy.typing import ArrayLike

from dpm2_core.extras import needs
from dpm2_core.sim.materials import Label, Material, Surface
from dpm2_core.sim.mesh import Mesh, make

BOX_FACES = np.array([
    [0, 2, 1], [0, 3, 2], [4, 5, 6], [4, 6, 7], [0, 1, 5], [0, 5, 4],
    [1, 2, 6], [1, 6, 5], [2, 3, 7], [2, 7, 6], [3, 0, 4], [3, 4, 7],
])  # fmt: skip


def box(low: ArrayLike, high: ArrayLike, surface: Surface) -> Mesh:
    """An upright box between two corners (3,)."""
    (x, y, z), (X, Y, Z) = np.asarray(low, float), np.asarray(high, float)
    corners = [(x, y, z), (X, y, z), (X, Y, z), (x, Y, z), (x, y, Z), (X, y, Z), (X, Y, Z), (x, Y, Z)]
    return make(corners, BOX_FACES, *surface)


def rod(start: ArrayLike, end: ArrayLike, radii: tuple[float, float], sides: int, surface: Surface) -> Mesh:
    """A tapered tube from `start` to `end`, capped at the end."""
    start, end = np.asarray(start, float), np.asarray(end, float)
    axis = (end - start) / np.linalg.norm(end - start)
    u = np.cross(axis, (1.0, 0, 0) if abs(axis[0]) < 0.9 else (0, 1.0, 0))
    u /= np.linalg.norm(u)
    a = np.arange(sides) * 2 * np.pi / sides
    ring = np.cos(a)[:, None] * u + np.sin(a)[:, None] * np.cross(axis, u)
    points = np.concatenate([start + radii[0] * ring, end + radii[1] * ring, end[None]])
    i, j = np.arange(sides), (np.arange(sides) + 1) % sides
    faces = np.concatenate([
        np.stack([i, j, j + sides], -1), np.stack([i, j + sides, i + sides], -1),
        np.stack([i + sides, j + sides, np.full(sides, 2 * sides)], -1),
    ])  # fmt: skip
    return make(points, faces, *surface)


def blob(center: ArrayLike, radii: ArrayLike, rough: float, rng: np.random.Generator, surface: Surface) -> Mesh:
    """An ellipsoid of 80 triangles with its vertices moved in and out by the fraction `rough`."""
    vertices, faces = _sphere()
    points = vertices * (1 + rng.normal(0, rough, (len(vertices), 1))) * np.asarray(radii)
    return make(points + np.asarray(center), faces, *surface)


@cache
def _sphere() -> tuple[np.ndarray, np.ndarray]:
    """Vertices (42, 3) on the unit sphere and faces (80, 3)."""
    with needs("sim", "the synthetic city"):
        import trimesh

    sphere = trimesh.creation.icosphere(subdivisions=1)
    return np.array(sphere.vertices), np.array(sphere.faces)


def leaves(centers: ArrayLike, size: float, rng: np.random.Generator, color: ArrayLike) -> Mesh:
    """One randomly rotated triangle of about `size` m at each of the centers (N, 3), with random brightness."""
    centers = np.asarray(centers, float)
    n = len(centers)
    corners = centers[:, None] + rng.normal(0, 0.6 * size, (n, 3, 3))
    shade = rng.uniform(0.65, 1.3, (n, 1)) * np.asarray(color)
    faces = np.arange(3 * n).reshape(n, 3)
    return make(corners.reshape(-1, 3), faces, Label.VEGETATION, Material.LEAF, shade.clip(0, 255))


def extrusion(profile: ArrayLike, y: ArrayLike, surface: Surface) -> Mesh:
    """A closed, nearly convex side profile (N, 2) of x, z, with half widths `y` (N,) at its corners."""
    profile = np.asarray(profile, float)
    n = len(profile)
    y = np.broadcast_to(np.asarray(y, float), n)
    left = np.stack([profile[:, 0], y, profile[:, 1]], -1)
    right = left * (1, -1, 1)
    center = np.stack([left.mean(0), right.mean(0)])
    points = np.concatenate([left, right, center])
    i, j = np.arange(n), (np.arange(n) + 1) % n
    faces = np.concatenate([
        np.stack([i, j, j + n], -1), np.stack([i, j + n, i + n], -1),
        np.stack([i, j, np.full(n, 2 * n)], -1), np.stack([i + n, j + n, np.full(n, 2 * n + 1)], -1),
    ])  # fmt: skip
    return make(points, faces, *surface)


def relief(x: ArrayLike, z: ArrayLike, depth: ArrayLike, material: ArrayLike, color: ArrayLike) -> Mesh:
    """A wall in the xz plane with recesses and bays, used for facades.

    Args:
        x: (N+1,) and z: (M+1,) borders of its cells, m.
        depth: (N, M) m, towards +y. material: (N, M). color: (N, M, 3).

    The steps between cells of different depth are walls with the color of the shallower cell's neighbor.
    """
    x, z, depth = np.asarray(x, float), np.asarray(z, float), np.asarray(depth, float)
    material, color = np.asarray(material), np.asarray(color)
    i, j = np.indices(depth.shape).reshape(2, -1)
    d = depth.ravel()
    front = _quads(x[i], d, z[j], x[i + 1], d, z[j], x[i + 1], d, z[j + 1], x[i], d, z[j + 1])
    quads, materials, colors = [front], [material.reshape(-1)], [color.reshape(-1, 3)]
    padded = np.zeros((depth.shape[0] + 2, depth.shape[1]))  # jambs; at the ends down to the plane
    padded[1:-1] = depth
    i, j = np.nonzero(padded[1:] - padded[:-1])
    near, far = padded[i, j], padded[i + 1, j]
    quads.append(_quads(x[i], near, z[j], x[i], far, z[j], x[i], far, z[j + 1], x[i], near, z[j + 1]))
    shallow = np.where(padded[i, j] < padded[i + 1, j], np.maximum(i - 1, 0), np.minimum(i, len(depth) - 1))
    materials.append(np.full(len(i), Material.PLASTER))
    colors.append(color[shallow, j])
    padded = np.zeros((depth.shape[0], depth.shape[1] + 2))  # sills and lintels
    padded[:, 1:-1] = depth
    i, j = np.nonzero(padded[:, 1:] - padded[:, :-1])
    near, far = padded[i, j], padded[i, j + 1]
    quads.append(_quads(x[i], near, z[j], x[i + 1], near, z[j], x[i + 1], far, z[j], x[i], far, z[j]))
    shallow = np.where(padded[i, j] < padded[i, j + 1], np.maximum(j - 1, 0), np.minimum(j, depth.shape[1] - 1))
    materials.append(np.full(len(i), Material.CONCRETE))
    colors.append(color[i, shallow])
    points = np.concatenate(quads).reshape(-1, 3)
    corner = np.arange(len(points)).reshape(-1, 4)
    faces = corner[:, [0, 1, 2, 0, 2, 3]].reshape(-1, 3)
    of_quads = np.concatenate(materials), np.concatenate(colors)
    return make(points, faces, Label.BUILDING, *(np.repeat(values, 2, 0) for values in of_quads))


def _quads(*columns: np.ndarray) -> np.ndarray:
    return np.stack(columns, -1).reshape(-1, 4, 3)


def turned(mesh: Mesh, yaw: float, to: ArrayLike = (0.0, 0.0, 0.0)) -> Mesh:
    """The mesh rotated about z by `yaw` rad and moved; its surface coordinates stay."""
    c, s = np.cos(yaw), np.sin(yaw)
    R = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]], np.float32)
    return replace(mesh, vertices=mesh.vertices @ R.T + np.asarray(to, np.float32))
