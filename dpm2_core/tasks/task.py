# SPDX-License-Identifier: Apache-2.0
"""Definition of a task: a network, its losses on a window of scans, and its evaluation."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from pathlib import Path
from pkgutil import resolve_name
from typing import ClassVar

import torch
from pydantic import Field
from torch import Tensor, nn

from dpm2_core.config import Settings
from dpm2_core.diffslam.schedule import ScheduleSettings, is_due, total_loss
from dpm2_core.diffslam.trajectory_loss import SlamLossSettings
from dpm2_core.errors import UsageError
from dpm2_core.learning.trainer import StepSettings
from dpm2_core.tasks.scan import RequiredData, TaskScan, TaskScans

TASKS = {
    "gndnet": "dpm2_core.tasks.ground_task:GroundTask",
    "dslr": "dpm2_core.tasks.dslr_task:DslrTask",
    "ae_lidar": "dpm2_core.tasks.ae_lidar_task:AeLidarTask",
    "movers": "dpm2_core.tasks.dynamic_objects_task:DynamicObjectTask",
}
"""Module and class of the task of each name; imported when it is needed."""


class TaskOptimizer(StepSettings):
    """Optimisation."""

    drop_every: int = Field(0, ge=0)
    """Epochs after which the rate is multiplied by `drop`, repeatedly, instead of the cosine; 0: the cosine."""
    warmup: int = Field(20, ge=0)
    """Steps of linear warm-up, at most half of all."""
    ema: float = Field(0, ge=0, lt=1)
    """Decay of the averaged weights, which are the ones that are saved; 0: the last ones."""


class TaskTraining(Settings):
    """A training of a task; each task adds its own settings."""

    network: Settings = Settings()
    """Settings of the network."""
    epochs: int = Field(default=20, ge=1)
    """Passes over the scans."""
    window: int = Field(default=5, ge=2)
    """Contiguous scans of a step."""
    batch: int = Field(default=1, ge=1)
    """Windows of a step."""
    every: int = Field(default=2, ge=1)
    """Distance of these scans (the paper: every second)."""
    optimiser: TaskOptimizer = TaskOptimizer()
    validate_every: int = Field(default=5, ge=1)
    """Epochs between validations."""

    def has_windows(self, epoch: int) -> bool:
        """Whether the scans of a step are contiguous in this epoch, for the SLAM loss. In the other epochs (all epochs
        of a task without it) they are of all places, shuffled."""
        return False


class SlamTaskTraining(TaskTraining):
    """A training of a task that the SLAM loss can be added to."""

    slam: ScheduleSettings = ScheduleSettings()
    """Schedule and weight of the SLAM loss; gamma 0: never used."""
    slam_loss: SlamLossSettings = SlamLossSettings()
    """Odometry of the SLAM loss."""

    def has_windows(self, epoch: int) -> bool:
        """True in the epochs of the SLAM loss, also if its weight is zero: trainings that differ only in the weight see
        the same scans."""
        return is_due(epoch, self.slam)


class Task(nn.Module, ABC):
    """A task that is trained with and without the SLAM loss. All that is trained and stored is in its parameters."""

    name: ClassVar[str]
    """As in `TASKS`."""
    training_type: ClassVar[type[TaskTraining]]
    """Its settings."""
    needs: ClassVar[Sequence[RequiredData]] = ()
    """Data that its scans must have."""

    def __init__(self, settings: TaskTraining) -> None:
        super().__init__()
        self.settings = settings

    @classmethod
    def learns_from(cls, settings: TaskTraining) -> Sequence[RequiredData]:
        """Data that scans must have for training; for evaluation, always `needs`."""
        return cls.needs

    @abstractmethod
    def losses(self, window: list[TaskScan]) -> tuple[Tensor, Callable[[], Tensor] | None]:
        """Loss of the task, a scalar, and a function that returns the SLAM loss, m2; None if it has no meaning.

        `window` contains the scans of `settings.batch` windows one after the other, see `windows`. They are contiguous
        in the epochs of `TaskTraining.has_windows`, and only there the SLAM loss has a meaning. Random numbers are
        drawn from torch's generator, so that a resumed training draws the same.
        """

    def forward(self, window: list[TaskScan], epoch: int) -> tuple[Tensor, dict[str, Tensor]]:
        """Eq. 1 and its parts, `task_loss` and, in the epochs where it is used, `slam_loss` (without gamma)."""
        model_loss, slam_loss = self.losses(window)
        parts = {"task_loss": model_loss}

        def slam() -> Tensor:
            assert slam_loss is not None
            parts["slam_loss"] = slam_loss()
            return parts["slam_loss"].to(model_loss)

        # A prediction that is not finite has no trajectory; its step is skipped, and the log shows it.
        total, settings = model_loss, self.settings
        if isinstance(settings, SlamTaskTraining) and slam_loss is not None and bool(model_loss.isfinite()):
            total = total_loss(model_loss, slam, epoch, settings.slam)
        return total, {"loss": total.detach()} | {name: value.detach() for name, value in parts.items()}

    @abstractmethod
    def evaluate(self, scans: TaskScans) -> dict[str, float]:
        """Figures over all scans; called in eval mode without gradient, see `training.measure`."""

    @abstractmethod
    def figure(self, scan: TaskScan, path: Path) -> None:
        """Draw the network's result for a scan next to the expected one; called as `evaluate`."""

    def clouds(self, scan: TaskScan) -> dict[str, Tensor]:
        """Clouds (N, 3), m, that SLAM can be run on, by name: `output`, `input`, `target`; called as `evaluate`.

        None by default: not every task makes clouds.
        """
        return {}

    def start_epoch(self, epoch: int) -> None:
        """Prepare an epoch, the first being 0: a task with several stages freezes the parts that do not learn in it."""

    def settle(self, scans: TaskScans) -> None:
        """Finish a training after the last step, before the weights are stored; `scans` are those learned from."""

    def windows(self, scans: int) -> list[slice]:
        """Slice of each window among this number of scans."""
        return [slice(i, i + self.settings.window) for i in range(0, scans, self.settings.window)]

    @property
    def device(self) -> torch.device:
        """Device of the network."""
        return next(self.parameters()).device


def task_type(name: str) -> type[Task]:
    """The task of that name.

    Raises:
        UsageError: no such task.
    """
    if name not in TASKS:
        raise UsageError(f"{name}: no such task; choose from {', '.join(TASKS)}")
    found: type[Task] = resolve_name(TASKS[name])
    return found
