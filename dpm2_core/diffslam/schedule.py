# SPDX-License-Identifier: Apache-2.0
"""How the SLAM loss joins the loss of the task: eq. 1 and the schedule of the paper."""

from __future__ import annotations

from collections.abc import Callable

from pydantic import Field
from torch import Tensor

from dpm2_core.config import Settings


class ScheduleSettings(Settings):
    """L = L_model + gamma L_slam in every k-th epoch."""

    gamma: float = Field(default=1.0, ge=0)
    """Weight of the SLAM loss; choose it so that gamma L_slam is a tenth to a half of L_model when it first counts."""
    every: int = Field(default=5, ge=1)
    """k: the last of every k epochs has the SLAM loss (the paper: 27 of 150 epochs for GndNet)."""


def is_slam_epoch(epoch: int, settings: ScheduleSettings) -> bool:
    """Whether the SLAM loss counts in this epoch, the first being 0."""
    return settings.gamma > 0 and epoch % settings.every == settings.every - 1


def total_loss(model_loss: Tensor, slam_loss: Callable[[], Tensor], epoch: int, settings: ScheduleSettings) -> Tensor:
    """Eq. 1. `slam_loss` is called only where it counts, and never replaces the loss of the task: equal motion alone
    would be satisfied by any pair of clouds."""
    return model_loss + settings.gamma * slam_loss() if is_slam_epoch(epoch, settings) else model_loss
