# SPDX-License-Identifier: Apache-2.0
"""Weighted Kabsch: the rigid transform between matched points in closed form, batched, in float64 (torch)."""

from __future__ import annotations

import torch
from torch import Tensor

from dpm2_core.geometry.se3_torch import make


def weighted_kabsch(source: Tensor, target: Tensor, weights: Tensor) -> Tensor:
    """T_target_source that minimizes sum w |target - T source|^2.

    A reflection is never returned. If the weights sum to zero, the translation is zero.

    Args:
        source, target: (B, K, 3), m. weights: (B, K), >= 0.

    Returns:
        (B, 4, 4) float64.
    """
    source, target, w = source.double(), target.double(), weights.double()[..., None]
    w = w / w.sum(1, keepdim=True).clamp(min=1e-12)
    source_mean, target_mean = (w * source).sum(1), (w * target).sum(1)
    covariance = ((target - target_mean[:, None]) * w).transpose(1, 2) @ (source - source_mean[:, None])
    U, _, Vt = torch.linalg.svd(covariance)
    sign = torch.ones(len(U), 3, dtype=U.dtype, device=U.device)
    sign[:, 2] = torch.linalg.det(U @ Vt).sign()  # reflection guard
    R = (U * sign[:, None]) @ Vt
    return make(R, target_mean - (R @ source_mean[..., None])[..., 0])
