# SPDX-License-Identifier: Apache-2.0
"""What moves or could move, learned from labelled scans; of the other tasks it uses the trainer, not the SLAM loss."""

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

from dpm2_core.errors import UsageError
from dpm2_core.network.perception.dynamic_objects import DynamicObjectNet, DynamicObjectNetSettings, occupancy, voxels
from dpm2_core.tasks.ground_task import UNCOUNTED
from dpm2_core.tasks.scan import TaskScan, TaskScans
from dpm2_core.tasks.task import Task, TaskTraining

MOVABLE = (10, 11, 13, 15, 16, 18, 20, 30, 31, 32)
"""Cars, bicycles, buses, motorcycles, on rails, trucks, other vehicles, people, riders: SemanticKITTI's classes."""
FIRST_MOVING = 252
"""The same while they move have this number and higher ones."""


class DynamicObjectTraining(TaskTraining):
    """A training of the dynamic objects."""

    network: DynamicObjectNetSettings = DynamicObjectNetSettings()
    """Grid and network."""
    epochs: int = Field(default=14, ge=1)
    window: int = Field(default=2, ge=2)
    batch: int = Field(default=4, ge=1)
    every: int = Field(default=5, ge=1)
    rate: float = Field(default=3e-3, gt=0)
    drop: float = Field(default=0.7, ge=0, lt=1)
    """At most this fraction of a scan's points is left out, another one each time: sparser sensors."""


class DynamicObjectTask(Task):
    """Points of dynamic objects, by the voxels that they are in."""

    name = "movers"
    training_type = DynamicObjectTraining
    needs = ("labels",)
    settings: DynamicObjectTraining

    def __init__(self, settings: DynamicObjectTraining) -> None:
        super().__init__(settings)
        self.net = DynamicObjectNet(settings.network)

    def losses(self, window: list[TaskScan]) -> tuple[Tensor, Callable[[], Tensor] | None]:
        """Cross-entropy over the occupied voxels, each by the root of how many points it has; turned and mirrored."""
        network, chosen, targets, weights = self.settings.network, [], [], []
        for scan in window:
            points, movable, counted = _arrays(scan)
            keep = counted & (torch.rand(len(points)).numpy() >= self.settings.drop * float(torch.rand(())))
            voxel, inside = voxels(_turned(points[keep]), network)
            where, back, count = np.unique(voxel[inside], return_inverse=True, return_counts=True)
            chosen.append(where)
            targets.append(np.bincount(back, movable[keep][inside], len(where)) / count)
            weights.append(np.sqrt(count))
        logits = self.net(occupancy(chosen, network).to(self.device)).flatten(1)
        found = torch.cat([row[torch.from_numpy(w)] for row, w in zip(logits, chosen, strict=True)])
        target, weight = (torch.from_numpy(np.concatenate(v)).to(found) for v in (targets, weights))
        loss = functional.binary_cross_entropy_with_logits(found, target, weight, reduction="sum")
        return loss / weight.sum().clamp(min=1), None

    def evaluate(self, scans: TaskScans) -> dict[str, float]:
        """Over all points of all scans: IoU, precision and recall of what can move, and recall of what does."""
        counts = np.zeros(5)  # right, false, missed, of those that move: right, all
        for i in range(len(scans)):
            scan = scans[i]
            points, movable, counted = _arrays(scan)
            found = (self.net.probability(points) > 0.5) & counted
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
        """The scan from above, what was found, missed and wrongly found in colors."""
        from dpm2_core.tasks.dynamic_objects_figure import dynamic_objects_png  # matplotlib is slow to import

        points, movable, counted = _arrays(scan)
        dynamic_objects_png(path, points[counted], self.net.probability(points)[counted] > 0.5, movable[counted])


def _arrays(scan: TaskScan) -> tuple[NDArray[np.float32], NDArray[np.bool_], NDArray[np.bool_]]:
    """Finite points (N, 4), which of them can move, and which have a class at all.

    Raises:
        UsageError: the scan has no labels.
    """
    if scan.labels is None:
        raise UsageError(f"{scan.sequence}, scan {scan.number}: no labels; what moves is not known")
    points, labels = scan.points.cpu().numpy(), scan.labels.cpu().numpy()
    finite = np.isfinite(points).all(1)
    points = np.where(finite[:, None], points, np.float32(0))
    return points, np.isin(labels, MOVABLE) | (labels >= FIRST_MOVING), finite & ~np.isin(labels, UNCOUNTED)


def _turned(points: NDArray[np.float32]) -> NDArray[np.float32]:
    """The points (N, 4) turned about z by a random angle, and half of the times mirrored."""
    angle, side = float(torch.rand(())) * 2 * math.pi, 1 if torch.rand(()) < 0.5 else -1
    turn = np.array([[math.cos(angle), -side * math.sin(angle)], [math.sin(angle), side * math.cos(angle)]], np.float32)
    return np.concatenate([points[:, :2] @ turn.T, points[:, 2:]], 1)


def _ratio(part: float, whole: float) -> float:
    return float(part / whole) if whole else math.nan
