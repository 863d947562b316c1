# SPDX-License-Identifier: Apache-2.0
"""The tasks of the differentiable SLAM paper, each trained with and without the SLAM loss, all else being equal."""

from __future__ import annotations

import json
import shlex
import shutil
import sys
from dataclasses import dataclass, field
from pathlib import Path
from statistics import mean, median, stdev
from typing import Any, Literal

from rich.console import Group

from benchmarks.harness import Options, Report, earlier, processors, requested, rounded, torch_threads, write_report
from dpm2_core.config import dump_settings, load_settings
from dpm2_core.evaluation.record import git_commit
from dpm2_core.files import atomic_write
from dpm2_core.tables import FigureTable
from dpm2_core.tasks.drives import TaskDriveSettings, make_task_drives
from dpm2_core.tasks.open import open_scans
from dpm2_core.tasks.scan import TaskScans
from dpm2_core.tasks.slam_figures import slam_figures
from dpm2_core.tasks.task import SlamTaskTraining, task_type
from dpm2_core.tasks.training import WEIGHTS, load_task, measure, new_task, train_task

Better = Literal["lower", "higher"]
_DONE = "settings.yaml"  # beside the weights of a training that ended


@dataclass(frozen=True)
class Comparison:
    """How a task is trained for the comparison, and which of its figures count.

    Attributes:
        settings: `key=value` of its training, the arm without the SLAM loss being the same with gamma 0.
        figures: of `Task.evaluate`, and which way is better.
        drives: synthetic drives for training and evaluation. drives_of: the task in whose folder they are.
        slam: odometry on the clouds that the task makes is evaluated as well.
    """

    settings: tuple[str, ...]
    figures: dict[str, Better]
    drives: TaskDriveSettings = field(default_factory=TaskDriveSettings)
    drives_of: str | None = None
    slam: bool = False


_USUAL = TaskDriveSettings(train=80, train_frames=12, val=12, val_frames=20)
_ODOMETRY = ("output_ate_m", "output_rpe_m", "output_rpe_deg")
COMPARISONS: dict[str, Comparison] = {
    "gndnet": Comparison(
        settings=(
            "network.cells=64", "network.channels=16", "gaps=0.1", "epochs=5", "rate=2e-3", "final_rate=2e-4",
            "slam.gamma=1", "slam.begin=1", "slam.every=4", "slam_loss.points=1024",
        ),
        figures={"mse": "lower", "miou": "higher", "precision": "higher", "recall": "higher"},
        drives=_USUAL,
    ),
    "dslr": Comparison(
        settings=(
            "network.image.columns=128", "network.channels=24", "autoencoder_epochs=26", "discriminator_epochs=1",
            "epochs=40", "window=3", "every=1", "batch=3", "rate=2e-3", "final_rate=1e-4", "slam.gamma=8",
            "slam.begin=28", "slam.every=3", "slam_loss.points=1024",
        ),
        figures=dict.fromkeys(("chamfer_m", "chamfer", "moved_m", *_ODOMETRY, "kept_ate_m", "kept_rpe_m"), "lower"),
        drives=TaskDriveSettings(
            train=80, train_frames=12, val=8, val_frames=20, first_seed=7300, presets=("city", "suburb"), traffic=20
        ),
        slam=True,
    ),
    "ae_lidar": Comparison(
        settings=(
            "network.image.columns=128", "network.channels=16", "network.latent=160", "epochs=24", "window=3",
            "every=1", "batch=3", "rate=2e-3", "final_rate=1e-4", "slam.gamma=30", "slam.begin=12", "slam.every=3",
            "slam_loss.points=1024",
        ),
        figures=dict.fromkeys(("chamfer_m", "chamfer", "d_error_m", *_ODOMETRY), "lower"),
        drives=_USUAL,
        drives_of="gndnet",
        slam=True,
    ),
}  # fmt: skip


