# SPDX-License-Identifier: Apache-2.0
"""The map file: kills at random times of a real `dpm2 run`, laps of one block, and what moving objects leave in it."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.console import Group

from benchmarks.harness import Options, Report, truth_of
from dpm2_core.config import load_settings
from dpm2_core.console import tracked
from dpm2_core.data.open import open_source
from dpm2_core.database import size_with_log
from dpm2_core.errors import Dpm2Error
from dpm2_core.estimates import Keyframe, Registration, isotropic
from dpm2_core.evaluation.metrics import ape_rmse
from dpm2_core.frame import Array
from dpm2_core.geometry import se3
from dpm2_core.geometry.voxel import voxel_first
from dpm2_core.sim.drive import simulate
from dpm2_core.sim.lidar import Lidar
from dpm2_core.sim.settings import DriveConfig, LidarConfig
from dpm2_core.sim.world import World, build_world
from dpm2_core.slam.build import make_mapper
from dpm2_core.slam.mapping.mapper import Mapper
from dpm2_core.slam.mapping.prune import prune, redundant_nodes
from dpm2_core.slam.settings import Config, SlamSettings
from dpm2_core.slam.store.check import check_map
from dpm2_core.slam.store.cloud_codec import unpack_mask
from dpm2_core.slam.store.map_cloud import map_cloud
from dpm2_core.slam.store.map_data import MapData, load_map, save_as
from dpm2_core.slam.store.map_store import MapStore
from dpm2_core.tables import FigureTable

Mask = NDArray[np.bool_]

KILLS = 50
SOURCE_KILLS = 20
LAPS = 5
_FRAMES = 120
_DRIFT = np.array([0, 0, 2e-4, 0.01, 0.005, 0.0])  # of the odometry, per keyframe, rad and m

# `dpm2 run` that reports on a pipe when the mapper has added a keyframe, which must then be in the file.
_CHILD_CODE = """
import os, sys
from dpm2_core.cli import main
from dpm2_core.slam.mapping.mapper import Mapper
os.write(int(sys.argv[1]), b"s")
add = Mapper.add
def reported(self, *arguments):
    out = add(self, *arguments)
    os.write(int(sys.argv[1]), b"k")
    return out
