# SPDX-License-Identifier: Apache-2.0
"""Moving objects: cars ahead and oncoming, pedestrians and cyclists next to the road."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dpm2_core.frame import Array
from dpm2_core.sim.mesh import Float, Hits, Mesh, Scene, merge, placed, pose
from dpm2_core.sim.road import Road
from dpm2_core.sim.settings import Preset
from dpm2_core.sim.terrain import Terrain
from dpm2_core.sim.vehicles import car, cyclist, person, truck

SIGHT = 110.0
"""Dynamic objects farther from the sensor are left out, m."""
GAP = 6.5
"""Dynamic objects nearer to the sensor are left out, m: a drive that leaves its lane must not get inside a car."""
ALONGSIDE = 2.4
"""The same for the columns of dense traffic, which keep to lanes 3.5 m apart, m."""


@dataclass(eq=False)
class Traffic:
    """M dynamic objects along the drive.

    Attributes:
        models: one mesh each. start, speed, lateral: (M,) m, m/s and m to the left of the drive; a negative speed is
            oncoming. follows: (M,) whether it is `start` m ahead of the car instead, with `speed` relative to the car.
            phase: (M,) of its small variations. gap: (M,) m, if it is nearer to the sensor it is left out.
    """

    road: Road
    terrain: Terrain
    models: list[Mesh]
    start: Array
    speed: Array
    lateral: Array
    follows: NDArray[np.bool_]
    phase: Array
    gap: Array

    def poses(self, time: float) -> tuple[Array, Array]:
        """Positions (M, 2) and headings (M,) at a time, s."""
        drive = self.road.drive
        driven = float(self.road.distance(time))
        s = self.start + self.speed * time + np.where(self.follows, driven + 2.0 * np.sin(0.3 * time + self.phase), 0.0)
        s = np.mod(s, drive.length)
        xy, yaw = drive.at(s, self.lateral)
        return xy, yaw + np.where((self.speed < 0) & ~self.follows, np.pi, 0.0)

    def dynamic_objects(self, time: float, around: ArrayLike) -> DynamicObjects | None:
        """The objects in sight of a position (2 or 3,) at a time, s; None if there are none."""
        if not self.models:
            return None
        xy, yaw = self.poses(time)
        distance = np.linalg.norm(xy - np.asarray(around)[:2], axis=1)
        in_sight = np.flatnonzero((distance < SIGHT) & (distance > self.gap))
        if not len(in_sight):
            return None
        poses = pose(xy[in_sight], self.terrain.surface_at(xy[in_sight]), yaw[in_sight])
        meshes = [placed(self.models[k], poses[i : i + 1], k * 101 % 65536) for i, k in enumerate(in_sight)]
        return DynamicObjects(
            Scene(merge(meshes)), np.repeat((in_sight + 1).astype(np.uint16), [len(m) for m in meshes])
        )


@dataclass(eq=False)
class DynamicObjects:
    """Moving objects at one time: a scene, and for each of its triangles (F,) the number of its dynamic object."""

    scene: Scene
    number: NDArray[np.uint16]

    def cast(self, origin: Float, directions: Float, reach: float) -> tuple[Hits, NDArray[np.intp]]:
        """Hits of the K of R rays from (3,) or (R, 3) that can meet a dynamic object, and their indices (K,)."""
        all_rays = origin.ndim == 2
        toward = np.arange(len(directions)) if all_rays else _rays_towards(self.scene.mesh, origin, directions)
        origins = np.ascontiguousarray(np.broadcast_to(origin, directions.shape)[toward])
        return self.scene.cast(origins, directions[toward], reach), toward


def _rays_towards(mesh: Mesh, origin: Float, directions: Float) -> NDArray[np.intp]:
    """Indices of the rays (R, 3) within the azimuths and elevations that a mesh covers as seen from a point (3,)."""
    bins = 720
    offsets = mesh.vertices - origin
    flat = np.hypot(offsets[:, 0], offsets[:, 1]) + np.float32(1e-3)
    corners = np.arctan2(offsets[:, 1], offsets[:, 0])[mesh.faces]
    spread = np.remainder(corners - corners[:, :1] + np.pi, 2 * np.pi) - np.pi
    first = np.floor((corners[:, 0] + spread.min(1) - 0.01) / (2 * np.pi) * bins).astype(int)
    last = np.floor((corners[:, 0] + spread.max(1) + 0.01) / (2 * np.pi) * bins).astype(int)
    # +1 where a triangle begins, -1 after its end, over three revolutions folded into one
    steps = np.bincount(first + bins, minlength=3 * bins + 1) - np.bincount(last + bins + 1, minlength=3 * bins + 1)
    covered = np.cumsum(steps)[: 3 * bins].reshape(3, bins).max(0) > 0
    slope = directions[:, 2] / (np.hypot(directions[:, 0], directions[:, 1]) + np.float32(1e-6))
    low, high = (offsets[:, 2] / flat).min() - 0.02, (offsets[:, 2] / flat).max() + 0.02
    azimuth = np.floor(np.arctan2(directions[:, 1], directions[:, 0]) / (2 * np.pi) * bins).astype(int) % bins
    return np.flatnonzero(covered[azimuth] & (slope > low) & (slope < high))


def make_traffic(road: Road, terrain: Terrain, preset: Preset, rng: np.random.Generator) -> Traffic:
    """Traffic with the number of dynamic objects that the preset has on a road of that length."""
    if preset.columns:
        walking = make_traffic(road, terrain, preset.model_copy(update={"traffic": 0.0, "columns": False}), rng)
        return _with_columns(walking, preset, rng)
    length = road.drive.length
    n_cars = int(rng.poisson(preset.traffic * length / 100 * rng.uniform(0.3, 1.7)))
    n_people = int(rng.poisson(preset.people * length / 100 * rng.uniform(0.3, 1.7)))
    library = [car(rng) for _ in range(min(n_cars, 12))] + [truck(rng) for _ in range(min(n_cars, 3))]
    cars = [library[int(k)] for k in rng.integers(0, max(len(library), 1), n_cars)]
    people = [cyclist(rng) if rng.random() < 0.25 else person(rng) for _ in range(min(n_people, 16))]
    walkers = [people[int(k)] for k in rng.integers(0, max(len(people), 1), n_people)]
    follows = rng.random(n_cars) < 0.3
    oncoming = rng.random(n_cars) < 0.7
    pace = preset.speed * rng.uniform(0.7, 1.1, n_cars)
    if preset.wide:
        lateral = np.where(oncoming, 2 * preset.lane - 3.6 * rng.integers(0, 2, n_cars), 3.6)
    else:
        follows |= ~oncoming
        lateral = np.full(n_cars, max(2 * preset.lane, 2.4))
    lateral = np.where(follows, 0.0, lateral)
    start = np.where(follows, rng.uniform(14, 90, n_cars), rng.uniform(0, length, n_cars))
    walk = rng.uniform(0.6, 1.4) + preset.half_width
    sides = rng.choice([-1, 1], n_people)
    of_cars = start, np.where(follows, 0.0, np.where(oncoming, -pace, pace)), lateral, follows
    of_people = (
        rng.uniform(0, length, n_people),
        rng.choice([-1, 1], n_people) * rng.uniform(0.8, 1.9, n_people),
        sides * (walk + rng.uniform(0, 0.8, n_people)) + preset.lane,
        np.zeros(n_people, bool),
    )
    columns = [np.concatenate(both) for both in zip(of_cars, of_people, strict=True)]
    columns += [rng.uniform(0, 6.3, n_cars + n_people), np.full(n_cars + n_people, GAP)]
    return Traffic(road, terrain, cars + walkers, *columns)


def _with_columns(others: Traffic, preset: Preset, rng: np.random.Generator) -> Traffic:
    """Add columns on two lanes each way: ahead and behind, alongside at nearly the car's speed, and oncoming."""
    length, lane = others.road.drive.length, 3.5
    library = [car(rng) for _ in range(12)] + [truck(rng) for _ in range(8)]
    lengths = np.array([np.ptp(mesh.vertices[:, 0]) for mesh in library])
    across = 2 * preset.lane
    second_lane, oncoming = (lane, (across, across - lane)) if preset.wide else (-lane, (across, across + lane))
    parts = []
    for lateral, trucks in ((0.0, 0.4), (second_lane, 0.7), (oncoming[0], 0.4), (oncoming[1], 0.4)):
        kind, at = _queue(lengths, trucks, 400 / preset.traffic, length, rng)
        same_way = lateral in (0.0, second_lane)
        pace = rng.uniform(-1.5, 1.5) if same_way else -preset.speed * rng.uniform(0.7, 1.0)
        if lateral == 0:  # space for the car itself, and for cars ahead and behind to come 2 m nearer
            pace = 0.0
            at = np.remainder(at + length / 2, length) - length / 2
            is_apart = np.abs(at) > 9 + lengths[kind] / 2
            kind, at = kind[is_apart], at[is_apart]
        parts.append((kind, at, *(np.full(len(at), value) for value in (pace, lateral, same_way))))
    kind, *queues = (np.concatenate(part) for part in zip(*parts, strict=True))
    queues += [rng.uniform(0, 6.3, len(kind)), np.full(len(kind), ALONGSIDE)]
    rest = others.start, others.speed, others.lateral, others.follows, others.phase, others.gap
    columns = (np.concatenate(both) for both in zip(queues, rest, strict=True))
    return Traffic(others.road, others.terrain, [library[k] for k in kind] + others.models, *columns)


def _queue(
    lengths: Array, trucks: float, spacing: float, road: float, rng: np.random.Generator
) -> tuple[NDArray[np.intp], Array]:
    """Types of 12 cars and then trucks with those `lengths`, and their positions (K,) m, on a lane of `road` m.

    `trucks` is the share of trucks. The mean distance between centers is `spacing` m, and never so small that they
    touch when both are 2 m off their positions.
    """
    n = int(road / 5) + 1  # more than fit
    kind = np.where(rng.random(n) < trucks, rng.integers(12, len(lengths), n), rng.integers(0, 12, n))
    slack = max(spacing - 5 - lengths[kind].mean(), 1.0)
    ends = np.cumsum(lengths[kind] + 5 + rng.exponential(slack, n))
    keep = ends < road
    return kind[keep], (ends - lengths[kind] / 2)[keep]
