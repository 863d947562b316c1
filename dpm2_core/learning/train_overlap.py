# SPDX-License-Identifier: Apache-2.0
"""The overlap training: the overlap head alone, on the frozen network of the registration training, half of the pairs
near, half hard or far."""

from __future__ import annotations

import copy
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from pydantic import Field
from torch import Tensor, nn

from dpm2_core.config import Settings
from dpm2_core.frame import Array
from dpm2_core.learning.checkpoint import load_checkpoint
from dpm2_core.learning.dataset import Batch, GroupDataset, GroupSettings
from dpm2_core.learning.trainer import OptimizerSettings, process_group, train
from dpm2_core.network.encoder import to_device
from dpm2_core.network.losses import overlap_loss
from dpm2_core.network.model import DeepPointMap2
from dpm2_core.network.pose_solver import overlap_features, solve_batch
from dpm2_core.network.pyramid import PointBatch
from dpm2_core.network.settings import NetworkSettings
from dpm2_core.network.spatial import Views
from dpm2_core.network.weights import load_weights, network_settings, save_weights

OVERLAP = 20.0  # m: nearer pairs are positive
HARD = 40.0  # m: half of the negatives lie between OVERLAP and this
FRAMES = 5  # a reference, two near it, one hard negative, one far


class OverlapSettings(GroupSettings):
    """Packed drives, of which frames are drawn that overlap and that do not, see `draw_overlap`."""

    def draw(self, poses: Array, noise: np.random.Generator) -> NDArray[np.intp]:
        return draw_overlap(poses, noise)


class OverlapOptimiserSettings(OptimizerSettings):
    """Optimization at a tenth of the rate and weight decay of the registration training (section 5.1)."""

    steps: int = Field(600, gt=0)
    rate: float = Field(1e-4, gt=0)
    decay: float = Field(1e-5, ge=0)
    warmup: int = Field(20, ge=0)


class OverlapTrainingSettings(Settings):
    """A training of the overlap training; the network is that of the registration training, with all its settings."""

    start: str
    """Weights of the registration training (safetensors)."""
    data: OverlapSettings = OverlapSettings()
    validation: str = ""
    """Folder of packed drives of other worlds; empty: none."""
    validation_batches: int = Field(25, gt=0)
    """Batches of a validation."""
    optimiser: OverlapOptimiserSettings = OverlapOptimiserSettings()


def draw_overlap(poses: Array, noise: np.random.Generator) -> NDArray[np.intp]:
    """Indices (FRAMES,) of a frame, two within OVERLAP m of it, one within HARD m and one beyond.

    poses (n, 4, 4), NaN where unknown. A kind that the drive does not have repeats another kind.
    """
    known = np.flatnonzero(np.isfinite(poses[:, :3, 3]).all(1))
    for _ in range(20):
        first = noise.choice(known)
        distance = np.linalg.norm(poses[known, :3, 3] - poses[first, :3, 3], axis=1)
        near = known[(distance <= OVERLAP) & (known != first)]
        hard = known[(distance > OVERLAP) & (distance <= HARD)]
        far = known[distance > HARD]
        if len(near) and (len(hard) or len(far)):
            break
    near = near if len(near) else np.array([first])
    hard = hard if len(hard) else far if len(far) else near
    far = far if len(far) else hard
    return np.array([first, *noise.choice(near, 2), noise.choice(hard), noise.choice(far)])


