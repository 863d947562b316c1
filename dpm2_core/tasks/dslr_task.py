# SPDX-License-Identifier: Apache-2.0
"""DSLR as a task: its three stages, the SLAM loss in the third, and its figures."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import torch
from pydantic import Field
from torch import Tensor
from torch.nn import functional

from dpm2_core.diffslam.trajectory_loss import SlamLoss
from dpm2_core.network.perception.dslr import Dslr, DslrSettings
from dpm2_core.tasks.chamfer import chamfer_figures
from dpm2_core.tasks.figures import range_png
from dpm2_core.tasks.range_scans import RangeReader, RangeScans, image_error, slam_of, variety
from dpm2_core.tasks.scan import TaskScan, TaskScans
from dpm2_core.tasks.task import SlamTaskTraining, Task, TaskOptimizer
from dpm2_core.tasks.training import mean_figures

_BATCH = 16
_MOVING_DIFFERENCE = 0.5
"""A slot whose distance differs from that of the static twin by more than this, m, shows a moving object."""


class DslrTraining(SlamTaskTraining):
    """A training of DSLR: epochs of the autoencoder, then of the discriminator, and the rest adversarial."""

    network: DslrSettings = DslrSettings()
    """Range image and size of the networks."""
    autoencoder_epochs: int = Field(default=40, ge=0)
    """Epochs in which encoder and decoder learn static scans (the original: up to 700)."""
    discriminator_epochs: int = Field(default=4, ge=0)
    """Epochs after these, in which the discriminator learns with them (the original: 50)."""
    epochs: int = Field(default=60, ge=1)
    """All epochs, including those of the third stage; only there the SLAM loss is used."""
    adversarial: float = Field(default=10.0, ge=0)
    """Weight of the discriminator's cross entropy relative to the sum of absolute errors of an image."""
    adversarial_shared: bool = False
    """Divide that weight by the number of scans of a step, as the authors do in the third stage: theirs is 10 / 128."""
    static_only: bool = True
    """The autoencoder learns from static scans only. False: from the dynamic ones, too, as the authors' does."""
    batch: int = Field(default=4, ge=1)
    """Windows of a step, so that pairs of codes are of different places, and means are over more than one place."""
    optimiser: TaskOptimizer = TaskOptimizer(clip=1000)  # the loss is a sum over 20 thousand values

    @property
    def third(self) -> int:
        """First epoch of the third stage."""
        return self.autoencoder_epochs + self.discriminator_epochs

    def has_windows(self, epoch: int) -> bool:
        """As `TaskTraining`; in the third stage only."""
        return epoch >= self.third and super().has_windows(epoch)


