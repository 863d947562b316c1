# SPDX-License-Identifier: Apache-2.0
"""PointNeXt-like point backbone: set abstraction, inverted residual blocks, feature propagation; LayerNorm, ReLU."""

from __future__ import annotations

from itertools import pairwise
from typing import NamedTuple

import torch
from torch import Tensor, nn

from dpm2_core.network.pooling import largest_sums, positions_in_view, use_compiled
from dpm2_core.network.pyramid import PointBatch
from dpm2_core.network.settings import PointsSettings, StageSettings

MOMENTS = 9  # mean (3) and scatter matrix (6) of a neighborhood
COLORS = 4
"""Numbers of a painted point: red, green, blue, 0..1, and whether it is in an image."""


class Scale(NamedTuple):
    """Key-points of one resolution: xyz (B, n, 3) m, features (B, n, C), mask (B, n) True where valid."""

    xyz: Tensor
    features: Tensor
    mask: Tensor


def gather(values: Tensor, index: Tensor) -> Tensor:
    """values (B, n, C) at index (B, ...): (B, ..., C)."""
    batch, n, channels = values.shape
    offset = torch.arange(batch, device=index.device).view(-1, *[1] * (index.ndim - 1)) * n
    flat = (index + offset).reshape(-1)
    return nn.functional.embedding(flat, values.reshape(-1, channels)).view(*index.shape, channels)


def view_axes(xyz: Tensor, view_aligned: bool = True) -> Tensor:
    """Horizontal unit vectors (..., 2) from sensor to points (..., 3); (1, 0) above it, and for all if not aligned."""
    xy = xyz[..., :2]
    length = xy.norm(dim=-1, keepdim=True)
    forward = torch.zeros_like(xy)
    forward[..., 0] = 1
    if not view_aligned:
        return forward
    return torch.where(length > 1e-3, xy / length.clamp(min=1e-3), forward)


def to_view(vectors: Tensor, axis: Tensor) -> Tensor:
    """Rotate vectors (..., 3) into the frames whose x axes are `axis` (..., 2); broadcasts."""
    c, s = axis[..., 0], axis[..., 1]
    x, y, z = vectors.unbind(-1)
    return torch.stack([c * x + s * y, c * y - s * x, z], -1)


def from_view(vectors: Tensor, axis: Tensor) -> Tensor:
    """Inverse of `to_view`."""
    return to_view(vectors, torch.stack([axis[..., 0], -axis[..., 1]], -1))


class ConvNormAct(nn.Sequential):
    """Point-wise linear layer, LayerNorm, ReLU unless `act` is False."""

    def __init__(self, channels_in: int, channels_out: int, act: bool = True) -> None:
        super().__init__(nn.Linear(channels_in, channels_out), nn.LayerNorm(channels_out))
        if act:
            self.append(nn.ReLU())


class Pooled(nn.Module):
    """Linear layer, LayerNorm, ReLU and maximum over neighbors.

    `pool_first` takes the maximum right after the linear layer: k times less to normalize, and the part of the layer
    that reads the neighbor's own features is computed once per point, before it is gathered.
    """

    def __init__(self, channels_in: int, relative: int, channels_out: int, pool_first: bool) -> None:
        super().__init__()
        self.split = (channels_in, relative)
        self.pool_first = pool_first
        self.linear = nn.Linear(channels_in + relative, channels_out)
        self.norm = nn.LayerNorm(channels_out)

    def forward(self, features: Tensor, index: Tensor, relative: Tensor) -> Tensor:
        """features (B, m, C), index (B, n, k) into m, relative (B, n, k, P) positions: (B, n, channels_out)."""
        if not self.pool_first:
            joined = torch.cat([gather(features, index), relative.to(features.dtype)], -1)
            return torch.relu(self.norm(self.linear(joined))).amax(2)
        W_features, W_positions = self.linear.weight.split(self.split, 1)
        projected = nn.functional.linear(features, W_features, self.linear.bias)
        return torch.relu(self.norm(pool_neighbors(projected, index, relative, W_positions)))


def pool_neighbors(projected: Tensor | None, index: Tensor | None, relative: Tensor, weight: Tensor) -> Tensor:
    """Maximum over k of projected[index] + weight @ relative, without keeping the (n, k, C) sums for the gradient.

    projected (B, m, C), index (B, n, k), or None for `relative` alone; relative (B, n, k, P), weight (C, P): (B, n, C).
    """
    if use_compiled(relative):
        return largest_sums(projected, index, relative, weight)
    with torch.no_grad():
        sums = nn.functional.linear(relative, weight)
        if projected is not None and index is not None:
            sums = gather(projected, index).add_(sums)
        best = argmax_neighbor(sums)
    n_positions = relative.shape[-1]
    chosen = relative.gather(2, best[..., None].expand(*best.shape, n_positions))
    out = (chosen * weight).sum(-1)
    if projected is not None and index is not None:
        out = out + projected.gather(1, index.gather(2, best))
    return out


