# SPDX-License-Identifier: Apache-2.0
"""The overlap training: only the heads that judge a pose, on the frozen network of the registration training. Half of
the pairs are near, half hard or far. The heads are the paper's overlap head and the confidence of a pose."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path
from typing import Self

import numpy as np
import torch
from numpy.typing import NDArray
from pydantic import Field
from torch import Tensor, nn

from dpm2_core.config import Settings
from dpm2_core.data.packed import PackedDrive, open_packed
from dpm2_core.frame import Array
from dpm2_core.geometry import se3_torch
from dpm2_core.learning.augment import UNCHANGED
from dpm2_core.learning.checkpoint import WEIGHTS
from dpm2_core.learning.dataset import GroupDataset, GroupSettings
from dpm2_core.learning.trainer import OptimizerSettings, Trainer
from dpm2_core.network.encoder import to_device
from dpm2_core.network.heads import POSE_FEATURES
from dpm2_core.network.losses import confidence_loss, overlap_loss
from dpm2_core.network.model import DeepPointMap2
from dpm2_core.network.pose_solver import solve_batch
from dpm2_core.network.precision import mixed_precision
from dpm2_core.network.pretrained import weights_path
from dpm2_core.network.pyramid import PointBatch
from dpm2_core.network.settings import NetworkSettings
from dpm2_core.network.solved import Solved, confidence_of, overlap_features
from dpm2_core.network.views import Views
from dpm2_core.network.weights import load_weights, network_settings, save_weights

OVERLAP = 20.0  # m: nearer pairs are positive
HARD = 40.0  # m: half of the negatives lie between OVERLAP and this
FRAMES = 5  # a reference, two near it, one hard negative, one far


class OverlapTrainingSettings(Settings):
    """The overlap training; the network is that of the registration training, with all its settings."""

    start: str
    """Weights of the registration training, a name or a .safetensors file."""
    data: GroupSettings = GroupSettings()
    """Packed drives, from which frames with and without overlap are drawn, see `draw_overlap`."""
    validation: str = ""
    """Folder of packed drives of other worlds; empty: none."""
    validation_batches: int = Field(25, gt=0)
    """Batches of a validation."""
    optimiser: OptimizerSettings = OptimizerSettings(steps=600, rate=1e-4, decay=1e-5, warmup=20)
    """Optimization at a tenth of the rate and weight decay of the registration training (section 5.1)."""


def draw_overlap(poses: Array, noise: np.random.Generator) -> NDArray[np.intp]:
    """Indices (FRAMES,) of a frame, two within OVERLAP m of it, one within HARD m and one beyond.

    poses (n, 4, 4). For a kind that the drive does not have, another kind is repeated.
    """
    frames = np.arange(len(poses))
    for _ in range(20):
        first = noise.choice(frames)
        distance = np.linalg.norm(poses[:, :3, 3] - poses[first, :3, 3], axis=1)
        near = frames[(distance <= OVERLAP) & (frames != first)]
        hard = frames[(distance > OVERLAP) & (distance <= HARD)]
        far = frames[distance > HARD]
        if len(near) and (len(hard) or len(far)):
            break
    near = near if len(near) else np.array([first])
    hard = hard if len(hard) else far if len(far) else near
    far = far if len(far) else hard
    return np.array([first, *noise.choice(near, 2), noise.choice(hard), noise.choice(far)])


def _draw(drive: PackedDrive, noise: np.random.Generator) -> NDArray[np.intp]:
    return draw_overlap(drive.poses, noise)


class OverlapTraining(nn.Module):
    """The frozen network with the heads that are trained, and their loss."""

    def __init__(self, network: NetworkSettings) -> None:
        super().__init__()
        self.model = DeepPointMap2(network)
        self.model.requires_grad_(False)
        self.model.decoder.overlap.requires_grad_(True)
        self.model.decoder.confidence.requires_grad_(network.decoder.precision)  # else it is not used

    def train(self, mode: bool = True) -> Self:
        """Set the mode; the frozen encoder stays in evaluation mode, with its running means."""
        super().train(mode)
        self.model.encoder.eval()
        return self

    def forward(
        self, points: PointBatch, views: Views | None, distance: Tensor, T_target_source: Tensor
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """Loss of places whose frames are `distance` (G * 4,) m from the first, which lies at T_target_source
        (G * 4, 4, 4) in each of them."""
        logits, solved = self.logits(points, views)
        parts = {"overlap": overlap_loss(logits, distance, OVERLAP)}
        decoder = self.model.decoder
        if solved is not None and decoder.settings.precision:
            parts["confidence"] = confidence_loss(confidence_of(decoder, solved), solved.T, T_target_source)
        loss = torch.stack(list(parts.values())).sum()
        return loss, {"loss": loss.detach(), **{name: part.detach() for name, part in parts.items()}}

    def logits(self, points: PointBatch, views: Views | None) -> tuple[Tensor, Solved | None]:
        """Overlap (G * 4,) of each place's first frame with its others, and its poses in them."""
        with torch.no_grad():
            tokens = self.model.encoder(points, views).tokens
            number = torch.arange(len(tokens.xyz), device=tokens.xyz.device).view(-1, FRAMES)
            source, target = tokens.at(number[:, :1].expand(-1, FRAMES - 1)), tokens.at(number[:, 1:])
            correlated = self.model.decoder(source, target)
            solved = solve_batch(self.model.decoder, source, target, correlated)
            no_pose = source.xyz.new_zeros(len(source.xyz), POSE_FEATURES)
            pose_features = no_pose if solved is None else overlap_features(solved)
        return self.model.decoder.overlap(*correlated, source.mask, target.mask, pose_features), solved


