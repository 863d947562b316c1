# SPDX-License-Identifier: Apache-2.0
"""Places static objects along the streets. Every placement uses two rasters: distance to the curb, and occupied."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import cv2
import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial import cKDTree

from dpm2_core.frame import Array
from dpm2_core.sim import plants
from dpm2_core.sim.buildings import building
from dpm2_core.sim.furniture import FURNITURE, street_box
from dpm2_core.sim.materials import Label, Material, Surface
from dpm2_core.sim.mesh import Mesh, merge, placed, pose
from dpm2_core.sim.road import Road
from dpm2_core.sim.settings import Preset
from dpm2_core.sim.shapes import box, leaves
from dpm2_core.sim.terrain import RESOLUTION, Kerbline, Terrain, kerbside_ribbon
from dpm2_core.sim.vehicles import car, truck

CLEAR_OF_DRIVE = 2.15
"""Distance from the path of the car's center without objects as low as a car (parked cars: without their center), m."""


class Layout:
    """Draws the static objects of a world, class by class; `meshes()` yields them."""

    def __init__(self, road: Road, terrain: Terrain, preset: Preset, rng: np.random.Generator) -> None:
        self.terrain, self.preset, self.rng = terrain, preset, rng
        self.occupied = np.zeros(terrain.edge.shape, np.uint8)
        self.drive = cKDTree(road.drive.xy)

    def meshes(self) -> Iterator[Mesh]:
        """All static objects. Space is taken in this order: cars first, then buildings, then plants."""
        preset = self.preset
        if preset.parked:
            yield from self._parked(preset.parked)
        if preset.buildings:
            ratio, setback = preset.buildings, preset.setback
            for level, chance in ((setback, ratio), (setback + 24, 0.5 * ratio), (setback + 50, 0.4 * ratio)):
                yield from self._buildings(level, chance)
        if preset.boundaries:
            yield from self._boundaries(preset.boundaries)
        kerb = preset.sidewalk or 1.2
        kinds = self.rng.choice(len(FURNITURE), 14, p=[p for _, p in FURNITURE])
        furniture = [FURNITURE[k][0](self.rng) for k in kinds]
        yield from self._scatter(furniture, preset.poles, (0.45, 0.9), 0.3, scale=None)
        trees = [plants.tree(self.rng) for _ in range(10)]
        distant = [plants.tree(self.rng, 0.4) for _ in range(10)]
        bushes = [plants.bush(self.rng) for _ in range(8)]
        yield from self._scatter(trees, preset.trees, (0.7, kerb + 3), 0.7, scale=(0.7, 1.15))
        yield from self._scatter(distant, preset.trees, (kerb + 4, kerb + 40), 0.7)
        yield from self._scatter(distant, 12 * preset.forest, (5, 30), 0.7, patchy=True)
        yield from self._scatter(bushes, 12 * preset.forest, (4, 16), 0.3, patchy=True)
        yield from self._scatter(bushes, preset.bushes, (kerb + 0.8, kerb + 14), 0.5)
        clutter = [*furniture, *(street_box(self.rng) for _ in range(6)), *(car(self.rng) for _ in range(6))]
        yield from self._scatter(clutter, preset.clutter, (kerb + 2.5, kerb + 22), 1.2)
        tufts = [plants.tuft(self.rng) for _ in range(8)]
        yield from self._scatter(tufts, 100 * preset.tufts, (preset.sidewalk + 0.6, preset.sidewalk + 7), 0.0)

    def _is_free(self, xy: Array) -> bool:
        return not self.occupied[self.terrain.cell(xy)].any()

    def _occupy(self, outline: ArrayLike) -> None:
        corners = np.rint((np.asarray(outline) - self.terrain.origin) / RESOLUTION).astype(np.int32)
        cv2.fillConvexPoly(self.occupied, corners, 1)

    def _scatter(
        self,
        templates: list[Mesh],
        per_100m: float,
        band: tuple[float, float],
        radius: float,
        patchy: bool = False,
        scale: tuple[float, float] | None = (0.8, 1.25),
    ) -> Iterator[Mesh]:
        """Copies at random positions in a band along the curb, at least `radius` m from objects that are there already.

        `scale`: smallest and largest; None for unscaled copies, aligned with the curb.
        """
        if per_100m <= 0:
            return
        terrain, rng = self.terrain, self.rng
        extent = np.array([_lower_extent(template) for template in templates])
        for line in terrain.contour(0.5 * (band[0] + band[1])):
            n = rng.poisson(per_100m * len(line.xy) / 100)
            picked = rng.integers(0, len(line.xy), n)
            if patchy:  # belts of about 40 m: half of the line, from a random wave
                picked = picked[np.sin(picked * rng.uniform(0.05, 0.12) + rng.uniform(0, 6.3)) > 0.2]
            n = len(picked)
            if not n:
                continue
            xy = line.xy[picked] + line.outward[picked] * rng.uniform(-0.5, 0.5, (n, 1)) * (band[1] - band[0])
            kind = rng.integers(0, len(templates), n)
            size = np.ones(n) if scale is None else rng.uniform(*scale, n)
            keep = terrain.edge_at(xy) > band[0] - 0.25
            keep &= self.drive.query(xy)[0] > CLEAR_OF_DRIVE + extent[kind] * size
            row, column = terrain.cell(xy)
            keep &= self.occupied[row, column] == 0
            if radius:
                close = cKDTree(xy).query_pairs(2 * radius, output_type="ndarray")
                keep[close[keep[close].all(1), 1]] = False
                self.occupied[row[keep], column[keep]] = 1
            xy, picked, kind, size = xy[keep], picked[keep], kind[keep], size[keep]
            yaw = rng.uniform(0, 2 * np.pi, len(xy))
            if scale is None:
                yaw = (
                    np.arctan2(line.outward[picked, 1], line.outward[picked, 0])
                    - np.pi / 2
                    + rng.normal(0, 0.05, len(xy))
                )
            tint = rng.uniform(0.8, 1.2, (len(xy), 1)) * rng.uniform(0.93, 1.07, (len(xy), 3))
            z = terrain.surface_at(xy)
            texture = rng.integers(0, 65536, len(xy))
            for k, template in enumerate(templates):
                if (chosen := kind == k).any():
                    yield placed(
                        template, pose(xy[chosen], z[chosen], yaw[chosen], size[chosen]), texture[chosen], tint[chosen]
                    )

    def _parked(self, share: float) -> Iterator[Mesh]:
        rng, level = self.rng, -0.95
        models = [car(rng) for _ in range(14)] + [truck(rng)]
        for line in self.terrain.contour(level):
            at = 0.0
            while at < len(line.xy) - 6:
                i, j = int(at + 2.5), int(at + 3.5)
                at += rng.uniform(5.2, 6.5)
                curvature = np.abs(np.diff(line.outward[i - 2 : i + 4], axis=0)).sum()
                if rng.random() > share or line.junction[max(i - 4, 0) : i + 8].any() or curvature > 0.25:
                    continue
                if self.drive.query(line.xy[i])[0] < CLEAR_OF_DRIVE:
                    continue
                ahead = line.xy[j] - line.xy[i]
                yaw = np.arctan2(ahead[1], ahead[0]) + rng.normal(0, 0.03) + np.pi * (rng.random() < 0.15)
                xy = line.xy[i] + line.outward[i] * rng.uniform(-0.1, 0.25)
                model = models[int(rng.choice(len(models), p=[0.07] * 14 + [0.02]))]
                yield placed(model, pose(xy, self.terrain.height_at(xy), yaw), rng.integers(65536, size=1))

    def _buildings(self, level: float, share: float) -> Iterator[Mesh]:
        rng = self.rng
        for line in self.terrain.contour(level):
            at = float(rng.uniform(0, 5))
            base = int(rng.integers(self.preset.floors[0], self.preset.floors[1] + 1))
            while at < len(line.xy) - 6:
                width = rng.uniform(7, 22)
                if rng.random() < share:
                    floors = int(np.clip(base + rng.integers(-1, 2), *self.preset.floors))
                    house = self._building(line, int(at), width, floors, level)
                    if house is not None:
                        yield house
                        at += width + (0.0 if rng.random() < 0.5 * share else rng.uniform(1, 6))
                        continue
                at += rng.uniform(3, 10)

    def _building(self, line: Kerbline, start: int, width: float, floors: int, level: float) -> Mesh | None:
        end = min(start + int(width), len(line.xy) - 1)
        chord = line.xy[end] - line.xy[start]
        width = float(np.linalg.norm(chord))
        if width < 6:
            return None
        along = chord / width
        inward = np.array([-along[1], along[0]])
        if inward @ line.outward[(start + end) // 2] < 0:
            along, inward = -along, -inward
        depth = self.rng.uniform(7, 15)
        front = (line.xy[start] + line.xy[end]) / 2 + inward * self.rng.uniform(0, 2.0) * (level > 6)
        u, v = np.meshgrid(np.linspace(-0.5, 0.5, 9) * (width - 0.5), np.linspace(0.2, depth, 9))
        spots = front + u.reshape(-1, 1) * along + v.reshape(-1, 1) * inward
        is_too_near = self.terrain.edge_at(spots).min() < min(level, self.preset.setback) * 0.7
        if is_too_near or self.drive.query(spots)[0].min() < CLEAR_OF_DRIVE + 1 or not self._is_free(spots):
            return None
        outline = [front + a * width / 2 * along + b * inward for a, b in ((-1, 0), (1, 0), (1, depth), (-1, depth))]
        self._occupy(outline)
        z = float(self.terrain.height_at(spots).mean())
        mesh = building(width, depth, floors, self.rng)
        return placed(mesh, pose(front, z, np.arctan2(along[1], along[0])), self.rng.integers(65536, size=1))

    def _boundaries(self, share: float) -> Iterator[Mesh]:
        """Hedges, walls and fences between sidewalk and garden, in runs of 6 to 30 m."""
        rng = self.rng
        kinds: tuple[Callable[[Kerbline], Iterator[Mesh]], ...] = (self._hedge, self._wall, self._fence)
        for line in self.terrain.contour((self.preset.sidewalk or 1.5) + 0.4):
            at = 0
            while at < len(line.xy) - 8:
                run = int(rng.integers(6, 30))
                part = slice(at, min(at + run, len(line.xy)))
                at += run + int(rng.integers(2, 6))
                span = Kerbline(line.xy[part], line.outward[part], line.junction[part])
                clear = self._is_free(span.xy) and (self.drive.query(span.xy)[0] > CLEAR_OF_DRIVE + 0.5).all()
                if rng.random() < share and clear:
                    self.occupied[self.terrain.cell(span.xy)] = 1
                    yield from kinds[int(rng.choice(3, p=[0.45, 0.3, 0.25]))](span)

    def _hedge(self, line: Kerbline) -> Iterator[Mesh]:
        rng = self.rng
        h, w = rng.uniform(0.7, 2.2), rng.uniform(0.5, 1.2)
        green = plants.GREENS[rng.integers(len(plants.GREENS))]
        section = ((0.0, -0.3), (0.0, h / 2), (0.08, h), (w / 2, h + 0.05), (w - 0.08, h), (w, h / 2), (w, -0.3))
        mesh = kerbside_ribbon(self.terrain, line, section, Surface(Label.VEGETATION, Material.LEAF, green * 0.8))
        mesh.vertices += rng.normal(0, 0.08, mesh.vertices.shape).astype(np.float32)
        yield mesh
        corners = mesh.vertices[mesh.faces[rng.integers(0, len(mesh), 5 * len(mesh))]]
        weights = rng.dirichlet((1, 1, 1), len(corners))
        yield leaves((corners * weights[..., None]).sum(1), 0.2, rng, green)

    def _wall(self, line: Kerbline) -> Iterator[Mesh]:
        h, brick = self.rng.uniform(0.4, 2.2), self.rng.random() < 0.5
        color = (150, 92, 76) if brick else self.rng.uniform(130, 210) * np.array([1, 0.98, 0.93])
        coping = [(-0.04, h), (-0.04, h + 0.06), (0.29, h + 0.06), (0.29, h)]
        section = [(0.0, -0.5), (0.0, h), *coping, (0.25, h), (0.25, -0.5)]
        stone = Surface(Label.FENCE, Material.BRICK if brick else Material.CONCRETE, color)
        yield kerbside_ribbon(self.terrain, line, section, stone)

    def _fence(self, line: Kerbline) -> Iterator[Mesh]:
        """Pickets and two rails, per meter."""
        rng = self.rng
        h, gap = rng.uniform(0.8, 1.9), float(rng.choice([0.13, 0.2, 0.33]))
        wood = rng.random() < 0.7
        color = rng.uniform(0.4, 1) * np.array((190, 150, 110) if wood else (150, 155, 155))
        kind = Surface(Label.FENCE, Material.WOOD if wood else Material.METAL, color)
        width = gap * rng.uniform(0.3, 0.75)
        pickets = [box((x, 0, -0.1), (x + width, 0.02, h), kind) for x in np.arange(0, 1, gap)]
        rails = [box((0, 0.02, z), (1.02, 0.06, z + 0.08), kind) for z in (0.25 * h, 0.8 * h)]
        ahead = np.diff(line.xy, axis=0)
        yaw = np.arctan2(ahead[:, 1], ahead[:, 0])
        stretch = np.stack([np.linalg.norm(ahead, axis=1), np.ones(len(yaw)), np.ones(len(yaw))], -1)
        poses = pose(line.xy[:-1], self.terrain.height_at(line.xy[:-1]), yaw)
        poses[:, :, :3] *= stretch[:, None]
        yield placed(merge([*pickets, *rails]), poses, rng.integers(65536, size=len(poses)))


def _lower_extent(mesh: Mesh) -> float:
    """Horizontal extent of the lower 3 m, m, which could touch a passing car or its sensor."""
    low = mesh.vertices[mesh.vertices[:, 2] < 3.0]
    return float(np.hypot(low[:, 0], low[:, 1]).max())
