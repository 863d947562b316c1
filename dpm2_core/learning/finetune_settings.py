# SPDX-License-Identifier: Apache-2.0
"""Settings of a fine-tuning, and the folders it uses."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from dpm2_core.config import Settings
from dpm2_core.data.settings import InputSettings
from dpm2_core.learning.augment import AugmentSettings
from dpm2_core.learning.generate import GenerateSettings
from dpm2_core.learning.registration_loss import LossSettings
from dpm2_core.learning.trainer import OptimizerSettings

DRIVES, HELD_OUT, REHEARSAL = "drives", "held_out", "rehearsal"
"""Folders of packed drives below the one of the training."""


class FinetuneOptimizer(OptimizerSettings):
    """Optimization: a few small steps."""

    steps: int = Field(default=300, gt=0)
    """Batches."""
    rate: float = Field(default=3e-4, gt=0)
    """Peak learning rate."""
    warmup: int = Field(default=20, ge=0)
    """Steps of linear warm-up."""
    ema: float = Field(default=0.98, ge=0, lt=1)
    """Decay of the averaged weights, which are the ones that are kept."""
    compile: bool = False
    """torch.compile: takes minutes to start."""
    save_every: int = Field(default=50, gt=0)
    """Steps between checkpoints."""


class FinetuneAugment(AugmentSettings):
    """Augmentation; the beams stay those of the LiDAR that is learned."""

    drop: float = Field(default=0.2, ge=0, lt=1)
    """Points are dropped at a ratio drawn from 0 to this."""
    beams: float = Field(default=0.0, ge=0, le=1)
    """Probability that only every second or fourth elevation survives."""


class RehearsalWorlds(GenerateSettings):
    """Synthetic worlds with the LiDAR that the shipped weights come from."""

    worlds: int = Field(default=6, gt=0)
    """Worlds, each a folder."""
    first_seed: int = Field(default=3000, ge=0)
    """Seed of the first world; the others follow."""
    frames: int = Field(default=40, gt=1)
    """Scans of each world, at random places of its road."""


class FinetuneSettings(Settings):
    """A fine-tuning."""

    input: InputSettings = InputSettings(images=False)
    """How drives are read: sequence, topics, time field. Images are not learned from."""
    weights: str = "small"
    """Name of weights that come with dpm2, or path of a .safetensors file: what to start from."""
    reference: Literal["geometric", "refined"] = "geometric"
    """Registration of the SLAM whose trajectory is the reference."""
    trajectory: float = Field(default=2.0, ge=0)
    """Weight of the trajectory loss, 1/m2."""
    pairs: float = Field(default=0.0, ge=0)
    """Weight of the losses of the registration training, with the reference as truth. They gained nothing, and took
    from the other."""
    loss: LossSettings = LossSettings()
    rehearsal: str = ""
    """Folder of packed drives of the LiDAR that the weights come from; empty: synthetic worlds are made."""
    rehearsal_share: float = Field(default=0.5, ge=0, lt=1)
    """Of the places of the batches."""
    rehearsal_worlds: RehearsalWorlds = RehearsalWorlds()
    """The synthetic worlds."""
    held_out: float = Field(default=0.15, ge=0, lt=1)
    """Last part of each drive, to be measured on before and after."""
    groups: int = Field(default=2, gt=0)
    """Places in a batch."""
    frames: int = Field(default=4, ge=2)
    """Scans of each place, in the order of the road."""
    radius: float = Field(default=15.0, gt=0)
    """Farthest from the first one drawn, m."""
    augment: FinetuneAugment = FinetuneAugment()
    optimiser: FinetuneOptimizer = FinetuneOptimizer()
