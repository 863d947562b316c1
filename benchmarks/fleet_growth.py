# SPDX-License-Identifier: Apache-2.0
"""Cost of adding a drive to a growing map: in the index, in the graph and in the file. And the memory for creating a
map of 20,000 keyframes at once.
"""

from __future__ import annotations

import time
from concurrent.futures import ProcessPoolExecutor
from contextlib import ExitStack
from dataclasses import replace
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.resident import peak_mb
from dpm2_core.estimates import Edge, Keyframe, Registration, isotropic
from dpm2_core.fleet.growth import Growth, Standing, add_drives, grown
from dpm2_core.fleet.places import FleetIndex
from dpm2_core.fleet.regions import LARGEST, Join, solve
from dpm2_core.frame import NO_POINTS, Array
from dpm2_core.geometry import se3
from dpm2_core.slam.graph.robust import RobustSettings
from dpm2_core.slam.loops.retrieval import WIDTH
from dpm2_core.slam.store.cloud_codec import pack_cloud
from dpm2_core.slam.store.cloud_store import CloudStore
from dpm2_core.slam.store.map_data import MapData, load_map, save_as
from dpm2_core.slam.store.map_store import MapStore
from dpm2_core.slam.store.rows import Session

DRIVES, KEYFRAMES, SHARED = 52, 100, 20
"""Number of drives; keyframes of each, 5 m apart; and keyframes that it shares with the next drive."""
AT_ONCE = 200
"""Number of drives in the map that is created at once: 20,000 keyframes."""
_NOISE = isotropic(1e-3, 0.02)
_POINTS = 5000  # of a cloud
_WINDOW = 5  # additions over which the median is taken