def bench_tasks(options: Options) -> Report:
    """Every task, or the one that `--only` names; overrides are of its training, repetitions are seeds.

    A training that ended in an earlier run with the same settings is not repeated, one that was stopped goes on, and
    tasks.json is written after each.
    """
    chosen, path = requested(options, COMPARISONS), options.out / "tasks.json"
    parts = earlier(path, "parts")
    with torch_threads(options.threads), processors(options.threads):
        for name in chosen:
            if options.only is None and parts.get(name, {}).get("complete"):
                continue
            for part in _compare(name, COMPARISONS[name], options):
                parts = {**earlier(path, "parts"), name: part}  # another process may have written its task
                write_report(path, "tasks", _report(parts), options)
    return _report(parts)


def _report(parts: dict[str, Any]) -> Report:
    return Report({"parts": parts}, _view(parts))


def _compare(name: str, comparison: Comparison, options: Options) -> Any:
    """The part of a task, again after every training."""
    kind = task_type(name)
    folder = options.cache / "tasks" / name
    drives = options.cache / "tasks" / (comparison.drives_of or name) / "drives"
    make_task_drives(drives, comparison.drives, options.threads)
    train, val = (open_scans(drives / which, kind.needs) for which in ("train", "val"))
    overrides = [*comparison.settings, *options.overrides]
    chosen = load_settings(kind.training_type, None, overrides)
    assert isinstance(chosen, SlamTaskTraining)
    shared = next((epoch for epoch in range(chosen.epochs) if chosen.has_windows(epoch)), 0)
    part: dict[str, Any] = {
        "command": shlex.join(["dpm2", *sys.argv[1:]]),
        "commit": git_commit(),
        "threads": options.threads,
        "settings": overrides,
        "drives": comparison.drives.model_dump(mode="json"),
        "scans": {"train": len(train), "val": len(val)},
        "shared_epochs": shared,
        "complete": False,
        "runs": {"without": {}, "with": {}},
    }
    for seed in range(options.repetitions):
        for variant, gamma in (("without", 0.0), ("with", chosen.slam.gamma)):
            slam = chosen.slam.model_copy(update={"gamma": gamma})
            settings = chosen.model_copy(update={"seed": seed, "slam": slam})
            out = folder / f"{variant}_{seed}"
            _train(name, settings, train, out, shared)
            figures = _measured(name, settings, val, out)
            if comparison.slam:
                slam_on = slam_figures(load_task(name, out / WEIGHTS), drives / "val")
                figures |= {figure: rounded(value) for figure, value in slam_on.items()}
            part["runs"][variant][str(seed)] = figures
            part["summary"] = summary(part["runs"], comparison.figures)
            part["complete"] = seed + 1 == options.repetitions and variant == "with"
            yield part


def _train(
    name: str, settings: SlamTaskTraining, learn: TaskScans, out: Path, shared: int = 0, until: int | None = None
) -> None:
    """Train, or go on, unless this very training has ended. The first `shared` epochs, before the SLAM loss counts for
    the first time, are trained once for both arms."""
    text = dump_settings(settings) + ("" if until is None else f"until: {until}\n")
    begun = out / "begun.yaml"
    if (out / _DONE).is_file() and (out / _DONE).read_text() == text:
        return
    resume = (out / "checkpoint.pt").is_file() and begun.is_file() and begun.read_text() == text
    if shared and not resume:
        common = out.with_name(f"shared_{settings.seed}")
        without = settings.model_copy(update={"slam": settings.slam.model_copy(update={"gamma": 0.0})})
        _train(name, without, learn, common, until=shared)
        out.mkdir(parents=True, exist_ok=True)
        for kept in ("checkpoint.pt", "log.jsonl"):
            shutil.copy(common / kept, out / kept)
        resume = True
    with atomic_write(begun) as file:
        file.write(text)
    train_task(new_task(name, settings), learn, out, resume, until=until)
    with atomic_write(out / _DONE) as file:
        file.write(text)


