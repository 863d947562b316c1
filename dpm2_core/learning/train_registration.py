# SPDX-License-Identifier: Apache-2.0
"""The registration training, with pairs of frames and with merged sets."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Self

import torch
from pydantic import Field
from torch import Tensor, nn

from dpm2_core.config import Settings
from dpm2_core.evaluation.pair_set import FAR, PairSet
from dpm2_core.learning.checkpoint import WEIGHTS
from dpm2_core.learning.dataset import DataSettings, GroupDataset
from dpm2_core.learning.pair_sampling import SetPairs, merge_tokens, sample_set_pairs
from dpm2_core.learning.registration_loss import LossSettings, registration_loss
from dpm2_core.learning.trainer import OptimizerSettings, Trainer
from dpm2_core.network.encoder import Encoded
from dpm2_core.network.losses import cosine, info_nce, label_pairs
from dpm2_core.network.model import DeepPointMap2
from dpm2_core.network.pointnext import Scale
from dpm2_core.network.pretrained import weights_path
from dpm2_core.network.pyramid import PointBatch
from dpm2_core.network.settings import NetworkSettings, preset
from dpm2_core.network.spatial import image_features
from dpm2_core.network.tokens import Tokens
from dpm2_core.network.views import Views
from dpm2_core.network.weights import load_fitting, load_weights, save_weights


class RegistrationTraining(nn.Module):
    """The network with its loss, as one module, so that it is compiled and distributed as a whole."""

    def __init__(self, network: NetworkSettings, loss: LossSettings, encoder: bool = True) -> None:
        """`encoder`: whether the encoder learns."""
        super().__init__()
        self.loss = loss
        self.model = DeepPointMap2(network)
        self.model.encoder.requires_grad_(encoder)
        self._frozen = not encoder
        channels = self.model.encoder.points.channels
        sizes = [stage.points for stage in network.points.stages]
        self.level = min(range(len(sizes)), key=lambda i: abs(sizes[i] - 256))  # key-points as dense as descriptors
        self.backbone_head = nn.Linear(channels[self.level], network.channels)
        fusion = self.model.encoder.fusion
        self.image_head: nn.Module | None = None
        if network.image.backbone != "none" and not self.model.encoder.painted and loss.image > 0:
            pixel_head = None if fusion is None else fusion.pixel
            self.image_head = nn.Linear(network.image.pyramid, network.channels) if pixel_head is None else pixel_head

    def train(self, mode: bool = True) -> Self:
        """Set the mode; an encoder that does not learn stays in evaluation mode, with its running means."""
        super().train(mode)
        if self._frozen:
            self.model.encoder.eval()
        return self

    def forward(
        self, points: PointBatch, views: Views | None, plans: tuple[SetPairs, ...]
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """Mean loss over the plans, and figures of the first."""
        encoded = self.model.encoder(points, views)  # without a graph if it does not learn
        total, figures = self.pair_loss(encoded.tokens, plans)
        if self.loss.backbone:
            auxiliary = self._backbone_loss(encoded.scales[self.level], plans[0])
            total = total + self.loss.backbone * auxiliary
            figures["backbone"] = auxiliary
        if self.image_head is not None and views is not None:
            auxiliary = self._image_loss(self.image_head, encoded, views, plans[0])
            total = total + self.loss.image * auxiliary
            figures["image"] = auxiliary
        figures["loss"] = total
        return total, {name: value.detach().float() for name, value in figures.items()}

    def pair_loss(self, tokens: Tokens, plans: tuple[SetPairs, ...]) -> tuple[Tensor, dict[str, Tensor]]:
        """Mean over the plans of the losses on descriptors, and figures of the first."""
        total = tokens.features.new_zeros((), dtype=torch.float32)
        figures: dict[str, Tensor] = {}
        view_aligned = self.model.settings.points.view_aligned
        for plan in plans:
            source = merge_tokens(tokens, plan.source, plan.T_source, view_aligned)
            target = merge_tokens(tokens, plan.target, plan.T_target, view_aligned)
            loss, found = registration_loss(self.model.decoder, source, target, plan.T_target_source, self.loss)
            total = total + loss / len(plans)
            figures = figures or found
        return total, figures

    def _backbone_loss(self, scale: Scale, plan: SetPairs) -> Tensor:
        """InfoNCE of the backbone's key-points of single frames."""
        i, j = plan.source[:, 0], plan.target[:, 0]
        features = self.backbone_head(scale.features)
        labels = label_pairs(scale.xyz[i], scale.xyz[j], plan.T_target_source, (scale.mask[i], scale.mask[j]))
        return info_nce(cosine(features[i], features[j]) / self.model.decoder.settings.temperature, labels, False)

    def _image_loss(self, head: nn.Module, encoded: Encoded, views: Views, plan: SetPairs) -> Tensor:
        """InfoNCE of the images' features where the descriptors project: the image branch learns long before the
        fusion uses it."""
        xyz = encoded.tokens.xyz
        features, seen = image_features(xyz, views, encoded.maps)
        features, mask = head(features), encoded.tokens.mask & seen
        i, j = plan.source[:, 0], plan.target[:, 0]
        labels = label_pairs(xyz[i], xyz[j], plan.T_target_source, (mask[i], mask[j]))
        return info_nce(cosine(features[i], features[j]) / self.model.decoder.settings.temperature, labels, False)


