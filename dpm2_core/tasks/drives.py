# SPDX-License-Identifier: Apache-2.0
"""Synthetic drives for the tasks, with exact classes, poses and twins without dynamic objects."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path

from pydantic import Field

from dpm2_core.config import Settings
from dpm2_core.sim.settings import DriveConfig, LidarConfig, PresetName


class TaskDriveSettings(Settings):
    """Worlds, each driven through once. Training and validation never share one."""

    train: int = Field(default=8, ge=1)
    """Drives to learn from."""
    train_frames: int = Field(default=60, ge=2)
    """Scans of each."""
    val: int = Field(default=3, ge=1)
    """Drives for evaluation."""
    val_frames: int = Field(default=40, ge=2)
    """Scans of each."""
    first_seed: int = Field(default=7000, ge=0)
    """Seed of the first training world, counting up; those of validation begin 100,000 later."""
    presets: tuple[PresetName, ...] = Field(default=("city", "suburb", "rural"), min_length=1)
    """Kinds of places, in turn."""
    traffic: float = Field(default=1.0, ge=0)
    """Factor on the traffic of the preset; above 1 in columns. From 20 on about a third of the points are on moving
    objects."""
    lidar: LidarConfig = LidarConfig(columns=512)
    """512 columns: the width of DSLR's range images."""


def make_task_drives(
    out: Path,
    settings: TaskDriveSettings,
    workers: int,
    progress: Callable[[str, int, int], None] = lambda name, done, total: None,
) -> None:
    """Write out/train/NN and out/val/NN, each in the layout of `dpm2 sim`; existing ones stay.

    Args:
        progress: called with the name of a drive, its frames done and its frames in all.

    Raises:
        UsageError: a folder contains another drive. Dpm2Error: a drive could not be written.
    """
    from dpm2_core.sim.drive import simulate  # embree is slow to import

    kinds = (("train", settings.train, settings.train_frames, 0), ("val", settings.val, settings.val_frames, 100_000))
    for kind, drives, frames, offset in kinds:
        for i in range(drives):
            name, preset = f"{kind}/{i:02d}", settings.presets[i % len(settings.presets)]
            drive = DriveConfig(
                frames=frames, seed=settings.first_seed + offset + i, road="random", preset=preset, images=False,
                traffic=settings.traffic, lidar=settings.lidar,
            )  # fmt: skip
            simulate(out / name, drive, workers, partial(progress, name))
