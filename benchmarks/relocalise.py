# SPDX-License-Identifier: Apache-2.0
"""Relocalization in a saved map: random positions, headings and offsets, with other traffic than during mapping."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from rich.console import Group
from rich.progress import Progress

from benchmarks.harness import Options, Report, processors, settings_of
from benchmarks.relocalise_open import open_roads
from benchmarks.relocalise_visits import evaluate_visit, keyframe_cloud, preprocessed, relocalizer_in, success_rates
from benchmarks.roads import open_road, road_files
from dpm2_core.console import progress_bar
from dpm2_core.estimates import Keyframe, Registration, isotropic
from dpm2_core.frame import Array, Frame, Points
from dpm2_core.geometry import se3
from dpm2_core.network.pretrained import load_network
from dpm2_core.sim.lidar import Lidar
from dpm2_core.sim.simulated_drive import SimulatedDrive
from dpm2_core.slam.build import make_mapper
from dpm2_core.slam.loops.pictures import KnownMap
from dpm2_core.slam.settings import SlamSettings
from dpm2_core.slam.store.map_data import load_map
from dpm2_core.slam.store.map_store import MapStore

LATERAL = (-1.2, 3.0)
"""m to the left of the drive: from cars parked at the curb to the other lane."""
APART = 5000.0
"""Distance between the roads in the single map of all roads, m."""
_NO_LOOPS = 1e9  # m between two keyframes of a loop
_EDGE_COVARIANCE = isotropic(np.radians(0.15), 0.05)


@dataclass(frozen=True)
class Road:
    """A road in the map: its drive, and T_map_world (4, 4)."""

    drive: SimulatedDrive
    T_map_world: Array


def bench_relocalise(options: Options) -> Report:
    """Map the roads with a keyframe every 5 m, save the map, load it, and relocalize `pairs` random scans in it.

    Without `--source` also on a highway and in a tunnel, where the geometry looks alike everywhere.

    Raises:
        UsageError: there are no pose files.
    """
    settings = settings_of(options)
    with progress_bar() as progress, tempfile.TemporaryDirectory() as folder, processors(options.threads):
        file = Path(folder) / "map.dpm2"
        roads = survey(options, settings, file, progress)
        with MapStore.open(file) as store:
            data = load_map(store)
            network = load_network(settings.neural.weights, settings.threads)
            relocalizer = relocalizer_in(settings, network, KnownMap(data.keyframes, data.clouds.item, data.poses))
            task = progress.add_task("relocalise", total=options.pairs)
            rows = []
            for cloud, truth in visits(roads, settings, options.pairs):
                rows.append(evaluate_visit(relocalizer.find, Keyframe(0, 0, 0, np.eye(4), cloud), truth))
                progress.advance(task)
            results = {"keyframes": len(data), "lateral_m": LATERAL, **success_rates(rows)}
        if not options.sources:
            results["open_roads"] = open_roads(settings, network, progress)
    return Report(results, Group(*(f"{name}: {value}" for name, value in results.items())))


def survey(options: Options, settings: SlamSettings, file: Path, progress: Progress) -> list[Road]:
    """Write the map of all roads with true poses, so that only relocalization is measured."""
    settings = settings.model_copy(update={"loops": settings.loops.model_copy(update={"gap": _NO_LOOPS})})
    roads: list[Road] = []
    with MapStore.create(file) as store:
        store.begin_session()
        mapper = make_mapper(settings, store)
        for path in road_files(options):
            drive = open_road(path)
            road = Road(drive, se3.make(np.eye(3), np.array([0, APART * len(roads), 0])))
            roads.append(road)
            frames = spaced(drive, 5.0)
            task = progress.add_task(f"map of {drive.name}", total=len(frames))
            for i in frames:
                cloud = keyframe_cloud(preprocessed(drive.frame(i), settings), settings)
                edge = Registration(np.eye(4), _EDGE_COVARIANCE, 1.0, 0.1, "survey") if mapper.keyframes else None
                T = road.T_map_world @ drive.poses[i]
                mapper.add(Keyframe(len(mapper.keyframes), i, i, T, cloud, edge))
                progress.advance(task)
        mapper.finish()
    return roads


def visits(roads: list[Road], settings: SlamSettings, count: int) -> Iterator[tuple[Points, Array]]:
    """Clouds of random visits, and the true T_map_lidar (4, 4) of each."""
    rng, lidar = np.random.default_rng(0), Lidar()
    lengths = np.array([road.drive.world.road.drive.length for road in roads])
    for _ in range(count):
        road = roads[int(rng.choice(len(roads), p=lengths / lengths.sum()))]
        world = road.drive.world
        s = rng.uniform(5, world.road.drive.length - 5)
        T = world.pose_at(s, rng.uniform(*LATERAL), rng.uniform(-np.pi, np.pi))
        scan = lidar.scan(world, T, rng.uniform(0, world.road.times[-1]), rng)
        points = preprocessed(Frame(0, scan.points), settings)
        yield keyframe_cloud(points, settings), road.T_map_world @ T


def spaced(drive: SimulatedDrive, meters: float) -> list[int]:
    """Frames of a drive that are `meters` apart along it."""
    distances = drive.world.road.distance(drive.times)
    return sorted({int(np.searchsorted(distances, s)) for s in np.arange(0, distances[-1], meters)})
