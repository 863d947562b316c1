# SPDX-License-Identifier: Apache-2.0
"""Training and measuring of the tasks: scans shuffled or in windows, eq. 1 and its schedule, on the common trainer."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path

import torch

from dpm2_core.diffslam.trajectory_loss import SlamLoss
from dpm2_core.diffslam.windows import ContiguousWindows
from dpm2_core.errors import UsageError
from dpm2_core.learning.checkpoint import WEIGHTS
from dpm2_core.learning.trainer import OptimizerSettings, Trainer
from dpm2_core.network.perception.task_weights import read_weights, write_weights
from dpm2_core.network.weights import load_strictly
from dpm2_core.tasks.scan import UNCOUNTED, RequiredData, TaskScan, TaskScans
from dpm2_core.tasks.task import Task, TaskTraining, task_type


def new_task(name: str, settings: TaskTraining) -> Task:
    """An untrained task; `settings` of the type that `task_type(name)` names."""
    torch.manual_seed(settings.optimiser.seed)
    return task_type(name)(settings)


def train_task(
    task: Task,
    scans: TaskScans,
    out: Path,
    val: TaskScans | None = None,
    until: int | None = None,
) -> Task:
    """Train a new task; checkpoint, log and at the end `WEIGHTS` go to `out`. The same seed gives the same weights,
    on one thread to the last bit.

    Args:
        val: scans to measure on during the training.
        until: stop after this epoch, with a checkpoint; the next call continues from there as if without a stop.

    Raises:
        UsageError: no window fits into the scans, none of them has a label that counts, or a checkpoint of another
            training.
    """
    settings = task.settings
    _check_labels(scans, task.learns_from(settings))
    windows = ContiguousWindows(scans.lengths, settings.window, settings.every, settings.optimiser.seed)
    epoch_steps = max(1, len(windows) // settings.batch)
    step_settings = {**settings.optimiser.model_dump(), "drop_every": settings.optimiser.drop_every * epoch_steps}
    optimizer = OptimizerSettings(
        **step_settings, steps=settings.epochs * epoch_steps, compile=False, bf16=False,
        save_every=epoch_steps, validate_every=settings.validate_every * epoch_steps,
    )  # fmt: skip

    def batches(start: int, rank: int) -> Iterator[tuple[list[TaskScan], int]]:
        return _batches(task, scans, windows, start)

    def save(averaged: Task) -> None:
        task.load_state_dict(averaged.state_dict())
        task.settle(scans)
        save_task(task, out / WEIGHTS, {"epochs": str(settings.epochs if until is None else until)})

    validate = None if val is None else partial(measure, scans=val)
    Trainer(task, batches, optimizer, out, save, validate).run(None if until is None else until * epoch_steps)
    return task.eval()


@torch.no_grad()
def measure(task: Task, scans: TaskScans) -> dict[str, float]:
    """`Task.evaluate` in eval mode; the mode is restored.

    Raises:
        UsageError: there are no scans, or they lack what the task needs.
    """
    _check_labels(scans, task.needs)
    was_training = task.training
    task.eval()
    try:
        return task.evaluate(scans)
    finally:
        task.train(was_training)


@torch.no_grad()
def draw(task: Task, scans: TaskScans, index: int, path: Path) -> None:
    """`Task.figure` of a scan.

    Raises:
        UsageError: there is no such scan.
    """
    if not 0 <= index < len(scans):
        raise UsageError(f"scan {index}: there are only {len(scans)} scans, counted from 0")
    task.eval().figure(scans[index].to(task.device), path)


def save_task(task: Task, path: Path, about: dict[str, str], half: bool = False) -> None:
    """Write parameters with the task's name and the settings of its network; `half` stores fp16."""
    write_weights(path, task.name, task.settings.network, task.state_dict(), about, half)


def load_task(name: str, path: Path) -> Task:
    """A trained task on the CPU, ready for evaluation.

    Raises:
        UsageError: no such file, a pickle, weights of another task, other settings or shapes.
    """
    kind = task_type(name)
    network_type = type(kind.training_type().network)
    state, network = read_weights(path, name, network_type)
    task = kind(kind.training_type(network=network))
    load_strictly(task, state, path, "its settings")
    return task.eval().requires_grad_(False)


def _batches(
    task: Task, scans: TaskScans, windows: ContiguousWindows, start: int
) -> Iterator[tuple[list[TaskScan], int]]:
    """Endless steps from `start` on: the scans of `settings.batch` windows, if contiguous one window after the other,
    and the epoch. Scans left at the end of an epoch are not used."""
    settings = task.settings
    steps = max(1, len(windows) // settings.batch)
    epoch, skip = divmod(start, steps)
    while True:
        task.train()
        task.start_epoch(epoch)
        for module in task.modules():
            if isinstance(module, SlamLoss):
                module.restart()
        if settings.has_windows(epoch):
            windows.set_epoch(epoch)
            order = [i for window in windows for i in window]
        else:  # neighboring scans are nearly the same: batch statistics and gradients need many places
            generator = torch.Generator().manual_seed(settings.optimiser.seed * 1_000_003 + epoch)
            order = torch.randperm(len(scans), generator=generator).tolist()
        size = settings.batch * settings.window
        for step in range(skip, steps):
            yield [scans[i] for i in order[step * size : (step + 1) * size]], epoch
        epoch, skip = epoch + 1, 0


def _check_labels(scans: TaskScans, needs: Sequence[RequiredData]) -> None:
    """Raise UsageError if labels are needed, and those of all scans are of no class."""
    if "labels" in needs and len(scans) and all(_is_of_no_class(scans[i]) for i in range(len(scans))):
        raise UsageError(
            f"{scans[0].sequence}: no point of any scan has a class: all labels are 0, unlabeled, or 1, outlier"
        )


def _is_of_no_class(scan: TaskScan) -> bool:
    return scan.labels is not None and bool(torch.isin(scan.labels, torch.tensor(UNCOUNTED)).all())


def mean_figures(rows: list[dict[str, float]]) -> dict[str, float]:
    """Mean of each figure over the scans that have it; NaN if none has."""
    out = {}
    for name in rows[0] if rows else ():
        values = [row[name] for row in rows if not math.isnan(row[name])]
        out[name] = sum(values) / len(values) if values else math.nan
    return out
