# SPDX-License-Identifier: Apache-2.0
"""Pixels as rays in the LiDAR frame: viewing directions, and distances of points from them (torch)."""

from __future__ import annotations

import torch
from torch import Tensor

from dpm2_core.geometry.full_precision import full_precision


@full_precision
def pixel_rays(uv: Tensor, K: Tensor, T_lidar_cam: Tensor) -> tuple[Tensor, Tensor]:
    """Rays through pixels.

    A direction is only rotated, not translated: the paper's equation 5 prints (u, u, 1, 1) and means (u, v, 1).

    Args:
        uv: (T, 2) pixel coordinates, the center of the first pixel being (0, 0).
        K: (B, 3, 3) intrinsics, pixels.
        T_lidar_cam: (B, 4, 4) camera to LiDAR, m.

    Returns:
        origins (B, 3), m, and unit directions (B, T, 3), both in the LiDAR frame.
    """
    homogeneous = torch.cat([uv, torch.ones_like(uv[:, :1])], -1)
    in_camera = homogeneous @ torch.linalg.inv(K).transpose(-1, -2)
    directions = in_camera @ T_lidar_cam[:, :3, :3].transpose(-1, -2)
    return T_lidar_cam[:, :3, 3], directions / directions.norm(dim=-1, keepdim=True)


@full_precision
def point_ray_distance(points: Tensor, origins: Tensor, directions: Tensor) -> tuple[Tensor, Tensor]:
    """Distance of points from rays, and whether they lie in front.

    The distance is |(r - o) - ((r - o).d) d|; the paper's equation 7 prints the projection length instead.

    Args:
        points: (B, N, 3), m. origins: (B, 3), m. directions: (B, T, 3), unit.

    Returns:
        distances (B, N, T), m, to the line of the ray, and in_front (B, N, T), (r - o).d >= 0.
    """
    relative = points - origins[:, None]
    along = relative @ directions.transpose(-1, -2)
    squared = (relative * relative).sum(-1, keepdim=True) - along * along
    return squared.clamp(min=0).sqrt(), along >= 0


@full_precision
def project(points: Tensor, K: Tensor, T_lidar_cam: Tensor) -> tuple[Tensor, Tensor]:
    """Project LiDAR points into the image.

    Args:
        points: (B, N, 3), m. K: (B, 3, 3), pixels. T_lidar_cam: (B, 4, 4).

    Returns:
        uv (B, N, 2), pixels, and depth (B, N), m along the optical axis; uv is invalid where depth <= 0.
    """
    in_camera = (points - T_lidar_cam[:, None, :3, 3]) @ T_lidar_cam[:, :3, :3]
    depth = in_camera[..., 2]
    image = in_camera @ K.transpose(-1, -2)
    return image[..., :2] / torch.where(depth > 1e-3, depth, torch.ones_like(depth))[..., None], depth
