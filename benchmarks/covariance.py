# SPDX-License-Identifier: Apache-2.0
"""Does the covariance of a registration match its errors? Pairs of frames near and far, real and simulated."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import numpy as np
from rich.console import Group
from scipy.special import chdtri

from benchmarks.harness import Options, Report, drives, processors, requested, rounded, settings_of, truth_of
from benchmarks.pairs import pairs_of
from dpm2_core.console import progress_bar
from dpm2_core.data.open import open_source
from dpm2_core.data.source import Source
from dpm2_core.estimates import Registration
from dpm2_core.frame import Array, Frame
from dpm2_core.geometry import se3
from dpm2_core.sim.drive import simulate
from dpm2_core.sim.settings import DriveConfig, LidarConfig
from dpm2_core.slam.build import make_registration
from dpm2_core.slam.preprocess import Scan
from dpm2_core.slam.registration.protocol import Prediction
from dpm2_core.tables import FigureTable

METHODS = ("geometric", "neural")
PARTS = ("real", "simulated")
_WORLDS = (("city", 64), ("suburb", 64), ("rural", 64), ("city", 32), ("suburb", 16))
_SEED = 940_000  # training begins at 1,000, validation at 900,000
_FRAMES = 60
_SPANS = {"pose": slice(0, 6), "rotation": slice(0, 3), "translation": slice(3, 6)}

Found = dict[tuple[int, int], tuple[Array, Registration]]
"""By positions of a pair: its true pose (4, 4), and the accepted registration."""


def bench_covariance(options: Options) -> Report:
    """Geometric and neural registration on every drive; `--only` chooses the real drives or the simulated ones.

    The ground truth is taken as exact: its own errors count against the covariance. The distance between the two
    methods, which share no errors but those of the sensor, shows how large these are.

    Raises:
        UsageError: there is no drive, or one has no ground truth.
    """
    results: dict[str, dict[str, Any]] = {}
    with processors(options.threads), progress_bar() as progress:
        for part in requested(options, PARTS):
            with drives(options) if part == "real" else _simulated(options) as sources:
                tracked_sources = progress.track(sources.items(), description=part)
                results[part] = {name: _evaluate_drive(source, options) for name, source in tracked_sources}
    return Report(results, Group(*(_table(part, rows) for part, rows in results.items())))


@contextmanager
def _simulated(options: Options) -> Iterator[dict[str, Source]]:
    """Drives with exact ground truth, of sensors with noise but without calibration errors."""
    sources: dict[str, Source] = {}
    for number, (preset, beams) in enumerate(_WORLDS):
        out = options.cache / "covariance" / f"{preset}_{beams}"
        tree = {"frames": _FRAMES, "seed": _SEED + number, "road": "random", "preset": preset, "images": False}
        simulate(out, DriveConfig(**tree, lidar=LidarConfig(beams=beams)), options.threads)
        sources[out.name] = open_source(out / "sequences" / "00")
    yield sources


def _evaluate_drive(source: Source, options: Options) -> dict[str, Any]:
    poses, frames = truth_of(source), list(source.frames())
    out: dict[str, Any] = {}
    for kind, pairs in pairs_of(poses, options.pairs).items():
        found = {method: _register_pairs(method, frames, poses, pairs, options) for method in METHODS}
        out[kind] = {
            method: {"pairs": len(pairs), **calibration(list(registered.values()))}
            for method, registered in found.items()
        }
        common = found["geometric"].keys() & found["neural"].keys()
        differences = [(found["geometric"][pair][1].T_target_source, found["neural"][pair][1]) for pair in common]
        out[kind]["between the two"] = {name: calibration(differences)[name] for name in ("median_m", "median_deg")}
    return out


def _register_pairs(
    method: str, frames: Sequence[Frame], poses: Array, pairs: Sequence[tuple[int, int]], options: Options
) -> Found:
    """Pairs registered to a map of one scan.

    The geometric registration starts at the truth, as from a good prediction: its convergence is not tested here. The
    network has no prior.
    """
    settings = settings_of(options, f"slam.registration={method}", "slam.visual.enabled=false")
    registration = make_registration(settings)
    scans: dict[int, Scan] = {}
    found: Found = {}
    for a, b in pairs:
        for i in {a, b} - scans.keys():
            scans[i] = registration.prepare(frames[i], np.zeros(6))
        T = se3.inverse(poses[a]) @ poses[b]
        registration = registration.fresh()
        registration.update(scans[a], np.eye(4))
        result = registration.register(scans[b], Prediction([T if method == "geometric" else np.eye(4)]))
        if result.ok:
            found[a, b] = T, result
    return found


def calibration(rows: Sequence[tuple[Array, Registration]]) -> dict[str, Any]:
    """Median errors, and medians of xi^T S^-1 xi over the expected value, for the pose, its rotation and translation.

    Args:
        rows: true pose (4, 4), and a registration with its covariance S (6, 6). 1 is right; more: S is too small.
    """
    if not rows:
        return {"registered": 0, "median_m": None, "median_deg": None, "chi2_ratio": None}
    xi = np.array([se3.way(r.T_target_source, T) for T, r in rows])
    S = np.array([r.covariance for _, r in rows])
    ratio = {}
    for name, span in _SPANS.items():
        part = xi[:, span, None]
        squared = np.swapaxes(part, 1, 2) @ np.linalg.solve(S[:, span, span], part)
        ratio[name] = rounded(float(np.median(squared) / chdtri(part.shape[1], 0.5)))
    rotation, translation = np.median(np.linalg.norm(xi.reshape(-1, 2, 3), axis=2), axis=0)
    errors = {"median_m": rounded(float(translation)), "median_deg": rounded(float(np.degrees(rotation)))}
    return {"registered": len(rows), **errors, "chi2_ratio": ratio}


def _table(part: str, drives: dict[str, Any]) -> FigureTable:
    names = ["drive", "pairs", "method"]
    figures = ("registered", "m", "deg", *(f"chi2 {span}" for span in _SPANS))
    table = FigureTable(f"Covariance, {part}: median chi2 divided by its expectation", names=names, figures=figures)
    for drive, kinds in drives.items():
        for kind, methods in kinds.items():
            for method, row in methods.items():
                errors = [row["median_m"], row["median_deg"], *(row.get("chi2_ratio") or {}).values()]
                texts = ["-" if value is None else f"{value:.3g}" for value in errors]
                registered = f"{row['registered']}/{row['pairs']}" if "pairs" in row else ""
                table.add_row(drive, kind, method, registered, *texts, *[""] * (5 - len(texts)))
    return table