def pair_distances(poses: Tensor) -> Tensor:
    """(G * 4,) m between the first frame of each place and the others, of poses (G, FRAMES, 4, 4)."""
    t = poses[:, :, :3, 3]
    return (t[:, 1:] - t[:, :1]).norm(dim=-1).flatten().float()


def pair_poses(poses: Tensor) -> Tensor:
    """T_target_source (G * 4, 4, 4) of the first frame of each place in the others, of poses (G, FRAMES, 4, 4)."""
    return (se3_torch.inverse(poses[:, 1:]) @ poses[:, :1]).flatten(0, 1)


def average_precision(scores: np.ndarray, positive: np.ndarray) -> float:
    """Area under the precision-recall curve as the mean precision at each positive."""
    order = np.argsort(-scores, kind="stable")
    hits = positive[order]
    precision = np.cumsum(hits) / np.arange(1, len(hits) + 1)
    return float(precision[hits].mean()) if hits.any() else float("nan")


def train_overlap(settings: OverlapTrainingSettings, out: Path) -> Path:
    """Train; writes checkpoint, log and `weights.safetensors`, those of the registration training with the new heads,
    to `out`."""
    optimizer, weights = settings.optimiser, out / WEIGHTS
    torch.manual_seed(optimizer.seed)
    start = weights_path(settings.start)
    network = network_settings(start)
    module = OverlapTraining(network)
    about = load_weights(module.model, start)
    data = GroupDataset(settings.data, network, _draw, optimizer.seed)

    def batches(start: int, rank: int) -> Iterator[tuple[PointBatch, Views | None, Tensor, Tensor]]:
        found = data.batches(start, rank)
        return ((b.points, b.views, pair_distances(b.poses), pair_poses(b.poses)) for b in found)

    def save(averaged: OverlapTraining) -> None:
        save_weights(averaged.model, weights, {**about, "phase": "2"})

    validate = validator(settings, network) if settings.validation else None
    Trainer(module, batches, optimizer, out, save, validate).run()
    return weights


def validator(
    settings: OverlapTrainingSettings, network: NetworkSettings
) -> Callable[[OverlapTraining], dict[str, float]]:
    """A function that measures the average precision on fixed batches of unseen worlds, with their images if they have
    any. Scans are not augmented, and no preset is emphasized, whatever the training does with its own."""
    images = settings.data.images and any(drive.has_images for drive in open_packed(Path(settings.validation)))
    changes = {"packed": {settings.validation: 1.0}, "images": images, "augment": UNCHANGED, "emphasis": {}}
    options = settings.data.model_copy(update=changes)
    data = GroupDataset(options, network, _draw, seed=1)
    batch = cache(lambda number: data[number, 0])

    @torch.inference_mode()
    def validate(module: OverlapTraining) -> dict[str, float]:
        device = next(module.parameters()).device
        scores, distances = [], []
        for points, views, poses in map(batch, range(settings.validation_batches)):
            with mixed_precision(device):
                logits, _ = module.logits(*to_device((points, views), device))
            scores.append(logits.cpu().numpy())
            distances.append(pair_distances(poses).numpy())
        positive = np.concatenate(distances) <= OVERLAP
        return {"average_precision": average_precision(np.concatenate(scores), positive)}

    return validate