def argmax_neighbor(sums: Tensor) -> Tensor:
    """Index (B, n, C) of the largest of (B, n, k, C) over k < 256.

    `argmax` over an inner dimension is many times slower than `amax` on the CPU, so the lowest bits store the index. A
    NaN may have any bits: the index is kept in range.
    """
    k = torch.arange(sums.shape[2], dtype=torch.int32, device=sums.device)[:, None]
    tagged = sums.float().view(torch.int32).bitwise_and(~255).bitwise_or(k)
    return tagged.view(torch.float32).amax(2).view(torch.int32).bitwise_and(255).clamp(max=sums.shape[2] - 1).long()


class Aggregation(nn.Module):
    """Neighbor features with their relative positions through one layer, then the maximum."""

    def __init__(self, channels_in: int, channels_out: int, radius: float, settings: PointsSettings) -> None:
        super().__init__()
        self.radius = radius
        self.view_aligned = settings.view_aligned
        self.pooled = Pooled(channels_in, 5 if settings.view_aligned else 3, channels_out, settings.pool_first)

    def forward(self, xyz: Tensor, centers: Tensor, features: Tensor, index: Tensor) -> Tensor:
        """xyz (B, m, 3) that begins with centers (B, n, 3), features (B, m, C), index (B, n, k) into m: (B, n, out)."""
        if self.view_aligned and use_compiled(xyz):
            return self.pooled(features, index, positions_in_view(xyz, view_axes(xyz), index, self.radius))
        delta = (gather(xyz, index) - centers[:, :, None]) / self.radius
        if not self.view_aligned:
            return self.pooled(features, index, delta)
        axis = view_axes(centers)[:, :, None]
        neighbor_axis = gather(view_axes(xyz), index)  # the neighbor's own axis; next, in the center's frame
        relative_axis = to_view(torch.cat([neighbor_axis, neighbor_axis[..., :1]], -1), axis)[..., :2]
        return self.pooled(features, index, torch.cat([to_view(delta, axis), relative_axis], -1))


class PatchAbstraction(nn.Module):
    """Stem and first set abstraction, on the neighborhoods of raw points.

    The stem is linear, so it is applied to center and offset separately: the same result without a stem per neighbor.
    """

    def __init__(self, settings: PointsSettings, painted: bool = False) -> None:
        """`painted`: every raw point comes with the color of its pixel, whose weights are zero before training."""
        super().__init__()
        stage = settings.stages[0]
        self.radius, self.far = stage.radius, settings.far
        self.view_aligned, self.pool_first = settings.view_aligned, settings.pool_first
        self.stem = nn.Linear(3, settings.stem)
        self.linear = nn.Linear(settings.stem + 3, stage.channels)
        self.norm = nn.LayerNorm(stage.channels)
        self.moments = ConvNormAct(stage.channels + MOMENTS, stage.channels) if settings.moments else None
        self.paint = nn.Linear(COLORS, stage.channels, bias=False) if painted else None
        if self.paint is not None:
            nn.init.zeros_(self.paint.weight)

    def forward(self, centers: Tensor, patches: Tensor, colors: Tensor | None = None) -> Tensor:
        """centers (B, n, 3), patches (B, n, k, 3), both m, colors (B, n, k, 4) of these points: (B, n, channels)."""
        if self.view_aligned:
            axis = view_axes(centers)
            centers, patches = to_view(centers, axis), to_view(patches, axis[:, :, None])
        local = patches / self.radius
        W_stem, W_position = self.linear.weight.split((self.stem.out_features, 3), 1)
        W_delta = W_position + W_stem @ self.stem.weight * (self.radius / self.far)
        at_center = self.linear(nn.functional.pad(self.stem(centers / self.far), (0, 3)))
        inputs, weight = local, W_delta
        if self.paint is not None:
            painted = local.new_zeros(*local.shape[:-1], COLORS) if colors is None else colors.to(local)
            inputs, weight = torch.cat([local, painted], -1), torch.cat([W_delta, self.paint.weight], 1)
        if self.pool_first:
            out = torch.relu(self.norm(pool_neighbors(None, None, inputs, weight) + at_center))
        else:
            out = nn.functional.linear(inputs, weight) + at_center[:, :, None]
            out = torch.relu(self.norm(out)).amax(2)
        if self.moments is None:
            return out
        return self.moments(torch.cat([out, neighborhood_moments(local).to(out.dtype)], -1))


