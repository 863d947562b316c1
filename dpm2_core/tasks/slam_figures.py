# SPDX-License-Identifier: Apache-2.0
"""Evaluation of a task's clouds by SLAM: the geometric odometry of this project on them, against the true poses."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from dpm2_core.data.open import open_source
from dpm2_core.data.trajectory import stamps_of
from dpm2_core.errors import UsageError
from dpm2_core.evaluation.metrics import evaluate
from dpm2_core.frame import Array, Frame
from dpm2_core.slam.build import make_odometry
from dpm2_core.slam.settings import SlamSettings
from dpm2_core.tasks.open import folders_of, names_of, open_scans, pairs_of
from dpm2_core.tasks.scan import TaskScans
from dpm2_core.tasks.task import Task
from dpm2_core.tasks.training import mean_figures


@dataclass(frozen=True, eq=False)
class TaskRun:
    """Odometry on each kind of cloud of one sequence: (N, 4, 4) poses by kind, the true ones, and the stamps, ns. These
    follow from the numbers of the scans: missing numbers are a pause."""

    sequence: str
    truth: Array
    poses: dict[str, Array]
    stamps: list[int]


def slam_figures(task: Task, path: Path, sequences: Sequence[str] = ()) -> dict[str, float]:
    """`KIND_ate_m`, `KIND_rpe_m` and `KIND_rpe_deg` of each kind of cloud of the task, means over the sequences.

    ATE is the root mean square position error after alignment (Umeyama, without scale), RPE the mean error from one
    scan to the next. Loops are not closed. `still_...` are those of a pose that never moves.

    Args:
        path: as for `open_scans`, with the true poses of every sequence. sequences: likewise.

    Raises:
        UsageError: the task makes no clouds, or there are no poses.
    """
    return mean_figures([figures_of(run) for run in slam_runs(task, path, sequences)])


def figures_of(run: TaskRun) -> dict[str, float]:
    """The figures of one sequence."""
    row: dict[str, float] = {}
    for kind, poses in {**run.poses, "still": np.tile(np.eye(4), (len(run.truth), 1, 1))}.items():
        figures = evaluate(run.truth, poses, stamps=np.array(run.stamps))
        row[f"{kind}_ate_m"] = _nan_if_none(figures.ape_rmse_m)
        row[f"{kind}_rpe_m"] = _nan_if_none(figures.rpe_trans_m)
        row[f"{kind}_rpe_deg"] = _nan_if_none(figures.rpe_rot_deg)
    return row


@torch.no_grad()
def slam_runs(task: Task, path: Path, sequences: Sequence[str]) -> Iterator[TaskRun]:
    """The odometry on every sequence.

    Raises:
        UsageError: as `slam_figures`.
    """
    found = False
    for name, truth, scans in _sequences_with_poses(task, path, sequences):
        found = True
        clouds, numbers = [], []
        for scan in map(scans.__getitem__, range(len(scans))):
            clouds.append(task.clouds(scan.to(task.device)))
            numbers.append(scan.number)
        if not clouds[0]:
            raise UsageError(f"{task.name}: this task outputs no clouds, which the SLAM needs")
        stamps = stamps_of(np.array(numbers) - numbers[0] + 1).tolist()
        poses = {
            kind: _odometry([scan_clouds[kind].cpu().numpy() for scan_clouds in clouds], stamps) for kind in clouds[0]
        }
        yield TaskRun(name, truth, poses, stamps)
    if not found:
        raise UsageError(f"{path}: no sequences with poses; want sequences/NN/velodyne and their poses")


def _sequences_with_poses(task: Task, path: Path, sequences: Sequence[str]) -> Iterator[tuple[str, Array, TaskScans]]:
    """Name, true poses (N, 4, 4) and scans of every sequence."""
    for pair in pairs_of(path, sequences):
        if (truth := pair.poses) is None:
            raise UsageError(f"{path}: no poses{pair.number}.txt next to the pairs; the SLAM cannot be evaluated")
        yield pair.name, truth, TaskScans([pair])
    for folder in folders_of(path, sequences):
        truth, scans = open_source(folder).poses, open_scans(folder, task.needs)
        if truth is None or len(truth) != len(scans):
            raise UsageError(f"{folder}: no true poses of its {len(scans)} scans; the SLAM cannot be evaluated")
        yield "/".join(names_of(folder, path)), truth, scans


def _odometry(clouds: list[np.ndarray], stamps: list[int]) -> Array:
    """Poses (N, 4, 4) of clouds (M, 3), m, with their stamps, ns."""
    odometry = make_odometry(SlamSettings(registration="geometric"))
    poses = []
    for i, (stamp, cloud) in enumerate(zip(stamps, clouds, strict=True)):
        points = np.concatenate([cloud, np.zeros((len(cloud), 1))], 1).astype(np.float32)
        poses.append(odometry.process(Frame(stamp=stamp, index=i, points=points)).T_odom_lidar)
    return np.stack(poses)


def _nan_if_none(value: float | None) -> float:
    return float("nan") if value is None else value
