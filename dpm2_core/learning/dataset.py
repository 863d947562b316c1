# SPDX-License-Identifier: Apache-2.0
"""Groups of nearby frames as batches: drawn by weight, augmented, sampled into pyramids."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from itertools import count
from pathlib import Path
from typing import Annotated, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from pydantic import AfterValidator, Field, NonNegativeFloat, PositiveFloat
from torch import Tensor
from torch.utils.data import DataLoader, Dataset

from dpm2_core.config import Settings
from dpm2_core.data.packed import PackedDrive, Sample, open_packed
from dpm2_core.errors import Dpm2Error, UsageError
from dpm2_core.frame import Array
from dpm2_core.learning.augment import AugmentSettings, augment
from dpm2_core.network.packed_frames import check_fits, fitted
from dpm2_core.network.pyramid import MIN_POINTS, PointBatch, Pyramid, build_pyramid, collate
from dpm2_core.network.settings import NetworkSettings
from dpm2_core.network.views import Views, collate_views
from dpm2_core.sim.settings import PRESET_NAMES

_MIN_TRAINING_POINTS = 8 * MIN_POINTS  # fewest points of a training scan
_MAX_TRIALS = 100  # places that are tried


def _check_place(name: str) -> str:
    if name not in PRESET_NAMES:
        raise ValueError(f"no preset of the synthetic city; there are {', '.join(PRESET_NAMES)}")
    return name


Place = Annotated[str, AfterValidator(_check_place)]
"""Name of a preset of the synthetic city."""


class PackedSettings(Settings):
    """Which packed drives to train on."""

    packed: dict[str, NonNegativeFloat] = Field({})
    """Folders of packed drives (`dpm2 train pack`) and the weight of each in the mixture."""
    emphasis: dict[Place, NonNegativeFloat] = Field({})
    """Factor on the weight of drives of a preset of the synthetic city, such as {tunnel: 3}."""
    groups: int = Field(4, gt=0)
    """Places in a batch, per process."""
    augment: AugmentSettings = AugmentSettings()


class GroupSettings(PackedSettings):
    """Packed drives, with images or without."""

    images: bool = False
    """Read the images."""
    workers: int = Field(1, ge=0)
    """Processes that load and sample; 0 loads in the training process."""


class DataSettings(GroupSettings):
    """The data of the registration training."""

    frames: int = Field(4, ge=2)
    """Frames of each place: one, and others within `radius` of it."""
    radius: float = Field(20.0, gt=0)
    """Largest distance between the first frame of a place and the others, m."""
    radii: dict[Place, PositiveFloat] = Field({})
    """The same for drives of a preset of the synthetic city, such as {tunnel: 15}: where everything looks alike, frames
    far apart show nothing to learn from."""

    def draw(self, drive: PackedDrive, noise: np.random.Generator) -> NDArray[np.intp]:
        """See `draw_group`."""
        return draw_group(drive.poses, noise, self.frames, self.radii.get(drive.preset, self.radius))


Draw = Callable[[PackedDrive, np.random.Generator], NDArray[np.intp]]
"""Draws indices (F,) of the frames of a place in a drive."""


class Batch(NamedTuple):
    """Frames of G places, F each, in the order place by place.

    Attributes:
        points: G * F pyramids. views: their images, or None.
        poses: (G, F, 4, 4) float64 T_world_lidar; worlds of different places are unrelated.
    """

    points: PointBatch
    views: Views | None
    poses: Tensor


def draw_group(poses: Array, noise: np.random.Generator, frames: int, radius: float) -> NDArray[np.intp]:
    """Indices (frames,) of one frame and others up to `radius` m from it, as many within a quarter of the radius as
    beyond: from near pairs a network learns accuracy, from far ones reach.

    poses (n, 4, 4); frames repeat if the neighborhood contains too few.
    """
    frame = np.arange(len(poses))
    first = noise.choice(frame)
    distance = np.linalg.norm(poses[:, :3, 3] - poses[first, :3, 3], axis=1)
    others = frame[(distance <= radius) & (frame != first)]
    if len(others) == 0:
        return np.full(frames, first)
    distance = np.linalg.norm(poses[others, :3, 3] - poses[first, :3, 3], axis=1)
    chosen = [first]
    for requested in radius * noise.uniform(0, 1, frames - 1) ** 2:
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
            factors = [settings.emphasis.get(drive.preset, 1.0) for drive in found]
            chances += [weight * factor * len(drive) / frames for drive, factor in zip(found, factors, strict=True)]
        if not sum(chances) > 0:
            raise UsageError("data.packed: no packed drives; make some with `dpm2 train data` or `dpm2 train pack`")
        self.drives: Sequence[PackedDrive] = drives
        self.chances = np.array(chances) / sum(chances)

    def choose(self, noise: np.random.Generator) -> PackedDrive:
        """One of the drives."""
        return self.drives[noise.choice(len(self.drives), p=self.chances)]


class GroupDataset(Dataset[Batch]):
    """Endless batches; batch `n` of a process depends only on seed, rank and `n`, so that a resumed run gets the same
    ones.

    Raises:
        UsageError: no packed drives, images are required and none has any, or the network needs more than was packed.
    """

    def __init__(self, settings: GroupSettings, network: NetworkSettings, draw: Draw, seed: int) -> None:
        self.settings, self.network, self.draw, self.seed = settings, network, draw, seed
        self.drives = Mixture(settings)
        if settings.images and not any(drive.has_images for drive in self.drives.drives):
            raise UsageError(
                "data.images: no drive of data.packed has images; set data.images=false to train without them"
            )
        for drive in self.drives.drives:
            check_fits(drive, network, settings.images)

    def __getitem__(self, step_and_rank: tuple[int, int]) -> Batch:
        """Batch of (step, rank of the process)."""
        noise = np.random.default_rng([self.seed, *step_and_rank])
        settings = self.settings
        pyramids: list[Pyramid] = []
        images = []
        poses = []
        for _ in range(settings.groups):
            for sample in self._draw_place(noise):
                images.append(sample.images if settings.images else ())
                pyramids.append(build_pyramid(sample.cloud, self.network, images[-1]))
                poses.append(sample.pose)
        views = collate_views(images, self.network.image) if settings.images else None
        pose_batch = torch.from_numpy(np.stack(poses)).view(settings.groups, -1, 4, 4)
        return Batch(collate(pyramids), views, pose_batch)

    def _draw_place(self, noise: np.random.Generator) -> list[Sample]:
        """Augmented frames of a place; another place is drawn if one of them shows too little, as next to a truck.

        Raises:
            Dpm2Error: no such place is found.
        """
        for _ in range(_MAX_TRIALS):
            drive = self.drives.choose(noise)
            found = [fitted(drive[index], drive, self.network.points) for index in self.draw(drive, noise)]
            if min(len(sample.cloud) for sample in found) >= _MIN_TRAINING_POINTS:
                return [augment(sample, self.settings.augment, noise) for sample in found]
        raise Dpm2Error(
            f"{_MAX_TRIALS} places of the packed drives were tried, and each has a scan of fewer than "
            f"{_MIN_TRAINING_POINTS} points"
        )

    def batches(self, start: int, rank: int) -> Iterator[Batch]:
        """Batches from step `start` on, in order, prepared ahead by worker processes."""
        workers = self.settings.workers
        return iter(
            DataLoader(
                self,
                batch_size=None,
                sampler=((step, rank) for step in count(start)),
                num_workers=workers,
                prefetch_factor=4 if workers else None,
                worker_init_fn=_use_one_thread,
            )
        )


def _use_one_thread(worker: int) -> None:
    torch.set_num_threads(1)
