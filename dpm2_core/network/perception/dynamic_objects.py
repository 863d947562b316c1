# SPDX-License-Identifier: Apache-2.0
"""Detects points of one scan on objects that move or could move: a small encoder-decoder over a grid seen from above.

A column of the grid has a value for each layer of height above the ground: whether it has points there. The output has
the same shape. Only occupancy is used, no counts, intensity or sensor height, so that other LiDARs look much the same.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from pydantic import Field
from torch import Tensor, nn
from torch.nn import functional

from dpm2_core.config import Settings
from dpm2_core.geometry.ground import height_above_ground
from dpm2_core.network.perception.task_weights import load_network
from dpm2_core.network.precision import mixed_precision

LAYERS = (0.25, 0.75, 1.25, 1.75, 2.5, 4.0)
"""Bounds of the layers of height above the ground, m; one more layer below, one above."""


class DynamicObjectNetSettings(Settings):
    """Grid and network of the dynamic objects."""

    cells: int = Field(default=200, ge=16, multiple_of=8)
    """Cells of the grid along x and along y; the sensor is at its center. Points off the grid count as static."""
    cell: float = Field(default=0.4, gt=0)
    """Edge of a cell, m."""
    channels: int = Field(default=24, ge=4)
    """Channels of the finest layers; the coarser ones have two and three times as many."""


class DynamicObjectNet(nn.Module):
    """Occupancy (B, 7, cells, cells), 0 or 1, to the logit of a dynamic object in each of its voxels, in the same
    shape."""

    range: Tensor

    def __init__(self, settings: DynamicObjectNetSettings | None = None) -> None:
        """Default settings if None: 152 thousand parameters."""
        super().__init__()
        self.settings = settings = settings or DynamicObjectNetSettings()
        c, planes = settings.channels, 4 * (len(LAYERS) + 1)  # 2 x 2 cells make one of the finest layers
        self.stem = _block(planes + 1, c, c)
        self.down = nn.ModuleList(_block(a * c, b * c, b * c, 2) for a, b in pairwise((1, 2, 3)))
        self.lift = nn.ModuleList(nn.Conv2d(a * c, b * c, 1) for a, b in pairwise((3, 2, 1)))
        self.up = nn.ModuleList(_layer(b * c, b * c) for b in (2, 1))
        self.head = nn.Conv2d(c, planes, 1)
        half = settings.cells // 2
        axis = (torch.arange(half) + 0.5) / half * 2 - 1
        distance = torch.hypot(axis[:, None], axis[None])  # points are fewer at larger distances
        self.register_buffer("range", distance[None, None], persistent=False)

    def forward(self, occupied: Tensor) -> Tensor:
        x = functional.pixel_unshuffle(occupied, 2).contiguous(memory_format=torch.channels_last)
        x = self.stem(torch.cat([x, self.range.to(x.dtype).expand(len(x), -1, -1, -1)], 1))
        skips = []
        for block in self.down:
            skips.append(x)
            x = block(x)
        for lift, block in zip(self.lift, self.up, strict=True):
            x = block(functional.interpolate(lift(x), scale_factor=2.0) + skips.pop())
        return functional.pixel_shuffle(self.head(x), 2)

    @torch.inference_mode()
    def probability(self, points: NDArray[np.float32]) -> NDArray[np.float32]:
        """Probability (N,) 0..1 of (N, 3+) points of one scan, m, in a frame with z about up; 0 off the grid."""
        voxel, inside = voxels(points, self.settings)
        occupied = occupancy([voxel[inside]], self.settings).to(self.range.device)
        with mixed_precision(occupied.device):
            logits = self(occupied)
        out = np.zeros(len(points), np.float32)
        out[inside] = logits.flatten().sigmoid().float().cpu().numpy()[voxel[inside]]
        return out


def voxels(
    points: NDArray[np.float32], settings: DynamicObjectNetSettings
) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
    """Number (N,) of the voxel of (N, 3+) finite points, by layer, x and y, and whether they are on the grid (N,)."""
    n = settings.cells
    x, y = (np.floor(points[:, axis] / settings.cell).astype(np.int64) + n // 2 for axis in (0, 1))
    inside = (x >= 0) & (x < n) & (y >= 0) & (y < n)
    layer = np.searchsorted(np.array(LAYERS, np.float32), height_above_ground(points))
    return (layer * n + x) * n + y, inside


def occupancy(scans: Sequence[NDArray[np.int64]], settings: DynamicObjectNetSettings) -> Tensor:
    """(B, 7, cells, cells), 1 in the voxels (N_b,) of each scan, 0 elsewhere."""
    shape = (len(LAYERS) + 1, settings.cells, settings.cells)
    out = torch.zeros(len(scans), math.prod(shape))
    for row, voxel in zip(out, scans, strict=True):
        row[torch.from_numpy(voxel)] = 1
    return out.view(len(scans), *shape)


def _layer(inputs: int, outputs: int, stride: int = 1) -> nn.Sequential:
    return nn.Sequential(
        nn.Conv2d(inputs, outputs, 3, stride, 1, bias=False), nn.BatchNorm2d(outputs), nn.ReLU(inplace=True)
    )


def _block(inputs: int, middle: int, outputs: int, stride: int = 1) -> nn.Sequential:
    return nn.Sequential(_layer(inputs, middle, stride), _layer(middle, outputs))


def load(path: Path) -> DynamicObjectNet:
    """A trained network on the CPU, ready for inference; raises as `task_weights.load_network`."""
    return load_network(path, "movers", "net", DynamicObjectNetSettings, DynamicObjectNet)
