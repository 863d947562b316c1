# SPDX-License-Identifier: Apache-2.0
"""Rays of pixels compared with brute force, and exact where the network multiplies in bf16."""

from __future__ import annotations

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from dpm2_core.frame import R_AHEAD
from dpm2_core.geometry import se3
from dpm2_core.geometry.rays import pixel_rays, point_ray_distance, project
from dpm2_core.geometry.se3_torch import transform
from dpm2_core.network.spatial import point_bias


def _camera() -> tuple[torch.Tensor, torch.Tensor]:
    K = torch.tensor([[[70.0, 0, 62], [0, 71, 33], [0, 0, 1]]], dtype=torch.float64)
    R = Rotation.from_euler("xyz", [0.2, -0.1, 0.3]).as_matrix() @ R_AHEAD
    return K, torch.from_numpy(se3.make(R, [0.3, -0.2, 0.1]))[None]


def test_point_ray_distance_against_brute_force(noise: np.random.Generator) -> None:
    """The distance to a ray is the minimum over points along it. The in-front test is the sign of the nearest point."""
    K, T = _camera()
    points = torch.from_numpy(noise.uniform(-20, 20, (1, 30, 3)))
    uv = torch.from_numpy(noise.uniform(0, 60, (8, 2)))
    origins, directions = pixel_rays(uv, K, T)
    distance, front = point_ray_distance(points, origins, directions)
    along = torch.linspace(-60, 60, 24001, dtype=torch.float64)  # steps of 5 mm: an error of at most 2 um at 1 m
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
    """In bf16, points were up to 0.4 m from their partners, and rays meters from their pixels. Tolerance: float32 at 50
    m."""
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
