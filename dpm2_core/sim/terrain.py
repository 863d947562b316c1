# SPDX-License-Identifier: Apache-2.0
"""The ground: distance of each position from the streets, height, and mesh.

All static objects are placed with one raster, the distance to the curb of the nearest street. It treats crossings,
loops and streets that are driven twice alike: nothing can be placed on a road, whichever pass created it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import cast

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.ndimage import distance_transform_edt, gaussian_filter
from scipy.spatial import cKDTree

from dpm2_core.data.trajectory import arc_lengths
from dpm2_core.extras import needs
from dpm2_core.frame import Array
from dpm2_core.sim.materials import Label, Material, Surface
from dpm2_core.sim.mesh import Mesh, make, merge
from dpm2_core.sim.road import Road
from dpm2_core.sim.settings import Preset

RESOLUTION = 0.5
"""Cell size of the rasters, m."""
MARGIN = 100.0
"""Ground beyond the streets, m."""
FINE = 14.0
"""The ground mesh has triangles of 1 m up to this distance from a curb, m, and of 4 m beyond."""
KERB = 0.12
"""Height of a sidewalk above the road, m."""


@dataclass(eq=False)
class Kerbline:
    """A line at a constant distance from the curb.

    Attributes:
        xy: (N, 2) m, points 1 m apart. outward: (N, 2) unit vectors away from the road. junction: (N,) near a crossing.
    """

    xy: Array
    outward: Array
    junction: NDArray[np.bool_]


class Terrain:
    """Rasters over the streets' bounding box.

    Attributes:
        origin: (2,) m, center of cell [0, 0]; cells are `RESOLUTION` apart, rows along y.
        edge: (H, W) float32 m, distance to the nearest curb, negative on a road.
        height: (H, W) float32 m, without curbs. nearest: (H, W) int32, nearest street sample.
        center: (S, 2) m and yaw, along: (S,) of all street samples; junction: (S,) near another street.
    """

    def __init__(self, road: Road, preset: Preset, rng: np.random.Generator) -> None:
        self.preset, self.resolution = preset, RESOLUTION
        self.center = np.concatenate([p.xy for p in road.streets])
        self.yaw = np.concatenate([p.yaw for p in road.streets])
        offsets = np.cumsum([0.0] + [p.length + 1e3 for p in road.streets])
        self.along = np.concatenate([p.s + o for p, o in zip(road.streets, offsets[:-1], strict=True)])
        self.half_width = np.concatenate(
            [np.full(len(p.xy), preset.half_width * (1 if k < road.main else 0.8)) for k, p in enumerate(road.streets)]
        )
        self.junction = self._junctions(road)
        low, high = self.center.min(0) - MARGIN, self.center.max(0) + MARGIN
        # whole 4 m cells
        self.origin = np.floor(low / 4) * 4
        shape = (np.ceil((high - self.origin) / 4) * 4 / RESOLUTION).astype(int) + 1
        self.nearest = self._nearest(shape)
        distance = self._distance()
        self.edge = (distance - self.half_width[self.nearest]).astype(np.float32)
        self.height = self._heights(road, rng)

    def _junctions(self, road: Road) -> NDArray[np.bool_]:
        reach = 2 * self.preset.half_width + 1
        pairs = cKDTree(self.center).query_pairs(reach, output_type="ndarray")
        arc_distance = np.abs(self.along[pairs[:, 0]] - self.along[pairs[:, 1]])
        lap_length = road.streets[0].length if road.drive.closed else np.inf
        pairs = pairs[(arc_distance > 3 * reach) & (np.abs(arc_distance - lap_length) > 3 * reach)]
        out = np.zeros(len(self.center), bool)
        out[pairs.ravel()] = True
        return out

    def _nearest(self, shape: NDArray[np.int_]) -> NDArray[np.int32]:
        mark = np.full((shape[1], shape[0]), -1, np.int32)
        column, row = np.rint((self.center - self.origin) / RESOLUTION).astype(int).T
        mark[row, column] = np.arange(len(self.center), dtype=np.int32)
        index = distance_transform_edt(mark < 0, return_distances=False, return_indices=True)
        return mark[index[0], index[1]]

    def _distance(self) -> Array:
        y = self.origin[1] + np.arange(self.nearest.shape[0])[:, None] * RESOLUTION - self.center[self.nearest, 1]
        x = self.origin[0] + np.arange(self.nearest.shape[1])[None] * RESOLUTION - self.center[self.nearest, 0]
        return np.hypot(x, y)

    def _heights(self, road: Road, rng: np.random.Generator) -> NDArray[np.float32]:
        preset, shape = self.preset, self.edge.shape
        # long waves are high, short ones low: grades are as on real streets
        waves = zip(rng.normal(0, 0.001, 6), rng.uniform(60, 300, 6), rng.uniform(0, 6.3, (6, 2)), strict=True)
        z = preset.hills * sum(
            grade * w * np.sin(2 * np.pi / w * (self.center @ (np.cos(direction), np.sin(direction))) + phase)
            for grade, w, (direction, phase) in waves
        )
        if road.heights is not None:
            main_heights = np.concatenate(road.heights)
            nearest = cKDTree(self.center[: len(main_heights)]).query(self.center[len(main_heights) :])[1]
            z = np.concatenate([main_heights, main_heights[nearest]])
        height = gaussian_filter(np.asarray(z, np.float32)[self.nearest], 5 / RESOLUTION)
        if preset.roughness > 0:
            # a cambered and slightly uneven road surface
            height -= 0.02 * np.clip(self.edge + preset.half_width, 0, preset.half_width)
            height += 0.012 * (_value_noise(shape, 5.0, rng) + _value_noise(shape, 14.0, rng))
            off_road = np.clip(self.edge - max(preset.sidewalk, 0.3), 0, None)
            rough = sum(a * _value_noise(shape, w, rng) for a, w in ((1.0, 2.5), (1.6, 8.0), (4.0, 30.0)))
            height += preset.roughness * np.minimum(off_road / 3, 1) * rough
            # slopes, banks and ditches that vary along the road
            bank = _value_noise(shape, 45.0, rng) * preset.hills * 0.05
            height += bank * np.clip(self.edge - 3, 0, 40)
            if not preset.sidewalk:
                ditch = np.clip(_value_noise(shape, 60.0, rng), 0, None)
                height -= 0.6 * ditch * np.exp(-(((self.edge - 2.2) / 0.8) ** 2))
        return height.astype(np.float32)

    def cell(self, xy: ArrayLike) -> tuple[NDArray[np.int_], NDArray[np.int_]]:
        """Rows and columns (N,) of the rasters at points (N, 2); points outside are moved to the border."""
        at = np.rint((np.asarray(xy) - self.origin.astype(np.asarray(xy).dtype)) / RESOLUTION).astype(np.int32)
        return at[..., 1].clip(0, self.edge.shape[0] - 1), at[..., 0].clip(0, self.edge.shape[1] - 1)

    def edge_at(self, xy: ArrayLike) -> NDArray[np.float32]:
        """Distance to the curb, m, at points (N, 2)."""
        return self.edge[self.cell(xy)]

    def height_at(self, xy: ArrayLike) -> Array:
        """Ground height, m, at points (N, 2), bilinear between the 1 m nodes of the mesh, without curbs."""
        at = (np.asarray(xy, float) - self.origin) / (2 * RESOLUTION)
        grid = self.height[::2, ::2]
        cell = np.floor(at).astype(int)
        i, j = cell[..., 1].clip(0, grid.shape[0] - 2), cell[..., 0].clip(0, grid.shape[1] - 2)
        v, u = (at[..., 1] - i).clip(0, 1), (at[..., 0] - j).clip(0, 1)
        low = grid[i, j] * (1 - u) + grid[i, j + 1] * u
        return low * (1 - v) + (grid[i + 1, j] * (1 - u) + grid[i + 1, j + 1] * u) * v

    def surface_at(self, xy: ArrayLike) -> Array:
        """Height of the surface, curbs included, m, at points (N, 2)."""
        edge = self.edge_at(xy)
        return self.height_at(xy) + KERB * ((edge > 0) & (edge < self.preset.sidewalk))

    def elevation(self) -> NDArray[np.float32]:
        """(H, W) m, height of the surface in the cells, curbs included; NaN beyond the mesh."""
        y, x = (
            self.origin[k] + np.arange(n) * RESOLUTION for k, n in ((1, self.edge.shape[0]), (0, self.edge.shape[1]))
        )
        out = np.full(self.edge.shape, np.nan, np.float32)
        inside = self.edge < MARGIN - 15
        xy = np.stack(np.broadcast_arrays(x[None], y[:, None]), -1)[inside]
        out[inside] = self.surface_at(xy)
        return out

    def lane_coordinates(self, xy: NDArray[np.floating]) -> tuple[NDArray, NDArray, NDArray[np.bool_]]:
        """For points (N, 2): m to the left of the nearest street's center, m along it, and whether at a crossing."""
        sample = self.nearest[self.cell(xy)]
        yaw = self.yaw[sample].astype(xy.dtype)
        offset = xy - self.center[sample].astype(xy.dtype)
        c, s = np.cos(yaw), np.sin(yaw)
        along = self.along[sample].astype(xy.dtype) + c * offset[:, 0] + s * offset[:, 1]
        return c * offset[:, 1] - s * offset[:, 0], along, self.junction[sample]

    def contour(self, level: float) -> Iterator[Kerbline]:
        """The lines `level` m outside the curb (negative: on the road), including the ends of streets."""
        for line in self._contour_lines(level):
            length = arc_lengths(line)
            if length[-1] < 6:
                continue
            s = np.linspace(0, length[-1], int(length[-1]) + 1)
            xy = np.stack([np.interp(s, length, line[:, k]) for k in (0, 1)], -1)
            xy[1:-1] = (xy[:-2] + 2 * xy[1:-1] + xy[2:]) / 4
            sample = self.nearest[self.cell(xy)]
            ahead = np.gradient(xy, axis=0)
            outward = np.stack([-ahead[:, 1], ahead[:, 0]], -1) / np.linalg.norm(ahead, axis=1, keepdims=True)
            away = np.einsum("ij,ij->i", outward, xy - self.center[sample])
            outward *= np.sign(away + 1e-9)[:, None]
            yield Kerbline(xy, outward, self.junction[sample])

    @cached_property
    def _contour_lines(self) -> Callable[[float], list[Array]]:
        """Function that returns the (N, 2) lines on which `edge` has a value, m."""
        with needs("sim", "the synthetic city"):
            import contourpy

        x = self.origin[0] + np.arange(self.edge.shape[1]) * RESOLUTION
        y = self.origin[1] + np.arange(self.edge.shape[0]) * RESOLUTION
        return cast("Callable[[float], list[Array]]", contourpy.contour_generator(x, y, self.edge).lines)

    def ground(self) -> Mesh:
        """The mesh of the ground, roads and sidewalks included."""
        return merge([*self._ground_meshes(), *self._sidewalks()])

    def _ground_meshes(self) -> Iterator[Mesh]:
        edge = self.edge[::2, ::2]
        near = edge < FINE
        corners = near[:-1, :-1] | near[1:, :-1] | near[:-1, 1:] | near[1:, 1:]
        x, y = (self.origin[k] + np.arange(n) * 2 * RESOLUTION for k, n in ((0, edge.shape[1]), (1, edge.shape[0])))
        xy = np.stack(np.broadcast_arrays(x[None], y[:, None]), -1)
        yield self._cell_mesh(*_snap_to_curb(xy, edge), corners)
        blocks = corners.reshape(corners.shape[0] // 4, 4, corners.shape[1] // 4, 4).all((1, 3))
        coarse = edge[::4, ::4]
        yield self._cell_mesh(xy[::4, ::4], coarse, ~blocks & (coarse[:-1, :-1] < MARGIN - 10))

    def _cell_mesh(self, xy: Array, edge: NDArray, keep: NDArray[np.bool_]) -> Mesh:
        """Two triangles for each kept cell between nodes (H, W, 2), classified by their mean distance to the curb."""
        i, j = np.nonzero(keep)
        used = np.zeros(edge.shape, bool)
        for di, dj in ((0, 0), (0, 1), (1, 0), (1, 1)):
            used[i + di, j + dj] = True
        number = np.cumsum(used.ravel(), dtype=np.int32).reshape(used.shape) - 1
        a, b, c, d = number[i, j], number[i, j + 1], number[i + 1, j + 1], number[i + 1, j]
        faces = np.stack([a, b, c, a, c, d], -1).reshape(-1, 3)
        xyz = np.concatenate([xy[used], self.height_at(xy[used])[:, None]], -1)
        middle = edge[used][faces].mean(1)
        road = middle < 0
        paved = self.preset.degenerate | (middle < self.preset.sidewalk)
        label = np.where(road, Label.ROAD, np.where(paved, Label.SIDEWALK, Label.TERRAIN))
        material = np.where(road, Material.ASPHALT, np.where(paved, Material.PAVING, Material.GRASS))
        color = np.where(road[:, None], (112, 110, 110), np.where(paved[:, None], (150, 146, 138), (98, 118, 60)))
        return make(xyz, faces, label, material, color, xyz[:, :2].astype(np.float32)[faces])

    def _sidewalks(self) -> Iterator[Mesh]:
        if not (width := self.preset.sidewalk):
            return
        section = ((-0.02, -0.02), (0.0, KERB), (0.12, KERB), (width, KERB), (width + 0.05, -0.1))
        for line in self.contour(0.0):
            yield kerbside_ribbon(self, line, section, Surface(Label.SIDEWALK, Material.PAVING, (165, 160, 152)))


def kerbside_ribbon(terrain: Terrain, line: Kerbline, profile: ArrayLike, surface: Surface) -> Mesh:
    """A profile of (offset outward, height above the ground) points, m, extruded along a line on the terrain."""
    section = np.asarray(profile, float)
    xy = line.xy[:, None] + line.outward[:, None] * section[:, :1]
    z = terrain.height_at(xy.reshape(-1, 2)).reshape(xy.shape[:2]) + section[:, 1]
    return sheet(np.concatenate([xy, z[..., None]], -1), surface)


def sheet(points: ArrayLike, surface: Surface) -> Mesh:
    """A surface through a grid (N, M, 3) of points; its surface coordinates are m along its columns and rows."""
    points = np.asarray(points, float)
    n, m = points.shape[:2]
    node = np.arange(n * m).reshape(n, m)
    a, b, c, d = node[:-1, :-1], node[1:, :-1], node[1:, 1:], node[:-1, 1:]
    faces = np.stack([a, b, c, a, c, d], -1).reshape(-1, 3)
    along, across = arc_lengths(points[:, m // 2]), arc_lengths(points[n // 2])
    uv = np.stack(np.broadcast_arrays(along[:, None], across[None]), -1).reshape(-1, 2)
    return make(points.reshape(-1, 3), faces, *surface, uv[faces])


def _snap_to_curb(xy: Array, edge: NDArray[np.float32]) -> tuple[Array, NDArray[np.float32]]:
    """Nodes (H, W, 2) of a 1 m grid, with those next to a curb moved onto it, and their distances (H, W) to it, m.

    A road then has a straight border instead of a staircase.
    """
    dy, dx = np.gradient(edge)
    slope = np.hypot(dy, dx) + 1e-6
    shift = np.where((np.abs(edge) < 0.71) & (slope > 0.5), edge, 0)  # 0.71: half of a cell's diagonal
    step = -(shift / slope)[..., None] * np.stack([dx, dy], -1) / slope[..., None]
    return xy + step, edge - shift


def _value_noise(shape: tuple[int, ...], wavelength: float, rng: np.random.Generator) -> NDArray[np.float32]:
    """(H, W) smooth noise of standard deviation about 0.5 with features of `wavelength` m."""
    nodes = [int(n * RESOLUTION / wavelength) + 4 for n in shape]
    coarse = rng.normal(0, 0.6, nodes).astype(np.float32)
    scale = wavelength / RESOLUTION
    to_node = np.array([[1 / scale, 0, 1], [0, 1 / scale, 1]])
    flags = cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP
    return cv2.warpAffine(coarse, to_node, (shape[1], shape[0]), flags=flags, borderMode=cv2.BORDER_REPLICATE)
