# SPDX-License-Identifier: Apache-2.0
"""Objects that move or could move, learned from labeled scans, with the trainer of the tasks but not the SLAM loss."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from pydantic import Field
from torch import Tensor
from torch.nn import functional
from torch.optim.swa_utils import update_bn

from dpm2_core.network.perception.dynamic_objects import DynamicObjectNet, DynamicObjectNetSettings, occupancy, voxels
from dpm2_core.network.precision import mixed_precision
from dpm2_core.network.pretrained import DYNAMIC
from dpm2_core.tasks.figures import dynamic_objects_png
from dpm2_core.tasks.scan import UNCOUNTED, TaskScan, TaskScans, classes_of
from dpm2_core.tasks.task import Task, TaskOptimizer, TaskTraining

MOVABLE = (10, 11, 13, 15, 16, 18, 20, 30, 31, 32)
"""Cars, bicycles, buses, motorcycles, on rails, trucks, other vehicles, people, riders: SemanticKITTI's classes."""
FIRST_MOVING = 252
"""Classes of the same objects while they move have this number and higher ones."""
_MAX_STRETCH = 0.2
_SLOPE_SIGMA = 0.07  # standard deviation along and across
_MAX_SHADOWS, _MAX_MISSING = 8, 0.15  # most shadows in a scan; largest share of its voxels that are left out
_STATISTICS_SCANS = 400  # scans for the statistics

Voxels = tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.int64]]
"""(V,) numbers of the occupied voxels of a scan, ascending, the fraction of their points that can move, and their
number of points."""


class DynamicObjectTraining(TaskTraining):
    """A training of the dynamic objects."""

    network: DynamicObjectNetSettings = DynamicObjectNetSettings()
    """Grid and network."""
    epochs: int = Field(default=14, ge=1)
    window: int = Field(default=2, ge=2)
    batch: int = Field(default=4, ge=1)
    every: int = Field(default=5, ge=1)
    optimiser: TaskOptimizer = TaskOptimizer(rate=3e-3, ema=0.998)
    thin: float = Field(default=0.7, ge=0, lt=1)
    """At most this fraction of a scan's points is left out, drawn each time, as with sparser sensors."""
    paste: float = Field(default=0.5, ge=0, le=1)
    """Probability that the dynamic objects of another scan are put into a scan, rotated about the sensor: they are then
    also where the simulator has none, in front of a hedge or in a yard."""


class DynamicObjectTask(Task):
    """Detection of points of dynamic objects, by their voxels."""

    name = "movers"
    training_type = DynamicObjectTraining
    needs = ("labels",)
    settings: DynamicObjectTraining

    def __init__(self, settings: DynamicObjectTraining) -> None:
        super().__init__(settings)
        self.net = DynamicObjectNet(settings.network)

    def losses(self, window: list[TaskScan]) -> tuple[Tensor, Callable[[], Tensor] | None]:
        """Cross-entropy over the occupied voxels, each weighted with the root of its number of points."""
        network, scans = self.settings.network, [self._voxels(scan) for scan in window]
        samples = [
            _paste_objects(own, others) if torch.rand(()) < self.settings.paste else own
            for own, others in zip(scans, scans[1:] + scans[:1], strict=True)
        ]
        numbers = [number for number, _, _ in samples]
        logits = self.net(occupancy(numbers, network).to(self.device)).flatten(1)
        found = torch.cat([row[torch.from_numpy(w)] for row, w in zip(logits, numbers, strict=True)])
        target = torch.from_numpy(np.concatenate([movable for _, movable, _ in samples])).to(found)
        weight = torch.from_numpy(np.sqrt(np.concatenate([count for _, _, count in samples]))).to(found)
        loss = functional.binary_cross_entropy_with_logits(found, target, weight, reduction="sum")
        return loss / weight.sum().clamp(min=1), None

    def _voxels(self, scan: TaskScan) -> Voxels:
        """Voxels of some of the points of a scan, varied at random; in half of the scans some points are hidden, as by
        objects in front of them."""
        points, movable, counted = _arrays(scan)
        keep = counted & (torch.rand(len(points)).numpy() >= self.settings.thin * float(torch.rand(())))
        if torch.rand(()) < 0.5:
            keep &= ~_is_shadowed(points)
        voxel, inside = voxels(_transform_randomly(points[keep]), self.settings.network)
        numbers, inverse, count = np.unique(voxel[inside], return_inverse=True, return_counts=True)
        fraction = np.bincount(inverse, movable[keep][inside], len(numbers)) / count
        if torch.rand(()) < 0.5:
            seen = torch.rand(len(numbers)).numpy() >= _MAX_MISSING * float(torch.rand(()))
            numbers, fraction, count = numbers[seen], fraction[seen], count[seen]
        return numbers, fraction, count

    def settle(self, scans: TaskScans) -> None:
        """Set the means and variances of the layers to those of whole scans. Training has seen only thinned and mixed
        scans, and on kinds of scans not trained on this costs as much as anything else."""
        network, generator = self.settings.network, torch.Generator().manual_seed(self.settings.optimiser.seed)
        chosen = torch.randperm(len(scans), generator=generator)[:_STATISTICS_SCANS].tolist()
        voxelized = (voxels(_arrays(scans[i])[0], network) for i in chosen)
        grids = (occupancy([voxel[inside]], network).to(self.device) for voxel, inside in voxelized)
        with mixed_precision(self.device):  # as `DynamicObjectNet.probability`
            update_bn(grids, self.net)

    def evaluate(self, scans: TaskScans) -> dict[str, float]:
        """Over all points of all scans: IoU, precision and recall of points that can move, recall of those that do."""
        counts = np.zeros(5)  # right, false, missed, of those that move: right, all
        for i in range(len(scans)):
            scan = scans[i]
            points, movable, counted = _arrays(scan)
            found = (self.net.probability(points) > DYNAMIC) & counted
            assert scan.labels is not None
            moving = (scan.labels >= FIRST_MOVING).cpu().numpy()
            counts += [(found & movable).sum(), (found & ~movable).sum(), (~found & movable & counted).sum(),
                       (found & moving).sum(), moving.sum()]  # fmt: skip
        right, false, missed, right_moving, moving_all = counts
        return {
            "iou": _ratio(right, right + false + missed),
            "precision": _ratio(right, right + false),
            "recall": _ratio(right, right + missed),
            "recall_moving": _ratio(right_moving, moving_all),
        }

    def figure(self, scan: TaskScan, path: Path) -> None:
        """Draw the scan from above, with points found, missed and wrongly found in colors."""
        points, movable, counted = _arrays(scan)
        dynamic_objects_png(path, points[counted], self.net.probability(points)[counted] > DYNAMIC, movable[counted])


