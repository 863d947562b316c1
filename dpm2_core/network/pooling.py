# SPDX-License-Identifier: Apache-2.0
"""The point backbone's loops over neighbors, compiled for inference: torch makes a pass for every operation."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from dpm2_core.geometry.compiled import compiled

Array = NDArray[np.float32]


def use_compiled(values: Tensor) -> bool:
    """Whether this is inference on the CPU."""
    return torch.is_inference_mode_enabled() and values.device.type == "cpu"


def largest_sums(projected: Tensor | None, index: Tensor | None, relative: Tensor, weight: Tensor) -> Tensor:
    """`pointnext.pool_neighbors` on the CPU without gradients, summed in float32; out in the dtype of `projected`."""
    batch, n, k, _ = relative.shape
    out = torch.empty(batch, n, len(weight))
    weights = weight.float().t().contiguous().numpy()
    no_features = np.zeros((1, len(weight)), np.float32), np.zeros((n, k), np.int64)
    for b in range(batch):
        values, neighbors = no_features
        if projected is not None and index is not None:
            values, neighbors = projected[b].float().contiguous().numpy(), index[b].numpy()
        _largest_sums(values, neighbors, relative[b].float().contiguous().numpy(), weights, out[b].numpy())
    return out if projected is None else out.to(projected.dtype)


def positions_in_view(xyz: Tensor, axes: Tensor, index: Tensor, radius: float) -> Tensor:
    """Positions of neighbors, in units of the radius, and their view axes, both in the view frames of the centers.

    xyz (B, m, 3) of which the first n are the centers, axes (B, m, 2), index (B, n, k) into m: (B, n, k, 5), see
    `pointnext.Aggregation`; on the CPU and without gradients.
    """
    out = torch.empty(*index.shape, 5)
    for b in range(len(xyz)):
        _positions_in_view(xyz[b].contiguous().numpy(), axes[b].numpy(), index[b].numpy(), radius, out[b].numpy())
    return out


@compiled("void(f4[:, ::1], i8[:, ::1], f4[:, :, ::1], f4[:, ::1], f4[:, ::1])")
def _largest_sums(projected: Array, index: NDArray[np.int64], relative: Array, weight: Array, out: Array) -> None:
    """out (n, C) = maximum over k of projected[index] + relative @ weight;
    projected (m, C), relative (n, k, P), weight (P, C)."""
    channels, total = out.shape[1], np.empty(out.shape[1], np.float32)
    for i in range(len(out)):
        largest = out[i]
        for k in range(index.shape[1]):
            values = projected[index[i, k]]
            for c in range(channels):
                total[c] = values[c]
            for p in range(len(weight)):
                x, w = relative[i, k, p], weight[p]
                for c in range(channels):
                    total[c] += x * w[c]
            for c in range(channels):
                largest[c] = total[c] if k == 0 or total[c] > largest[c] else largest[c]


@compiled("void(f4[:, ::1], f4[:, ::1], i8[:, ::1], f4, f4[:, :, ::1])")
def _positions_in_view(xyz: Array, axes: Array, index: NDArray[np.int64], radius: float, out: Array) -> None:
    for i in range(len(index)):
        c, s = axes[i, 0], axes[i, 1]
        for k in range(index.shape[1]):
            j = index[i, k]
            x, y, z = (
                (xyz[j, 0] - xyz[i, 0]) / radius,
                (xyz[j, 1] - xyz[i, 1]) / radius,
                (xyz[j, 2] - xyz[i, 2]) / radius,
            )
            out[i, k, 0], out[i, k, 1], out[i, k, 2] = c * x + s * y, c * y - s * x, z
            out[i, k, 3], out[i, k, 4] = c * axes[j, 0] + s * axes[j, 1], c * axes[j, 1] - s * axes[j, 0]
