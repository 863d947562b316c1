# SPDX-License-Identifier: Apache-2.0
"""Losses of the network. All of them are masked, and free of NaN for batches without a single positive."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor, nn

from dpm2_core.geometry import se3_torch

RIGHT_M, RIGHT_DEG = 1.0, 3.0  # largest errors of a right pose; few lie between these and several meters
SOFT = 3.0  # degrees of freedom of the Student distribution of offset residuals


class Labels(NamedTuple):
    """Pairs of two sets by their true distance.

    Attributes:
        distance: (B, N, M) m, inf at padding.
        forward: (B, N) index of the nearest target of each source, -1 if it is farther than the limit.
        backward: (B, M) the same for each target. The other pairs within the limit are neutral.
        near: (B, N, M) True within the limit.
    """

    distance: Tensor
    forward: Tensor
    backward: Tensor
    near: Tensor


def label_pairs(source: Tensor, target: Tensor, T_target_source: Tensor, masks: tuple[Tensor, Tensor]) -> Labels:
    """source (B, N, 3), target (B, M, 3), m, their true relation (B, 4, 4), masks (B, N), (B, M); the limit is 1 m."""
    moved = se3_torch.transform(T_target_source, source)
    distance = torch.cdist(moved, target, compute_mode="donot_use_mm_for_euclid_dist")
    valid = masks[0][:, :, None] & masks[1][:, None]
    return label_distances(distance.masked_fill(~valid, torch.inf), 1.0)


def label_distances(distance: Tensor, limit: float) -> Labels:
    """Labels of a distance matrix (B, N, M)."""
    forward, backward = (
        torch.where(nearest <= limit, index, -1) for nearest, index in (distance.min(2), distance.min(1))
    )
    return Labels(distance, forward, backward, distance <= limit)


def cosine(source: Tensor, target: Tensor) -> Tensor:
    """Cosine similarities (B, N, M) of (B, N, C) and (B, M, C), float32."""
    return (nn.functional.normalize(source, dim=-1) @ nn.functional.normalize(target, dim=-1).mT).float()


def info_nce(scores: Tensor, labels: Labels, neutral_is_negative: bool) -> Tensor:
    """InfoNCE of scores (B, N, M), from source to target and back, averaged; rows without positive are ignored.

    Args:
        scores: similarities divided by the temperature.
        neutral_is_negative: nearby targets other than the nearest count as negatives, as in DeepPointMap for the
            correlated descriptors; else they are left out, as for those of the encoder.
    """
    scores = scores.masked_fill(labels.distance.isinf(), -1e4)
    losses = []
    for axis, positive in ((2, labels.forward), (1, labels.backward)):
        used = positive >= 0
        index = positive.clamp(min=0).unsqueeze(axis)
        positive_scores = scores.gather(axis, index).squeeze(axis)
        kept = scores
        if not neutral_is_negative:
            neutral = labels.near.scatter(axis, index, False)
            kept = scores.masked_fill(neutral, -1e4)
        losses.append(((kept.logsumexp(axis) - positive_scores) * used).sum() / used.sum().clamp(min=1))
    return (losses[0] + losses[1]) / 2


def mahalanobis_offset(residual: Tensor, weight: Tensor) -> Tensor:
    """Mean of sqrt(r^T C^-1 r), C the covariance of the detached residuals (identity below 4 of them).

    residual (P, 3), m; weight (P,) 0 or 1.
    """
    count = weight.sum()
    detached = residual.detach().float()
    mean = (detached * weight[:, None]).sum(0) / count.clamp(min=1)
    centered = (detached - mean) * weight[:, None]
    eye = torch.eye(3, device=residual.device)
    covariance = centered.T @ centered / count.clamp(min=1) + 1e-6 * eye
    inverse = torch.linalg.inv(torch.where(count >= 4, covariance, eye))
    squared = ((residual @ inverse) * residual).sum(-1)
    distance = (squared + 1e-12).sqrt()  # the root has no gradient at 0
    return (distance * weight).sum() / count.clamp(min=1)


def student_offset(residual: Tensor, L: Tensor, weight: Tensor) -> Tensor:
    """Negative log likelihood of residuals (P, 3) under a Student distribution of precision L L^T (P, 3, 3)."""
    whitened_residuals = (residual[..., None, :] @ L)[..., 0, :]
    squared = (whitened_residuals * whitened_residuals).sum(-1)
    log_determinant = L.diagonal(dim1=-2, dim2=-1).log().sum(-1)
    loss = (SOFT + 3) / 2 * torch.log1p(squared / SOFT) - log_determinant
    return (loss * weight).sum() / weight.sum().clamp(min=1)


def overlap_loss(logits: Tensor, distance: Tensor, limit: float) -> Tensor:
    """Binary cross entropy of overlap logits (B,) against `distance` (B,) <= limit, m."""
    return nn.functional.binary_cross_entropy_with_logits(logits, (distance <= limit).float())


def confidence_loss(logits: Tensor, T: Tensor, true: Tensor) -> Tensor:
    """Binary cross entropy of the logits (B,) that poses (B, 4, 4) are right, against whether they are within
    `RIGHT_M` and `RIGHT_DEG` of the true ones."""
    difference = se3_torch.log(se3_torch.inverse(true.double()) @ T.double())
    right = (difference[:, 3:].norm(dim=-1) < RIGHT_M) & (difference[:, :3].norm(dim=-1) < math.radians(RIGHT_DEG))
    return nn.functional.binary_cross_entropy_with_logits(logits, right.to(logits.dtype))
