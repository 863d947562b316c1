# SPDX-License-Identifier: Apache-2.0
"""GndNet as a task: the height of the ground, from labeled scans and from a SLAM on the points above it."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from pathlib import Path

import torch
from pydantic import Field
from scipy.ndimage import distance_transform_edt
from torch import Tensor

from dpm2_core.diffslam.trajectory_loss import SlamLoss, SlamLossSettings
from dpm2_core.network.perception.gndnet import (
    GroundNet,
    GroundSettings,
    elevation_labels,
    ground_loss,
    ground_metrics,
    obstacle_weight,
)
from dpm2_core.tasks.figures import ground_png
from dpm2_core.tasks.scan import UNCOUNTED, RequiredData, TaskScan, TaskScans, classes_of
from dpm2_core.tasks.task import SlamTaskTraining, Task, TaskTraining
from dpm2_core.tasks.training import mean_figures

GROUND = (40, 44, 48, 49, 60, 72)
"""Road, parking, sidewalk, other ground, lane marking, terrain: SemanticKITTI's classes of the ground."""


class GroundTraining(SlamTaskTraining):
    """A training of GndNet."""

    network: GroundSettings = GroundSettings()
    """Grid, network and loss."""
    slam_loss: SlamLossSettings = SlamLossSettings(warm_start=True)
    """Odometry of the SLAM loss, on the points above the ground: slow to converge from the identity."""
    tilt: float = Field(default=3.0, ge=0, lt=45)
    """Each window is rolled and pitched by up to this, deg (the original: 10)."""
    gaps: float = Field(default=0.0, ge=0, le=1)
    """Weight in the loss of a cell without ground points; its label is that of the nearest cell with some."""
    lift: float = Field(default=0.0, ge=0)
    """Each window is moved up or down by up to this, m: LiDARs on other cars are higher or lower."""


class GroundTask(Task):
    """Elevation of the ground; above it, the clouds of the SLAM loss."""

    name = "gndnet"
    training_type = GroundTraining
    needs = ("labels",)
    settings: GroundTraining

    def __init__(self, settings: GroundTraining) -> None:
        super().__init__(settings)
        self.net = GroundNet(settings.network)
        self.slam_loss = SlamLoss(settings.slam_loss)

    @classmethod
    def learns_from(cls, settings: TaskTraining) -> Sequence[RequiredData]:
        """Labels, unless the SLAM loss can learn from scans without."""
        assert isinstance(settings, GroundTraining)
        return () if settings.slam.gamma > 0 else cls.needs

    def losses(self, window: list[TaskScan]) -> tuple[Tensor, Callable[[], Tensor]]:
        """Loss of the elevation; SLAM on all points, weighted by how far they are above the predicted ground.

        The reference weights the same points by their height above the true ground. In a scan without labels, whose own
        loss is only the curvature, it weights all points with 1.

        Raises:
            UsageError: a scan without labels in a training that has no SLAM loss to learn from it.
        """
        network = self.settings.network
        R, lift = self._random_motion()
        clouds = [scan.points @ R.T + lift for scan in window]
        pairs = [elevation_labels(c, self._ground_mask(scan), network) for c, scan in zip(clouds, window, strict=True)]
        known = torch.stack([known for _, known in pairs])
        labels = torch.stack([filled(label, k) for label, k in pairs])
        elevation = self.net(clouds)

        def slam() -> Tensor:
            xyz = [cloud[:, :3] for cloud in clouds]
            predicted = [obstacle_weight(c, e, network) for c, e in zip(xyz, elevation, strict=True)]
            reference = [
                torch.ones_like(w) if scan.labels is None else obstacle_weight(c, e, network)
                for scan, c, e, w in zip(window, xyz, labels, predicted, strict=True)
            ]
            parts = self.windows(len(xyz))
            return torch.stack([self.slam_loss(xyz[p], xyz[p], predicted[p], reference[p]) for p in parts]).mean()

        cell_weights = known + self.settings.gaps * (~known & known.flatten(1).any(1)[:, None, None])
        loss = ground_loss(elevation, labels, cell_weights, network)
        return loss, slam

    def _ground_mask(self, scan: TaskScan) -> Tensor:
        """Which points (N,) are known to be of the ground."""
        if scan.labels is None and self.settings.slam.gamma > 0:
            return torch.zeros(len(scan.points), dtype=torch.bool, device=scan.points.device)
        return ground_of(scan)[0]

    def _random_motion(self) -> tuple[Tensor, Tensor]:
        """A random roll, pitch and lift: (4, 4) and (4,) that rotate and move points (N, 4)."""
        R = torch.eye(4)
        R[:3, :3] = random_tilt(math.radians(self.settings.tilt))
        lift = torch.tensor([0.0, 0.0, (2 * float(torch.rand(1)) - 1) * self.settings.lift, 0.0])
        return R.to(self.device), lift.to(self.device)

    def evaluate(self, scans: TaskScans) -> dict[str, float]:
        """Means over the scans of `ground_metrics`."""
        rows = []
        for i in range(len(scans)):
            scan = scans[i].to(self.device)
            ground, counted = ground_of(scan)
            elevation = self.net([scan.points])[0]
            rows.append(ground_metrics(scan.points, ground, counted, elevation, self.settings.network))
        return mean_figures(rows)

    def figure(self, scan: TaskScan, path: Path) -> None:
        """Draw the predicted elevation, with the points above it, next to the true one, seen from above."""
        labels, known = elevation_labels(scan.points, ground_of(scan)[0], self.settings.network)
        truth = torch.where(known, labels, torch.nan)
        ground_png(path, self.net([scan.points])[0], truth, scan.points, self.settings.network)


def ground_of(scan: TaskScan) -> tuple[Tensor, Tensor]:
    """Which points (N,) are of the ground, and which have a class at all (N,).

    Raises:
        UsageError: as `classes_of`.
    """
    classes = classes_of(scan, "the ground")
    return torch.isin(classes, classes.new_tensor(GROUND)), ~torch.isin(classes, classes.new_tensor(UNCOUNTED))


def filled(elevation: Tensor, known: Tensor) -> Tensor:
    """The elevation (cells, cells), where unknown that of the nearest known cell; zero if no cell is known."""
    if not bool(known.any()):
        return torch.zeros_like(elevation)
    nearest = distance_transform_edt(~known.cpu().numpy(), return_distances=False, return_indices=True)
    x, y = torch.from_numpy(nearest).long().to(elevation.device)
    return elevation[x, y]


def random_tilt(largest: float) -> Tensor:
    """Rotation (3, 3) by a random roll and pitch of up to `largest`, rad."""
    roll, pitch = ((2 * torch.rand(2) - 1) * largest).tolist()
    a, b, c, d = math.cos(roll), math.sin(roll), math.cos(pitch), math.sin(pitch)
    return torch.tensor([[c, b * d, a * d], [0, a, -b], [-d, b * c, a * c]])
