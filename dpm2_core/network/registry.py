# SPDX-License-Identifier: Apache-2.0
"""Image backbones by name: they compute feature maps from pixels."""

from __future__ import annotations

from torch import Tensor, nn

from dpm2_core.errors import UsageError
from dpm2_core.extras import needs
from dpm2_core.network.convnext import ConvNeXt, ImagePyramid
from dpm2_core.network.settings import ImageSettings


def image_backbone(settings: ImageSettings) -> ImagePyramid | None:
    """The image backbone that the settings name, with its pyramid; None for `none`.

    Raises:
        UsageError: no such backbone, or timm is requested and not installed.
    """
    if settings.backbone == "none":
        return None
    if settings.backbone.startswith("timm:"):
        return ImagePyramid(TimmBackbone(settings.backbone.removeprefix("timm:")), settings)
    if settings.backbone != "convnext":
        raise UsageError(f"image.backbone {settings.backbone}: want one of none, convnext, timm:NAME")
    return ImagePyramid(ConvNeXt(settings.depths, settings.channels), settings)


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
