# SPDX-License-Identifier: Apache-2.0
"""AE_lidar as a task: a scan through the bottleneck and back, with SLAM on the reconstruction."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from pydantic import Field
from torch import Tensor

from dpm2_core.diffslam.trajectory_loss import SlamLoss
from dpm2_core.tasks.ae_lidar import AeLidarSettings, LidarAutoencoder
from dpm2_core.tasks.chamfer import chamfer_figures
from dpm2_core.tasks.figures import range_png
from dpm2_core.tasks.range_scans import RangeReader, RangeScans, image_error, slam_of, variety
from dpm2_core.tasks.scan import TaskScan, TaskScans
from dpm2_core.tasks.task import SlamTaskTraining, Task, TaskOptimizer
from dpm2_core.tasks.training import mean_figures

_MIN_DIVERGENCE = 5.0
"""Below this a smaller divergence of a VAE does not reduce the loss, nats: the codes keep some information."""


class AeLidarTraining(SlamTaskTraining):
    """A training of AE_lidar."""

    network: AeLidarSettings = AeLidarSettings()
    """Range image and size of the network."""
    epochs: int = Field(default=60, ge=1)
    """Passes over the windows (the original: 150)."""
    divergence_warmup: int = Field(default=150, ge=1)
    """Epochs until the divergence of a VAE counts in full."""
    optimiser: TaskOptimizer = TaskOptimizer(rate=5e-4, clip=1000)  # the loss is a sum over 20 thousand values
    batch: int = Field(default=4, ge=1)
    """Windows of a step: means are over more than one place."""


class AeLidarTask(Task):
    """Reconstruction of scans."""

    name = "ae_lidar"
    training_type = AeLidarTraining
    settings: AeLidarTraining

    def __init__(self, settings: AeLidarTraining) -> None:
        super().__init__(settings)
        self.network = LidarAutoencoder(settings.network)
        self.slam_loss = SlamLoss(settings.slam_loss)
        self._divergence_weight = 0.0  # share of the divergence that counts
        self._reader = RangeReader(settings.network.image)

    def start_epoch(self, epoch: int) -> None:
        """Increase the weight of the divergence with every epoch."""
        self._divergence_weight = min(1.0, (epoch + 1) / self.settings.divergence_warmup)

    def losses(self, window: list[TaskScan]) -> tuple[Tensor, Callable[[], Tensor] | None]:
        """Sum of absolute errors, and divergence; SLAM on the reconstructions against SLAM on the scans."""
        scans = self._reader.read(window, keep=True)
        output, divergence = self.network(scans.images)
        loss = image_error(output, scans.images)
        if self.settings.network.variational:
            loss = loss + self._divergence_weight * divergence.clamp(min=_MIN_DIVERGENCE).mean()
        return loss, lambda: slam_of(self.slam_loss, output, scans, self.windows(len(output)))

    def evaluate(self, scans: TaskScans) -> dict[str, float]:
        """Means over the scans: `chamfer_m` (mean distance, m) and `chamfer` (as DSLR gives it) to the scan, and
        `d_error_m`, the mean error of the distance over ground. And the `variety` of the reconstructions and of the
        scans, `varies_m` and `target_varies_m`."""
        rows, pairs = [], list[tuple[RangeScans, RangeScans]]()
        for index in range(len(scans)):
            true = self._reader.read([scans[index].to(self.device)])
            output = self._reconstruct(true)
            pairs.append((output, true))
            row = chamfer_figures(output.clouds()[0], true.clouds()[0])
            rows.append(row | {"d_error_m": float(output.off(true)[true.masks].mean())})
        found, target = zip(*pairs, strict=True)
        return mean_figures(rows) | {"varies_m": variety(found), "target_varies_m": variety(target)}

    def clouds(self, scan: TaskScan) -> dict[str, Tensor]:
        """The reconstruction and the scan, as range images show them."""
        scans = self._reader.read([scan])
        return {"output": self._reconstruct(scans).clouds()[0], "input": scans.clouds()[0]}

    def figure(self, scan: TaskScan, path: Path) -> None:
        """The scan and its reconstruction: range images, and seen from above."""
        scans = self._reader.read([scan])
        rows = {"scan": scans, "reconstruction": self._reconstruct(scans)}
        range_png(path, rows, f"AE_lidar: {scan.sequence}, scan {scan.number}")

    def _reconstruct(self, scans: RangeScans) -> RangeScans:
        """The reconstructions of scans; a slot has a point if the scan had one there."""
        return scans.with_images(self.network(scans.images)[0])
