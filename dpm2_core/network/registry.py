# SPDX-License-Identifier: Apache-2.0
"""Backbones by name. A point backbone maps a PointBatch to Scales, an image backbone pixels to maps of features."""

from __future__ import annotations

from collections.abc import Callable

from torch import Tensor, nn

from dpm2_core.errors import UsageError
from dpm2_core.extras import needs
from dpm2_core.network.convnext import ConvNeXt, ImagePyramid
from dpm2_core.network.pointnext import PointNeXt
from dpm2_core.network.settings import ImageSettings, PointsSettings

POINT_BACKBONES: dict[str, Callable[[PointsSettings, bool], nn.Module]] = {"pointnext": PointNeXt}
"""Each takes whether its points come with colors, and has `channels`, a list with those of every scale it returns, fine
to coarse."""

IMAGE_BACKBONES: dict[str, Callable[[ImageSettings], nn.Module]] = {
    "convnext": lambda s: ConvNeXt(s.depths, s.channels)
}
"""Each has `channels` and `strides` lists and returns one (B, C, h, w) map a stride, fine to coarse."""


def point_backbone(settings: PointsSettings, painted: bool = False) -> nn.Module:
    """The point backbone that the settings name; `painted`: its points come with colors.

    Raises:
        UsageError: no such backbone.
    """
    if settings.backbone not in POINT_BACKBONES:
        raise UsageError(f"points.backbone {settings.backbone}: want one of {', '.join(POINT_BACKBONES)}")
    return POINT_BACKBONES[settings.backbone](settings, painted)


def image_backbone(settings: ImageSettings) -> ImagePyramid | None:
    """The image backbone that the settings name, with its pyramid; None for `none`.

    Raises:
        UsageError: no such backbone, or timm is asked for and not installed.
    """
    if settings.backbone == "none":
        return None
    if settings.backbone.startswith("timm:"):
        return ImagePyramid(TimmBackbone(settings.backbone.removeprefix("timm:")), settings)
    if settings.backbone not in IMAGE_BACKBONES:
        names = ", ".join(["none", *IMAGE_BACKBONES, "timm:NAME"])
        raise UsageError(f"image.backbone {settings.backbone}: want one of {names}")
    return ImagePyramid(IMAGE_BACKBONES[settings.backbone](settings), settings)


class TimmBackbone(nn.Module):
    """A feature extractor of the timm library, without pretrained weights."""

    def __init__(self, name: str) -> None:
        super().__init__()
        with needs("timm", f"image.backbone timm:{name}"):
            import timm

        try:
            self.model = timm.create_model(name, features_only=True, pretrained=False)
        except (RuntimeError, ValueError) as error:
            raise UsageError(f"image.backbone timm:{name}: {error}") from None
        self.channels: list[int] = self.model.feature_info.channels()
        self.strides: list[int] = self.model.feature_info.reduction()

    def forward(self, x: Tensor) -> list[Tensor]:
        return self.model(x)