def bench_growth(folder: Path) -> dict[str, Any]:
    """Processor time of each addition, without the search for loops, which does not depend on the size of the map.

    The drives are artificial: true poses with noise, clouds of noise, true loops, and places that look alike if they
    are the same.
    """
    rng = np.random.default_rng(0)
    count = (KEYFRAMES - SHARED) * DRIVES + SHARED
    path_poses = _circle(count)
    place_vectors = rng.normal(size=(count, WIDTH)).astype(np.float32)
    index, sizes, rows = FleetIndex(folder), dict[str, int](), []
    with MapStore.create(folder / "town.dpm2map") as store:
        for number in range(DRIVES):
            indices = np.arange(KEYFRAMES) + number * (KEYFRAMES - SHARED)
            name, data = f"d{number:02d}", _drive(path_poses[indices], rng)
            vectors = place_vectors[indices] + 0.1 * rng.normal(size=(KEYFRAMES, WIDTH)).astype(np.float32)
            joins = _joins(f"d{number - 1:02d}", name, path_poses, indices) if number else []
            rows.append(
                {"map": sum(sizes.values()), **_measure_addition(store, index, sizes, (name, data, vectors), joins)}
            )
            sizes[name] = KEYFRAMES
    at_5_drives, at_50_drives = (_median(rows[last - _WINDOW : last]) for last in (5 + _WINDOW // 2 + 1, DRIVES))
    return {
        "keyframes": KEYFRAMES * DRIVES,
        "cpu_ms_at_5_drives": at_5_drives,
        "cpu_ms_at_50_drives": at_50_drives,
        "ratio": {part: at_50_drives[part] / at_5_drives[part] for part in at_5_drives},
    }


def bench_whole(folder: Path) -> dict[str, Any]:
    """Drives like those of `bench_growth`, 20,000 keyframes, into a new map, in a separate process: its memory."""
    rng = np.random.default_rng(1)
    path_poses = _circle((KEYFRAMES - SHARED) * AT_ONCE + SHARED)
    joins: list[Join] = []
    for number in range(AT_ONCE):
        indices = np.arange(KEYFRAMES) + number * (KEYFRAMES - SHARED)
        save_as(_drive(path_poses[indices], rng), folder / f"d{number:03d}.dpm2map")
        if number:
            joins += _joins(f"d{number - 1:03d}", f"d{number:03d}", path_poses, indices)
    with ProcessPoolExecutor(1, get_context("spawn")) as process:  # a forked one would include this one's memory
        return process.submit(_create_whole, folder, joins).result()


def _create_whole(folder: Path, joins: list[Join]) -> dict[str, Any]:
    """As in `merge`: the graph of all drives, then their maps into one file."""
    start, began = peak_mb(), time.process_time()
    with ExitStack() as stack:
        stores = [(path.stem, stack.enter_context(MapStore.open(path))) for path in sorted(folder.glob("d*.dpm2map"))]
        maps = {name: load_map(store, descriptors=False) for name, store in stores}
        region = solve(maps, joins, RobustSettings(), LARGEST)
        solved = time.process_time()
        moved = {name: replace(data, poses=region.poses[name]) for name, data in maps.items()}
        with MapStore.create(folder / "town.dpm2map") as store:
            add_drives(store, {}, Growth(moved, region.joins))
    return {
        "keyframes": sum(map(len, maps.values())),
        "joins_accepted": sum(join.loop.ok for join in region.joins),
        "joins": len(joins),
        "cpu_s": {"graph": solved - began, "file": time.process_time() - solved},
        "file_mb": round((folder / "town.dpm2map").stat().st_size / 2**20),
        "memory_mb": {"start": start, "peak": peak_mb()},
    }


def _circle(count: int) -> Array:
    """(N, 4, 4) true poses, 5 m apart, in a wide circle."""
    return np.asarray(se3.exp(np.arange(count)[:, None] * np.array([0, 0, 0.01, 5.0, 0, 0])))


def _measure_addition(store: MapStore, index: FleetIndex, sizes: dict[str, int], drive: tuple[str, MapData, Any],
           joins: list[Join]) -> dict[str, float]:  # fmt: skip
    """Processor time, ms, of each part of an addition."""
    name, data, vectors = drive
    began = time.process_time()
    index.similar(vectors, 8)
    index.add(name, [0, 0], vectors)
    index.save()
    indexed = time.process_time()
    growth: Growth | None = Growth({name: data})
    if joins:
        links = list(zip(list(sizes), list(sizes)[1:], strict=False))
        growth = grown(Standing(store, sizes, links, RobustSettings(), LARGEST), {name: data}, joins)
    assert growth is not None
    assert all(join.loop.ok for join in growth.joins)
    solved = time.process_time()
    with store.together():
        add_drives(store, sizes, growth)
    written = time.process_time()
    parts = {"index": indexed - began, "graph": solved - indexed, "file": written - solved, "all": written - began}
    return {part: 1e3 * seconds for part, seconds in parts.items()}


def _median(rows: list[dict[str, float]]) -> dict[str, float]:
    return {part: float(np.median([row[part] for row in rows])) for part in ("index", "graph", "file", "all")}


def _drive(poses: Array, rng: np.random.Generator) -> MapData:
    """The map of a drive in the frame of its first keyframe."""
    clouds, odometry, edges = CloudStore(), [np.eye(4)], []
    for number in range(len(poses)):
        clouds.append(pack_cloud(rng.uniform(-40, 40, (_POINTS, 4)).astype(np.float32)))
        if number:
            T = se3.inverse(poses[number - 1]) @ poses[number] @ se3.exp(rng.normal(size=6) * np.sqrt(np.diag(_NOISE)))
            odometry.append(odometry[-1] @ T)
            edges.append(Edge("odometry", number - 1, number, Registration(T, _NOISE)))
    keyframes = [Keyframe(i, i * 10**9, i, T, NO_POINTS, session=1) for i, T in enumerate(odometry)]
    sessions = [Session(1, "0", "2026-01-01T00:00:00Z", "", "")]
    return MapData(keyframes, np.array(odometry), edges, [], sessions, clouds)


def _joins(one: str, other: str, path_poses: Array, indices: Any) -> list[Join]:
    """Loops between the last keyframes of a drive and the first of the next, and to the neighbors of these."""
    pairs = [(a, b) for b in range(SHARED) for a in range(max(b - 2, 0), min(b + 3, SHARED))]
    first = KEYFRAMES - SHARED
    return [
        Join(one, other, Edge("loop", first + a, b,
                              Registration(se3.inverse(path_poses[indices[a]]) @ path_poses[indices[b]], _NOISE)))
        for a, b in pairs
    ]  # fmt: skip
