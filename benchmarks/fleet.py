# SPDX-License-Identifier: Apache-2.0
"""Fleets on a local Ray cluster: parts of roads in one map, an index of 200,000 places, kills, and two workers."""

from __future__ import annotations

import hashlib
import json
import os
import random
import shutil
import signal
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.fleet_drives import STEP, chained, odometry_of, poses_of, write_drive
from benchmarks.fleet_growth import bench_growth, bench_whole
from benchmarks.harness import Options, Report, earlier, requested
from benchmarks.resident import peak_mb
from benchmarks.roads import FIRST_SEED, road_files
from dpm2_core.errors import Dpm2Error, UsageError
from dpm2_core.evaluation.machine import processors
from dpm2_core.evaluation.metrics import ape_rmse
from dpm2_core.fleet.cluster import Cluster, Status
from dpm2_core.fleet.drives import MAP, parts_of, read_drives
from dpm2_core.fleet.growth import spans_of
from dpm2_core.fleet.joins import ENOUGH
from dpm2_core.fleet.merge import merge
from dpm2_core.fleet.part import Part
from dpm2_core.fleet.places import WIDTH, FleetIndex
from dpm2_core.fleet.run import Outcome, View, carry_out
from dpm2_core.frame import Array
from dpm2_core.sim.drive import simulate
from dpm2_core.sim.settings import DriveConfig, LidarConfig
from dpm2_core.sim.world import build_world
from dpm2_core.slam.settings import SlamSettings
from dpm2_core.slam.store.map_data import load_map
from dpm2_core.slam.store.map_store import MapStore
from dpm2_core.tables import FigureTable

METERS, LENGTH, SHARED = 150.0, 110.0, 40.0
"""Length of each road; length of each drive along the chained roads, and its overlap with the next drive, m."""
DRIVES = 12
PLACES, QUERIES, FOUND = 200_000, 500, 8
KILLS = 20
_COMPARED_FILES = ("trajectory_kitti.txt", "trajectory.tum", "map.ply", "pose_graph.g2o", "loops.csv")
_FAST_SETTINGS = ("slam.registration=geometric", "slam.loops.descriptors=false", "slam.threads=1")


def bench_fleet(options: Options) -> Report:
    """The parts of the benchmark, or the one that `--only` names: town, index, kills, workers, growth, whole."""
    parts: dict[str, Callable[[Path, Options], dict[str, Any]]] = {
        "town": bench_town, "index": bench_index, "kills": bench_kills, "workers": bench_workers,
        "growth": lambda folder, _: bench_growth(folder), "whole": lambda folder, _: bench_whole(folder),
    }  # fmt: skip
    # With --only the earlier results of the other parts are kept.
    before = {} if options.only is None else {name: earlier(options.out / "fleet.json", name) for name in parts}
    results: dict[str, Any] = {name: figures for name, figures in before.items() if figures}
    for name in requested(options, parts):
        with tempfile.TemporaryDirectory(prefix="dpm2_bench_fleet_") as folder:
            results[name] = parts[name](Path(folder), options)
    table = FigureTable("Fleets", names=["part"], text=["figures"])
    for name, figures in results.items():
        table.add_row(name, json.dumps(figures))
    return Report(results, table)


def bench_town(folder: Path, options: Options) -> dict[str, Any]:
    """Chained roads, driven in parts: true and wrong joins, errors, and the cost of each added drive."""
    files = list(road_files(options))
    chained(files, METERS, folder / "way.txt")
    world = build_world(str(folder / "way.txt"), "suburb", FIRST_SEED)
    spans = [(first, first + LENGTH) for first in np.arange(DRIVES) * (LENGTH - SHARED)]
    if spans[-1][1] > world.road.drive.length:
        raise UsageError(f"{len(files)} roads of {METERS:g} m: {world.road.drive.length:.0f} m, want {spans[-1][1]:g}")
    truth = {f"d{n:02d}": poses_of(world, span, n) for n, span in enumerate(spans)}
    added, out = [], folder / "town.dpm2map"
    with Cluster(workers=2) as cluster:
        cluster.start()
        for number, (name, poses) in enumerate(truth.items()):
            cached = options.cache / "fleet" / f"{name}_{_key(poses)}"
            if not cached.exists():
                write_drive(cached, world, poses, number)
            shutil.copytree(cached, folder / "fleet" / name)
            before = time.perf_counter()
            merged = merge(folder / "fleet", out, SlamSettings(), Cluster())
            added.append({"drive": name, "keyframes": len(poses), "s": time.perf_counter() - before})
            print(f"{name}: {added[-1]}", file=sys.stderr)
        map_errors = _errors(folder / "fleet", out, truth, merged.drives)
        whole_map = merge(folder / "fleet", folder / "anew.dpm2map", SlamSettings(), Cluster())
    joined = {tuple(row["drives"]) for row in merged.joins if row["accepted"] >= ENOUGH}
    true = {(a, b) for a, b in combinations(truth, 2) if _overlap(truth[a], truth[b])}
    path_poses = poses_of(world, (0.0, spans[-1][1]), DRIVES)
    return {
        "drives": len(truth),
        "keyframes": sum(map(len, truth.values())),
        "in_the_map": len(merged.drives),
        "true_joins": len(true),
        "joined": len(joined & true),
        "wrong": len(joined - true),
        "ape_m": {
            "one_drive_of_the_whole_way": float(ape_rmse(path_poses, odometry_of(path_poses))),
            "map": map_errors.pop("map"),
            "map_made_at_once": _errors(folder / "fleet", folder / "anew.dpm2map", truth, whole_map.drives)["map"],
        },
        "ape_of_each_drive_m": map_errors,
        "rejected": merged.rejected,
        "added": added,
        "peak_mb": peak_mb(),
    }


