# SPDX-License-Identifier: Apache-2.0
"""One training of a task, and one measurement of it: the parts of the experiments of the differentiable SLAM paper."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from statistics import median
from typing import Literal, TypedDict

from dpm2_core.config import load_settings
from dpm2_core.console import Advance
from dpm2_core.data.trajectory import write_tum
from dpm2_core.evaluation.run_folder import TRAJECTORY, TRUTH, write_truth
from dpm2_core.files import make_folder
from dpm2_core.fleet.part import Figures
from dpm2_core.learning.begun import begin_training
from dpm2_core.learning.checkpoint import read_log
from dpm2_core.tasks.open import open_scans
from dpm2_core.tasks.slam_figures import figures_of, slam_runs
from dpm2_core.tasks.task import SlamTaskTraining, task_type
from dpm2_core.tasks.training import load_task, mean_figures, measure, new_task, train_task

TRAIN = "dpm2_core.experiments.task_part:train"
MEASURE = "dpm2_core.experiments.task_part:measure_on"
SLAM = "dpm2_core.experiments.task_part:slam_on"
Arm = Literal["without", "with", "placebo"]
Scans = tuple[Path, Sequence[str]]
"""Root of a data set, and the sequences in it."""


class Training(TypedDict):
    """The training of an arm: its task, root of the data set, sequences, YAML file, settings KEY=VALUE, and its seed,
    counted from that of the settings."""

    task: str
    data: Path
    learn: Sequence[str]
    config: Path | None
    settings: Sequence[str]
    seed: int
    arm: Arm


def settings_of(training: Training) -> SlamTaskTraining:
    """The settings of an arm: without the SLAM loss, with it, or with that of the window before as a placebo."""
    chosen = load_settings(task_type(training["task"]).training_type, training["config"], training["settings"])
    assert isinstance(chosen, SlamTaskTraining)
    arm = training["arm"]
    gamma = 0.0 if arm == "without" else chosen.slam.gamma
    seed = chosen.optimiser.seed + training["seed"]
    return chosen.model_copy(
        update={
            "optimiser": chosen.optimiser.model_copy(update={"seed": seed}),
            "slam": chosen.slam.model_copy(update={"gamma": gamma}),
            "slam_loss": chosen.slam_loss.model_copy(update={"placebo": arm == "placebo"}),
        }
    )


def first_slam_epoch(settings: SlamTaskTraining) -> int:
    """Number of epochs before the SLAM loss is used for the first time; the arms of a seed share them."""
    return next((epoch for epoch in range(settings.epochs) if settings.has_windows(epoch)), 0)


def train(
    folder: Path, advance: Advance, training: Training, until: int | None = None, start: Path | None = None
) -> Figures:
    """Train an arm; weights, log and checkpoint stay in the folder, and a stopped training continues.

    Args:
        until: train only this number of epochs. start: folder of a training that stopped there, to continue from.

    Raises:
        UsageError: no such scans, or too few.
    """
    settings = settings_of(training)
    task_class = task_type(training["task"])
    # All arms must see the same scans, so the one that needs most decides: the one without the SLAM loss.
    required = task_class.learns_from(settings_of({**training, "arm": "without"}))
    scans = open_scans(training["data"], required, training["learn"])
    inputs = {"training": training, "until": until, "content": scans.digest()}
    begin_training(folder, settings, data=inputs, start=start)
    task = new_task(training["task"], settings)
    train_task(task, scans, folder, until=until)
    advance(1, 1)
    epochs = until or settings.epochs
    return {"scans": len(scans), "epochs": epochs, **_log_figures(folder, epochs, settings.slam.gamma)}


def measure_on(folder: Path, advance: Advance, task: str, weights: Path, drive: Scans) -> Figures:
    """Figures of a training on a data set's sequences.

    Raises:
        UsageError: no such scans, or they lack what the task needs.
    """
    scans = open_scans(drive[0], task_type(task).needs, drive[1])
    figures = measure(load_task(task, weights), scans)
    advance(1, 1)
    return {"scans": len(scans), **figures}


def slam_on(folder: Path, advance: Advance, task: str, weights: Path, drive: Scans) -> Figures:
    """Odometry on the clouds that a trained task makes of a data set's sequences; writes the trajectories.

    Raises:
        UsageError: as `slam_runs`.
    """
    rows = {}
    for run in slam_runs(load_task(task, weights), *drive):
        rows[run.sequence] = figures_of(run)
        for kind, poses in run.poses.items():
            run_folder = folder / folder_name(run.sequence) / kind
            make_folder(run_folder)
            write_tum(run_folder / TRAJECTORY, run.stamps, poses)
            write_truth(run_folder / TRUTH, run.stamps, run.truth)
        advance(len(rows), len(rows))
    return {"sequences": rows, **mean_figures(list(rows.values()))}


def folder_name(sequence: str) -> str:
    """Name of the folder for the trajectories of a sequence."""
    return sequence.replace("/", "_")


def _log_figures(folder: Path, epochs: int, gamma: float) -> Figures:
    """The loss of the last of these epochs, the ratio of the SLAM loss to the task's when first used, and the skipped
    steps."""
    rows = [row for row in read_log(folder) if "norm" in row]
    epoch_steps = max(1, len(rows) // epochs)
    first = [row for row in rows if row.get("slam_loss") is not None and row["task_loss"]][:epoch_steps]
    share = [gamma * row["slam_loss"] / row["task_loss"] for row in first]
    last = [row["task_loss"] for row in rows[-epoch_steps:] if row["task_loss"] is not None]  # None: it was not finite
    return {
        "last_task_loss": median(last) if last else None,
        "slam_share_at_first": median(share) if share else None,
        "skipped_steps": sum(row["norm"] is None for row in rows),
    }
