# SPDX-License-Identifier: Apache-2.0
"""AE_lidar as a task: a scan through the bottleneck and back, with SLAM on what comes out."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from pydantic import Field
from torch import Tensor

from dpm2_core.diffslam.trajectory_loss import SlamLoss
from dpm2_core.tasks.ae_lidar import AeLidarSettings, LidarAutoencoder
from dpm2_core.tasks.chamfer import chamfer_figures
from dpm2_core.tasks.range_scans import (
    RangeReader,
    RangeScans,
    clouds,
    image_error,
    slam_of,
    variety,
)
from dpm2_core.tasks.scan import TaskScan, TaskScans
from dpm2_core.tasks.task import SlamTaskTraining, Task
from dpm2_core.tasks.training import mean_figures

_LEAST_DIVERGENCE = 5.0
"""Below this the divergence of a VAE costs no less, nats: the codes keep something to say."""


class AeLidarTraining(SlamTaskTraining):
    """A training of AE_lidar."""

    network: AeLidarSettings = AeLidarSettings()
    """Range image and size of the network."""
    epochs: int = Field(default=60, ge=1)
    """Passes over the windows (the original: 150)."""
    divergence_warmup: int = Field(default=150, ge=1)
    """Epochs until the divergence of a VAE counts in full."""
    rate: float = Field(default=5e-4, gt=0)
    """Peak learning rate."""
    batch: int = Field(default=4, ge=1)
    """Windows of a step: means are over more than one place."""
    clip: float = Field(default=1000.0, gt=0)
    """Largest norm of the gradient; the loss is a sum over 20 thousand values."""


class AeLidarTask(Task):
    """Scans to themselves."""

    name = "ae_lidar"
    training_type = AeLidarTraining
    settings: AeLidarTraining

    def __init__(self, settings: AeLidarTraining) -> None:
        super().__init__(settings)
        self.network = LidarAutoencoder(settings.network)
        self.slam_loss = SlamLoss(settings.slam_loss)
        self._ratio = 0.0  # of the divergence that counts
        self._reader = RangeReader(settings.network.image)

    def start_epoch(self, epoch: int) -> None:
        """The divergence counts for more with every epoch."""
        self._ratio = min(1.0, (epoch + 1) / self.settings.divergence_warmup)

    def losses(self, window: list[TaskScan]) -> tuple[Tensor, Callable[[], Tensor] | None]:
        """Sum of absolute errors, and divergence; SLAM on what was made against SLAM on the scans."""
        scans = self._reader.read(window, keep=True)
        made, divergence = self.network(scans.images)
        loss = image_error(made, scans.images)
        if self.settings.network.variational:
            loss = loss + self._ratio * divergence.clamp(min=_LEAST_DIVERGENCE).mean()
        scale = self.settings.network.image.scale
        return loss, lambda: slam_of(self.slam_loss, made, scans, scale, self.windows(len(made)))

    def evaluate(self, scans: TaskScans) -> dict[str, float]:
        """Means over the scans: `chamfer_m` (mean distance, m) and `chamfer` (as DSLR gives it) to the scan, and
        `d_error_m`, the mean error of the distance over ground. And the `variety` of what is made and of the scans,
        `varies_m` and `target_varies_m`."""
        rows, scale = [], self.settings.network.image.scale
        images: dict[str, list[Tensor]] = {"varies_m": [], "target_varies_m": []}
        for index in range(len(scans)):
            true = self._reader.read([scans[index].to(self.device)])
            made = self._made(true)
            images["varies_m"].append(made.images)
            images["target_varies_m"].append(true.images)
            error = (made.images - true.images)[:, 0].abs()[true.masks] * scale
            row = chamfer_figures(clouds(made, scale)[0], clouds(true, scale)[0])
            rows.append(row | {"d_error_m": float(error.mean())})
        return mean_figures(rows) | {name: variety(of, scale) for name, of in images.items()}

    def clouds(self, scan: TaskScan) -> dict[str, Tensor]:
        """The reconstruction and the scan, as range images show them."""
        scans, scale = self._reader.read([scan]), self.settings.network.image.scale
        return {"output": clouds(self._made(scans), scale)[0], "input": clouds(scans, scale)[0]}

    def figure(self, scan: TaskScan, path: Path) -> None:
        """The scan and its reconstruction: range images, and seen from above."""
        from dpm2_core.tasks.range_figure import range_png  # matplotlib is slow to import

        scans = self._reader.read([scan])
        rows = {
            "scan": (scans.images[0], scans.masks[0]),
            "reconstruction": (self._made(scans).images[0], scans.masks[0]),
        }
        range_png(path, rows, self.settings.network.image.scale, f"AE_lidar: {scan.sequence}, scan {scan.number}")

    def _made(self, scans: RangeScans) -> RangeScans:
        """What the network makes of them; a slot has a point where the scan had one."""
        return RangeScans(self.network(scans.images)[0], scans.masks, scans.frames)
