# SPDX-License-Identifier: Apache-2.0
"""A window of a user's clouds, checked, downsampled and padded to one tensor."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from dpm2_core.errors import UsageError

MIN_POINTS = 50
"""A scan with fewer points is rejected: a normal needs ten."""
_CELLS_PER_AXIS = 2**20  # a cell index of three axes fits into 63 bits


def window(
    clouds: Sequence[Tensor] | Tensor, weights: Sequence[Tensor] | Tensor | None, count: int, voxel: float, name: str
) -> tuple[Tensor, Tensor]:
    """Points (T, N, 3) and weights (T, N) float64 of T clouds, N <= `count`, padded with weight zero.

    A cloud of more than `count` points keeps one point of each occupied voxel, and of these a random choice, the same
    in every call. Points of weight zero are not chosen. The gradient of the kept points and weights passes through.

    Args:
        clouds: T tensors (N_t, 3), m, or one (T, N, 3). weights: the same without the last axis, 0..1; None: all one.
        voxel: edge, m. name: of the clouds, for messages.

    Raises:
        UsageError: fewer than 2 scans or `MIN_POINTS` points, a wrong shape, a value not finite, a weight outside 0..1.
    """
    if len(clouds) < 2:
        raise UsageError(f"{name}: a window of {len(clouds)} scans has no motion; want at least 2")
    if weights is not None and len(weights) != len(clouds):
        raise UsageError(f"{name}: weights of {len(weights)} scans for clouds of {len(clouds)}")
    pairs = []
    for t, cloud in enumerate(clouds):
        where = f"{name}, scan {t}"
        for tensor in (cloud, *(() if weights is None else (weights[t],))):
            if not isinstance(tensor, Tensor):
                raise UsageError(f"{where}: want tensors of torch, found {type(tensor).__name__}")
        weight = cloud.new_ones(cloud.shape[:1]) if weights is None else weights[t]
        _check_scan(cloud, weight, where)
        keep = _kept_indices(cloud.detach(), weight.detach(), count, voxel)
        # A scan without any weight keeps one point, so that it stays in the window, with a (zero) gradient of weights.
        kept = cloud[keep] if len(keep) else cloud[:1].nan_to_num(0.0, 0.0, 0.0)
        pairs.append((kept.double(), (weight[keep] if len(keep) else weight[:1]).double()))
    pad = torch.nn.utils.rnn.pad_sequence
    return pad([points for points, _ in pairs], batch_first=True), pad(
        [weight for _, weight in pairs], batch_first=True
    )


def _check_scan(cloud: Tensor, weight: Tensor, where: str) -> None:
    if cloud.ndim != 2 or cloud.shape[1] != 3 or not cloud.is_floating_point():
        raise UsageError(f"{where}: want floating-point points (N, 3), found {tuple(cloud.shape)} {cloud.dtype}")
    if len(cloud) < MIN_POINTS:
        raise UsageError(f"{where}: {len(cloud)} points; want at least {MIN_POINTS}")
    if weight.shape != cloud.shape[:1]:
        raise UsageError(f"{where}: weights {tuple(weight.shape)} for {len(cloud)} points")
    # Padding may contain any values; the common case costs one synchronization with the device.
    bad_points = ~cloud.detach().isfinite().all(1) & (weight.detach() != 0)
    bad_weights = ~((weight.detach() >= 0) & (weight.detach() <= 1))
    if bool((bad_points | bad_weights).any()):
        if bool(bad_points.any()):
            raise UsageError(f"{where}: {int(bad_points.sum())} of its {len(cloud)} points are not finite")
        raise UsageError(f"{where}: {int(bad_weights.sum())} of its {len(cloud)} weights are not in 0..1")


def _kept_indices(points: Tensor, weight: Tensor, count: int, voxel: float) -> Tensor:
    """Indices of the points to keep, in their own order."""
    index = weight.nonzero()[:, 0]
    if len(index) <= count:
        return index
    # The order is drawn for all points: whether a weight is zero does not change the choice among the others.
    generator = torch.Generator().manual_seed(len(points))
    order = torch.randperm(len(points), generator=generator).to(index.device)
    index = order[weight[order] != 0]
    cell = (points[index] / voxel).floor().long().clamp(
        -_CELLS_PER_AXIS // 2, _CELLS_PER_AXIS // 2 - 1
    ) + _CELLS_PER_AXIS // 2
    key, by_cell = ((cell[:, 0] * _CELLS_PER_AXIS + cell[:, 1]) * _CELLS_PER_AXIS + cell[:, 2]).sort(stable=True)
    first = torch.ones_like(key, dtype=torch.bool)
    first[1:] = key[1:] != key[:-1]
    return index[by_cell[first].sort()[0][:count]].sort()[0]