class OverlapTraining(nn.Module):
    """The frozen network with a trained overlap head, and its loss."""

    def __init__(self, network: NetworkSettings) -> None:
        super().__init__()
        self.model = DeepPointMap2(network)
        self.model.requires_grad_(False)
        self.model.decoder.overlap.requires_grad_(True)

    def forward(self, points: PointBatch, views: Views | None, distance: Tensor) -> tuple[Tensor, Tensor]:
        """Loss and logits (G * 4,) of each place's first frame with its others, `distance` (G * 4,) m away."""
        with torch.no_grad():
            tokens = self.model.encoder(points, views).tokens
            first = torch.arange(0, len(tokens.xyz), FRAMES, device=distance.device).repeat_interleave(FRAMES - 1)
            other = torch.arange(len(tokens.xyz), device=distance.device).view(-1, FRAMES)[:, 1:].flatten()
            source = tokens._replace(**{name: getattr(tokens, name)[first] for name in tokens._fields})
            target = tokens._replace(**{name: getattr(tokens, name)[other] for name in tokens._fields})
            correlated = self.model.decoder(source, target)
            solved = solve_batch(self.model.decoder, source, target, correlated)
            posed = (
                torch.zeros(len(distance), 2, device=distance.device) if solved is None else overlap_features(solved)
            )
        logits = self.model.decoder.overlap(*correlated, source.mask, target.mask, posed)
        return overlap_loss(logits, distance, OVERLAP), logits


def pair_distances(batch: Batch) -> Tensor:
    """(G * 4,) m between the first frame of each place and the others."""
    t = batch.poses[:, :, :3, 3]
    return (t[:, 1:] - t[:, :1]).norm(dim=-1).flatten().float()


def average_precision(scores: np.ndarray, positive: np.ndarray) -> float:
    """Area under the precision-recall curve as the mean precision at each positive."""
    order = np.argsort(-scores, kind="stable")
    hits = positive[order]
    precision = np.cumsum(hits) / np.arange(1, len(hits) + 1)
    return float(precision[hits].mean()) if hits.any() else float("nan")


def train_overlap(settings: OverlapTrainingSettings, out: Path, resume: bool = False) -> Path:
    """Train; writes checkpoint, log and `weights.safetensors`, the registration training's with the new head, to
    `out`."""
    with process_group() as (rank, world, device):
        torch.manual_seed(settings.optimiser.seed)
        network = network_settings(Path(settings.start))
        module = OverlapTraining(network).to(device)
        about = load_weights(module.model, Path(settings.start))
        ema = copy.deepcopy(module).requires_grad_(False)
        start = load_checkpoint(out / "checkpoint.pt", module, ema, None) if resume else 0
        seed = settings.optimiser.seed
        data = GroupDataset(settings.data, network, seed, start, (rank, world))

        def loss(run: nn.Module, batch: Batch, step: int) -> tuple[Tensor, dict[str, Tensor]]:
            value, _ = run(*to_device((batch.points, batch.views, pair_distances(batch)), device))
            return value, {"loss": value.detach()}

        validate = validator(settings, network, device) if settings.validation and rank == 0 else None
        train(module, ema, iter(data.loader()), loss, settings.optimiser, out, resume, validate, start, rank, device)
        if rank == 0:
            kept = {key: value for key, value in about.items() if key not in ("preset", "network")}
            save_weights(ema.model, out / "weights.safetensors", {**kept, "phase": "2"})
    return out / "weights.safetensors"


def validator(
    settings: OverlapTrainingSettings, network: NetworkSettings, device: torch.device
) -> Callable[[nn.Module], dict[str, float]]:
    """A function that measures the average precision on fixed batches of unseen worlds."""
    options = settings.data.model_copy(update={"packed": {settings.validation: 1.0}})
    data = GroupDataset(options, network, seed=1)
    batches = [data.batch(i) for i in range(settings.validation_batches)]

    @torch.inference_mode()
    def validate(module: nn.Module) -> dict[str, float]:
        scores, distances = [], []
        for batch in batches:
            distance = pair_distances(batch)
            with torch.autocast(device.type, torch.bfloat16):
                _, logits = module(*to_device((batch.points, batch.views, distance), device))
            scores.append(logits.cpu().numpy())
            distances.append(distance.numpy())
        positive = np.concatenate(distances) <= OVERLAP
        return {"average_precision": average_precision(np.concatenate(scores), positive)}

    return validate