def _key(poses: Array) -> str:
    """Key of a cached drive, which distinguishes it from other drives."""
    weights = SlamSettings().weights_id()
    return hashlib.sha256(poses.round(6).tobytes() + weights.encode()).hexdigest()[:12]


def _overlap(one: Array, other: Array) -> bool:
    """Whether enough keyframes of two drives are within one step of each other: they saw the same place."""
    distance = np.linalg.norm(one[:, None, :2, 3] - other[None, :, :2, 3], axis=-1).min(0)
    return int((distance <= STEP).sum()) >= ENOUGH


def _errors(fleet: Path, out: Path, truth: Mapping[str, Array], sizes: Mapping[str, int]) -> dict[str, Any]:
    """APE, m, of a map, and of each drive: by itself, and in the map."""
    with MapStore.open(out) as store:
        poses = load_map(store, descriptors=False).poses
    errors: dict[str, Any] = {"map": float(ape_rmse(np.concatenate([truth[name] for name in sizes]), poses))}
    for name, span in spans_of(sizes).items():
        with MapStore.open(fleet / name / MAP) as store:
            alone = load_map(store, descriptors=False).poses
        errors[name] = {
            "alone": float(ape_rmse(truth[name], alone)),
            "in_the_map": float(ape_rmse(truth[name], poses[span.start : span.stop])),
        }
    return errors


