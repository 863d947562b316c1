# SPDX-License-Identifier: Apache-2.0
"""A LiDAR mounted at an angle: pairs of real frames registered by the network, with the same and opposite headings."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product
from typing import Any

import numpy as np

from benchmarks.harness import Options, Report, drives, processors, settings_of, truth_of
from benchmarks.pairs import summarized
from dpm2_core.console import tracked
from dpm2_core.data.source import Source
from dpm2_core.descriptors import Descriptors
from dpm2_core.frame import Array, Frame
from dpm2_core.geometry import se3
from dpm2_core.geometry.sampling import evenly
from dpm2_core.network.model import DeepPointMap2
from dpm2_core.network.pretrained import load_network
from dpm2_core.network.pyramid import build_pyramid, collate, crop
from dpm2_core.tables import FigureTable, record_table

TILTS = (0, 15, 30)
"""Degrees of pitch, the same for all scans, as for a LiDAR that is mounted looking down ahead."""
APART = (1, 3, 8)
AXES = ("level", "sensor")
"""Axes of the descriptors: level axes if the sensor is tilted, as in the SLAM, or always the sensor's axes."""
_MAX_RANDOM_TILT = 35.0  # degrees: each scan is also tilted by up to this, about its own axis


def bench_tilt(options: Options) -> Report:
    """Success of pairs on every drive at every tilt and heading.

    Raises:
        UsageError: there is no drive, or one has no ground truth.
    """
    s = settings_of(options)
    network = load_network(s.neural.weights, options.threads)
    with drives(options) as sources, processors(options.threads):
        named = tracked(sources.items(), "drives")
        results = {name: _evaluate_drive(source, network, options.pairs) for name, source in named}
    return Report({"drives": results}, _table(results))


def _evaluate_drive(source: Source, network: DeepPointMap2, most: int) -> dict[str, Any]:
    poses, frames = truth_of(source), list(source.frames())
    pairs = [(a, a + n) for n in APART for a in evenly(len(frames) - n, most).tolist()]
    noise = np.random.default_rng(0)
    out: dict[str, Any] = {}
    for tilt, is_opposite in product((*map(str, TILTS), "random"), (False, True)):
        mounts = [_mount(tilt, noise) for _ in frames]
        others = [mount @ se3.exp([0, 0, np.pi * is_opposite, 0, 0, 0]) for mount in mounts]
        row = out.setdefault(tilt, {})["opposite" if is_opposite else "same"] = {}
        for axes in AXES:
            target_descriptors = _describe(network, frames, mounts, {a for a, _ in pairs}, axes)
            source_descriptors = _describe(network, frames, others, {b for _, b in pairs}, axes)
            errors: dict[int, list[tuple[float, float]]] = {n: [] for n in APART}
            for a, b in pairs:
                T_true = mounts[a] @ se3.inverse(poses[a]) @ poses[b] @ se3.inverse(others[b])
                T = network.register(source_descriptors[b], target_descriptors[a]).T_target_source
                errors[b - a].append(se3.apart(T_true, T))
            row[axes] = {f"{n} apart": summarized(np.array(rows).reshape(-1, 2)) for n, rows in errors.items()}
    return out


def _mount(tilt: str, noise: np.random.Generator) -> Array:
    """T_tilted_level (4, 4) of a scan."""
    if tilt != "random":
        return se3.exp([0, np.radians(int(tilt)), 0, 0, 0, 0])
    heading, angle = noise.uniform(0, 2 * np.pi), np.radians(noise.uniform(0, _MAX_RANDOM_TILT))
    return se3.exp([angle * np.cos(heading), angle * np.sin(heading), 0, 0, 0, 0])


def _describe(
    network: DeepPointMap2, frames: Sequence[Frame], mounts: Sequence[Array], indices: set[int], axes: str
) -> dict[int, Descriptors]:
    out = {}
    for i in sorted(indices):
        points = se3.transform(mounts[i], frames[i].points).astype(np.float32)
        if axes == "level":
            out[i] = network.describe(Frame(i, points))
            continue
        pyramid = build_pyramid(crop(points, network.settings.points), network.settings)
        out[i] = network.encoder.encode_batch(collate([pyramid]), None)[0]
    return out


def _table(results: dict[str, Any]) -> FigureTable:
    figures = {"success": "success", "m": "median_m"}
    columns = {f"{name} {n} apart": f"{{{n} apart[{key}]:.3g}}" for n in APART for name, key in figures.items()}
    title, names = "A tilted LiDAR: pairs by the network", ["drive", "tilt deg", "heading", "axes"]
    return record_table(title, names, columns, results)
