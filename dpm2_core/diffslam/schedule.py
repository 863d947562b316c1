# SPDX-License-Identifier: Apache-2.0
"""Sum of the SLAM loss and the loss of the task: eq. 1 and the schedule of the paper, and a bound."""

from __future__ import annotations

from collections.abc import Callable

from pydantic import Field
from torch import Tensor

from dpm2_core.config import Settings

_MIN_SLAM_LOSS = 1e-12  # a SLAM loss of zero needs no bound


class ScheduleSettings(Settings):
    """L = L_model + gamma L_slam in every k-th epoch, the second term bounded by a fraction of the first."""

    gamma: float = Field(default=0.0, ge=0)
    """Weight of the SLAM loss; choose it so that the gradient of gamma L_slam is about half of that of L_model when it
    is first used. The losses themselves are comparable only if both are means. 0: it is never used."""
    every: int = Field(default=5, ge=1)
    """k: the last of every k epochs has the SLAM loss (the paper: 27 of 150 epochs for GndNet)."""
    begin: int = Field(default=0, ge=0)
    """Epochs before the first k: an untrained network produces no clouds that a SLAM could run on."""
    most: float | None = Field(default=0.5, gt=0)
    """Largest fraction of |L_model| that gamma L_slam may have in a step. If a registration is lost, its error, which
    is heavy-tailed, would be the whole step. None: no bound, eq. 1 as in the paper."""


def is_due(epoch: int, settings: ScheduleSettings) -> bool:
    """Whether the SLAM loss is used in this epoch, the first being 0, whatever its weight."""
    since = epoch - settings.begin
    return since >= 0 and since % settings.every == settings.every - 1


def total_loss(model_loss: Tensor, slam_loss: Callable[[], Tensor], epoch: int, settings: ScheduleSettings) -> Tensor:
    """Eq. 1, bounded. `slam_loss` is called only if it is used, and never replaces the loss of the task: any clouds
    with the same motion would satisfy it alone."""
    if settings.gamma == 0 or not is_due(epoch, settings):
        return model_loss
    weighted = settings.gamma * slam_loss()
    if settings.most is not None:
        weighted = weighted * (settings.most * model_loss.abs() / weighted.clamp(min=_MIN_SLAM_LOSS)).detach().clamp(
            max=1
        )
    return model_loss + weighted