def bench_index(folder: Path, options: Options) -> dict[str, Any]:
    """Places on smooth paths through a low-dimensional space, as in real drives; processor time of this process."""
    rng = np.random.default_rng(0)
    scale = 0.8 ** np.arange(24)
    axes = np.linalg.qr(rng.normal(size=(WIDTH, 24)))[0].T
    paths = np.concatenate([_random_path(rng, 400) * scale for _ in range(PLACES // 400)])
    places = (paths @ axes + 0.03 * rng.normal(size=(PLACES, WIDTH))).astype(np.float32)
    noisy = paths[rng.integers(0, PLACES, QUERIES)] @ axes + 0.03 * rng.normal(size=(QUERIES, WIDTH))
    queries = noisy.astype(np.float32)
    index = FleetIndex(folder)
    build, _ = _timed(lambda: index.add("all", [0], places))
    search, found = _timed(lambda: index.similar(queries, FOUND))
    centered = places - places.mean(0)
    centered /= np.linalg.norm(centered, axis=1, keepdims=True)
    centered_queries = queries - places.mean(0)
    brute, nearest = _timed(lambda: [_best_matches(rows @ centered.T) for rows in np.array_split(centered_queries, 10)])
    single, _ = _timed(lambda: [_best_matches(row @ centered.T) for row in centered_queries[:50]])
    recall = [len(set(a) & set(b)) / FOUND for a, b in zip(found, np.concatenate(nearest), strict=True)]
    index.save()
    return {
        "places": PLACES,
        "recall": float(np.mean(recall)),
        "build_s": build,
        "ms_a_query": {
            "index": 1e3 * search / QUERIES,
            "brute_in_batches": 1e3 * brute / QUERIES,
            "brute_one_by_one": 1e3 * single / 50,
        },
        "bytes_a_place": (folder / "index.faiss").stat().st_size / PLACES,
    }


def _random_path(rng: np.random.Generator, count: int) -> Array:
    steps, out = rng.normal(size=(count, 24)), np.zeros((count, 24))
    for i in range(1, count):
        out[i] = 0.97 * out[i - 1] + 0.243 * steps[i]
    return out


def _best_matches(cosines: Array) -> Array:
    return np.asarray(np.argpartition(-cosines, FOUND, axis=-1)[..., :FOUND])


def _timed(work: Callable[[], Any]) -> tuple[float, Any]:
    began = time.process_time()
    found = work()
    return time.process_time() - began, found


class _Killer(View):
    """Kills workers of running drives with -9 at random times."""

    def __init__(self, seed: int) -> None:
        self.kills = 0
        self._random = random.Random(seed)
        self._next = 0.0
        self._ended: set[str] = set()

    def begun(self, names: Sequence[str]) -> None:
        """See `View`."""
        self._ended.clear()
        self._next = time.monotonic() + self._random.uniform(0, 6)

    def running(self, status: Mapping[str, Status]) -> None:
        """See `View`."""
        running = [now for name, now in status.items() if name not in self._ended and now.where]
        if self.kills < KILLS and running and time.monotonic() >= self._next:
            self._next = time.monotonic() + self._random.uniform(0, 6)
            with suppress(ProcessLookupError):
                os.kill(int(self._random.choice(running).where.rpartition(":")[2]), signal.SIGKILL)
                self.kills += 1

    def ended(self, outcome: Outcome) -> None:
        """See `View`."""
        self._ended.add(outcome.name)


def _drives(folder: Path, count: int, frames: int) -> list[Part]:
    for seed in range(count):
        lidar = LidarConfig(columns=900)
        simulate(folder / f"drive{seed}", DriveConfig(frames=frames, seed=seed, images=False, lidar=lidar))
    return parts_of(read_drives([folder / f"drive{seed}" for seed in range(count)]), None, _FAST_SETTINGS)


def bench_kills(folder: Path, options: Options) -> dict[str, Any]:
    """Fleets of four drives until 20 workers were killed, each restarted until complete; also one left alone."""
    parts, killer = _drives(folder, 4, 60), _Killer(0)
    fleets, calls, equal = 0, 0, 0
    with Cluster(workers=2) as cluster:
        cluster.start()
        carry_out(parts, folder / "alone", Cluster())
        while killer.kills < KILLS:
            fleets += 1
            out = folder / f"out{fleets}"
            for _ in range(10):
                calls += 1
                if all(outcome.figures is not None for outcome in carry_out(parts, out, Cluster(), killer)):
                    break
            equal += sum(_are_equal(out / part.name, folder / "alone" / part.name) for part in parts)
            if leftovers := [path.name for path in out.iterdir() if path.name.startswith(".")]:
                raise Dpm2Error(f"{out}: left behind: {leftovers}")
    return {"kills": killer.kills, "drives": fleets * len(parts), "calls": calls, "equal": equal}


def _are_equal(one: Path, other: Path) -> bool:
    return all((one / name).read_bytes() == (other / name).read_bytes() for name in _COMPARED_FILES)


def bench_workers(folder: Path, options: Options) -> dict[str, Any]:
    """Wall time of four equal drives with one worker and with two, one thread each; and the overhead of the cluster."""
    parts = _drives(folder, 1, 200)
    four = [Part(f"{n}", part.work, part.arguments, part.inputs, True, 1) for part in parts for n in range(4)]
    out: dict[str, Any] = {"processors": processors()}
    for workers in (1, 2):
        with Cluster(workers=workers) as cluster:
            cluster.start()
            warm_up = [Part(f"w{n}", four[0].work, four[0].arguments, (), True, 1) for n in range(workers)]
            list(_seconds(carry_out(warm_up, folder / f"warm{workers}", Cluster())))  # imports, compiled functions
            began = time.perf_counter()
            seconds = list(_seconds(carry_out(four, folder / f"by{workers}", Cluster())))
            out[f"wall_s_{workers}"] = time.perf_counter() - began
            out[f"own_s_{workers}"] = sum(seconds) / workers
    out["speedup"] = out["wall_s_1"] / out["wall_s_2"]
    out["overhead"] = out["wall_s_1"] / out["own_s_1"] - 1
    return out


def _seconds(outcomes: Sequence[Outcome]) -> Iterator[float]:
    for outcome in outcomes:
        if outcome.figures is None:
            raise Dpm2Error(f"{outcome.name}: {outcome.reason}")
        yield outcome.figures["part"]["seconds"]
