# SPDX-License-Identifier: Apache-2.0
"""Robustness: the hardships of `hardships.py` for each registration and for KISS-ICP, with an image of the results."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from rich.console import Group

from benchmarks.figures import verdicts_png
from benchmarks.geometric import BASELINE, Method, Trial, dpm2, kiss_icp
from benchmarks.hardships import EVERY, Case, cases, judged
from benchmarks.harness import Options, Report, drives, installed, processors, requested, truth_of
from dpm2_core.console import progress_bar
from dpm2_core.estimates import State
from dpm2_core.evaluation.metrics import evaluate
from dpm2_core.sim.settings import PresetName
from dpm2_core.sim.simulated_drive import SimulatedDrive
from dpm2_core.tables import FigureTable, record_table

REGISTRATIONS = ("adaptive", "refined", "neural", "geometric")
_NO_IMAGES = "slam.visual.enabled=false"
_SYNTHETIC_FRAMES = 80
_RATE_CASES = tuple(f"every {every}" for every in EVERY)
_SYNTHETIC: tuple[tuple[str, PresetName, int], ...] = (("loop", "city", 940_000), ("random", "suburb", 940_001))
"""Worlds that were not used in training, in addition to the real drives."""


def bench_hard(options: Options) -> Report:
    """Every method in every hardship on every drive, once, without images; `--only` chooses one method.

    The image is `hard.png` next to the record.

    Raises:
        UsageError: there is no drive, or one has no ground truth.
    """
    makers: dict[str, Callable[[], Method]] = {
        name: partial(dpm2, options, f"slam.registration={name}", _NO_IMAGES) for name in REGISTRATIONS
    }
    makers[BASELINE] = partial(kiss_icp, options)
    methods = installed({name: makers[name] for name in requested(options, makers)})
    results: dict[str, Any] = {}
    worlds = () if options.sources else _SYNTHETIC
    synthetic = [SimulatedDrive(road, preset, seed, preset) for road, preset, seed in worlds]
    with drives(options, synthetic) as sources, processors(options.threads), progress_bar() as progress:
        for name, source in sources.items():
            frames = list(source.frames(0, _SYNTHETIC_FRAMES if source in synthetic else None))
            hard = list(cases(frames, truth_of(source)[: len(frames)]))
            task = progress.add_task(name, total=len(hard) * len(methods))
            results[name] = {}
            for case in hard:
                results[name][case.name] = row = {}
                for method, run in methods.items():
                    progress.update(task, description=f"{name}: {case.name}, {method}")
                    row[method] = _figures(case, run(case.frames))
                    progress.advance(task)
    options.out.mkdir(parents=True, exist_ok=True)
    draw(options.out / "hard.png", results)
    return Report({"drives": results}, Group(_table(results), _rates(results)))


def draw(path: Path, results: Mapping[str, Any]) -> None:
    """Draw a table for each drive, with a row for each hardship and a column for each method."""
    panels = {
        drive: {
            case: {method: (figures["verdict"], figures["error_m"]) for method, figures in methods.items()}
            for case, methods in hard.items()
        }
        for drive, hard in results.items()
    }
    verdicts_png(path, panels, "Who survives what: worst error afterwards, m")


def _figures(case: Case, trial: Trial) -> dict[str, Any]:
    states: Sequence[State | None] = trial.states or [None] * len(case.frames)
    figures = {"frames": len(case.frames), "failed_frames": trial.failed, **judged(case, trial.poses, states)}
    if case.name in _RATE_CASES:
        metrics = evaluate(case.truth, trial.poses, failed_frames=trial.failed)
        figures |= {key: getattr(metrics, key) for key in ("rpe_trans_m", "rpe_rot_deg", "final_drift_percent")}
    return figures


def _table(results: Mapping[str, Any]) -> FigureTable:
    methods: Sequence[str] = list(next(iter(next(iter(results.values())).values())))
    table = FigureTable(
        "Worst error afterwards, m. ?: wrong, and says so; !: wrong without a word.",
        names=["drive", "hardship"],
        figures=methods,
    )
    marks = {"right": "", "said": " ?", "silent": " !"}
    for drive, hard in results.items():
        for case, row in hard.items():
            cells = (f"{figures['error_m']:.2f}{marks[figures['verdict']]}" for figures in row.values())
            table.add_row(drive, case, *cells)
    return table


def _rates(results: Mapping[str, Any]) -> FigureTable:
    columns = {"RPE m": "{rpe_trans_m:.3f}", "RPE deg": "{rpe_rot_deg:.3f}", "drift %": "{final_drift_percent:.3f}",
               "failed": "{failed_frames}"}  # fmt: skip
    rows = {drive: {rate: hard[rate] for rate in _RATE_CASES if rate in hard} for drive, hard in results.items()}
    return record_table("Few frames per second", ["drive", "frames", "method"], columns, rows)
