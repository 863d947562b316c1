# SPDX-License-Identifier: Apache-2.0
"""What moves: cars ahead and oncoming, people and cyclists beside the road."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dpm2_core.sim.config import Preset
from dpm2_core.sim.mesh import Mesh, merge, placed, pose
from dpm2_core.sim.road import Road
from dpm2_core.sim.terrain import Terrain
from dpm2_core.sim.vehicles import car, cyclist, person, truck

Array = NDArray[np.float64]
SIGHT = 110.0
"""Movers farther from the sensor are left out, m."""
GAP = 6.5
"""Movers nearer to the sensor are left out, m: a drive that leaves its lane must not find itself inside a car."""


@dataclass(eq=False)
class Traffic:
    """M movers along the drive.

    Attributes:
        models: one mesh each. start, speed, lateral: (M,) m, m/s and m to the left of the drive; a negative speed is
            against it. follows: (M,) keeps its distance ahead of the car instead. phase: (M,) of its small variations.
    """

    road: Road
    terrain: Terrain
    models: list[Mesh]
    start: Array
    speed: Array
    lateral: Array
    follows: NDArray[np.bool_]
    phase: Array

    def poses(self, time: float) -> tuple[Array, Array]:
        """Places (M, 2) and headings (M,) at a time, s."""
        drive = self.road.drive
        own = float(self.road.distance(time))
        s = self.start + np.where(self.follows, own + 2.0 * np.sin(0.3 * time + self.phase), self.speed * time)
        s = np.mod(s, drive.length)
        xy, yaw = drive.at(s, self.lateral)
        return xy, yaw + np.where(self.speed < 0, np.pi, 0.0)

    def mesh(self, time: float, around: ArrayLike) -> tuple[Mesh, NDArray[np.uint16]] | None:
        """All in sight of a place (2,) at a time, and the number (F,) of each triangle's mover; None without any."""
        if not self.models:
            return None
        xy, yaw = self.poses(time)
        away = np.linalg.norm(xy - np.asarray(around)[:2], axis=1)
        seen = np.flatnonzero((away < SIGHT) & (away > GAP))
        if not len(seen):
            return None
        z = self.terrain.surface_at(xy[seen])
        poses = pose(xy[seen], z, yaw[seen])
        meshes = [placed(self.models[k], poses[i : i + 1], k * 101 % 65536) for i, k in enumerate(seen)]
        return merge(meshes), np.repeat((seen + 1).astype(np.uint16), [len(m) for m in meshes])


def make_traffic(road: Road, terrain: Terrain, preset: Preset, rng: np.random.Generator) -> Traffic:
    """As many movers as the preset has on that length."""
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
    if preset.half_width > 10:  # two lanes each way
        lateral = np.where(oncoming, 2 * preset.lane - 3.6 * rng.integers(0, 2, n_cars), 3.6)
    else:
        follows |= ~oncoming
        lateral = np.full(n_cars, max(2 * preset.lane, 2.4))
    lateral = np.where(follows, 0.0, lateral)
    start = np.where(follows, rng.uniform(14, 90, n_cars), rng.uniform(0, length, n_cars))
    walk = rng.uniform(0.6, 1.4) + preset.half_width
    sides = rng.choice([-1, 1], n_people)
    return Traffic(
        road,
        terrain,
        cars + walkers,
        np.concatenate([start, rng.uniform(0, length, n_people)]),
        np.concatenate(
            [
                np.where(oncoming & ~follows, -pace, pace),
                rng.choice([-1, 1], n_people) * rng.uniform(0.8, 1.9, n_people),
            ]
        ),
        np.concatenate([lateral, sides * (walk + rng.uniform(0, 0.8, n_people)) + preset.lane]),
        np.concatenate([follows, np.zeros(n_people, bool)]),
        rng.uniform(0, 6.3, n_cars + n_people),
    )