Mapper.add = reported
main(sys.argv[2:])
"""


def bench_map(options: Options) -> Report:
    """50 kills of a drive, and five laps of a block with traffic; for given drives 20 kills each."""
    with tempfile.TemporaryDirectory(prefix="dpm2_bench_map_") as folder:
        if options.sources:
            given = {str(path): crashes(Path(folder) / str(n), options, path) for n, path in enumerate(options.sources)}
            return Report({"crashes": given}, Group(*map(_crash_table, given.values())))
        crash = crashes(Path(folder), options)
        laps = bench_laps(Path(folder), options)
    return Report({"crash": crash, "laps": laps}, Group(_crash_table(crash), _laps_table(laps)))


def crashes(folder: Path, options: Options, drive: Path | None = None) -> dict[str, Any]:
    """Drives that are killed at random times and resumed until they end, compared with an uninterrupted one.

    Args:
        drive: a drive with ground truth; None simulates a short one, which is run without the network.
    """
    command, kills_wanted = ["run", "--out", str(folder / "out")], SOURCE_KILLS
    if drive is None:
        drive, kills_wanted = folder / "drive", KILLS
        simulate(
            drive,
            DriveConfig(
                frames=_FRAMES, seed=5, road="loop", preset="suburb", images=False, lidar=LidarConfig(beams=16)
            ),
        )
        command += ["--set", "slam.loops.descriptors=false"]
    source = open_source(drive)
    truth = truth_of(source)
    command += [str(drive)]
    command += [word for setting in options.overrides for word in ("--set", setting)]
    uninterrupted = folder / "alone.dpm2map"
    started = time.perf_counter()
    _run([*command, "--map", str(uninterrupted)], None)
    duration = time.perf_counter() - started  # from the imports to the last image
    rng, kills, finished_paths = np.random.default_rng(0), [], []
    path = folder / "killed0.dpm2map"
    for _ in tracked(range(kills_wanted), "kills"):
        before = _keyframes(path)
        while True:
            added = _run([*command, "--map", str(path), "--resume"], float(rng.uniform(0, 0.4 * duration)))
            if added is not None:
                break
            finished_paths.append(path)  # it ended before the kill: start the next drive
            path = folder / f"killed{len(finished_paths)}.dpm2map"
            before = 0
        result = check_map(path) if path.exists() else None
        after = _keyframes(path)
        kills.append({"opens": result is None or not result.problems, "lost": before + added - after})
    _run([*command, "--map", str(path), "--resume"], None)
    finished_paths.append(path)
    ape = [_ape(final, truth) for final in (uninterrupted, *finished_paths)]
    return {
        "frames": len(source),
        "keyframes": _keyframes(uninterrupted),
        "kills": len(kills),
        "maps_that_open": sum(kill["opens"] for kill in kills),
        # Of the keyframes that the mapper had added; one that was being added is not counted, but may be in the file.
        "most_keyframes_lost": max(max(kill["lost"], 0) for kill in kills),
        "keyframes_in_flight_saved": sum(kill["lost"] < 0 for kill in kills),
        "drives": len(finished_paths),
        "ape_m": {"uninterrupted": ape[0], "killed": ape[1:]},
        "seconds_uninterrupted": duration,
    }


def _run(arguments: list[str], kill_after: float | None) -> int | None:
    """Run `dpm2` and kill it some s after its imports; returns the keyframes added, or None if it ended by itself.

    Raises:
        Dpm2Error: it failed.
    """
    read, write = os.pipe()
    environment = os.environ | {"MPLBACKEND": "Agg"}
    child = subprocess.Popen(
        [sys.executable, "-c", _CHILD_CODE, str(write), *arguments],
        pass_fds=[write], stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True, env=environment,
    )  # fmt: skip
    os.close(write)
    os.read(read, 1)
    try:
        _, errors = child.communicate(timeout=kill_after)
    except subprocess.TimeoutExpired:
        child.send_signal(signal.SIGKILL)
        child.communicate()
    with os.fdopen(read, "rb") as pipe:
        added = len(pipe.read())
    if child.returncode > 0:
        raise Dpm2Error(f"dpm2 {' '.join(arguments)}: {errors.strip().splitlines()[-1:]}")
    return added if child.returncode < 0 else None


def _keyframes(path: Path) -> int:
    if not path.exists():
        return 0
    with MapStore.open(path) as store:
        return sum(1 for _ in store.rows("keyframes"))


def _ape(path: Path, truth: Array) -> float:
    """APE of the keyframes of a map, m; those that a resumed run made twice are counted once."""
    with MapStore.open(path) as store:
        data = load_map(store, descriptors=False)
    rows = {keyframe.index: node for node, keyframe in enumerate(data.keyframes)}
    return float(ape_rmse(truth[list(rows)], data.poses[list(rows.values())]))


def bench_laps(folder: Path, options: Options) -> dict[str, Any]:
    """Laps of one block with different traffic: growth of the map, and what the traffic leaves in it."""
    settings = load_settings(Config, None, ["slam.loops.descriptors=false", *options.overrides]).slam
    world = build_world("loop", "city", seed=3, length=250.0)
    path, growth = folder / "laps.dpm2map", []
    labels: list[Mask] = []
    with MapStore.create(path) as store:
        store.begin_session()
        mapper, previous = make_mapper(settings, store), None
        for lap in range(LAPS):
            for keyframe, moving in _lap(world, lap, previous):
                mapper.add(keyframe)
                labels.append(moving)
                previous = keyframe
            growth.append(_lap_row(mapper, path, lap))
        mapper.finish()
        data = load_map(store, descriptors=False)
        dynamics = _moving(data, labels, settings)
        pruned = prune(data, redundant_nodes(data, 0, 0))
        save_as(pruned, folder / "pruned.dpm2map")
    sizes = [file.stat().st_size for file in (path, folder / "pruned.dpm2map")]
    return {
        "lap_m": float(world.road.drive.length),
        "laps": growth,
        "bytes_after_closing": sizes[0],
        "bytes_pruned": sizes[1],
        "keyframes_pruned": len(pruned),
        "kB_a_keyframe_without_descriptors": growth[0]["bytes"] / growth[0]["keyframes"] / 1e3,
        "moving": dynamics,
    }


def _lap(world: World, lap: int, previous: Keyframe | None) -> Iterator[tuple[Keyframe, Mask]]:
    """Keyframes every 5 m with drifting odometry, and which of their points move (M,)."""
    lidar, rng = Lidar(LidarConfig(columns=1024)), np.random.default_rng(lap)
    distances = np.arange(0.0, world.road.drive.length, 5.0)
    for number, s in enumerate(tracked(distances, f"lap {lap + 1}")):
        T_world_kf = world.pose_at(float(s))
        scan = lidar.scan(world, T_world_kf, 100.0 * lap + s / 8, rng)
        near = voxel_first(scan.points, 0.3, far=60.0)
        node = lap * len(distances) + number
        edge, T_odom_kf = None, T_world_kf
        if previous is not None:
            T = se3.inverse(world.pose_at(float(distances[number - 1]))) @ T_world_kf @ se3.exp(_DRIFT)
            edge = Registration(T, isotropic(1e-3, 0.03), 0.9, 0.05, "simulated")
            T_odom_kf = previous.T_odom_kf @ T
        previous = Keyframe(node, node * 10**8, node, T_odom_kf, scan.points[near], edge)
        yield previous, scan.moving[near]


def _lap_row(mapper: Mapper, path: Path, lap: int) -> dict[str, Any]:
    own, size, accepted = int(mapper.clouds.own.sum()), size_with_log(path), sum(loop.ok for loop in mapper.loops)
    return {"lap": lap + 1, "keyframes": len(mapper.keyframes), "with_own_cloud": own, "bytes": size, "loops": accepted}


def _moving(data: MapData, labels: list[Mask], settings: SlamSettings) -> dict[str, float]:
    """Share of points on moving objects in the map before and after; share removed of these, and of static points."""
    own = np.flatnonzero(data.clouds.own).tolist()
    masks = {}
    for node in own:
        packed = data.clouds.moving(node)
        masks[node] = np.zeros(len(labels[node]), bool) if packed is None else unpack_mask(packed, len(labels[node]))
    moving = np.concatenate([labels[node] for node in own])
    removed = np.concatenate([masks[node] for node in own])
    points = np.concatenate([se3.transform(data.poses[node], data.clouds.whole(node)) for node in own])
    before = voxel_first(points, settings.map.voxel)
    remaining = np.flatnonzero(~removed)
    after = remaining[voxel_first(points[remaining], settings.map.voxel)]
    return {
        "share_before": float(moving[before].mean()),
        "share_after": float(moving[after].mean()),
        "removed": float(removed[moving].mean()),
        "static_removed": float(removed[~moving].mean()),
        "points_of_map": len(map_cloud(data.clouds, data.poses, settings.map.voxel)),
    }


def _crash_table(crash: dict[str, Any]) -> FigureTable:
    table = FigureTable("Kills of a running drive", text=["what", "figures"], header=False)
    ape = crash["ape_m"]
    for row in (
        ("kills, maps that are sound", f"{crash['kills']}, {crash['maps_that_open']}"),
        ("most keyframes lost at a kill, besides the one in flight", str(crash["most_keyframes_lost"])),
        ("APE uninterrupted, m", f"{ape['uninterrupted']:.4f}"),
        ("APE of killed and resumed drives, m", ", ".join(f"{value:.4f}" for value in ape["killed"])),
    ):
        table.add_row(*row)
    return table


def _laps_table(laps: dict[str, Any]) -> FigureTable:
    m = laps["moving"]
    caption = (
        f"points of moving things: {m['share_before']:.2%} of the map before, {m['share_after']:.2%} after; "
        f"{m['removed']:.0%} of them removed, and {m['static_removed']:.3%} of the static ones"
    )
    figures = ("keyframes", "with own cloud", "MB", "loops")
    table = FigureTable(f"Laps of {laps['lap_m']:.0f} m", names=["lap"], figures=figures, caption=caption)
    for row in laps["laps"]:
        cells = (row["lap"], row["keyframes"], row["with_own_cloud"], f"{row['bytes'] / 1e6:.2f}", row["loops"])
        table.add_row(*map(str, cells))
    table.add_row("pruned", str(laps["keyframes_pruned"]), "", f"{laps['bytes_pruned'] / 1e6:.2f}", "")
    return table
