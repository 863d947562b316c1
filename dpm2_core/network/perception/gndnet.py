# SPDX-License-Identifier: Apache-2.0
"""GndNet (Paigwar et al., IROS 2020): the height of the ground in a grid around the sensor, from one scan.

Pillars of points, a feature of each by a small network and a maximum, and an encoder-decoder over the grid. Points are
scattered into the grid one by one, so that a pillar may have any number of them; the original takes at most 100.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Literal

import torch
from pydantic import Field
from torch import Tensor, nn
from torch.nn import functional

from dpm2_core.config import Settings
from dpm2_core.errors import UsageError
from dpm2_core.network.perception.task_weights import load_network


class GroundSettings(Settings):
    """Grid, network and loss of the ground."""

    cells: int = Field(default=100, ge=8, multiple_of=4)
    """Cells of the grid along x and along y; the sensor is at its center."""
    cell: float = Field(default=1.0, gt=0)
    """Edge of a cell, m."""
    sensor_height: float = 1.733
    """Height of the LiDAR above the ground below it, m."""
    height_range: float = Field(default=4.0, gt=0)
    """Points farther than this above or below that ground are not used, m."""
    channels: int = Field(default=64, ge=4)
    """Channels of a pillar's feature; the inner layers have two and four times as many."""
    threshold: float = 0.2
    """A point higher above the ground is an obstacle, m."""
    softness: float = Field(default=0.05, gt=0)
    """Width of the soft threshold, m."""
    smoothness: float = Field(default=0.1, ge=0, le=1)
    """Fraction of the loss that is the curvature of the ground."""
    curvature: Literal["squared", "absolute"] = "squared"
    """Second differences along x and y, squared. Or, as in the authors' code, absolute and the mixed ones twice, which
    weights a bend of 0.1 m ten times as much."""


