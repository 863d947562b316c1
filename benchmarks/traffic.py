# SPDX-License-Identifier: Apache-2.0
"""SLAM with a third of the points on moving objects: unfiltered, with each filter, and without all moving points."""

from __future__ import annotations

from collections.abc import Iterator
from statistics import mean, median, pstdev
from time import process_time
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from benchmarks.harness import Options, Report, earlier, requested, settings_of, write_report
from dpm2_core.evaluation.metrics import evaluate
from dpm2_core.evaluation.record import git_commit
from dpm2_core.files import file_digest
from dpm2_core.frame import Frame, Points
from dpm2_core.network.pretrained import PERCEPTION_WEIGHTS, PRETRAINED_DIR, weights_path
from dpm2_core.sim.lidar import Lidar
from dpm2_core.sim.settings import LidarConfig, PresetName
from dpm2_core.sim.world import World, build_world
from dpm2_core.slam.build import make_odometry
from dpm2_core.slam.filters import FilterKind, FilterSettings, make_filter
from dpm2_core.slam.odometry.odometry import Odometry
from dpm2_core.slam.settings import SlamSettings
from dpm2_core.tables import record_table

PLACES: dict[PresetName, float] = {"city": 20.0, "suburb": 40.0, "rural": 40.0}
"""Environments, and the factor on their usual traffic: 20 to 40 % of the points are on it."""
FIRST_SEED = 900_001
"""Seed of the first world; training ends well below."""
FRAMES = 60
LIDAR = LidarConfig(columns=1024)
"""64 beams, about 60 thousand points."""
REGISTRATIONS = ("adaptive", "geometric", "neural", "refined")
ORACLE = "true dynamic objects left out"
_ERRORS = ("rpe_trans_m", "rpe_rot_deg", "ape_rmse_m")
LOST = 0.1
"""A drive with a larger RPE, m, has diverged: the odometry followed the traffic."""

Scans = list[tuple[Points, NDArray[np.bool_]]]
"""Points (N, 4) and which of them move (N,), frame by frame."""


def bench_traffic(options: Options) -> Report:
    """Every registration in every environment, with repetitions in different worlds; `--only` names one registration.

    Continues traffic.json if it has the same settings and weights; the file is written after each drive.

    Raises:
        UsageError: no such registration.
    """
    chosen = requested(options, REGISTRATIONS)
    path = options.out / "traffic.json"
    drives = earlier(path, "drives", recipe=_recipe(options))
    for preset, traffic in PLACES.items():
        for seed in range(FIRST_SEED, FIRST_SEED + options.repetitions):
            name = f"{preset} {seed}"
            runs = drives.get(name, {}).get("runs", {})
            missing = {r: [m for m in _methods(r) if m not in runs.get(r, {})] for r in chosen}
            if not any(missing.values()):
                continue
            world = build_world("straight", preset, seed, traffic=traffic)
            scans = list(_scans(world))
            truth = np.stack([world.drive_pose(0.1 * i) for i in range(FRAMES)])
            ratio = mean(float(moving.mean()) for _, moving in scans)
            drives[name] = {"traffic": traffic, "share_moving": ratio, "runs": runs}
            for registration, methods in missing.items():
                settings = settings_of(options, f"slam.registration={registration}")
                found = {m: _run(scans, truth, settings, m) for m in methods}
                runs[registration] = runs.get(registration, {}) | found
                write_report(path, _report(drives, options), options)
    return _report(drives, options)


def _methods(registration: str) -> list[str]:
    """Methods compared: `none`, the filters with weights (with a network only `movers`), and the oracle."""
    shipped = [kind for kind, name in PERCEPTION_WEIGHTS.items() if (PRETRAINED_DIR / f"{name}.safetensors").is_file()]
    return ["none", *(kind for kind in shipped if registration == "geometric" or kind == "movers"), ORACLE]


def _scans(world: World) -> Iterator[tuple[Points, NDArray[np.bool_]]]:
    """The first scans of the drive, at 10 Hz: it begins at full speed in the middle of the traffic."""
    lidar = Lidar(LIDAR)
    for i in range(FRAMES):
        scan = lidar.scan(world, world.drive_pose(0.1 * i), 0.1 * i, np.random.default_rng([world.seed, 12, i]))
        yield scan.points, scan.moving