def neighborhood_moments(local: Tensor) -> Tensor:
    """Mean and scatter of neighborhoods (..., k, 3), the scatter divided by its trace: (..., 9)."""
    mean = local.mean(-2)
    centered = local - mean[..., None, :]
    x, y, z = centered.unbind(-1)
    scatter = torch.stack([(a * b).mean(-1) for a, b in ((x, x), (y, y), (z, z), (x, y), (x, z), (y, z))], -1)
    trace = scatter[..., :3].sum(-1, keepdim=True)
    return torch.cat([mean, scatter / (trace + 1e-4)], -1)


class InvertedResidual(nn.Module):
    """Aggregation among the points of a level, then a point-wise inverted bottleneck, added to the input."""

    def __init__(self, channels: int, radius: float, settings: PointsSettings) -> None:
        super().__init__()
        self.aggregation = Aggregation(channels, channels, radius, settings)
        self.expand = ConvNormAct(channels, 4 * channels)
        self.project = ConvNormAct(4 * channels, channels, act=False)

    def forward(self, xyz: Tensor, features: Tensor, index: Tensor) -> Tensor:
        """xyz (B, n, 3), features (B, n, C), index (B, n, k): (B, n, C)."""
        out = self.project(self.expand(self.aggregation(xyz, xyz, features, index)))
        return torch.relu(out + features)


class FeaturePropagation(nn.Module):
    """Features of a coarse level brought to a fine one by inverse-distance weights, joined with its own."""

    def __init__(self, coarse: int, fine: int, channels: int) -> None:
        super().__init__()
        self.layers = nn.Sequential(ConvNormAct(coarse + fine, channels), ConvNormAct(channels, channels))

    def forward(self, coarse: Scale, fine: Scale, index: Tensor) -> Scale:
        """index (B, n_fine, 3) into the coarse points."""
        delta = gather(coarse.xyz, index) - fine.xyz[:, :, None]
        weight = 1 / ((delta * delta).sum(-1) + 1e-6)
        weight = (weight / weight.sum(-1, keepdim=True)).to(coarse.features.dtype)
        interpolated = (gather(coarse.features, index) * weight[..., None]).sum(2)
        return Scale(fine.xyz, self.layers(torch.cat([interpolated, fine.features], -1)), fine.mask)


class PointNeXt(nn.Module):
    """The backbone; `channels` lists those of the scales it returns, fine to coarse."""

    def __init__(self, settings: PointsSettings, painted: bool = False) -> None:
        super().__init__()
        stages = settings.stages
        self.sizes = [stage.points for stage in stages]
        self.patch = PatchAbstraction(settings, painted)
        self.abstractions = nn.ModuleList(
            Aggregation(before.channels, stage.channels, stage.radius, settings) for before, stage in pairwise(stages)
        )
        self.residuals = nn.ModuleList(nn.ModuleList(self._residuals(stage, settings)) for stage in stages)
        self.channels = [stage.channels for stage in stages]
        self.ups = nn.ModuleList()
        for level in range(len(stages) - 2, len(stages) - 2 - settings.upsample, -1):
            self.ups.append(FeaturePropagation(self.channels[level + 1], self.channels[level], self.channels[level]))

    @staticmethod
    def _residuals(stage: StageSettings, settings: PointsSettings) -> list[InvertedResidual]:
        return [InvertedResidual(stage.channels, radius, settings) for radius in stage.residual_radii]

    def forward(self, batch: PointBatch, colors: Tensor | None = None) -> list[Scale]:
        """All levels, fine to coarse; `colors` as for `PatchAbstraction`."""
        scales: list[Scale] = []
        for level, size in enumerate(self.sizes):
            xyz = batch.xyz[:, :size]
            if level == 0:
                features = self.patch(xyz, batch.patches, colors)
            else:
                finer = scales[-1]
                features = self.abstractions[level - 1](finer.xyz, xyz, finer.features, batch.groups[level - 1])
            for block, index in zip(self.residuals[level], batch.locals[level], strict=True):  # type: ignore[call-overload]
                features = block(xyz, features, index)
            mask = torch.arange(size, device=xyz.device) < batch.valid[:, None]
            scales.append(Scale(xyz, features, mask))
        for step, up in enumerate(self.ups):
            level = len(scales) - 2 - step
            scales[level] = up(scales[level + 1], scales[level], batch.ups[step])
        return scales
