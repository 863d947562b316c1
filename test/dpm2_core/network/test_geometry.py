# SPDX-License-Identifier: Apache-2.0
"""Sampling, rays and Kabsch against brute force."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from dpm2_core.geometry import se3
from dpm2_core.geometry.kabsch import weighted_kabsch
from dpm2_core.geometry.point_grid import PointGrid
from dpm2_core.geometry.rays import pixel_rays, point_ray_distance, project
from dpm2_core.geometry.sampling import farthest_points, neighbours
from dpm2_core.geometry.se3_torch import transform
from dpm2_core.network.spatial import point_bias


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
    """By a k-d tree of five levels, in plain numpy."""
    points = noise.uniform(-30, 30, (3000, 3)).astype(np.float32)
    cell = points
    for _ in range(5):
        axis = np.ptp(cell, axis=0).argmax()
        low = cell[:, axis] < cell[:, axis].mean()
        cell = cell[low]
    assert points[farthest_points(points, 2, PointGrid(points.astype(float), 1.5))[0]] in cell


def test_neighbors_beyond_the_radius_repeat_the_nearest(noise: np.random.Generator) -> None:
    """Nothing farther than the radius is gathered, also where the cloud is smaller than k."""
    points = noise.uniform(-10, 10, (12, 3)).astype(np.float32)
    index = neighbours(PointGrid(points.astype(float), 2.0), points, 16, 5.0)
    distance = np.linalg.norm(points[index] - points[:, None], axis=2)
    assert index.max() < len(points)
    assert (distance <= 5).all()
    assert (index[:, 0] == np.arange(12)).all()
    for row, true in zip(index, np.linalg.norm(points - points[:, None], axis=2), strict=True):
        assert set(row) == set(np.flatnonzero(true <= 5))


def _camera() -> tuple[torch.Tensor, torch.Tensor]:
    K = torch.tensor([[[70.0, 0, 62], [0, 71, 33], [0, 0, 1]]], dtype=torch.float64)
    R = Rotation.from_euler("xyz", [0.2, -0.1, 0.3]).as_matrix() @ [[0, 0, 1], [-1, 0, 0], [0, -1, 0]]
    return K, torch.from_numpy(se3.make(R, [0.3, -0.2, 0.1]))[None]


def test_point_ray_distance_against_brute_force(noise: np.random.Generator) -> None:
    """The distance to a ray is the least over points along it; the in-front test is the sign of that point."""
    K, T = _camera()
    points = torch.from_numpy(noise.uniform(-20, 20, (1, 30, 3)))
    uv = torch.from_numpy(noise.uniform(0, 60, (8, 2)))
    origins, directions = pixel_rays(uv, K, T)
    distance, front = point_ray_distance(points, origins, directions)
    along = torch.linspace(-60, 60, 24001, dtype=torch.float64)  # steps of 5 mm: at most 2 um of distance off at 1 m
    line = origins[0] + along[:, None, None] * directions[0]
    for n in range(30):
        gaps = (line - points[0, n]).norm(dim=-1)
        least, at = gaps.min(0)
        torch.testing.assert_close(distance[0, n], least, atol=1e-3, rtol=0)
        clear = along[at].abs() > 0.01
        assert (front[0, n] == (along[at] >= 0))[clear].all()


def test_rays_and_projection_are_inverse(noise: np.random.Generator) -> None:
    """A point along the ray of a pixel projects to that pixel; one behind has negative depth."""
    K, T = _camera()
    uv = torch.from_numpy(noise.uniform(0, 120, (20, 2)))
    origins, directions = pixel_rays(uv, K, T)
    back, depth = project(origins[:, None] + 7 * directions, K, T)
    torch.testing.assert_close(back[0], uv, atol=1e-6, rtol=0)
    assert (depth > 0).all()
    assert (project(origins[:, None] - 7 * directions, K, T)[1] < 0).all()


def test_geometry_is_exact_where_the_network_multiplies_in_bf16(noise: np.random.Generator) -> None:
    """bf16 put points up to 0.4 m beside their partners, and rays meters beside pixels. Tolerance: float32 at 50 m."""
    K, T = (value.float() for value in _camera())
    points = torch.from_numpy(noise.uniform(-50, 50, (1, 30, 3))).float()
    uv = torch.from_numpy(noise.uniform(0, 60, (8, 2))).float()
    exact = (*pixel_rays(uv, K, T), *project(points, K, T), transform(T, points))
    distance = point_ray_distance(points, *exact[:2])[0]
    with torch.autocast("cpu", torch.bfloat16):
        rounded = (*pixel_rays(uv, K, T), *project(points, K, T), transform(T, points))
        torch.testing.assert_close(point_ray_distance(points, *exact[:2])[0], distance, atol=1e-3, rtol=1e-5)
        bias = point_bias(points, points, torch.ones(1, 30, dtype=torch.bool), 1.0)
    torch.testing.assert_close(rounded, exact, atol=1e-3, rtol=1e-5)
    assert (bias[0, 0].argmax(-1) == torch.arange(30)).all()


def test_kabsch_is_exact_and_batched(noise: np.random.Generator) -> None:
    """Perfect matches give the transform to rounding, whatever the positive weights."""
    T = torch.from_numpy(se3.exp(noise.normal(0, 1, (5, 6)) * [1, 1, 1, 9, 9, 9]))
    source = torch.from_numpy(noise.normal(0, 10, (5, 40, 3)))
    weights = torch.from_numpy(noise.uniform(0.1, 1, (5, 40)))
    torch.testing.assert_close(weighted_kabsch(source, transform(T, source), weights), T, atol=1e-9, rtol=0)


def test_kabsch_never_reflects(noise: np.random.Generator) -> None:
    """Mirrored and flat point sets still give a rotation."""
    source = torch.from_numpy(noise.normal(0, 10, (2, 40, 3)))
    source[1, :, 2] = 0  # coplanar: without the guard the sign of the normal is open
    target = source * torch.tensor([1.0, 1.0, -1.0])
    T = weighted_kabsch(source, target, torch.ones(2, 40))
    torch.testing.assert_close(torch.linalg.det(T[:, :3, :3]), torch.ones(2, dtype=torch.float64))


def test_kabsch_without_weight_is_finite() -> None:
    """All weights zero give some rigid transform, not NaN."""
    zero = torch.zeros(1, 5, 3)
    assert weighted_kabsch(zero, zero, torch.zeros(1, 5)).isfinite().all()
