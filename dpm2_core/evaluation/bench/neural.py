# SPDX-License-Identifier: Apache-2.0
"""The network: pairs of unseen synthetic and of real frames, odometry, and speed, beside classical methods."""

from __future__ import annotations

import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np
from rich.box import SIMPLE
from rich.console import Group
from rich.progress import Progress
from rich.table import Table

from dpm2_core.config import load_settings
from dpm2_core.data.source import Source
from dpm2_core.errors import UsageError
from dpm2_core.evaluation.bench.geometric import BASELINE, Method, dpm2, kiss_config, kiss_icp, quantiles_ms, summary
from dpm2_core.evaluation.bench.harness import Options, Report, drives, processors, unique_name
from dpm2_core.evaluation.bench.pairs import (
    PairMethod,
    all_pairs,
    by_registration,
    gicp_from_identity,
    kiss_from_identity,
    summarised,
)
from dpm2_core.frame import Frame
from dpm2_core.network.encoder import collate_views
from dpm2_core.network.model import DeepPointMap2
from dpm2_core.network.pyramid import build_pyramid, collate, crop
from dpm2_core.network.weights import read_metadata
from dpm2_core.slam.neural import load_network, weights_path
from dpm2_core.slam.system import Config, SlamSettings, make_registration
from dpm2_core.training.generate import GenerateSettings, generate
from dpm2_core.training.validation import PairSet

_UNSEEN = GenerateSettings(worlds=12, first_seed=910_000, frames=24)  # training begins at 1,000, validation at 900,000


def bench_neural(options: Options) -> Report:
    """Every figure of the network that needs no training; scans are in memory, and only processing is timed.

    Raises:
        UsageError: no weights, no drive, or one without ground truth.
    """
    s = _settings(options, "neural")
    network = load_network(s.neural.weights, options.threads, s.neural.preset)
    results: dict[str, Any] = {"weights": _weights(s.neural.weights)}
    with processors(options.threads), Progress(transient=True) as progress:
        task = progress.add_task("synthetic pairs", total=None)
        results["synthetic"] = _synthetic(network, options)
        results["drives"] = {}
        with drives(options) as sources:
            for source in sources:
                progress.update(task, description=f"{source.name}: reading")
                name = unique_name(source, results["drives"])
                results["drives"][name] = _drive(source, network, options, progress)
    return Report(results, _view(results))


def _settings(options: Options, registration: str) -> SlamSettings:
    """Of the SLAM with that registration and the weights that were asked for."""
    return load_settings(Config, None, _overrides(options, registration)).slam


def _overrides(options: Options, registration: str) -> list[str]:
    weights = [] if options.weights is None else [f"slam.neural.weights={options.weights}"]
    return [f"slam.threads={options.threads}", *weights, *options.overrides, f"slam.registration={registration}"]


def _weights(name: str) -> dict[str, Any]:
    path = weights_path(name)
    about = read_metadata(path)
    about.pop("network", None)
    return {"name": name, "bytes": path.stat().st_size, **about}


def _synthetic(network: DeepPointMap2, options: Options) -> dict[str, Any]:
    """Pairs of frames of worlds that neither training nor the choice of the checkpoint has seen."""
    camera = network.encoder.image is not None
    with tempfile.TemporaryDirectory(prefix="dpm2_bench_") as folder:
        root = options.unseen
        if root is None:
            root = Path(folder)
            settings = _UNSEEN.model_copy(update={"images": camera, "preset": network.settings.preset})
            generate(root, settings, options.threads)
        pairs = PairSet(root, 2 * options.pairs, network.settings, images=camera)
        rows = pairs.errors(network)
        dark = PairSet(root, 2 * options.pairs, network.settings, images=False).errors(network) if camera else None
    near, turned = rows[:, 0] <= 5, rows[:, 1] > 0
    kinds = {"up to 5 m": near & ~turned, "5-20 m": ~near & ~turned, "up to 20 m": ~turned, "turned": turned}
    out: dict[str, Any] = {kind: {"neural": summarised(rows[chosen, 2:4])} for kind, chosen in kinds.items()}
    if dark is not None:
        for kind, chosen in kinds.items():
            out[kind]["neural without image"] = summarised(dark[chosen, 2:4])
    # Of 6 degrees of freedom: a median of 5.35 would say that the covariance is just right.
    good = rows[:, 2] < 0.6
    out["median_chi2"] = float(np.median(rows[good, 4])) if good.any() else None
    return out


def _drive(source: Source, network: DeepPointMap2, options: Options, progress: Progress) -> dict[str, Any]:
    if source.poses is None:
        raise UsageError(f"{source.name}: the drive has no ground truth to compare with")
    frames = list(source.frames())
    if network.encoder.image is None:
        frames = [replace(frame, images=()) for frame in frames]
    pair_methods = _pair_methods(options)
    odometries = _odometries(options)
    total = 3 * len(pair_methods) + options.repetitions * len(odometries)
    task = progress.add_task(source.name, total=total)
    pairs = all_pairs(pair_methods, frames, source.poses, options.pairs, lambda: progress.advance(task))
    outcomes: dict[str, list[Any]] = {name: [] for name in odometries}
    for _ in range(options.repetitions):
        for name, run in odometries.items():
            outcomes[name].append(run(frames))
            progress.advance(task)
    progress.remove_task(task)
    odometry = {name: summary(source, outcomes[name]) for name in odometries}
    if BASELINE in odometry:
        base = odometry[BASELINE]["frame_ms"]["median"]
        for row in odometry.values():
            row["frame_ms"]["ratio"] = round(row["frame_ms"]["median"] / base, 3)
    stages, size = stage_times(network, frames)
    return {"pairs": pairs, "odometry": odometry, "network_stages_ms": stages, "descriptor_bytes": size}