class RegistrationTrainingSettings(Settings):
    """The registration training."""

    preset: str = "small"
    """Network preset."""
    network: dict[str, Any] = Field({})
    """Changes to the preset, such as {fusion: {kind: scale_dot}}."""
    data: DataSettings = DataSettings()
    validation: str = ""
    """Folder of packed drives of other worlds, for validation; empty: none."""
    validation_pairs: int = Field(200, gt=0)
    """Frame pairs of a validation."""
    loss: LossSettings = LossSettings()
    optimiser: OptimizerSettings = OptimizerSettings()
    pairs: int = Field(4, gt=0)
    """Frame pairs drawn from each place."""
    sets: float = Field(0.25, ge=0, le=1)
    """Fraction of steps that also register merged sets: one frame to the others, or half to half."""
    start: str = ""
    """Weights to start from, a name or a .safetensors file; empty: random."""
    encoder: bool = True
    """Whether the encoder learns; if not, only the decoder does, for the descriptors that `start` produces."""
    partial: bool = False
    """Load from `start` what fits, if the network differs; the rest is random, and is named in the new weights."""


def set_pairs_of(poses: Tensor, settings: RegistrationTrainingSettings, step: int) -> tuple[SetPairs, ...]:
    """The set pairs that a step registers: frame pairs, and in some steps one pair of merged sets per place."""
    noise = torch.Generator().manual_seed(settings.optimiser.seed * 1_000_003 + step)
    radius, frames = settings.data.radius, poses.shape[1]
    plans = [sample_set_pairs(poses, settings.pairs, (1, 1), radius, noise)]
    if frames > 2 and torch.rand((), generator=noise) < settings.sets:
        sides = (1, frames - 1) if torch.rand((), generator=noise) < 0.5 else (frames // 2, frames - frames // 2)
        plans.append(sample_set_pairs(poses, 1, sides, radius, noise))
    return tuple(plans)


def train_registration(settings: RegistrationTrainingSettings, out: Path) -> Path:
    """Train; checkpoints, log and at the end the averaged weights, `weights.safetensors`, go to `out`."""
    optimizer, weights = settings.optimiser, out / WEIGHTS
    torch.manual_seed(optimizer.seed)
    network = preset(settings.preset, settings.network)
    module = RegistrationTraining(network, settings.loss, settings.encoder)
    random: list[str] = []
    if settings.start and settings.partial:
        random = load_fitting(module.model, weights_path(settings.start))
    elif settings.start:
        load_weights(module.model, weights_path(settings.start))
    data = GroupDataset(settings.data, network, settings.data.draw, optimizer.seed)

    def batches(start: int, rank: int) -> Iterator[tuple[PointBatch, Views | None, tuple[SetPairs, ...]]]:
        for step, (points, views, poses) in enumerate(data.batches(start, rank), start):
            yield points, views, set_pairs_of(poses, settings, step)

    def save(averaged: RegistrationTraining) -> None:
        about = {"phase": "1", "steps": str(optimizer.steps), "images": str(settings.data.images).lower()}
        if settings.partial:
            about |= {"start": Path(settings.start).stem, "random_at_start": ", ".join(random)}
        save_weights(averaged.model, weights, about)

    validate = validator(settings, network) if settings.validation else None
    Trainer(module, batches, optimizer, out, save, validate).run()
    return weights


def validator(
    settings: RegistrationTrainingSettings, network: NetworkSettings
) -> Callable[[RegistrationTraining], dict[str, float]]:
    """A function that measures a module on frame pairs of unseen worlds."""
    data = settings.data
    farthest = max(data.radius, FAR)
    pairs = PairSet(Path(settings.validation), settings.validation_pairs, network, data.images, farthest)
    return lambda module: pairs.measure(module.model)
