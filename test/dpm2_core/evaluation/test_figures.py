# SPDX-License-Identifier: Apache-2.0
"""The plot of a run shows its data to scale and is written completely."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from dpm2_core.evaluation.figures import trajectory_png
from dpm2_core.geometry import se3

ORANGE = np.array([255, 159, 28])


def _arc(count: int = 80, radius: float = 50.0) -> np.ndarray:
    angle = np.linspace(0, np.pi / 2, count)
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, :2, 3] = radius * np.column_stack([np.sin(angle), 1 - np.cos(angle)])
    return poses


def _cloud(count: int = 20_000) -> np.ndarray:
    rng = np.random.default_rng(0)
    return rng.uniform([-40, -40, -2, 0], [90, 90, 6, 1], (count, 4)).astype(np.float32)


def _picture(path: Path) -> np.ndarray:
    return cv2.cvtColor(cv2.imread(str(path)), cv2.COLOR_BGR2RGB).astype(int)


def _orange(make_image: np.ndarray) -> np.ndarray:
    return np.argwhere(np.abs(make_image - ORANGE).max(-1) < 12)


@pytest.mark.slow
def test_the_trajectory_is_drawn_to_scale_and_the_map_beneath_it(tmp_path: Path) -> None:
    """A quarter circle is as wide as it is high; the map makes dark areas brighter."""
    trajectory_png(tmp_path / "with.png", _arc(), cloud=_cloud(), title="")
    trajectory_png(tmp_path / "without.png", _arc(), title="")
    make_image, bare = _picture(tmp_path / "with.png"), _picture(tmp_path / "without.png")
    # The legend, in the upper right, contains samples of the same color.
    points = _orange(make_image)
    points = points[(points[:, 0] > 0.25 * make_image.shape[0]) | (points[:, 1] < 0.7 * make_image.shape[1])]
    height, width = np.ptp(points, axis=0)
    assert height > 200
    assert width == pytest.approx(height, rel=0.1)
    assert (make_image.max(-1) > 60).mean() > 5 * (bare.max(-1) > 60).mean()


@pytest.mark.slow
def test_the_ground_truth_is_brought_into_the_map_frame(tmp_path: Path) -> None:
    """Ground truth of another world frame, with unknown frames, gives the image of one in the map frame."""
    gt = _arc()
    gt[10:20] = np.nan
    trajectory_png(tmp_path / "near.png", _arc(), gt, _cloud())
    trajectory_png(tmp_path / "far.png", _arc(), se3.exp([0, 0, 2, 5000, -300, 40]) @ gt, _cloud())
    difference = np.abs(_picture(tmp_path / "near.png") - _picture(tmp_path / "far.png"))
    assert (difference > 8).mean() < 1e-3  # alignment leaves 1e-9 m, which may change a pixel at an edge


@pytest.mark.slow
@pytest.mark.parametrize(
    ("est", "cloud"),
    [
        (np.eye(4)[None], None),
        (np.tile(np.eye(4), (5, 1, 1)), np.zeros((0, 4), np.float32)),
        (_arc(), np.full((3, 4), 1e5, np.float32)),
    ],
    ids=["one pose", "standing, empty map", "map out of sight"],
)
def test_a_drive_that_went_nowhere_still_gives_a_image(
    tmp_path: Path, est: np.ndarray, cloud: np.ndarray | None
) -> None:
    trajectory_png(tmp_path / "p.png", est, np.full_like(est, np.nan), cloud)
    assert _picture(tmp_path / "p.png").shape[1] == 1800
    assert [entry.name for entry in tmp_path.iterdir()] == ["p.png"]
