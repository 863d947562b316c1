# SPDX-License-Identifier: Apache-2.0
"""The grid returns exactly what a search through all points returns, however they are spread."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.distance import cdist

from dpm2_core.geometry.point_grid import PointGrid


def spread_points(seed: int, count: int) -> np.ndarray:
    """Points that are dense in one region, sparse around it, and a few very far away."""
    rng = np.random.default_rng(seed)
    return rng.normal(size=(count, 3)) * rng.choice([0.3, 3.0, 30.0, 300.0], (count, 1), p=[0.5, 0.3, 0.15, 0.05])


@given(st.integers(0, 10_000), st.integers(1, 400), st.floats(0.05, 20), st.floats(0.01, 400))
def test_nearest_is_exact(seed: int, count: int, cell: float, radius: float) -> None:
    points, queries = spread_points(seed, count), spread_points(seed + 1, 50)
    grid = PointGrid(points, cell)
    found = grid.nearest(queries, radius)
    distance = cdist(queries, points).min(1)
    clear = np.abs(distance - radius) > 1e-9 * radius  # else rounding decides
    assert ((found >= 0) == (distance < radius))[clear].all()
    hit = found >= 0
    np.testing.assert_allclose(
        np.linalg.norm(grid.points[found] - queries, axis=1)[hit], distance[hit], rtol=1e-12, atol=1e-12
    )


@given(st.integers(0, 10_000), st.integers(1, 400), st.floats(0.05, 20), st.integers(1, 20))
def test_neighbors_are_exact_and_nearest_first(seed: int, count: int, cell: float, k: int) -> None:
    points, queries = spread_points(seed, count), spread_points(seed + 1, 50)
    grid, k = PointGrid(points, cell), min(k, count)
    found = grid.neighbors(queries, k)
    assert all(len(set(row)) == k for row in found.tolist())
    distance = np.linalg.norm(grid.points[found] - queries[:, None], axis=2)
    np.testing.assert_allclose(distance, np.sort(cdist(queries, points))[:, :k], rtol=1e-12, atol=1e-12)


@given(st.integers(0, 10_000), st.integers(1, 60), st.floats(0.05, 20), st.integers(1, 20), st.floats(0.01, 100))
def test_neighbors_beyond_the_radius_or_missing_repeat_the_nearest(
    seed: int, count: int, cell: float, k: int, radius: float
) -> None:
    points, queries = spread_points(seed, count), spread_points(seed + 1, 50)
    distance = np.pad(np.sort(cdist(queries, points)), ((0, 0), (0, 20)), constant_values=np.inf)[:, :k]
    expected = np.where(distance <= radius, distance, distance[:, :1])
    grid = PointGrid(points, cell)
    found = np.linalg.norm(grid.points[grid.neighbors(queries, k, radius)] - queries[:, None], axis=2)
    clear = np.abs(distance - radius) > 1e-9 * radius  # else rounding decides
    np.testing.assert_allclose(found[clear], expected[clear], rtol=1e-12, atol=1e-12)


def test_points_come_sorted_with_their_order() -> None:
    points = spread_points(3, 1000)
    grid = PointGrid(points, 0.5)
    np.testing.assert_array_equal(grid.points, points[grid.order])
    assert sorted(grid.order.tolist()) == list(range(1000))


@pytest.mark.parametrize("where", [np.zeros(3), np.array([1e6, -1e6, 1e6])])
def test_equal_points(where: np.ndarray) -> None:
    grid = PointGrid(np.tile(where, (50, 1)), 0.5)
    assert grid.nearest(where[None] + 0.1, 1.0)[0] >= 0
    assert sorted(grid.neighbors(where[None], 50)[0].tolist()) == list(range(50))


def test_a_query_that_is_not_finite_or_far_away_has_no_nearest_point() -> None:
    grid = PointGrid(spread_points(0, 100), 0.5)
    queries = np.array([[np.nan, 0, 0], [0, np.inf, 0], [1e9, 0, 0], [-1e300, 0, 0]])
    assert (grid.nearest(queries, 10.0) == -1).all()


def test_an_empty_cloud() -> None:
    grid = PointGrid(np.zeros((0, 3)), 0.5)
    assert grid.nearest(np.zeros((2, 3)), 1.0).tolist() == [-1, -1]
    with pytest.raises(ValueError, match="empty"):
        grid.neighbors(np.zeros((2, 3)), 3)
