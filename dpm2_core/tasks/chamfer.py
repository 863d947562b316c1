# SPDX-License-Identifier: Apache-2.0
"""Chamfer distance of two clouds, for evaluation: by k-d trees, without gradient."""

from __future__ import annotations

import math

import numpy as np
from scipy.spatial import cKDTree
from torch import Tensor

from dpm2_core.errors import UsageError
from dpm2_core.tasks.pairs import SCALE


def chamfer_figures(a: Tensor, b: Tensor) -> dict[str, float]:
    """Distance from each point of two clouds (N, 3) and (M, 3), m, to the nearest of the other; NaN if one is empty.

    Returns:
        `chamfer_m`: half the sum of the two clouds' means, m. `chamfer`: sum of the squares over all points of both, of
        clouds in units of 120 m, as DSLR gives it.

    Raises:
        UsageError: a point is not finite.
    """
    if not len(a) or not len(b):
        return {"chamfer_m": math.nan, "chamfer": math.nan}
    x, y = (cloud.detach().cpu().double().numpy() for cloud in (a, b))
    if not (np.isfinite(x).all() and np.isfinite(y).all()):
        raise UsageError("Chamfer distance: a cloud has points that are not finite")
    forth, back = cKDTree(y).query(x)[0], cKDTree(x).query(y)[0]
    squares = float((forth**2).sum() + (back**2).sum())
    return {"chamfer_m": float(forth.mean() + back.mean()) / 2, "chamfer": squares / SCALE**2}
