# SPDX-License-Identifier: Apache-2.0
"""Settings of a fine-tuning, and the folders it uses."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from dpm2_core.config import Settings
from dpm2_core.data.settings import InputSettings
from dpm2_core.learning.augment import AugmentSettings
from dpm2_core.learning.registration_loss import LossSettings
from dpm2_core.learning.trainer import OptimizerSettings

DRIVES, HELD_OUT, REHEARSAL = "drives", "held_out", "rehearsal"
"""Folders of packed drives below that of the training."""


class FinetuneSettings(Settings):
    """A fine-tuning."""

    input: InputSettings = InputSettings(images=False)
    """How drives are read: sequence, topics, time field. Images are not used."""
    weights: str = "small"
    """Weights to start from: name of weights that come with dpm2, or path of a .safetensors file."""
    reference: Literal["geometric", "refined"] = "geometric"
    """Registration of the SLAM whose trajectory is the reference."""
    trajectory: float = Field(default=2.0, ge=0)
    """Weight of the trajectory loss, 1/m2."""
    pairs: float = Field(default=0.0, ge=0)
    """Weight of the losses of the registration training, with the reference as truth. They brought no gain, and reduced
    that of the trajectory loss."""
    loss: LossSettings = LossSettings()
    rehearsal: str = ""
    """Folder of packed drives of the LiDAR that the weights come from. If empty, worlds of the synthetic city are made,
    with 64 beams 1.73 m above the ground; `dpm2 train data` makes those of another LiDAR."""
    rehearsal_share: float = Field(default=0.5, ge=0, lt=1)
    """Share of the rehearsal among the places of the batches."""
    held_out: float = Field(default=0.15, ge=0, lt=1)
    """Share of each drive, at its end, on which the network is measured before and after."""
    groups: int = Field(default=2, gt=0)
    """Places in a batch."""
    frames: int = Field(default=4, ge=2)
    """Scans of each place, in the order of the road."""
    radius: float = Field(default=15.0, gt=0)
    """Largest distance of a scan from the first one drawn, m."""
    augment: AugmentSettings = AugmentSettings(drop=0.2, beams=0)
    """Augmentation; the beams stay those of the LiDAR to be learned."""
    optimiser: OptimizerSettings = OptimizerSettings(
        steps=300, rate=3e-4, warmup=20, ema=0.98, compile=False, save_every=50
    )
    """Optimization: a few small steps."""
