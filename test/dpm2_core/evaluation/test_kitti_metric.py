# SPDX-License-Identifier: Apache-2.0
"""The metric equals the development kit's on published results, and the kit's algorithm with its loops."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from dpm2_core.data.trajectory import read_trajectory
from dpm2_core.evaluation.kitti_metric import OFFICIAL_LENGTHS, segment_errors
from dpm2_core.geometry import se3


@pytest.mark.parametrize(
    ("name", "t_err", "r_err"), [("ORB", "0.006997", "0.000044"), ("SPTAM", "0.014870", "0.000097")]
)
def test_the_development_kit_prints_the_same(kitti_excerpt: Path, name: str, t_err: str, r_err: str) -> None:
    gt = read_trajectory(kitti_excerpt / "gt_poses" / "00.txt").poses
    est = read_trajectory(kitti_excerpt / "results" / f"KITTI_00_{name}.txt").poses
    errors = segment_errors(gt, est)
    assert len(errors) == 3283
    mean = errors.mean()
    assert mean is not None
    assert (f"{mean[0]:.6f}", f"{mean[1]:.6f}") == (t_err, r_err)


def _walk(count: int, noise: float, seed: int = 0) -> np.ndarray:
    """A drive of about a meter per frame with gentle turns; every step has errors of `noise` (rad and m)."""
    turns = np.cumsum(np.random.default_rng(7).normal(scale=0.01, size=count))
    xi = np.column_stack([np.zeros((count, 2)), turns * 0.05, np.ones(count), np.zeros((count, 2))])
    steps = se3.exp(xi + np.random.default_rng(seed).normal(scale=noise, size=(count, 6)))
    poses = [np.eye(4)]
    for step in steps[:-1]:
        poses.append(poses[-1] @ step)
    return np.array(poses)


def _as_the_kit_does(gt: np.ndarray, est: np.ndarray, lengths: list[float], step: int) -> list[tuple[float, ...]]:
    """evaluate_odometry.cpp, loop by loop, with numpy's matrix inverse instead of its own."""
    travelled = [0.0]
    for a, b in pairwise(gt):
        travelled.append(travelled[-1] + float(np.sqrt(((a[:3, 3] - b[:3, 3]) ** 2).sum())))
    errors = []
    for first in range(0, len(gt), step):
        for length in lengths:
            last = next((i for i in range(first, len(gt)) if travelled[i] > travelled[first] + length), None)
            if last is None:
                continue
            delta_gt = np.linalg.inv(gt[first]) @ gt[last]
            delta_est = np.linalg.inv(est[first]) @ est[last]
            error = np.linalg.inv(delta_est) @ delta_gt
            angle = np.arccos(np.clip((np.trace(error[:3, :3]) - 1) / 2, -1, 1))
            errors.append((length, np.linalg.norm(error[:3, 3]) / length, angle / length))
    return errors


@pytest.mark.parametrize(("lengths", "step"), [([10.0, 20.0, 50.0], 1), (list(OFFICIAL_LENGTHS), 10)])
def test_agrees_with_the_algorithm_written_as_loops(lengths: list[float], step: int) -> None:
    gt, est = _walk(400, 0.0), _walk(400, 0.003)
    expected = np.array(_as_the_kit_does(gt, est, lengths, step))
    errors = segment_errors(gt, est, lengths)
    assert len(errors) > 20
    # The kit's arc cosine loses half of the digits near zero: 1e-8 rad.
    np.testing.assert_allclose(np.column_stack([errors.length, errors.t_err, errors.r_err]), expected, atol=1e-7)


def test_a_known_scale_error_and_a_known_turn_come_out() -> None:
    gt = np.tile(np.eye(4), (200, 1, 1))
    gt[:, 0, 3] = np.arange(200)
    est = gt.copy()
    est[:, 0, 3] *= 1.02
    mean = segment_errors(gt, est, [50.0]).mean()
    # As in the kit, the segment ends at the first frame beyond 50 m, at 51 m, and its error is divided by 50 m.
    assert mean == pytest.approx((0.02 * 51 / 50, 0.0), abs=1e-12)
    turning = gt @ se3.exp(np.column_stack([np.zeros((200, 2)), 0.001 * np.arange(200), np.zeros((200, 3))]))
    mean = segment_errors(gt, turning, [50.0]).mean()
    assert mean is not None
    assert mean[1] == pytest.approx(0.001 * 51 / 50)


def test_the_world_frame_of_the_estimate_does_not_matter() -> None:
    gt, est = _walk(100, 0.0), _walk(100, 0.003)
    elsewhere = se3.exp([0.3, -0.2, 2.0, 100, -50, 3]) @ est
    np.testing.assert_allclose(segment_errors(gt, elsewhere, [20.0]).t_err, segment_errors(gt, est, [20.0]).t_err)


def test_segments_at_missing_frames_are_left_out_and_the_others_unchanged() -> None:
    gt, est = _walk(100, 0.0), _walk(100, 0.003)
    whole = segment_errors(gt, est, [20.0])
    est[[10, 40]] = np.nan
    holed = segment_errors(gt, est, [20.0])
    assert len(whole) - 4 <= len(holed) < len(whole)
    assert np.isfinite(holed.t_err).all()
    assert set(holed.t_err) <= set(whole.t_err)


def test_a_path_shorter_than_every_length_has_no_figure() -> None:
    errors = segment_errors(_walk(50, 0.0), _walk(50, 0.003))
    assert len(errors) == 0
    assert errors.mean() is None
