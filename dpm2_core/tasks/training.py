# SPDX-License-Identifier: Apache-2.0
"""Training and measuring of the tasks: scans shuffled or in windows, eq. 1 and its schedule, on the common trainer."""

from __future__ import annotations

import copy
import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor, nn

from dpm2_core.diffslam.schedule import total_loss
from dpm2_core.diffslam.windows import ContiguousWindows
from dpm2_core.errors import UsageError
from dpm2_core.learning.checkpoint import load_checkpoint
from dpm2_core.learning.trainer import OptimizerSettings, train
from dpm2_core.network.perception.task_weights import load_strictly, read_weights, write_weights
from dpm2_core.tasks.scan import TaskScan, TaskScans
from dpm2_core.tasks.task import SlamTaskTraining, Task, TaskTraining, task_type

WEIGHTS = "weights.safetensors"
"""What a training leaves in its folder, beside checkpoint.pt and log.jsonl."""


def train_task(
    name: str,
    settings: TaskTraining,
    scans: TaskScans,
    out: Path,
    resume: bool = False,
    val: TaskScans | None = None,
    until: int | None = None,
) -> Task:
    """Train; checkpoint, log and at the end `WEIGHTS` go to `out`. The same seed gives the same weights,
    on one thread to the last bit.

    Args:
        settings: of the type that `task_type(name)` names. val: scans to measure on as the training goes on.
        until: stop after this epoch, with a checkpoint; `resume` goes on from there as if nothing had been.

    Raises:
        UsageError: no window fits into the scans, or there is nothing to resume.
    """
    device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
    torch.manual_seed(settings.seed)
    task = task_type(name)(settings).to(device)
    twin = copy.deepcopy(task).requires_grad_(False)
    start = load_checkpoint(out / "checkpoint.pt", task, twin, None) if resume else 0
    windows = ContiguousWindows(scans.lengths, settings.window, settings.every, settings.seed)
    epoch = max(1, len(windows) // settings.batch)

    def loss(module: nn.Module, batch: _Batch, step: int) -> tuple[Tensor, dict[str, Tensor]]:
        return eq1(task, batch.scans, batch.epoch, settings)

    optimizer = OptimizerSettings(
        steps=settings.epochs * epoch, rate=settings.rate, final_rate=settings.final_rate, warmup=settings.warmup,
        decay=settings.decay, clip=settings.clip, ema=0.0, seed=settings.seed, compile=False, bf16=False,
        save_every=epoch, validate_every=settings.validate_every * epoch,
    )  # fmt: skip
    batches = _batches(task, scans, windows, settings.batch, start, device)
    measured = None if val is None else lambda module: measure(module, val)
    train(task, twin, batches, loss, optimizer, out, resume, measured, start, 0, device,
          None if until is None else until * epoch)  # fmt: skip
    save_task(task, out / WEIGHTS, {"epochs": str(settings.epochs if until is None else until)})
    return task.eval()


def eq1(task: Task, window: list[TaskScan], epoch: int, settings: TaskTraining) -> tuple[Tensor, dict[str, Tensor]]:
    """Eq. 1 and its parts, `task_loss` and, in the epochs where it counts, `slam_loss` (without gamma)."""
    model_loss, slam_loss = task.losses(window)
    parts = {"task_loss": model_loss}

    def slam() -> Tensor:
        assert slam_loss is not None
        parts["slam_loss"] = slam_loss()
        return parts["slam_loss"].to(model_loss)

    # A prediction that is not finite has no trajectory; its step is skipped, and the log shows it.
    total = model_loss
    if isinstance(settings, SlamTaskTraining) and slam_loss is not None and bool(model_loss.isfinite()):
        total = total_loss(model_loss, slam, epoch, settings.slam)
    return total, {"loss": total.detach()} | {name: value.detach() for name, value in parts.items()}


@torch.no_grad()
def measure(module: nn.Module, scans: TaskScans) -> dict[str, float]:
    """`Task.evaluate` in eval mode; the mode is put back.

    Raises:
        UsageError: there are no scans, or they lack what the task needs.
    """
    assert isinstance(module, Task)
    was = module.training
    module.eval()
    try:
        return module.evaluate(scans)
    finally:
        module.train(was)


@torch.no_grad()
def draw(task: Task, scans: TaskScans, index: int, path: Path) -> None:
    """`Task.picture` of a scan.

    Raises:
        UsageError: there is no such scan.
    """
    if not 0 <= index < len(scans):
        raise UsageError(f"scan {index}: there are {len(scans)}, counted from 0")
    task.eval().figure(scans[index].to(task.device), path)


def save_task(task: Task, path: Path, about: dict[str, str], half: bool = False) -> None:
    """Parameters with the task's name and the settings of its network; `half` stores fp16."""
    write_weights(path, task.name, task.settings.network, task.state_dict(), about, half)


def load_task(name: str, path: Path) -> Task:
    """A trained task on the CPU, ready to be measured.

    Raises:
        UsageError: no such file, a pickle, weights of another task, other settings or shapes.
    """
    kind = task_type(name)
    network_type = type(kind.training_type().network)
    state, network = read_weights(path, name, network_type)
    task = kind(kind.training_type(network=network))
    load_strictly(task, state, path)
    return task.eval().requires_grad_(False)


@dataclass(frozen=True)
class _Batch:
    """The scans of a step, if contiguous one window after the other, and its epoch."""

    epoch: int
    scans: list[TaskScan]


def _batches(
    task: Task, scans: TaskScans, windows: ContiguousWindows, batch: int, start: int, device: torch.device
) -> Iterator[_Batch]:
    """The scans of so many windows a step, from step `start` on, for ever; what is left of an epoch is not used."""
    steps = max(1, len(windows) // batch)
    epoch, skip = divmod(start, steps)
    while True:
        task.train()
        task.start_epoch(epoch)
        settings = task.settings
        if settings.has_windows(epoch):
            windows.set_epoch(epoch)
            order = [i for window in windows for i in window]
        else:  # neighbors in a step would be nearly one scan: batch statistics and gradients want many places
            generator = torch.Generator().manual_seed(settings.seed * 1_000_003 + epoch)
            order = torch.randperm(len(scans), generator=generator).tolist()
        size = batch * settings.window
        for step in range(skip, steps):
            yield _Batch(epoch, [scans[i].to(device) for i in order[step * size : (step + 1) * size]])
        epoch, skip = epoch + 1, 0


def mean_figures(rows: list[dict[str, float]]) -> dict[str, float]:
    """Mean of each figure over the scans that have it; NaN where none has."""
    out = {}
    for name in rows[0] if rows else ():
        values = [row[name] for row in rows if not math.isnan(row[name])]
        out[name] = sum(values) / len(values) if values else math.nan
    return out
