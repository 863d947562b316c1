# SPDX-License-Identifier: Apache-2.0
"""Farthest points and neighbors compared with brute force."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from dpm2_core.geometry.point_grid import PointGrid
from dpm2_core.geometry.sampling import evenly, farthest_points, neighbours


@pytest.mark.parametrize(("count", "most"), [(0, 5), (1, 1), (7, 1), (7, 7), (7, 9), (8, 7), (100_001, 100_000)])
def test_some_of_a_row_are_different_ones_from_its_first_to_its_last(count: int, most: int) -> None:
    some = evenly(count, most)
    assert len(some) == min(count, most)
    assert (np.diff(some) > 0).all()
    assert set(some[:1]) <= {0}
    assert most == 1 or set(some[-1:]) <= {count - 1}


@pytest.mark.parametrize("n", [5, 200, 3000])
def test_farthest_points_are_greedy(noise: np.random.Generator, n: int) -> None:
    """Each point is the farthest from those before; a shorter sampling is a prefix; no index repeats."""
    points = noise.uniform(-30, 30, (n, 3)).astype(np.float32)
    grid = PointGrid(points.astype(float), 1.5)
    order = farthest_points(points, 40, grid)
    assert len(order) == len(set(order)) == min(n, 40)
    nearest = np.full(n, np.inf)
    for before, chosen in pairwise(order):
        nearest = np.minimum(nearest, np.linalg.norm(points - points[before], axis=1))
        assert nearest[chosen] == pytest.approx(nearest.max(), rel=1e-5)  # float32 ties
    assert (farthest_points(points, 20, grid) == order[:20]).all()
    assert (farthest_points(points, 40, PointGrid(points.astype(float), 9.0)) == order).all()


def test_the_sampling_starts_where_that_of_the_training_did(noise: np.random.Generator) -> None:
    """Computed with a k-d tree of five levels, in plain numpy."""
    points = noise.uniform(-30, 30, (3000, 3)).astype(np.float32)
    cell = points
    for _ in range(5):
        axis = np.ptp(cell, axis=0).argmax()
        low = cell[:, axis] < cell[:, axis].mean()
        cell = cell[low]
    assert points[farthest_points(points, 2, PointGrid(points.astype(float), 1.5))[0]] in cell


def test_neighbors_beyond_the_radius_repeat_the_nearest(noise: np.random.Generator) -> None:
    """No point farther than the radius is returned, even if the cloud has fewer than k points."""
    points = noise.uniform(-10, 10, (12, 3)).astype(np.float32)
    index = neighbours(PointGrid(points.astype(float), 2.0), points, 16, 5.0)
    distance = np.linalg.norm(points[index] - points[:, None], axis=2)
    assert index.max() < len(points)
    assert (distance <= 5).all()
    assert (index[:, 0] == np.arange(12)).all()
    for row, true in zip(index, np.linalg.norm(points - points[:, None], axis=2), strict=True):
        assert set(row) == set(np.flatnonzero(true <= 5))