def _run(scans: Scans, truth: NDArray[np.float64], settings: SlamSettings, method: str) -> dict[str, Any]:
    """Errors and time of the odometry with a filter, and the time of the filter alone."""
    kind: FilterKind = "none" if method == ORACLE else method  # type: ignore[assignment]
    chosen = FilterSettings(kind=kind)
    clouds = [points[~moving] if method == ORACLE else points for points, moving in scans]
    found = _odometry(make_odometry(settings.model_copy(update={"filter": chosen})), clouds, truth)
    if (point_filter := make_filter(chosen, settings.threads)) is not None:
        cpu = process_time()
        for cloud in clouds[:: len(clouds) // 6]:
            point_filter(cloud)
        found["filter_cpu_ms"] = 1e3 * (process_time() - cpu) / len(clouds[:: len(clouds) // 6])
    return found


def _odometry(odometry: Odometry, clouds: list[Points], truth: NDArray[np.float64]) -> dict[str, Any]:
    """Errors of the odometry alone, without loops, and its time."""
    poses, failed, cpu = np.zeros_like(truth), 0, process_time()
    for i, cloud in enumerate(clouds):
        tracked = odometry.process(Frame(i * 10**8, cloud, index=i))
        poses[i] = tracked.T_odom_lidar
        failed += not tracked.registration.ok
    seconds = (process_time() - cpu) / len(clouds)
    checked = evaluate(truth, poses, failed_frames=failed)
    return {**{name: getattr(checked, name) for name in _ERRORS}, "failed_frames": failed, "cpu_ms": 1e3 * seconds}


def summarized(drives: dict[str, Any]) -> dict[str, Any]:
    """For each registration and method, over its drives: mean, spread and median, drives diverged, ratios.

    `ratio`: of means and medians to those of `none` on the same drives.
    """
    out: dict[str, Any] = {}
    for registration in REGISTRATIONS:
        rows = [d["runs"][registration] for d in drives.values() if registration in d["runs"]]
        for method in dict.fromkeys(m for row in rows for m in row):
            rows_with_method = [row for row in rows if method in row]
            found, none = (_figures([row[m] for row in rows_with_method if m in row]) for m in (method, "none"))
            found["ratio"] = {key: found[key] / none[key] for key in found if "rpe" in key}
            out.setdefault(registration, {})[method] = found
    return out


def _figures(runs: list[dict[str, Any]]) -> dict[str, Any]:
    rpe, rotation = [run["rpe_trans_m"] for run in runs], [run["rpe_rot_deg"] for run in runs]
    return {
        "drives": len(runs), "rpe_m": mean(rpe), "spread_m": pstdev(rpe), "median_rpe_m": median(rpe),
        "rpe_deg": mean(rotation), "median_rpe_deg": median(rotation), "diverged": sum(e > LOST for e in rpe),
        "cpu_ms": median(run["cpu_ms"] for run in runs),
    }  # fmt: skip


def _recipe(options: Options) -> dict[str, Any]:
    """The settings on which the drives depend: if they have changed, all are measured again."""
    return {
        "frames": FRAMES,
        "lidar": LIDAR.model_dump(),
        "first_seed": FIRST_SEED,
        "places": PLACES,
        "overrides": list(options.overrides),
        "threads": options.threads,
        "network_sha256": file_digest(weights_path(settings_of(options).neural.weights)),
        "weights_sha256": {path.stem: file_digest(path) for path in sorted(PRETRAINED_DIR.glob("*.safetensors"))},
    }


def _report(drives: dict[str, Any], options: Options) -> Report:
    summary = summarized(drives)
    results = {"recipe": _recipe(options), "summary": summary, "drives": drives, "torch": torch.__version__,
               "measured_at": git_commit()}  # fmt: skip
    columns = {
        "RPE m": "{rpe_m:.4f} ({median_rpe_m:.4f})", "RPE deg": "{rpe_deg:.4f} ({median_rpe_deg:.4f})",
        "diverged": "{diverged} of {drives}", "CPU ms": "{cpu_ms:.0f}",
    }  # fmt: skip
    title, names = "RPE in dense traffic, mean over drives (median)", ["registration", "filter"]
    table = record_table(title, names, columns, summary, sections=True)
    return Report(results, table)
