# SPDX-License-Identifier: Apache-2.0
"""ConvNeXt with a feature pyramid (FPN): an image becomes feature pixels of several strides."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor, nn

from dpm2_core.network.settings import ImageSettings


class FeatureMap(NamedTuple):
    """One level: features (B, C, h, w), and the stride in pixels of the resized image."""

    features: Tensor
    stride: int


class ChannelNorm(nn.LayerNorm):
    """LayerNorm over the channels of (B, C, h, w)."""

    def forward(self, x: Tensor) -> Tensor:
        return super().forward(x.permute(0, 2, 3, 1)).permute(0, 3, 1, 2)


class Block(nn.Module):
    """Depth-wise 7x7, LayerNorm, inverted bottleneck with GELU, layer scale, residual."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.depthwise = nn.Conv2d(channels, channels, 7, padding=3, groups=channels)
        self.norm = nn.LayerNorm(channels)
        self.expand = nn.Linear(channels, 4 * channels)
        self.project = nn.Linear(4 * channels, channels)
        self.scale = nn.Parameter(torch.full((channels,), 0.1))

    def forward(self, x: Tensor) -> Tensor:
        out = self.norm(self.depthwise(x).permute(0, 2, 3, 1))
        out = self.project(nn.functional.gelu(self.expand(out))) * self.scale
        return x + out.permute(0, 3, 1, 2)


class ConvNeXt(nn.Module):
    """Stages at strides 4, 8, 16, 32."""

    def __init__(self, depths: tuple[int, ...], channels: tuple[int, ...]) -> None:
        super().__init__()
        self.channels = list(channels)
        self.strides = [4 << i for i in range(len(channels))]
        self.down = nn.ModuleList()
        for i, out in enumerate(channels):
            if i == 0:
                self.down.append(nn.Sequential(nn.Conv2d(3, out, 4, 4), ChannelNorm(out)))
            else:
                self.down.append(nn.Sequential(ChannelNorm(channels[i - 1]), nn.Conv2d(channels[i - 1], out, 2, 2)))
        self.stages = nn.ModuleList(
            nn.Sequential(*(Block(c) for _ in range(depth))) for depth, c in zip(depths, channels, strict=True)
        )

    def forward(self, x: Tensor) -> list[Tensor]:
        """x (B, 3, H, W): (B, C_i, H/4/2^i, W/4/2^i) of each stage."""
        out = []
        for down, stage in zip(self.down, self.stages, strict=True):
            x = stage(down(x))
            out.append(x)
        return out


class ImagePyramid(nn.Module):
    """Any backbone with `channels` and `strides`, then the top-down pathway of an FPN on the requested levels."""

    def __init__(self, backbone: nn.Module, settings: ImageSettings) -> None:
        super().__init__()
        strides: list[int] = list(backbone.strides)  # type: ignore[arg-type]
        channels: list[int] = list(backbone.channels)  # type: ignore[arg-type]
        missing = set(settings.strides) - set(strides)
        if missing:
            raise ValueError(f"image strides {sorted(missing)}: the backbone has {strides}")
        self.first = strides.index(min(settings.strides))
        self.strides = sorted(settings.strides)
        self.chosen = [strides.index(stride) - self.first for stride in self.strides]
        self.backbone = backbone
        width = settings.pyramid
        self.lateral = nn.ModuleList(nn.Conv2d(c, width, 1) for c in channels[self.first :])
        self.smooth = nn.ModuleList(nn.Conv2d(width, width, 3, padding=1) for _ in settings.strides)
        # By numpy: the first product of tensors on the meta device imports torch._dynamo, which takes 2 s.
        for name, value in (("mean", [0.485, 0.456, 0.406]), ("std", [0.229, 0.224, 0.225])):
            scaled = np.array(value, np.float32)[:, None, None] * np.float32(255)
            self.register_buffer(name, torch.tensor(scaled[None]), persistent=False)

    def forward(self, pixels: Tensor) -> list[FeatureMap]:
        """pixels (B, 3, H, W) uint8 RGB: one map per configured stride, fine to coarse."""
        x = (pixels.float() - self.mean) / self.std  # type: ignore[operator]
        maps = self.backbone(x.contiguous(memory_format=torch.channels_last))[self.first :]
        levels = [lateral(level) for lateral, level in zip(self.lateral, maps, strict=True)]
        for i in range(len(levels) - 2, -1, -1):
            up = nn.functional.interpolate(levels[i + 1], levels[i].shape[-2:], mode="nearest")
            levels[i] = levels[i] + up
        return [
            FeatureMap(smooth(levels[i]), stride)
            for smooth, i, stride in zip(self.smooth, self.chosen, self.strides, strict=True)
        ]
