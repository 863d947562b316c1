# SPDX-License-Identifier: Apache-2.0
"""Training of the image branch alone, before the registration training with images, on points that two images show.

Inside the whole network the image branch learns last: its effect on the pose is indirect. Alone it learns in minutes,
because every LiDAR point that both cameras see is an exact correspondence, and a step runs no point cloud network.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import count
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from pydantic import Field
from torch import Tensor, nn

from dpm2_core.config import Settings
from dpm2_core.errors import UsageError
from dpm2_core.frame import Camera, Image
from dpm2_core.geometry import se3
from dpm2_core.learning.augment import augment_image
from dpm2_core.learning.checkpoint import WEIGHTS
from dpm2_core.learning.dataset import Mixture, PackedSettings, draw_group
from dpm2_core.learning.trainer import OptimizerSettings, Trainer
from dpm2_core.network.losses import cosine, info_nce, label_distances
from dpm2_core.network.model import DeepPointMap2
from dpm2_core.network.packed_frames import check_images
from dpm2_core.network.pretrained import weights_path
from dpm2_core.network.settings import NetworkSettings, preset
from dpm2_core.network.spatial import image_features
from dpm2_core.network.views import Views, collate_views
from dpm2_core.network.weights import load_weights, save_weights

NEUTRAL = 1.5  # m, within which a point's neighbors are neither right nor wrong


class ImagePairs(NamedTuple):
    """Images in pairs: first and second of each pair, one after the other.

    Attributes:
        views: of 2 P frames. points: (2 P, n, 3) m, the same points in both LiDAR frames of a pair.
    """

    views: Views
    points: Tensor


class ImageDataSettings(PackedSettings):
    """Packed drives, and how far apart the images of a pair are."""

    radius: float = Field(20.0, gt=0)
    """Largest distance between two images, m."""


class ImageTrainingSettings(Settings):
    """A training of the image branch."""

    preset: str = "small"
    """Network preset."""
    network: dict[str, Any] = Field({})
    """Changes to the preset."""
    data: ImageDataSettings = ImageDataSettings()
    """Drives with images."""
    points: int = Field(256, gt=0)
    """Points drawn for each pair."""
    shift: float = Field(0.3, ge=0)
    """Standard deviation of the second image's points from the true ones, m: descriptors never coincide exactly."""
    optimiser: OptimizerSettings = OptimizerSettings()
    start: str = ""
    """Weights of the network, a name or a .safetensors file, whose other parts stay as they are; empty: random."""


class ImageDataset:
    """Pairs of images of a place and the points that the first of them shows."""

    def __init__(self, settings: ImageDataSettings, network: NetworkSettings, seed: int) -> None:
        self._settings, self._network, self._seed = settings, network, seed
        self._drives = Mixture(settings)
        for drive in self._drives.drives:
            check_images(drive, network)

    def pairs(self, points: int, start: int = 0, rank: int = 0) -> Iterator[ImagePairs]:
        """Endless pairs, for each step from `start` on, as deterministic as the batches of `GroupDataset`.

        Raises:
            UsageError: a drive without images, or whose images show too few points.
        """
        settings = self._settings
        for step in count(start):
            noise = np.random.default_rng([self._seed, step, rank])
            images: list[list[Image]] = []
            drawn: list[NDArray[np.float32]] = []
            for _ in range(100 * settings.groups):
                if len(images) == 2 * settings.groups:
                    break
                drive = self._drives.choose(noise)
                a, b = (drive[i] for i in draw_group(drive.poses, noise, 2, settings.radius))
                if not (a.images and b.images):
                    raise UsageError(
                        f"{drive.folder}: has no images; pack it with images or remove it from data.packed"
                    )
                seen = a.cloud[shown(a.cloud, a.images[0].camera)]
                if len(seen) < points:
                    continue
                chosen = seen[noise.choice(len(seen), points, replace=False)]
                drawn += [chosen, se3.transform(se3.inverse(b.pose) @ a.pose, chosen).astype(np.float32)]
                images += [[augment_image(s.images[0], np.eye(4), settings.augment, noise)] for s in (a, b)]
            views = collate_views(images, self._network.image)
            if views is None or len(images) < 2 * settings.groups:
                raise UsageError(f"data.packed: hardly any image shows {points} points; set a lower `points`")
            yield ImagePairs(views, torch.from_numpy(np.stack(drawn)))


def shown(points: NDArray[np.float32], camera: Camera) -> NDArray[np.bool_]:
    """Which points (N, 3), m, in the LiDAR frame project into the camera's image."""
    camera_points = se3.transform(se3.inverse(camera.T_lidar_cam), points)
    in_front = camera_points[:, 2] > 0.1
    uv = (camera_points @ camera.K.T)[:, :2] / np.where(in_front, camera_points[:, 2], 1.0)[:, None]
    return in_front & (uv >= 0).all(1) & (uv < camera.size).all(1)


class ImageTraining(nn.Module):
    """Image branch with its loss."""

    def __init__(self, network: NetworkSettings, shift: float) -> None:
        super().__init__()
        self.model = DeepPointMap2(network)
        self.temperature, self.shift = network.decoder.temperature, shift
        encoder = self.model.encoder
        if encoder.image is None or encoder.fusion is None or encoder.fusion.pixel is None:
            raise UsageError(f"preset {network.preset}: has no features of single image pixels to train (fusion.pixel)")
        self.image, self.head = encoder.image, encoder.fusion.pixel
        self.requires_grad_(False)
        for part in (self.image, self.head):
            part.requires_grad_(True)

    def forward(self, batch: ImagePairs) -> tuple[Tensor, dict[str, Tensor]]:
        """Mean InfoNCE of the points that both images of a pair show."""
        maps = self.image(batch.views.pixels.flatten(0, 1))
        points = batch.points.clone()
        points[1::2] += torch.randn_like(points[1::2]) * self.shift
        features, seen = image_features(points, batch.views, maps)
        features = self.head(features)
        valid = seen[::2, :, None] & seen[1::2, None]
        distance = torch.cdist(batch.points[1::2], points[1::2], compute_mode="donot_use_mm_for_euclid_dist")
        labels = label_distances(distance.masked_fill(~valid, torch.inf), NEUTRAL)
        scores = cosine(features[::2], features[1::2]) / self.temperature
        loss = info_nce(scores, labels, False)
        best = scores.detach().masked_fill(~valid, -1e4).argmax(2, keepdim=True)
        used = labels.forward >= 0
        right = ((distance.gather(2, best)[..., 0] <= NEUTRAL) & used).sum() / used.sum().clamp(min=1)
        return loss, {"loss": loss.detach(), "right": right}


def train_image(settings: ImageTrainingSettings, out: Path) -> Path:
    """Train; checkpoint, log and the whole network's weights go to `out`."""
    optimizer, weights = settings.optimiser, out / WEIGHTS
    torch.manual_seed(optimizer.seed)
    network = preset(settings.preset, settings.network)
    module = ImageTraining(network, settings.shift)
    if settings.start:
        load_weights(module.model, weights_path(settings.start))
    data = ImageDataset(settings.data, network, optimizer.seed)

    def batches(start: int, rank: int) -> Iterator[tuple[ImagePairs]]:
        return ((pairs,) for pairs in data.pairs(settings.points, start, rank))

    def save(averaged: ImageTraining) -> None:
        save_weights(averaged.model, weights, {"phase": "image", "steps": str(optimizer.steps)})

    Trainer(module, batches, optimizer, out, save).run()
    return weights