def _pair_methods(options: Options) -> dict[str, PairMethod]:
    methods = {
        name: by_registration(make_registration(_settings(options, name)))
        for name in ("neural", "refined", "geometric")
    }
    methods["small_gicp"] = gicp_from_identity(options.threads)
    if (config := kiss_config(options)) is not None:
        methods[BASELINE] = kiss_from_identity(config)
    return methods


def _odometries(options: Options) -> dict[str, Method]:
    ours = {
        name: dpm2(replace(options, overrides=_overrides(options, name))) for name in ("neural", "refined", "geometric")
    }
    kiss = kiss_icp(options)
    return ours if kiss is None else {**ours, BASELINE: kiss}


def stage_times(network: DeepPointMap2, frames: Sequence[Frame]) -> tuple[dict[str, dict[str, float]], int]:
    """Time of each stage from raw points to a pose, frame to frame, and the bytes of a frame's descriptors."""
    encoder, points = network.encoder, network.settings.points
    clocks, before, size = [], None, 0
    for frame in frames[:60]:
        clock = [perf_counter()]
        cloud = crop(frame.points, points)
        clock.append(perf_counter())
        pyramid = build_pyramid(cloud, points)
        clock.append(perf_counter())
        views = collate_views([frame.images], network.settings.image) if encoder.image is not None else None
        clock.append(perf_counter())
        descriptors = encoder.encode_batch(collate([pyramid]), views, next(network.parameters()).device)[0]
        clock.append(perf_counter())
        network.decoder.register(descriptors, before or descriptors)
        clock.append(perf_counter())
        clocks.append(np.diff([*clock]))
        before, size = descriptors, descriptors.nbytes
    times = np.array(clocks)[1:]  # the first call allocates
    names = ("crop and voxels", "sampling and neighbours", "pictures", "encoder", "decoder and pose")
    stages = {name: quantiles_ms(column) for name, column in zip(names, times.T, strict=True)}
    return {**stages, "total": quantiles_ms(times.sum(1))}, size


def _view(results: Mapping[str, Any]) -> Group:
    tables = [_pair_table("Unseen synthetic worlds", results["synthetic"])]
    for name, drive in results["drives"].items():
        tables.append(_pair_table(f"{name}: pairs without a prior", drive["pairs"]))
        tables.append(_odometry_table(name, drive["odometry"]))
        tables.append(_stage_table(f"{name}: the network alone, ms a frame", drive["network_stages_ms"]))
    size = {drive["descriptor_bytes"] for drive in results["drives"].values()}
    return Group(*tables, f"Descriptors of a frame: {', '.join(map(str, sorted(size)))} bytes.")


def _new_table(title: str, words: Sequence[str], figures: Sequence[str]) -> Table:
    table = Table(title=title, title_justify="left", box=SIMPLE)
    for column in words:
        table.add_column(column, no_wrap=True)
    for column in figures:
        table.add_column(column, justify="right", no_wrap=True)
    return table


def _pair_table(title: str, kinds: Mapping[str, Any]) -> Table:
    figures = ("pairs", "median m", "deg", "success %")
    table = _new_table(f"{title}. Success: 0.6 m, 1.5 deg.", ("kind", "method"), figures)
    for kind, methods in kinds.items():
        if not isinstance(methods, dict):
            continue
        for method, row in methods.items():
            values = (("median_m", 1, 3), ("median_deg", 1, 3), ("success", 100, 1))
            shown = ["-" if row[key] is None else f"{scale * row[key]:.{digits}f}" for key, scale, digits in values]
            table.add_row(kind, method, str(row["pairs"]), *shown)
        table.add_section()
    return table


def _odometry_table(drive: str, methods: Mapping[str, Any]) -> Table:
    figures = ("RPE m", "deg", "APE m", "drift %", "failed", "ms", "p95", "ratio")
    table = _new_table(f"{drive}: odometry. Ratio: of median times to KISS-ICP's.", ("method",), figures)
    for method, row in methods.items():
        keys = ("rpe_trans_m", "rpe_rot_deg", "ape_rmse_m", "final_drift_percent")
        errors = ["-" if row[key] is None else f"{row[key]:.3f}" for key in keys]
        ms = row["frame_ms"]
        times = [f"{ms['median']:.0f}", f"{ms['p95']:.0f}", f"{ms.get('ratio', float('nan')):.2f}"]
        table.add_row(method, *errors, f"{row['failed_frames']:.0f}", *times)
    return table


def _stage_table(title: str, stages: Mapping[str, Any]) -> Table:
    table = _new_table(title, ("stage",), ("median", "p95"))
    for stage, ms in stages.items():
        table.add_row(stage, f"{ms['median']:.1f}", f"{ms['p95']:.1f}")
    return table
