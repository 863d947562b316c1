# SPDX-License-Identifier: Apache-2.0
"""Few frames per second: every 3rd, 6th and 10th frame of the drives, for each registration and for KISS-ICP."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from rich.console import Group
from rich.progress import Progress

from benchmarks.geometric import BASELINE, Method, Outcome, dpm2, kiss_icp
from benchmarks.harness import Options, Report, drives, processors, requested, truth_of, unique_name
from dpm2_core.evaluation.metrics import evaluate
from dpm2_core.frame import Array
from dpm2_core.tables import FigureTable

EVERY = (1, 3, 6, 10)
"""Every so manieth frame: at 10 Hz and 50 km/h 1.4, 4, 8 and 14 m apart."""
REGISTRATIONS = ("adaptive", "refined", "neural", "geometric")


def bench_hard(options: Options) -> Report:
    """Every method on every drive at every rate, once, without loops and images; `--only` chooses one method.

    Raises:
        UsageError: there is no drive, or one has no ground truth.
    """
    methods: dict[str, Method] = {}
    for name in requested(options, (*REGISTRATIONS, BASELINE)):
        run = kiss_icp(options) if name == BASELINE else _odometry(options, name)
        if run is not None:
            methods[name] = run
    results: dict[str, Any] = {}
    with drives(options) as sources, processors(options.threads), Progress(transient=True) as progress:
        task = progress.add_task("benchmark", total=len(sources) * len(EVERY) * len(methods))
        for source in sources:
            poses, frames = truth_of(source), list(source.frames())
            rates: dict[str, Any] = {}
            for every in [every for every in EVERY if len(frames) > every]:  # two frames at least
                rates[f"every {every}"] = row = {}
                for name, run in methods.items():
                    progress.update(task, description=f"{source.name}: {name}, every {every}")
                    row[name] = _figures(poses[::every], run(frames[::every]))
                    progress.advance(task)
            results[unique_name(source, results)] = rates
    return Report({"drives": results}, Group(_table(results)))


def _odometry(options: Options, registration: str) -> Method:
    return dpm2(options, f"slam.registration={registration}", "slam.loops.enabled=false", "slam.visual.enabled=false")


def _figures(truth: Array, outcome: Outcome) -> dict[str, Any]:
    metrics = evaluate(truth, outcome.poses, failed_frames=outcome.failed)
    names: Sequence[str] = ("frames", "failed_frames", "rpe_trans_m", "rpe_rot_deg", "final_drift_percent")
    return {name: getattr(metrics, name) for name in names}


def _table(results: dict[str, Any]) -> FigureTable:
    figures = ("RPE m", "RPE deg", "drift %", "failed")
    table = FigureTable("Few frames per second", names=["drive", "frames", "method"], figures=figures)
    for drive, rates in results.items():
        for rate, methods in rates.items():
            for name, row in methods.items():
                errors = [f"{row[key]:.3f}" for key in ("rpe_trans_m", "rpe_rot_deg", "final_drift_percent")]
                table.add_row(drive, rate, name, *errors, str(row["failed_frames"]))
    return table