def _measured(name: str, settings: SlamTaskTraining, val: TaskScans, out: Path) -> dict[str, Any]:
    """Figures of one training on the scans of other worlds, and how the SLAM loss stood beside the task's."""
    figures = measure(load_task(name, out / WEIGHTS), val)
    logged = (json.loads(line) for line in (out / "log.jsonl").read_text().splitlines())
    # A training that was stopped may have logged steps twice, and goes on after the last checkpoint.
    rows = list({row["step"]: row for row in logged if "norm" in row}.values())
    epoch = len(rows) // settings.epochs
    first = [row for row in rows if row.get("slam_loss") is not None][:epoch]
    return {
        **{figure: rounded(value) for figure, value in figures.items()},
        "last_task_loss": rounded(median(row["task_loss"] for row in rows[-epoch:])),
        "slam_share_at_first": rounded(
            settings.slam.gamma * median(row["slam_loss"] / row["task_loss"] for row in first)) if first else None,
        "skipped_steps": sum(row["norm"] is None for row in rows),
    }  # fmt: skip


def summary(runs: dict[str, dict[str, dict[str, Any]]], figures: dict[str, Better]) -> dict[str, Any]:
    """Mean and standard deviation over the seeds of every figure and arm, and what the SLAM loss gained.

    `gain` is the relative improvement of the mean, positive where the arm with the SLAM loss is better; it is beyond
    the spread where the means are farther apart than the two standard deviations together. `paired` has the gains seed
    by seed, both arms of which share all but the SLAM loss: their mean and its standard error, relative to the mean of
    the arm without, and how many seeds are better with it.
    """
    out = {}
    for figure, better in figures.items():
        variants = {variant: [run[figure] for run in of.values()] for variant, of in runs.items()}
        row: dict[str, Any] = {
            variant: {"mean": rounded(mean(values)), "std": rounded(stdev(values)) if len(values) > 1 else None}
            for variant, values in variants.items()
            if values
        }
        if variants["with"] and variants["without"]:
            gap = mean(variants["with"]) - mean(variants["without"])
            sign = -1 if better == "lower" else 1
            size = abs(mean(variants["without"]))
            row["gain"] = rounded(sign * gap / size)
            if min(map(len, variants.values())) > 1:
                row["beyond_spread"] = abs(gap) > sum(stdev(values) for values in variants.values())
            seeds = sorted(runs["with"].keys() & runs["without"].keys())
            better_by = [sign * (runs["with"][s][figure] - runs["without"][s][figure]) for s in seeds]
            if len(seeds) > 1:
                row["paired"] = {
                    "mean": rounded(mean(better_by) / size),
                    "standard_error": rounded(stdev(better_by) / len(seeds) ** 0.5 / size),
                    "better": sum(value > 0 for value in better_by),
                    "seeds": len(seeds),
                }
        out[figure] = row
    return out


def _view(parts: dict[str, Any]) -> Group:
    tables = []
    for name, part in parts.items():
        columns = ["without", "with SLAM loss", "gain", "paired", "beyond the spread"]
        table = FigureTable(f"{name}, {len(part['runs']['with'])} seeds", names=["figure"], figures=columns)
        for figure, row in part["summary"].items():
            cells = [_cell(row.get(variant)) for variant in ("without", "with")]
            gain = f"{row['gain']:+.1%}" if "gain" in row else ""
            beyond = {True: "yes", False: "no"}.get(row.get("beyond_spread"), "")
            table.add_row(figure, *cells, gain, _paired(row.get("paired")), beyond)
        tables.append(table)
    return Group(*tables)


def _paired(row: dict[str, float] | None) -> str:
    if row is None:
        return ""
    return f"{row['mean']:+.1%} ± {row['standard_error']:.1%}, {row['better']} of {row['seeds']} better"


def _cell(row: dict[str, float | None] | None) -> str:
    if row is None:
        return ""
    return f"{row['mean']:.4g}" + (f" ± {row['std']:.2g}" if row["std"] is not None else "")
