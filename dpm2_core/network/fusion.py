# SPDX-License-Identifier: Apache-2.0
"""Visual-point fusion: reference points and the multi-modal transformer (MMT) with the alternatives of Table 4."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor, nn

from dpm2_core.geometry.corners import TEXTURE
from dpm2_core.network.attention import Attention, RelativeBias, sine_code
from dpm2_core.network.convnext import FeatureMap
from dpm2_core.network.pointnext import Scale, to_view, view_axes
from dpm2_core.network.settings import NetworkSettings
from dpm2_core.network.spatial import (
    image_features,
    point_bias,
    ray_bias,
    sample_at_points,
    seen_from,
    token_pixels,
)
from dpm2_core.network.tokens import Tokens
from dpm2_core.network.views import Views

_WINDOW = 3  # side of the square of samples that roi_pooling reads instead of the image attention


class ReferencePoints(nn.Module):
    """The reference points generator (RPG): positions of the descriptors, and their first features."""

    def __init__(self, settings: NetworkSettings, scale_channels: list[int]) -> None:
        super().__init__()
        fusion, points = settings.fusion, settings.points
        self.n, self.far = fusion.points, points.far
        self.sampled = sampled = fusion.reference in ("salient", "fps")
        self.levels = [
            i
            for i, stage in enumerate(points.stages)
            if fusion.reference_features and sampled and stage.points >= fusion.points
        ]
        if not sampled:
            generator = torch.Generator().manual_seed(0)  # the same positions in every frame: descriptors must repeat
            if fusion.reference == "uniform":
                xyz = torch.rand(self.n, 3, generator=generator) * 2 - 1
            else:
                xyz = torch.randn(self.n, 3, generator=generator) / 3
            self.register_buffer("fixed", xyz * torch.tensor([points.far, points.far, 3.0]))
        channels = 3 + sum(scale_channels[i] for i in self.levels)
        width = settings.channels
        self.embed = nn.Sequential(nn.Linear(channels, width), nn.ReLU(), nn.Linear(width, width))
        self.view_aligned = points.view_aligned

    def forward(self, scales: list[Scale]) -> Tokens:
        """The reference points. Sampled ones are the first points of the finest scale; see `build_pyramid`."""
        finest = scales[0]
        if self.sampled:
            xyz, mask = finest.xyz[:, : self.n], finest.mask[:, : self.n]
        else:
            xyz = self.fixed.expand(len(finest.xyz), -1, -1)  # type: ignore[operator]
            mask = torch.ones_like(xyz[..., 0], dtype=torch.bool)
        axis = view_axes(xyz, self.view_aligned)
        parts = [to_view(xyz, axis) / self.far] + [scales[i].features[:, : self.n] for i in self.levels]
        dtype = parts[-1].dtype
        return Tokens(xyz, self.embed(torch.cat([part.to(dtype) for part in parts], -1)), axis, mask)


class Branch(NamedTuple):
    """Tokens (B, T, C) of one modality, their spatial bias (B, h, N, T) or None, and mask (B, 1, N or 1, T).

    rows: (N,) indices of the reference points that read the tokens; None: all.
    """

    tokens: Tensor
    bias: Tensor | None
    mask: Tensor
    rows: Tensor | None = None


class FusionLayer(nn.Module):
    """Self-attention of reference points, one attention per modality, and an MLP over the three."""

    def __init__(self, settings: NetworkSettings) -> None:
        super().__init__()
        width, fusion = settings.channels, settings.fusion
        learnable = fusion.kind != "without_learnable"
        camera = settings.image.backbone != "none"
        sampled = fusion.kind == "roi_pooling"
        self.self_attention = Attention(width, fusion.heads)
        self.lidar = Attention(width, fusion.heads, learnable)
        has_image_attention = camera and not sampled and fusion.kind != "point_painting"
        self.image = Attention(width, fusion.heads, learnable) if has_image_attention else None
        self.sampled = nn.Linear(width, width) if camera and sampled else None
        self.norms = nn.ModuleList(nn.LayerNorm(width) for _ in range(2))
        self.fuse = nn.Sequential(
            nn.Linear((3 if camera else 2) * width, 2 * width), nn.ReLU(), nn.Linear(2 * width, width)
        )
        spatial = fusion.kind not in ("without_spatial", "scale_dot")
        self.gains = nn.ParameterList()
        if spatial and fusion.learned_gain:
            branches = 1 if self.image is None else 2
            self.gains.extend(nn.Parameter(torch.ones(fusion.heads, 1, 1)) for _ in range(branches))
        self.camera = camera

    def _bias(self, branch: int, bias: Tensor | None) -> Tensor | None:
        return bias * self.gains[branch].to(bias.dtype) if bias is not None and len(self.gains) else bias

    def forward(
        self, references: Tensor, bias_and_mask: tuple[Tensor | None, Tensor], lidar: Branch, image: Branch | None
    ) -> Tensor:
        """references (B, N, C); `bias_and_mask`: of the self-attention."""
        x = self.norms[0](references + self.self_attention(references, references, *bias_and_mask))
        parts = [x, self.lidar(x, lidar.tokens, self._bias(0, lidar.bias), lidar.mask)]
        if self.camera:
            if image is None:
                parts.append(torch.zeros_like(x))
            elif self.sampled is not None:
                parts.append(self.sampled(image.tokens) * image.mask[:, 0, :, :1])
            else:
                parts.append(self._read_image(x, image))
        return self.norms[1](x + self.fuse(torch.cat(parts, -1)))

    def _read_image(self, x: Tensor, image: Branch) -> Tensor:
        """Image attention of reference points x (B, N, C); zeros for those that do not read the image."""
        assert self.image is not None
        bias = self._bias(1, image.bias)
        if image.rows is None:
            return self.image(x, image.tokens, bias, image.mask)
        out = torch.zeros_like(x)
        out[:, image.rows] = self.image(x[:, image.rows], image.tokens, bias, image.mask).to(x.dtype)
        return out


class Fusion(nn.Module):
    """Reference points gather from LiDAR key-points and feature pixels: the descriptors of a frame."""

    def __init__(self, settings: NetworkSettings, scale_channels: list[int]) -> None:
        super().__init__()
        fusion, width = settings.fusion, settings.channels
        self.settings = fusion
        self.references = ReferencePoints(settings, scale_channels)
        self.lidar_in = nn.ModuleList(nn.Linear(scale_channels[i], width) for i in fusion.levels)
        reads_images = settings.image.backbone != "none" and fusion.kind != "point_painting"
        if reads_images:
            self.image_in = nn.Linear(settings.image.pyramid, width)
            self.image_norm = nn.LayerNorm(width)
        self.pixel = None
        if reads_images and fusion.pixel:
            self.pixel = nn.Linear(settings.image.pyramid, settings.channels)
            self.pixel_in = nn.Linear(settings.channels, settings.channels, bias=False)
            nn.init.zeros_(self.pixel_in.weight)  # starts as the network without it
        self.texture = None
        if fusion.corners and fusion.reference == "salient":
            self.texture = nn.Linear(TEXTURE, settings.channels, bias=False)
            nn.init.orthogonal_(self.texture.weight, 4.0)  # half of a descriptor's norm: like patches, like codes
        self.lidar_norm = nn.LayerNorm(width)
        self.layers = nn.ModuleList(FusionLayer(settings) for _ in range(fusion.layers))
        self.relative = RelativeBias(fusion.layers, fusion.heads) if fusion.relative else None
        self.out = nn.Linear(width, settings.channels)

    def forward(self, scales: list[Scale], views: Views | None, maps: list[FeatureMap], texture: Tensor) -> Tokens:
        """scales of the point backbone; views with the feature maps (B * V, C, h, w) of their images, or None; texture
        (B, N, TEXTURE) of the reference points that are image corners, zeros for the others."""
        refs = self.references(scales)
        chosen = [scales[i] for i in self.settings.levels]
        lidar = self._lidar_branch(refs, chosen)
        image = self._image_branch(refs, views, maps) if views is not None else None
        self_mask = refs.mask[:, None, None]
        biases = [None] * len(self.layers) if self.relative is None else self.relative(refs.xyz, refs.axis)
        x = refs.features
        if self.settings.kind == "scale_dot":
            x = x + sine_code(refs.xyz, x.shape[-1])
        for layer, bias in zip(self.layers, biases, strict=True):
            x = layer(x, (bias, self_mask), lidar, image)
        x = self.out(x)
        if self.pixel is not None and views is not None:
            features, seen = image_features(refs.xyz, views, maps)
            pixel_features = nn.functional.normalize(self.pixel(features).float(), dim=-1).to(x.dtype)
            x = x + self.pixel_in(pixel_features) * seen[..., None]
        if self.texture is not None:
            x = x + self.texture(texture.to(x.dtype))
        return refs._replace(features=x)

    def _lidar_branch(self, refs: Tokens, scales: list[Scale]) -> Branch:
        features = torch.cat([project(s.features) for project, s in zip(self.lidar_in, scales, strict=True)], 1)
        xyz, mask = torch.cat([s.xyz for s in scales], 1), torch.cat([s.mask for s in scales], 1)
        features = self.lidar_norm(features)
        bias = None
        if self.settings.kind == "scale_dot":
            features = features + sine_code(xyz, features.shape[-1])
        elif self.settings.kind != "without_spatial":
            bias = point_bias(refs.xyz, xyz, mask, self.settings.alpha_lidar)
        return Branch(features, bias, mask[:, None, None])

    def _image_branch(self, refs: Tokens, views: Views, maps: list[FeatureMap]) -> Branch | None:
        """The branch of the images; None if no reference point is in an image."""
        batch, count = views.present.shape
        kind = self.settings.kind
        uv = token_pixels(maps)
        xyz, rows = refs.xyz, None
        if (
            torch.is_inference_mode_enabled()
            and batch == 1
            and kind != "roi_pooling"
            and self.settings.image_mask == "view"
        ):
            visible = torch.stack([seen_from(xyz, views, view) for view in range(count)]).any(0)[0]
            rows = visible.nonzero()[:, 0]  # about a fourth of them with one image
            if not len(rows):
                return None
            xyz = xyz[:, rows]
        bias, seen = ray_bias(xyz, views, uv, self.settings.alpha_image)
        if kind == "roi_pooling":
            finest = maps[0].features.unflatten(0, (batch, count))[:, 0]
            sampled = sample_at_points(refs.xyz, views, finest, _WINDOW)
            return Branch(self.image_norm(self.image_in(sampled)), None, seen[:, None, :, :1])
        flat = torch.cat([m.features.flatten(2).transpose(1, 2) for m in maps], 1)
        tokens = self.image_norm(self.image_in(flat)).unflatten(0, (batch, count)).flatten(1, 2)
        present = views.present.repeat_interleave(len(uv), 1)[:, None, None]
        if self.settings.image_mask == "view":
            present = seen.repeat_interleave(len(uv), 2)[:, None]
        if kind == "scale_dot":
            tokens = tokens + sine_code(torch.nn.functional.pad(uv / 8, (0, 1)), tokens.shape[-1]).repeat(count, 1)
        spatial = None if kind in ("scale_dot", "without_spatial") else bias
        return Branch(tokens, spatial, present, rows)
