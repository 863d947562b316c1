# SPDX-License-Identifier: Apache-2.0
"""Positions of tokens: spatial biases of LiDAR key-points and feature pixels, image features at projected points."""

from __future__ import annotations

import torch
from torch import Tensor

from dpm2_core.geometry.full_precision import full_precision
from dpm2_core.geometry.rays import pixel_rays, point_ray_distance, project
from dpm2_core.network import compiled_bias
from dpm2_core.network.attention import effective_mask, zscore
from dpm2_core.network.convnext import FeatureMap
from dpm2_core.network.precision import product_type
from dpm2_core.network.views import Views


def point_bias(points: Tensor, tokens: Tensor, token_mask: Tensor, alpha: float) -> Tensor:
    """z-score over the tokens of exp(-alpha |p - r|): points (B, N, 3), tokens (B, T, 3): (B, 1, N, T)."""
    distance = _distances(points, tokens)
    return _near_bias(distance, torch.ones_like(distance, dtype=torch.bool), token_mask[:, None], (alpha,))


@full_precision
def _distances(points: Tensor, tokens: Tensor) -> Tensor:
    """(B, N, T), m, of points (B, N, 3) from tokens (B, T, 3)."""
    product = 2 * points @ tokens.transpose(-1, -2)
    squared = (points * points).sum(-1)[..., None] + (tokens * tokens).sum(-1)[:, None] - product
    return squared.clamp(min=1e-6).sqrt()


def _near_bias(distance: Tensor, counted: Tensor, mask: Tensor, alphas: tuple[float, ...]) -> Tensor:
    """The z-scores (B, len(alphas), N, T) of M exp(-alpha distance) over the tokens that the mask shows, and 0 for the
    others; M is 0 where a distance (B, N, T) is not counted. The mask is (B, 1, T or 1).

    bf16 under autocast: the largest tensors of the network, read by every layer.
    """
    if compiled_bias.applies(distance) and effective_mask(mask) is None:
        return compiled_bias.near_bias(distance, counted, alphas)
    alpha = torch.tensor(alphas, device=distance.device).view(1, -1, 1, 1)
    bias = zscore(torch.exp(-alpha * distance[:, None]) * counted[:, None], mask[:, None])
    return bias.to(product_type(bias))


def token_pixels(maps: list[FeatureMap]) -> Tensor:
    """Centers (T, 2) in the resized image of the pixels of all maps, u then v."""
    parts = []
    for features, stride in maps:
        h, w = features.shape[-2:]
        v, u = torch.meshgrid(torch.arange(h), torch.arange(w), indexing="ij")
        parts.append((torch.stack([u, v], -1).reshape(-1, 2) + 0.5) * stride - 0.5)
    return torch.cat(parts).to(maps[0].features.device)


def ray_bias(points: Tensor, views: Views, uv: Tensor, alphas: tuple[float, ...]) -> tuple[Tensor, Tensor]:
    """Bias of feature pixels by the distance of points from their rays.

    Args:
        points: (B, N, 3), m. uv: (T, 2), pixels, the same in every view. alphas: 1/m, one or one per head.

    Returns:
        The z-score of M exp(-alpha distance), (B, len(alphas), N, V * T), where M is 0 for points behind the camera. It
        is taken over the T tokens of each view, so that one camera does not change the bias of another. And `seen`
        (B, N, V), True where the point projects into an image that is present.
    """
    biases, seen = [], []
    for view in range(views.pixels.shape[1]):
        K, T_lidar_cam = views.K[:, view].float(), views.T_lidar_cam[:, view].float()
        distance, front = point_ray_distance(points, *pixel_rays(uv, K, T_lidar_cam))
        biases.append(_near_bias(distance, front, views.present[:, view, None, None], alphas))
        seen.append(seen_from(points, views, view))
    return torch.cat(biases, -1), torch.stack(seen, -1)


def seen_from(points: Tensor, views: Views, view: int) -> Tensor:
    """Which points (B, N, 3) project into a view's image, if it is present: (B, N)."""
    height, width = views.pixels.shape[-2:]
    uv, depth = project(points, views.K[:, view].float(), views.T_lidar_cam[:, view].float())
    inside = (depth > 0.1) & (uv[..., 0] >= 0) & (uv[..., 0] < width) & (uv[..., 1] >= 0) & (uv[..., 1] < height)
    return inside & views.present[:, view, None]


def sample_at_points(points: Tensor, views: Views, features: Tensor, window: int, view: int = 0) -> Tensor:
    """Features of a view's finest map around projected points.

    Args:
        points: (B, N, 3), m. features: (B, C, h, w). window: 1 or 3, side of the square of samples, a map pixel apart.

    Returns:
        (B, N, C), the mean of the window; zero outside the image.
    """
    height, width = views.pixels.shape[-2:]
    uv, depth = project(points, views.K[:, view].float(), views.T_lidar_cam[:, view].float())
    size = torch.tensor([width, height], device=uv.device)
    grid = (uv + 0.5) / size * 2 - 1
    grid = torch.where(depth[..., None] > 0.1, grid, torch.full_like(grid, -9))  # behind the camera: outside
    steps = torch.arange(window, device=uv.device) - window // 2
    shift = torch.stack(torch.meshgrid(steps, steps, indexing="xy"), -1).reshape(-1, 2)
    shift = shift * 2 / torch.tensor(features.shape[:1:-1], device=uv.device)
    samples = torch.nn.functional.grid_sample(
        features.float(), grid[:, :, None] + shift, mode="bilinear", padding_mode="zeros", align_corners=False
    )
    return samples.mean(-1).transpose(1, 2)


def paint(points: Tensor, views: Views) -> Tensor:
    """Colors of points (B, N, 3), m: (B, N, 4) red, green, blue, 0..1, of the first image that shows a point, and 1;
    zeros for a point that no image shows.

    S. Vora et al., "PointPainting: Sequential Fusion for 3D Object Detection", CVPR 2020, with colors for classes.
    """
    out = points.new_zeros(*points.shape[:2], 4)
    for view in range(views.pixels.shape[1]):
        seen = seen_from(points, views, view) & (out[..., 3] == 0)
        pixels = views.pixels[:, view].float() / 255
        sampled = sample_at_points(points, views, torch.cat([pixels, torch.ones_like(pixels[:, :1])], 1), 1, view)
        covered = sampled[..., 3:]  # less than 1 within half a pixel of the border, where zeros are mixed in
        color = torch.cat([sampled[..., :3] / covered.clamp(min=1e-3), torch.ones_like(covered)], -1)
        out = torch.where(seen[..., None], color, out)
    return out


def image_features(points: Tensor, views: Views, maps: list[FeatureMap]) -> tuple[Tensor, Tensor]:
    """Features of the finest maps where points project.

    Args:
        points: (B, N, 3), m.

    Returns:
        (B, N, C), the mean of the views that see the point, zero if none does; and (B, N), whether any does.
    """
    finest = maps[0].features.unflatten(0, tuple(views.present.shape))
    seen = torch.stack([seen_from(points, views, view) for view in range(finest.shape[1])], -1)
    sampled = [sample_at_points(points, views, finest[:, view], 1, view) for view in range(finest.shape[1])]
    total = (torch.stack(sampled, -1) * seen[:, :, None]).sum(-1)
    return (total / seen.sum(-1, keepdim=True).clamp(min=1)).to(finest.dtype), seen.any(-1)