def _paste_objects(own: Voxels, others: Voxels) -> Voxels:
    """A scan's own voxels with the dynamic objects among the others, each voxel once."""
    objects = others[1] > 0.5
    numbers = np.concatenate([own[0], others[0][objects]])
    unique, inverse = np.unique(numbers, return_inverse=True)
    movable, count = np.zeros(len(unique)), np.zeros(len(unique), np.int64)
    np.maximum.at(movable, inverse, np.concatenate([own[1], others[1][objects]]))
    np.add.at(count, inverse, np.concatenate([own[2], others[2][objects]]))
    return unique, movable, count


def _arrays(scan: TaskScan) -> tuple[NDArray[np.float32], NDArray[np.bool_], NDArray[np.bool_]]:
    """Finite points (N, 4), which of them can move, and which have a class at all.

    Raises:
        UsageError: as `classes_of`.
    """
    points, labels = scan.points.cpu().numpy(), classes_of(scan, "the moving objects").cpu().numpy()
    finite = np.isfinite(points).all(1)
    points = np.where(finite[:, None], points, np.float32(0))
    return points, np.isin(labels, MOVABLE) | (labels >= FIRST_MOVING), finite & ~np.isin(labels, UNCOUNTED)


def _is_shadowed(points: NDArray[np.float32]) -> NDArray[np.bool_]:
    """Which of the points (N, 4) lie in the shadows of random objects that do not exist: sectors of up to 0.24 rad,
    each from some distance on."""
    azimuth, distance = np.arctan2(points[:, 1], points[:, 0]), np.hypot(points[:, 0], points[:, 1])
    out = np.zeros(len(points), np.bool_)
    for start, width, beyond in torch.rand(int(float(torch.rand(())) * _MAX_SHADOWS), 3).tolist():
        out |= ((azimuth - math.tau * start) % math.tau < 0.04 + 0.2 * width) & (distance > 4 + 30 * beyond)
    return out


def _transform_randomly(points: NDArray[np.float32]) -> NDArray[np.float32]:
    """The points (N, 4) rotated about z by a random angle, mirrored in half of the cases, stretched by up to 20 % and
    tilted. On a slope cars are higher above the lowest point around them, and a network trained without slopes finds
    none there."""
    angle, side = float(torch.rand(())) * 2 * math.pi, 1 if torch.rand(()) < 0.5 else -1
    stretch = 1 + _MAX_STRETCH * (2 * torch.rand(3).numpy() - 1)
    slope = _SLOPE_SIGMA * torch.randn(2).numpy()
    c, s = math.cos(angle), math.sin(angle)
    M = np.array([[c, -side * s, 0], [s, side * c, 0], [*slope, 1]]) * stretch
    return np.concatenate([points[:, :3] @ M.T.astype(np.float32), points[:, 3:]], 1)


def _ratio(part: float, whole: float) -> float:
    return float(part / whole) if whole else math.nan
