# SPDX-License-Identifier: Apache-2.0
"""From a frame to its descriptors."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from dpm2_core.descriptors import Descriptors, levelling
from dpm2_core.errors import Dpm2Error
from dpm2_core.frame import Frame, Image
from dpm2_core.geometry.scale import scale_of
from dpm2_core.geometry.tilt import tilt_of
from dpm2_core.network.convnext import FeatureMap
from dpm2_core.network.fusion import Fusion
from dpm2_core.network.images import in_encoded_axes, small_image
from dpm2_core.network.pointnext import PointNeXt, Scale, view_axes
from dpm2_core.network.precision import mixed_precision
from dpm2_core.network.pyramid import PointBatch, build_pyramid, collate, crop
from dpm2_core.network.registry import image_backbone
from dpm2_core.network.settings import NetworkSettings
from dpm2_core.network.spatial import paint
from dpm2_core.network.tokens import Tokens
from dpm2_core.network.views import Views, collate_views


class Encoded(NamedTuple):
    """Descriptors of a batch, and what the auxiliary losses read: key-points, and feature maps of the images."""

    tokens: Tokens
    scales: list[Scale]
    maps: list[FeatureMap]


class Encoder(nn.Module):
    """Point backbone, image backbone and visual-point fusion."""

    def __init__(self, settings: NetworkSettings) -> None:
        super().__init__()
        self.settings = settings
        self.painted = settings.fusion.kind == "point_painting" and settings.image.backbone != "none"
        self.points = PointNeXt(settings.points, self.painted)
        # A painted cloud carries its colors through the point backbone; images are read, but have no features.
        self.image: nn.Module | None = nn.Identity() if self.painted else image_backbone(settings.image)
        channels = self.points.channels
        self.fusion = Fusion(settings, channels) if settings.fusion.kind != "none" else None
        self.level = len(channels) - 1 - settings.points.upsample  # descriptors of the version without fusion
        if self.fusion is None and channels[self.level] != settings.channels:
            raise ValueError(f"level {self.level} has {channels[self.level]} channels, descriptors {settings.channels}")

    def forward(self, points: PointBatch, views: Views | None = None) -> Encoded:
        """Encode a batch; `views` is None if no frame of it has an image."""
        if self.image is None:
            views = None
        scales = self.points(points, self._colors(points, views)) if self.painted else self.points(points)
        if self.fusion is None:
            scale = scales[self.level]
            axis = view_axes(scale.xyz, self.settings.points.view_aligned)
            return Encoded(Tokens(scale.xyz, scale.features, axis, scale.mask), scales, [])
        maps = []
        if self.painted:
            views = None
        if views is not None and self.image is not None:
            maps = self.image(views.pixels.flatten(0, 1))
        return Encoded(self.fusion(scales, views, maps, points.texture), scales, maps)

    @staticmethod
    def _colors(points: PointBatch, views: Views | None) -> Tensor | None:
        """Colors (B, n, k, 4) of every raw point of the first neighborhoods; None without images."""
        if views is None:
            return None
        raw = points.xyz[:, : points.patches.shape[1], None] + points.patches
        return paint(raw.flatten(1, 2), views).unflatten(1, raw.shape[1:3])

    @torch.inference_mode()
    def encode(self, frame: Frame) -> Descriptors:
        """Descriptors of one frame, from its raw points and its images, if any.

        Those of a tilted sensor are computed in leveled axes, from its mounting (`Frame.up`) and the ground; those of a
        room as if it had the size of a street.

        Raises:
            Dpm2Error: too few points in range, or the result is not finite.
        """
        cloud, scale = crop(frame.points, self.settings.points), scale_of(frame.points)
        images = [small_image(image, self.settings.image) for image in frame.images] if self.image is not None else []
        up = tilt_of(cloud, frame.up)
        if scale != 1:
            cloud = crop(frame.points[:, :3] * np.float32(scale), self.settings.points)
        if up is None and scale == 1:
            return self._encode(cloud, images)
        R = levelling(up)
        views = [in_encoded_axes(image, R, scale) for image in images]
        descriptors = self._encode(np.ascontiguousarray(cloud @ R.T), views)
        return replace(descriptors, xyz=descriptors.xyz @ R / np.float32(scale), up=up, scale=scale)

    def _encode(self, cloud: NDArray[np.float32], images: Sequence[Image]) -> Descriptors:
        """Descriptors of a cropped (M, 3) cloud, in its own axes."""
        points = collate([build_pyramid(cloud, self.settings, images)])
        views = collate_views([images], self.settings.image)
        descriptors = self.encode_batch(points, views)[0]
        if not np.isfinite(descriptors.step).all():
            raise Dpm2Error(
                "the network's descriptors are not finite: the weights are damaged, or a library fails on this machine"
            )
        return descriptors

    @torch.inference_mode()
    def encode_batch(self, points: PointBatch, views: Views | None) -> list[Descriptors]:
        """Descriptors of a batch of prepared frames."""
        device = next(self.parameters()).device
        with mixed_precision(device):
            tokens = self(*to_device((points, views), device)).tokens
        xyz, features, mask = (field.cpu() for field in (tokens.xyz, tokens.features.float(), tokens.mask))
        return [Descriptors.of(x[m].numpy(), f[m].numpy()) for x, f, m in zip(xyz, features, mask, strict=True)]


def to_device(batch: Any, device: torch.device | str) -> Any:
    """Move all items that have a method `to`, in arbitrarily nested tuples and lists."""
    if isinstance(batch, tuple | list):
        moved = [to_device(item, device) for item in batch]
        return type(batch)(*moved) if hasattr(batch, "_fields") else type(batch)(moved)
    return batch.to(device) if hasattr(batch, "to") else batch