class GroundNet(nn.Module):
    """Scans to the height of the ground, (B, cells, cells) m in the frame of the LiDAR, indexed [x, y]."""

    def __init__(self, settings: GroundSettings | None = None) -> None:
        """Default settings if None: 2.217 million parameters."""
        super().__init__()
        self.settings = settings = settings or GroundSettings()
        c = settings.channels
        self.pillar = nn.Linear(9, c)
        self.down = nn.ModuleList([_block(c, 2 * c, 2 * c), _block(2 * c, 4 * c, 4 * c)])
        self.up = nn.ModuleList([_block(4 * c, 4 * c, 2 * c), _block(2 * c, 2 * c, c)])
        self.head = nn.Conv2d(c, 1, 3, padding=1)

    def forward(self, scans: Sequence[Tensor]) -> Tensor:
        """Height in every cell, also in cells without points.

        Args:
            scans: B of (N_b, 4) [x, y, z m, intensity 0..1]; points outside the grid or not finite are not used.

        Raises:
            UsageError: a scan has another shape.
        """
        x = torch.stack([self._pillar_grid(scan) for scan in scans])
        indices = []
        for block in self.down:
            x, index = functional.max_pool2d(block(x), 2, return_indices=True)
            indices.append(index)
        for block, index in zip(self.up, reversed(indices), strict=True):
            x = block(functional.max_unpool2d(x, index, [2, 2]))
        return self.head(x)[:, 0] - self.settings.sensor_height

    def _pillar_grid(self, scan: Tensor) -> Tensor:
        """(channels, cells, cells) features of the pillars of one scan, zero for cells without points."""
        if scan.ndim != 2 or scan.shape[1] != 4:
            raise UsageError(f"GroundNet: a scan of shape {tuple(scan.shape)}; want (N, 4)")
        s = self.settings
        scan = scan[scan.isfinite().all(1)]
        height = scan[:, 2] + s.sensor_height
        cell, inside = cell_of(scan, s)
        keep = inside & (height.abs() < s.height_range)
        scan, cell, height = scan[keep], cell[keep], height[keep]
        xyz = torch.cat([scan[:, :2], height[:, None]], 1)
        count, total = _sums(cell, xyz, s)
        mean = total / count.clamp(min=1)[:, None]
        grid = torch.stack([cell // s.cells, cell % s.cells], 1)
        center = (grid + 0.5 - s.cells / 2) * s.cell
        point_features = torch.cat([xyz, scan[:, 3:], xyz - mean[cell], xyz[:, :2] - center], 1)
        features = functional.relu(self.pillar(point_features))
        out = features.new_zeros(s.cells**2, features.shape[1])
        out = out.scatter_reduce(0, cell[:, None].expand_as(features), features, "amax")  # ReLU: zero is the minimum
        return out.T.unflatten(1, (s.cells, s.cells))


def load(path: Path) -> GroundNet:
    """A trained network on the CPU, ready for inference; raises as `task_weights.load_network`."""
    return load_network(path, "gndnet", "net", GroundSettings, GroundNet)


def cell_of(points: Tensor, settings: GroundSettings) -> tuple[Tensor, Tensor]:
    """Index (N,) of the cell of points (N, 2+), x first, and whether they are on the grid at all (N,)."""
    grid = (points[:, :2] / settings.cell + settings.cells / 2).floor()
    inside = ((grid >= 0) & (grid < settings.cells)).all(1)
    grid = grid.nan_to_num(0).clamp(0, settings.cells - 1).long()
    return grid[:, 0] * settings.cells + grid[:, 1], inside


def _sums(cell: Tensor, values: Tensor, settings: GroundSettings) -> tuple[Tensor, Tensor]:
    """Number of points in each cell (cells^2,), and the sum (cells^2, ...) of their values (N, ...)."""
    count = values.new_zeros(settings.cells**2).index_add_(0, cell, values.new_ones(len(cell)))
    return count, values.new_zeros(settings.cells**2, *values.shape[1:]).index_add_(0, cell, values)


def elevation_labels(points: Tensor, ground: Tensor, settings: GroundSettings) -> tuple[Tensor, Tensor]:
    """Mean height (cells, cells), m, of the ground points of a scan, and (cells, cells) bool, the cells with any.

    The original fits a surface by a conditional random field, whose code is not public.

    Args:
        points: (N, 3+) m. ground: (N,) bool.

    Raises:
        UsageError: another number of labels than of points.
    """
    if ground.shape != points.shape[:1]:
        raise UsageError(f"ground labels: {len(ground)} for {len(points)} points")
    cell, inside = cell_of(points, settings)
    keep = inside & ground
    count, total = _sums(cell[keep], points[keep, 2], settings)
    shape = (settings.cells, settings.cells)
    return (total / count.clamp(min=1)).view(shape), (count > 0).view(shape)


def ground_loss(elevation: Tensor, labels: Tensor, known: Tensor, settings: GroundSettings) -> Tensor:
    """Smooth L1 over the cells that are known, and the curvature of the whole map; a scalar.

    Args:
        elevation, labels: (B, cells, cells) m. known: (B, cells, cells) bool, or the weight of a cell, 0..1; without a
            known cell the loss is only the curvature.
    """
    requested = torch.where(known > 0, labels, elevation.detach())
    error = functional.smooth_l1_loss(elevation, requested, reduction="none")
    fit = (error * known).sum() / known.sum().clamp(min=1)
    if settings.curvature == "squared":
        curvature = sum(elevation.diff(n=2, dim=axis).square().mean() for axis in (1, 2))
    else:
        curvature = sum(elevation.diff(dim=a).diff(dim=b).abs().mean() for a in (1, 2) for b in (1, 2))
    return (1 - settings.smoothness) * fit + settings.smoothness * curvature


def height_above(points: Tensor, elevation: Tensor, settings: GroundSettings) -> Tensor:
    """Height (N,), m, of the points (N, 3+) of one scan above its ground (cells, cells), bilinear between the cells."""
    half = settings.cells * settings.cell / 2
    yx = (points[:, [1, 0]] / half).to(elevation.dtype)  # grid_sample takes the last axis first
    found = functional.grid_sample(
        elevation[None, None], yx[None, None], mode="bilinear", padding_mode="border", align_corners=False
    )
    return points[:, 2] - found[0, 0, 0]


def obstacle_weight(points: Tensor, elevation: Tensor, settings: GroundSettings) -> Tensor:
    """(N,) 0..1: how far a point is on an object above the ground; zero off the grid.

    This is a soft threshold of the evaluation, so that the SLAM loss reaches the elevation: a mask has no gradient.
    """
    above = height_above(points, elevation, settings)
    return torch.sigmoid((above - settings.threshold) / settings.softness) * cell_of(points, settings)[1]


def ground_metrics(
    points: Tensor, ground: Tensor, counted: Tensor, elevation: Tensor, settings: GroundSettings
) -> dict[str, float]:
    """Figures of a scan: `mse` (m2) of the ground's height; `miou`, `precision`, `recall` of the obstacles, each 0..1.

    And those that the authors' evaluation prints: `ground_iou`, `ground_precision` and `ground_recall` of the ground,
    and `mse_authors` (m2). There the points of a cell are counted from one, which draws its mean height towards the
    ground level at the car. A figure is NaN if the scan has nothing to measure for it; `miou` is then of the other
    class only.

    Args:
        points: (N, 3+) m. ground: (N,) bool. counted: (N,) bool, false for points without a class.
        elevation: (cells, cells) m.
    """
    points, ground = points[counted], ground[counted]
    labels, known = elevation_labels(points, ground, settings)
    inside = cell_of(points, settings)[1]
    found = (height_above(points, elevation, settings) > settings.threshold)[inside]
    obstacle = ~ground[inside]
    true_positive = (found & obstacle).sum().item()
    true_negative = (~found & ~obstacle).sum().item()
    false_positive, false_negative = (found & ~obstacle).sum().item(), (~found & obstacle).sum().item()
    iou, ground_iou = (
        _ratio(true_positive, true_positive + false_positive + false_negative),
        _ratio(true_negative, true_negative + false_positive + false_negative),
    )
    ious = [value for value in (iou, ground_iou) if not math.isnan(value)]
    return {
        "mse": float((elevation - labels)[known].square().mean()) if bool(known.any()) else math.nan,
        "miou": _ratio(sum(ious), len(ious)),
        "precision": _ratio(true_positive, true_positive + false_positive),
        "recall": _ratio(true_positive, true_positive + false_negative),
        "mse_authors": _mse_authors(points[ground], elevation, settings),
        "ground_iou": ground_iou,
        "ground_precision": _ratio(true_negative, true_negative + false_negative),
        "ground_recall": _ratio(true_negative, true_negative + false_positive),
    }


def _ratio(part: float, whole: float) -> float:
    return part / whole if whole else math.nan


def _mse_authors(points: Tensor, elevation: Tensor, settings: GroundSettings) -> float:
    """The authors' mean squared error, m2, of ground points (N, 3+): heights above the ground level at the car."""
    cell, inside = cell_of(points, settings)
    count, total = _sums(cell[inside], points[inside, 2] + settings.sensor_height, settings)
    error = (elevation.flatten() + settings.sensor_height - total / (count + 1))[count > 0]
    return float(error.square().mean()) if len(error) else math.nan


def _block(inputs: int, middle: int, outputs: int) -> nn.Sequential:
    def layer(a: int, b: int) -> list[nn.Module]:
        return [nn.Conv2d(a, b, 3, padding=1), nn.BatchNorm2d(b), nn.ReLU()]

    return nn.Sequential(*layer(inputs, middle), *layer(middle, outputs))
