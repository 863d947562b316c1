# SPDX-License-Identifier: Apache-2.0
"""The attention of a reference point of the network to the image (the paper's Figure 7).

The network stores no attention weights, since that would cost time and memory in every frame. They are computed again
from the inputs of the image attention in the last fusion layer.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from dpm2_core.errors import UsageError
from dpm2_core.evaluation.canvas import BACKGROUND, ESTIMATE, INK, new_figure, save_png
from dpm2_core.frame import Array, Frame
from dpm2_core.geometry.rays import project
from dpm2_core.network.attention import Attention
from dpm2_core.network.encoder import to_device
from dpm2_core.network.images import small_image
from dpm2_core.network.model import DeepPointMap2
from dpm2_core.network.pyramid import build_pyramid, collate, crop
from dpm2_core.network.spatial import seen_from
from dpm2_core.network.views import collate_views


@dataclass(frozen=True, eq=False)
class ImageAttention:
    """What a frame's descriptors read from its first image.

    Attributes:
        pixels: (H, W, 3) uint8, as the network reads it.
        points: (N, 3) reference points, m. uv: (N, 2) their positions in the image, pixels. seen: (N,) whether in it.
        chosen: one of them. heat: (H, W) 0..1, its attention, the mean of all heads, per pixel; 1 is the maximum.
    """

    pixels: NDArray[np.uint8]
    points: Array
    uv: Array
    seen: NDArray[np.bool_]
    chosen: int
    heat: NDArray[np.float32]


@torch.no_grad()  # inference mode computes only the points in the image, with other numbers
def image_attention(model: DeepPointMap2, frame: Frame, point: int | None = None) -> ImageAttention:
    """Attention of one reference point in the last layer; by default of the one nearest to the image center.

    Raises:
        UsageError: weights without a camera or without attention to it, a frame without an image, no such point, or
            none in the image.
    """
    encoder = model.encoder
    attention = None if encoder.fusion is None else encoder.fusion.layers[-1].image
    if encoder.image is None or not isinstance(attention, Attention):
        raise UsageError("these weights have no image attention to show")
    images = [small_image(image, encoder.settings.image) for image in frame.images[:1]]
    views = collate_views([images], encoder.settings.image)
    if views is None:
        raise UsageError(f"frame {frame.index} has no image")
    cloud = crop(frame.points, encoder.settings.points)
    points = collate([build_pyramid(cloud, encoder.settings, images)])
    inputs: list[Any] = []
    hook = attention.register_forward_pre_hook(lambda module, arguments: inputs.append(arguments))
    device = next(model.parameters()).device
    try:
        encoded = encoder(*to_device((points, views), device))
    finally:
        hook.remove()
    views = to_device(views, device)
    xyz = encoded.tokens.xyz
    seen = (seen_from(xyz, views, 0) & encoded.tokens.mask)[0].cpu().numpy()
    projected, _ = project(xyz, views.K[:, 0].float(), views.T_lidar_cam[:, 0].float())
    uv = projected[0].cpu().numpy().astype(np.float64)
    height, width = encoder.settings.image.size
    if point is None:
        if not seen.any():
            raise UsageError(f"no reference point of frame {frame.index} is in its image")
        distance = np.linalg.norm(uv - [width / 2, height / 2], axis=1)
        point = int(np.where(seen, distance, np.inf).argmin())
    elif not 0 <= point < len(seen) or not seen[point]:
        raise UsageError(f"point {point}: want one in the image: {', '.join(map(str, np.flatnonzero(seen)))}")
    weights = attention.weights(*inputs[-1])[0, :, point].mean(0)
    sizes = [m.features.shape[-2:] for m in encoded.maps]
    heat = np.zeros((height, width), np.float32)
    for (h, w), part in zip(sizes, weights.float().cpu().split([h * w for h, w in sizes]), strict=True):
        # Attention per pixel: that of a coarse map is spread over more pixels.
        grid = part.view(h, w).numpy() * (h * w)
        heat += cv2.resize(grid, (width, height), interpolation=cv2.INTER_LINEAR)
    heat /= max(float(heat.max()), 1e-9)
    pixels = views.pixels[0, 0].permute(1, 2, 0).cpu().numpy()
    return ImageAttention(pixels, xyz[0].cpu().numpy().astype(np.float64), uv, seen, point, heat)


def attention_png(path: Path, attentions: Mapping[str, ImageAttention], title: str) -> None:
    """A panel of several networks' attention, one below the other (the paper's Figure 7).

    Raises:
        Dpm2Error: the file could not be written.
    """
    figure = new_figure(figsize=(10, 3.4 * max(1, len(attentions)) + 0.6), dpi=100, facecolor=BACKGROUND)
    for row, (name, attention) in enumerate(attentions.items()):
        axes = figure.add_subplot(len(attentions), 1, 1 + row, facecolor=BACKGROUND)
        draw_attention(axes, attention)
        axes.set_title(f"{name}: {axes.get_title()}", color=INK)
    figure.suptitle(title, color=INK)
    save_png(path, figure)


def draw_attention(axes: Any, attention: ImageAttention) -> None:
    """Draw the image with its reference points, and over it the attention of the chosen one."""
    gray = attention.pixels.mean(2, keepdims=True) / 255 * 0.7
    color = cv2.cvtColor(
        cv2.applyColorMap((255 * attention.heat).astype(np.uint8), cv2.COLORMAP_INFERNO), cv2.COLOR_BGR2RGB
    )
    axes.imshow(gray + (color / 255 - gray) * (0.75 * attention.heat[..., None]))
    distance = np.linalg.norm(attention.points, axis=1)
    axes.scatter(*attention.uv[attention.seen].T, c=distance[attention.seen], cmap="viridis_r", s=14, linewidths=0)
    x, y = attention.uv[attention.chosen]
    axes.plot(x, y, "o", markersize=16, markerfacecolor="none", markeredgecolor=ESTIMATE, markeredgewidth=2)
    axes.set_title(
        f"reference points, near ones light; attention of point {attention.chosen}, "
        f"{distance[attention.chosen]:.1f} m away",
        color=INK,
    )
    axes.set_axis_off()
