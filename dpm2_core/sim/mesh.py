# SPDX-License-Identifier: Apache-2.0
"""Triangle meshes with class, material, color and surface coordinates for every triangle, and ray casting."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dpm2_core.extras import needs
from dpm2_core.sim.materials import Label, Material

Float = NDArray[np.float32]
Int = NDArray[np.int32]


@dataclass(eq=False)
class Mesh:
    """A triangle soup.

    Attributes:
        vertices: (V, 3) float32 m. faces: (F, 3) int32.
        label: (F,) uint8 `Label`. material: (F,) uint8 `Material`. color: (F, 3) uint8 RGB.
        uv: (F, 3, 2) float32, surface coordinates of the corners, m. texture: (F,) uint16, seed of the pattern.
    """

    vertices: Float
    faces: Int
    label: NDArray[np.uint8]
    material: NDArray[np.uint8]
    color: NDArray[np.uint8]
    uv: Float
    texture: NDArray[np.uint16]

    def __len__(self) -> int:
        return len(self.faces)

    def part(self, keep: NDArray[np.bool_]) -> Mesh:
        """The mesh with a part of the triangles; the vertices stay."""
        columns = {f.name: getattr(self, f.name)[keep] for f in fields(self) if f.name != "vertices"}
        return Mesh(self.vertices, **columns)


def make(
    vertices: ArrayLike,
    faces: ArrayLike,
    label: Label | NDArray[np.integer],
    material: Material | NDArray[np.integer],
    color: ArrayLike = (128, 128, 128),
    uv: Float | None = None,
) -> Mesh:
    """A mesh from (V, 3) vertices and (F, 3) faces; the other values are for all triangles or one for each.

    Without `uv` each triangle is projected along the axis nearest to its normal.
    """
    vertices, faces = np.asarray(vertices, np.float32), np.asarray(faces, np.int32)
    n = len(faces)
    return Mesh(
        vertices,
        faces,
        _filled_bytes(label, (n,)),
        _filled_bytes(material, (n,)),
        _filled_bytes(color, (n, 3)),
        _box_uv(vertices[faces]) if uv is None else np.asarray(uv, np.float32),
        np.zeros(n, np.uint16),
    )


# A world consists of thousands of small meshes: the overhead of numpy's general functions took a quarter of the time
# for building it.


def _filled_bytes(values: ArrayLike, shape: tuple[int, ...]) -> NDArray[np.uint8]:
    out = np.empty(shape, np.uint8)
    out[...] = np.asarray(values, np.uint8)
    return out


_NEXT, _AFTER = np.array([1, 2, 0]), np.array([2, 0, 1])
_OTHER_AXES = np.array([[1, 2], [0, 2], [0, 1]])  # the two other axes of each axis
_CORNER = np.arange(3)[:, None]


def _box_uv(corners: Float) -> Float:
    a, b = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    normal = np.abs(a[:, _NEXT] * b[:, _AFTER] - a[:, _AFTER] * b[:, _NEXT])
    axes = _OTHER_AXES[normal.argmax(-1)]
    return corners[np.arange(len(corners))[:, None, None], _CORNER, axes[:, None, :]]


def merge(meshes: Sequence[Mesh]) -> Mesh:
    """One mesh of all triangles, in order."""
    offsets = np.cumsum([0] + [len(m.vertices) for m in meshes[:-1]])
    columns = {f.name: np.concatenate([getattr(m, f.name) for m in meshes]) for f in fields(Mesh) if f.name != "faces"}
    faces = np.concatenate([m.faces + np.int32(k) for m, k in zip(meshes, offsets, strict=True)])
    return Mesh(faces=faces, **columns)


def placed(template: Mesh, poses: ArrayLike, texture: ArrayLike = 0, tint: ArrayLike | None = None) -> Mesh:
    """Copies of a template.

    Args:
        poses: (N, 3, 4) or (N, 4, 4) affine maps from template to world (may scale and mirror).
        texture: (N,) pattern numbers.
        tint: (N, 3) color factors, 1 keeps the color; None for all 1.
    """
    poses = np.asarray(poses, np.float32)
    n, v = len(poses), len(template.vertices)
    points = np.einsum("nij,vj->nvi", poses[:, :3, :3], template.vertices) + poses[:, None, :3, 3]
    faces = template.faces[None] + (np.arange(n, dtype=np.int32) * v)[:, None, None]
    color = np.repeat(template.color[None], n, 0)
    if tint is not None:
        color = (color * np.asarray(tint, np.float32)[:, None]).clip(0, 255).astype(np.uint8)
    f = len(template)
    return Mesh(
        points.reshape(-1, 3),
        faces.reshape(-1, 3),
        np.tile(template.label, n),
        np.tile(template.material, n),
        color.reshape(-1, 3),
        np.tile(template.uv, (n, 1, 1)),
        np.repeat(np.broadcast_to(np.asarray(texture, np.uint16), n), f),
    )


def pose(xy: ArrayLike, z: ArrayLike, yaw: ArrayLike, scale: ArrayLike = 1.0) -> NDArray[np.float64]:
    """(N, 3, 4) maps: scale by `scale` (N,) or (N, 3), rotate by `yaw` (N,) rad about z, move to xy (N, 2), z (N,)."""
    xy, yaw = np.atleast_2d(np.asarray(xy, float)), np.atleast_1d(np.asarray(yaw, float))
    n = len(xy)
    out = np.zeros((n, 3, 4))
    out[:, 0, 0] = out[:, 1, 1] = np.cos(yaw)
    out[:, 1, 0] = np.sin(yaw)
    out[:, 0, 1] = -out[:, 1, 0]
    out[:, 2, 2] = 1.0
    scale = np.asarray(scale, float)
    out[:, :, :3] *= scale[:, None, :] if scale.ndim == 2 else np.broadcast_to(scale, n)[:, None, None]
    out[:, :2, 3], out[:, 2, 3] = xy, z
    return out


def rotated(directions: Float, R: ArrayLike) -> Float:
    """Directions (N, 3) float32 rotated by R (3, 3); faster than a product with such a narrow matrix."""
    R = np.asarray(R, np.float32)
    out = directions[:, :1] * R[:, 0]
    out += directions[:, 1:2] * R[:, 1]
    out += directions[:, 2:] * R[:, 2]
    return out


@dataclass(eq=False)
class Rows:
    """Arrays with one row per item."""

    def part(self, which: NDArray[np.bool_] | NDArray[np.intp]) -> Self:
        """The rows of some items."""
        return type(self)(*(getattr(self, field.name)[which] for field in fields(self)))


@dataclass(eq=False)
class Hits(Rows):
    """Nearest hits of R rays.

    Attributes:
        distance: (R,) float32 m, inf if nothing was hit. face: (R,) int32 triangle, -1 if nothing was hit.
        normal: (R, 3) float32, not normalized, either side. u, v: (R,) float32 barycentric, weights of corners 1 and 2.
    """

    distance: Float
    face: Int
    normal: Float
    u: Float
    v: Float


class Scene:
    """A mesh prepared for ray casting. Casting is thread-safe and releases the GIL."""

    def __init__(self, mesh: Mesh) -> None:
        with needs("sim", "the synthetic city"):
            from embreex.mesh_construction import TriangleMesh
            from embreex.rtcore_scene import EmbreeScene

        self.mesh = mesh
        self._scene = EmbreeScene()
        TriangleMesh(self._scene, np.ascontiguousarray(mesh.vertices), np.ascontiguousarray(mesh.faces))
        self.cast(np.zeros((1, 3), np.float32), np.array([[0, 0, 1]], np.float32))  # builds the tree: not thread-safe

    def cast(self, origins: Float, directions: Float, reach: float = 1e4) -> Hits:
        """Rays from (R, 3) origins along (R, 3) directions (unit length), up to `reach` m; both float32."""
        out = self._scene.run(origins, directions, query="INTERSECT", output=True)
        face, distance = out["primID"], out["tfar"]
        missed = (face < 0) | (distance > reach)
        face[missed], distance[missed] = -1, np.inf
        return Hits(distance, face, out["Ng"], out["u"], out["v"])