class DslrTask(Task):
    """Translation of dynamic scans to static ones."""

    name = "dslr"
    training_type = DslrTraining
    needs = ("static",)
    settings: DslrTraining

    def __init__(self, settings: DslrTraining) -> None:
        super().__init__(settings)
        self.network = Dslr(settings.network)
        self.slam_loss = SlamLoss(settings.slam_loss)
        self.stage = 1
        self._reader = RangeReader(settings.network.image)

    def start_epoch(self, epoch: int) -> None:
        """Choose the stage; in the third, everything but the dynamic encoder is frozen, running means included."""
        s, network = self.settings, self.network
        self.stage = 1 if epoch < s.autoencoder_epochs else 2 if epoch < s.third else 3
        if epoch == s.third:
            network.dynamic_encoder.load_state_dict(network.static_encoder.state_dict())
        for module in (network.static_encoder, network.decoder, network.discriminator):
            module.requires_grad_(self.stage < 3).train(self.stage < 3)
        network.dynamic_encoder.requires_grad_(self.stage == 3)

    def losses(self, window: list[TaskScan]) -> tuple[Tensor, Callable[[], Tensor] | None]:
        """Loss of the stage; SLAM on the translated scans against that on the static twins."""
        static = self._reader.read(window, static=True, keep=True)
        network = self.network
        if self.stage == 1 and self.settings.static_only:
            return image_error(network.decoder(network.static_encoder(static.images)), static.images), None
        dynamic = self._reader.read(window, keep=True)
        if self.stage == 1:
            both = torch.cat([static.images, dynamic.images])
            return image_error(network.decoder(network.static_encoder(both)), both), None
        shuffled = torch.randperm(len(window))
        if self.stage == 2:
            static_codes, dynamic_codes = network.static_encoder(torch.cat([static.images, dynamic.images])).chunk(2)
            output = network.decoder(torch.cat([static_codes, dynamic_codes]))
            pair_loss = _adversarial_loss(network.discriminator(static_codes, static_codes[shuffled]), 1.0)
            pair_loss = pair_loss + _adversarial_loss(network.discriminator(static_codes[shuffled], dynamic_codes), 0.0)
            error = image_error(output, torch.cat([static.images, dynamic.images]))
            return error + self.settings.adversarial * pair_loss, None
        with torch.no_grad():
            static_codes = network.static_encoder(static.images)
        dynamic_codes = network.dynamic_encoder(dynamic.images)
        output = network.decoder(dynamic_codes)
        adversarial_loss = _adversarial_loss(network.discriminator(static_codes[shuffled], dynamic_codes), 1.0)

        def slam() -> Tensor:
            return slam_of(self.slam_loss, output, static, self.windows(len(output)))

        weight = self.settings.adversarial / (len(window) if self.settings.adversarial_shared else 1)
        return image_error(output, static.images) + weight * adversarial_loss, slam

    def evaluate(self, scans: TaskScans) -> dict[str, float]:
        """Means over the scans.

        `chamfer_m` (mean distance, m) and `chamfer` (as DSLR gives it) of the translated scans to the static twins.
        `moved_m`: the mean error of the distance where something moves. `input_...`: the same without translation.
        `varies_m` and `target_varies_m`: the `variety` of the translated scans and of the twins.
        """
        rows, pairs = [], list[tuple[RangeScans, RangeScans]]()
        for begin in range(0, len(scans), _BATCH):
            batch = [scans[i].to(self.device) for i in range(begin, min(begin + _BATCH, len(scans)))]
            dynamic, static = self._reader.read(batch), self._reader.read(batch, static=True)
            output = self._translate(dynamic)
            pairs.append((output, static))
            for i in range(len(batch)):
                twin = static.part(i, i + 1)
                row = _scan_figures(output.part(i, i + 1), dynamic.part(i, i + 1), twin)
                unchanged = _scan_figures(dynamic.part(i, i + 1), dynamic.part(i, i + 1), twin)
                rows.append(row | {f"input_{name}": value for name, value in unchanged.items()})
        found, target = zip(*pairs, strict=True)
        return mean_figures(rows) | {"varies_m": variety(found), "target_varies_m": variety(target)}

    def clouds(self, scan: TaskScan) -> dict[str, Tensor]:
        """Points (N, 3), m, as range images show them: `output`, the translated scan, `kept`, points of the scan that
        `Dslr.in_front` keeps, `input`, the scan, and `target`, its static twin."""
        dynamic, static = self._reader.read([scan]), self._reader.read([scan], static=True)
        output = self._translate(dynamic)
        moving = self.network.in_front(dynamic.images[:, 0], output.images[:, 0])
        kept = replace(dynamic, masks=dynamic.masks & ~moving)
        kinds = {"output": output, "kept": kept, "input": dynamic, "target": static}
        return {name: range_scans.clouds()[0] for name, range_scans in kinds.items()}

    def figure(self, scan: TaskScan, path: Path) -> None:
        """The scan, its translation and its static twin: range images, and seen from above."""
        dynamic, static = self._reader.read([scan]), self._reader.read([scan], static=True)
        rows = {"scan": dynamic, "translated": self._translate(dynamic), "static twin": static}
        range_png(path, rows, f"DSLR: {scan.sequence}, scan {scan.number}")

    def _translate(self, dynamic: RangeScans) -> RangeScans:
        """The translated scans; a slot has a point if the scan had one there."""
        return dynamic.with_images(self.network(dynamic.images))


def _scan_figures(result: RangeScans, dynamic: RangeScans, static: RangeScans) -> dict[str, float]:
    """Figures of one scan's translation against its static twin."""
    is_moving = dynamic.masks & static.masks & (dynamic.off(static) > _MOVING_DIFFERENCE)
    error = float(result.off(static)[is_moving].mean())
    return chamfer_figures(result.clouds()[0], static.clouds()[0]) | {"moved_m": error}


def _adversarial_loss(logits: Tensor, requested: float) -> Tensor:
    return functional.binary_cross_entropy_with_logits(logits, torch.full_like(logits, requested))
