# SPDX-License-Identifier: Apache-2.0
"""Chamfer distance of two clouds, for evaluation: by k-d trees, without gradient."""

from __future__ import annotations

from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from torch import Tensor

from dpm2_core.errors import UsageError

Array = NDArray[np.float64]


def chamfer_distance(a: Tensor, b: Tensor, squared: bool = False, reduction: Literal["mean", "sum"] = "mean") -> float:
    """Distance from each point to the nearest of the other cloud, over both clouds.

    Args:
        a, b: (N, 3) and (M, 3), m.
        squared: of the distances; they are squared before they are put together.
        reduction: `mean`: half the sum of the two clouds' means, m or m2, whatever their numbers of points.
            `sum`: over all points of both, as DSLR gives it, squared and of clouds in units of 120 m.

    Raises:
        UsageError: see `nearest_distances`.
    """
    forth, back = (d**2 if squared else d for d in nearest_distances(a, b))
    return float(forth.sum() + back.sum() if reduction == "sum" else (forth.mean() + back.mean()) / 2)


def nearest_distances(a: Tensor, b: Tensor) -> tuple[Array, Array]:
    """From each point of a (N, 3) to the nearest of b (M, 3), (N,), and the other way, (M,), m.

    Raises:
        UsageError: a cloud is empty, has another shape, or a point that is not finite.
    """
    x, y = _checked(a, "first"), _checked(b, "second")
    return cKDTree(y).query(x)[0], cKDTree(x).query(y)[0]


def _checked(cloud: Tensor, name: str) -> Array:
    if cloud.ndim != 2 or cloud.shape[1] != 3 or not len(cloud):
        raise UsageError(f"Chamfer distance: the {name} cloud has shape {tuple(cloud.shape)}; want (N, 3), N > 0")
    points: Array = cloud.detach().cpu().double().numpy()
    if not np.isfinite(points).all():
        raise UsageError(f"Chamfer distance: the {name} cloud has points that are not finite")
    return points
