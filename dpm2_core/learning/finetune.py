# SPDX-License-Identifier: Apache-2.0
"""Fine-tuning on a user's own drives without ground truth: the SLAM's trajectory is the reference.

The network registers consecutive scans of a stretch of road. The resulting trajectory is compared with that of the SLAM
(eq. 3 of "Differentiable SLAM Helps Deep Learning-based LiDAR Perception Tasks"), and pairs of scans are matched as in
the registration training. Batches also contain scans of the LiDAR that the weights come from, so that it is not
forgotten.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from dpm2_core.data.packed import PackedDrive
from dpm2_core.diffslam.trajectory_loss import chained, trajectory_loss
from dpm2_core.evaluation.pair_set import PairSet
from dpm2_core.frame import Array
from dpm2_core.learning.checkpoint import WEIGHTS
from dpm2_core.learning.dataset import GroupDataset, GroupSettings, draw_group
from dpm2_core.learning.finetune_settings import DRIVES, HELD_OUT, REHEARSAL, FinetuneSettings
from dpm2_core.learning.pair_sampling import SetPairs, sample_set_pairs
from dpm2_core.learning.pose_loss import differentiable_poses
from dpm2_core.learning.train_registration import RegistrationTraining
from dpm2_core.learning.trainer import Trainer
from dpm2_core.network.decoder import Decoder
from dpm2_core.network.model import DeepPointMap2
from dpm2_core.network.pretrained import weights_path
from dpm2_core.network.pyramid import PointBatch
from dpm2_core.network.tokens import Tokens
from dpm2_core.network.weights import load_model, read_metadata, save_weights


class Finetuned(RegistrationTraining):
    """The network with the losses of the registration training and of the trajectory."""

    def __init__(self, model: DeepPointMap2, settings: FinetuneSettings) -> None:
        super().__init__(model.settings, settings.loss)
        self.model = model.requires_grad_(True).train()
        self.weights = settings.trajectory, settings.pairs
        self.image_head = None  # LiDAR only
        self.loss = settings.loss.model_copy(update={"backbone": 0.0})  # its head is not part of the weights

    def forward(  # type: ignore[override]
        self, points: PointBatch, poses: Tensor, plans: tuple[SetPairs, ...]
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """Loss and figures of G places of F scans with their reference poses (G, F, 4, 4)."""
        trajectory_weight, pair_weight = self.weights
        total = poses.new_zeros(())
        figures: dict[str, Tensor] = {}
        tokens = self.model.encoder(points, None).tokens
        if pair_weight:
            loss, figures = self.pair_loss(tokens, plans)
            total = total + pair_weight * loss
        if trajectory_weight:
            found, diverged = window_trajectories(self.model.decoder, tokens, poses)
            reference = torch.linalg.inv(poses[:, :1]) @ poses
            loss = torch.stack([trajectory_loss(a, b) for a, b in zip(found, reference, strict=True)]).mean()
            figures |= {"trajectory": loss, "diverged": diverged}
            total = total + trajectory_weight * loss
        figures["loss"] = total
        return total, {name: value.detach().float() for name, value in figures.items()}


def window_trajectories(decoder: Decoder, tokens: Tokens, poses: Tensor) -> tuple[Tensor, Tensor]:
    """Trajectories (G, F, 4, 4) T_first_scan by registering each scan to the one before; the fraction that diverged.

    Args:
        tokens: descriptors of G * F scans, place by place. poses: (G, F, 4, 4) reference, float64; where the network
            diverged, their motion is used. See `differentiable_poses` for the gradient.
    """
    groups, frames = poses.shape[:2]
    number = torch.arange(groups * frames, device=poses.device).view(groups, frames)
    source, target = tokens.at(number[:, 1:]), tokens.at(number[:, :-1])
    truth = (torch.linalg.inv(poses[:, :-1]) @ poses[:, 1:]).flatten(0, 1)
    T, usable = differentiable_poses(decoder, source, target, decoder(source, target), truth)
    steps = torch.where(usable[:, None, None], T, truth).unflatten(0, (groups, frames - 1))
    return chained(steps), (~usable).double().mean()


def draw_road_segment(poses: Array, noise: np.random.Generator, frames: int, radius: float) -> NDArray[np.intp]:
    """`draw_group` in the order of the road, so that each scan follows the one before."""
    chosen = draw_group(poses, noise, frames, radius)
    positions = poses[chosen, :3, 3] - poses[chosen, :3, 3].mean(0)
    direction = np.linalg.svd(positions, full_matrices=False)[2][0]
    return chosen[np.argsort(positions @ direction, kind="stable")]


def finetune(settings: FinetuneSettings, out: Path, data: Path | None = None) -> Path:
    """Train on what `prepare` wrote below `data`; checkpoint, log and `weights.safetensors` go to `out`.

    data: None for `out`.

    Raises:
        UsageError: no such weights, or no drives.
    """
    start_from, optimizer, weights = weights_path(settings.weights), settings.optimiser, out / WEIGHTS
    torch.manual_seed(optimizer.seed)
    module = Finetuned(load_model(start_from), settings)

    def segments(drive: PackedDrive, noise: np.random.Generator) -> NDArray[np.intp]:
        return draw_road_segment(drive.poses, noise, settings.frames, settings.radius)

    places = GroupDataset(_group_settings(settings, data or out), module.model.settings, segments, optimizer.seed)

    def batches(start: int, rank: int) -> Iterator[tuple[PointBatch, Tensor, tuple[SetPairs]]]:
        for step, (points, _, poses) in enumerate(places.batches(start, rank), start):
            noise = torch.Generator().manual_seed(optimizer.seed * 1_000_003 + step)
            yield points, poses, (sample_set_pairs(poses, settings.frames, (1, 1), 20.0, noise),)

    def save(averaged: Finetuned) -> None:
        about = read_metadata(start_from)
        about |= {"finetuned_from": start_from.stem, "finetuned_steps": str(optimizer.steps)}
        save_weights(averaged.model, weights, about)

    Trainer(module, batches, optimizer, out, save).run()
    return weights


def measure(weights: Path, settings: FinetuneSettings, out: Path, pairs: int = 100) -> dict[str, dict[str, float]]:
    """Errors of registration on the held-out parts and on the rehearsal, if there are any; see `PairSet.measure`."""
    model = load_model(weights)
    folders = {"held-out parts": out / HELD_OUT, "rehearsal": Path(settings.rehearsal or out / REHEARSAL)}
    return {
        name: PairSet(folder, pairs, model.settings, False).measure(model)
        for name, folder in folders.items()
        if folder.is_dir()
    }


def _group_settings(settings: FinetuneSettings, out: Path) -> GroupSettings:
    packed = {str(out / DRIVES): 1 - settings.rehearsal_share}
    if settings.rehearsal_share:
        packed[settings.rehearsal or str(out / REHEARSAL)] = settings.rehearsal_share
    return GroupSettings(packed=packed, groups=settings.groups, workers=1, augment=settings.augment)
