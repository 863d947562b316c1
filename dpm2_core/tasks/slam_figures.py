# SPDX-License-Identifier: Apache-2.0
"""What a task's clouds are worth to a SLAM: the geometric odometry of this project on them, against the true poses."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch

from dpm2_core.data.open import open_source
from dpm2_core.errors import UsageError
from dpm2_core.evaluation.metrics import evaluate
from dpm2_core.frame import Array, Frame
from dpm2_core.slam.build import make_odometry
from dpm2_core.slam.settings import SlamSettings
from dpm2_core.tasks.open import open_scans
from dpm2_core.tasks.semantic_kitti import sequence_folders
from dpm2_core.tasks.task import Task
from dpm2_core.tasks.training import mean_figures

_PERIOD = 100_000_000  # ns between scans


@torch.no_grad()
def slam_figures(task: Task, path: Path) -> dict[str, float]:
    """Of each kind of cloud that the task has: `KIND_ate_m`, `KIND_rpe_m` and `KIND_rpe_deg`, means over the sequences.

    ATE is the root mean square position error after alignment (Umeyama, without scale), RPE the mean error from one
    scan to the next. Loops are not closed.

    Args:
        path: as for `open_scans`, with the true poses of every sequence.

    Raises:
        UsageError: the task makes no clouds, or there are no poses.
    """
    rows = []
    for folder in sequence_folders(path):
        truth = open_source(folder).poses
        scans = open_scans(folder, task.needs)
        if truth is None or len(truth) != len(scans):
            raise UsageError(f"{folder}: no true poses of its {len(scans)} scans; the SLAM cannot be evaluated")
        made = [task.clouds(scans[i].to(task.device)) for i in range(len(scans))]
        if not made[0]:
            raise UsageError(f"{task.name}: makes no clouds that SLAM could run on")
        row: dict[str, float] = {}
        for kind in made[0]:
            figures = evaluate(truth, _odometry([of[kind].cpu().numpy() for of in made]))
            row[f"{kind}_ate_m"] = _number(figures.ape_rmse_m)
            row[f"{kind}_rpe_m"] = _number(figures.rpe_trans_m)
            row[f"{kind}_rpe_deg"] = _number(figures.rpe_rot_deg)
        rows.append(row)
    if not rows:
        raise UsageError(f"{path}: no sequences with poses; want sequences/NN/velodyne and its poses")
    return mean_figures(rows)


def _odometry(clouds: list[np.ndarray]) -> Array:
    """Poses (N, 4, 4) of clouds (M, 3), m."""
    odometry = make_odometry(SlamSettings(registration="geometric"))
    poses = []
    for i, cloud in enumerate(clouds):
        points = np.concatenate([cloud, np.zeros((len(cloud), 1))], 1).astype(np.float32)
        poses.append(odometry.process(Frame(stamp=(i + 1) * _PERIOD, index=i, points=points)).T_odom_lidar)
    return np.stack(poses)


def _number(value: float | None) -> float:
    return float("nan") if value is None else value
