# SPDX-License-Identifier: Apache-2.0
"""Groups of near-by frames as batches: drawn by weight, augmented, sampled into pyramids."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from pydantic import Field
from torch import Tensor
from torch.utils.data import DataLoader, IterableDataset, get_worker_info

from dpm2_core.config import Settings
from dpm2_core.data.packed import PackedDrive, Sample, open_packed
from dpm2_core.frame import Array
from dpm2_core.learning.augment import AugmentSettings, augment
from dpm2_core.network.encoder import collate_views
from dpm2_core.network.pyramid import PointBatch, Pyramid, build_pyramid, collate
from dpm2_core.network.settings import NetworkSettings
from dpm2_core.network.spatial import Views


class PackedSettings(Settings):
    """Which packed drives to train on."""

    packed: dict[str, float] = Field({})
    """Folders of packed drives (`dpm2 train pack`) and the weight of each in the mixture."""
    emphasis: dict[str, float] = Field({})
    """Factor on the weight of drives of a preset of the synthetic city, such as {tunnel: 3}."""
    groups: int = Field(4, gt=0)
    """Places in a batch, per process."""
    workers: int = Field(1, ge=0)
    """Processes that load and sample; 0 loads in the training process."""
    augment: AugmentSettings = AugmentSettings()


class GroupSettings(PackedSettings, ABC):
    """Packed drives, and how the frames of a place are drawn from one."""

    images: bool = False
    """Read the images."""

    @abstractmethod
    def draw(self, poses: Array, noise: np.random.Generator) -> NDArray[np.intp]:
        """Indices (F,) of the frames of a place in a drive with these poses (n, 4, 4), NaN where unknown."""


class DataSettings(GroupSettings):
    """What to train registration on."""

    frames: int = Field(4, ge=2)
    """Frames of each place: one, and others within `radius` of it."""
    radius: float = Field(20.0, gt=0)
    """m."""

    def draw(self, poses: Array, noise: np.random.Generator) -> NDArray[np.intp]:
        """See `draw_group`."""
        return draw_group(poses, self.frames, self.radius, noise)


class Batch(NamedTuple):
    """Frames of G places, F each, in the order place by place.

    Attributes:
        points: G * F pyramids. views: their images, or None.
        poses: (G, F, 4, 4) float64 T_world_lidar; worlds of different places are unrelated.
    """

    points: PointBatch
    views: Views | None
    poses: Tensor


def draw_group(poses: Array, frames: int, radius: float, noise: np.random.Generator) -> NDArray[np.intp]:
    """Indices (frames,) of one frame and others whose distance from it is about uniform in 0..radius m.

    poses (n, 4, 4), NaN where unknown; frames repeat where the neighborhood holds too few.
    """
    known = np.flatnonzero(np.isfinite(poses[:, :3, 3]).all(1))
    first = noise.choice(known)
    distance = np.linalg.norm(poses[known, :3, 3] - poses[first, :3, 3], axis=1)
    others = known[(distance <= radius) & (known != first)]
    if len(others) == 0:
        return np.full(frames, first)
    distance = np.linalg.norm(poses[others, :3, 3] - poses[first, :3, 3], axis=1)
    chosen = [first]
    for requested in noise.uniform(0, radius, frames - 1):
        gap = np.abs(distance - requested)
        if len(others) >= frames - 1:
            gap[np.isin(others, chosen)] = np.inf
        chosen.append(others[gap.argmin()])
    return np.array(chosen)


class Mixture:
    """Packed drives, chosen at random by their weights.

    Attributes:
        drives: all of them. chances: (len,) probability of each.
    """

    def __init__(self, settings: PackedSettings) -> None:
        drives: list[PackedDrive] = []
        chances: list[float] = []
        for folder, weight in settings.packed.items():
            found = open_packed(Path(folder))
            frames = sum(len(drive) for drive in found)
            drives += found
            factors = [settings.emphasis.get(str(drive.about.get("preset")), 1.0) for drive in found]
            chances += [weight * factor * len(drive) / frames for drive, factor in zip(found, factors, strict=True)]
        self.drives: Sequence[PackedDrive] = drives
        self.chances = np.array(chances) / sum(chances)

    def choose(self, noise: np.random.Generator) -> PackedDrive:
        """One of the drives."""
        return self.drives[noise.choice(len(self.drives), p=self.chances)]


class GroupDataset(IterableDataset):
    """An endless stream of batches; batch `n` depends on seed and `n` alone, so a resumed run sees the same."""

    def __init__(
        self,
        settings: GroupSettings,
        network: NetworkSettings,
        seed: int,
        start: int = 0,
        shard: tuple[int, int] = (0, 1),
    ) -> None:
        self.settings, self.network, self.seed, self.start, self.shard = settings, network, seed, start, shard
        self.drives = Mixture(settings)

    def __iter__(self) -> Iterator[Batch]:
        info = get_worker_info()
        step, stride = self.start, 1
        if info is not None:
            step, stride = self.start + info.id, info.num_workers
        while True:
            yield self.batch(step)
            step += stride

    def batch(self, step: int) -> Batch:
        """Batch number `step` of this process."""
        noise = np.random.default_rng([self.seed, step, self.shard[0]])
        settings = self.settings
        pyramids: list[Pyramid] = []
        images = []
        poses = []
        for _ in range(settings.groups):
            drive = self.drives.choose(noise)
            for index in settings.draw(drive.poses, noise):
                sample: Sample = augment(drive[index], settings.augment, noise)
                pyramids.append(build_pyramid(sample.cloud, self.network))
                images.append(sample.images if settings.images else ())
                poses.append(sample.pose)
        views = collate_views(images, self.network.image) if settings.images else None
        shaped = torch.from_numpy(np.stack(poses)).view(settings.groups, -1, 4, 4)
        return Batch(collate(pyramids), views, shaped)

    def loader(self) -> DataLoader:
        """Batches in order, prepared ahead by worker processes."""
        workers = self.settings.workers
        return DataLoader(
            self,
            batch_size=None,
            num_workers=workers,
            prefetch_factor=4 if workers else None,
            persistent_workers=False,
            worker_init_fn=_one_thread,
        )


def _one_thread(worker: int) -> None:
    torch.set_num_threads(1)
