# SPDX-License-Identifier: Apache-2.0
"""Solved poses: how well their pairs fit, and how probable it is that they are right."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from dpm2_core.network.decoder import Decoder

_MIN_SUPPORT, _MIN_SIGMA, _MIN_RMSE = 0.01, 0.02, 0.8  # lower values are clamped: 99 % of right poses have more
_MAX_ERROR = 1e3  # m


class Solved(NamedTuple):
    """Poses of a batch.

    Attributes:
        T: (B, 4, 4) float64.
        covariance: (B, 6, 6) [rad, m] of xi in T exp(xi); not finite if the pairs do not determine a pose.
        residual: (B,) m, root mean square distance between the points of the inliers.
        inliers: (B,) pairs that fit, in both directions.
        support: (B,) 0..1, mean probability of the best pairs, matched without the pose, that it brings together.
        share: (B,) 0..1, share of the pairs that are inliers.
    """

    T: Tensor
    covariance: Tensor
    residual: Tensor
    inliers: Tensor
    support: Tensor
    share: Tensor


def confidence_of(decoder: Decoder, solved: Solved) -> Tensor:
    """Logit (B,) of each pose being right, by the head of the decoder."""
    logits: Tensor = decoder.confidence(confidence_features(solved))
    return logits


def confidence_features(solved: Solved) -> Tensor:
    """Features (B, `CONFIDENCE_FEATURES`) that distinguish right poses from wrong ones: logarithm of `support`, share
    of the pairs that fit, logarithms of the largest standard deviation of the position and of the residual, and the
    distance in units of 20 m, at most 1.

    A wrong pose brings fewer pairs together, and less closely. For views far apart, fewer pairs are expected. Frames
    that a wrong pose in a tunnel puts at the same place would match better if they were there.
    """
    variance = torch.linalg.eigvalsh(solved.covariance[:, 3:, 3:].nan_to_num(_MAX_ERROR**2, _MAX_ERROR**2))[:, -1]
    support = solved.support.double().nan_to_num(0.0).clamp(min=_MIN_SUPPORT).log()
    sigma = variance.clamp(_MIN_SIGMA**2, _MAX_ERROR**2).sqrt().log()
    rmse = solved.residual.nan_to_num(_MAX_ERROR).clamp(_MIN_RMSE, _MAX_ERROR).log()
    distance = _distance(solved).clamp(max=1)
    return torch.stack([support, solved.share.double(), sigma, rmse, distance.double()], -1).float()


def overlap_features(solved: Solved) -> Tensor:
    """Features (B, `POSE_FEATURES`) of the pose of a pair for its overlap: `support`, the distance in units of 20 m,
    and the share of the pairs that fit, which distinguishes places that look alike."""
    distance = _distance(solved)
    return torch.stack([solved.support.nan_to_num(0.0).to(distance.dtype), distance, solved.share], -1).float()


def _distance(solved: Solved) -> Tensor:
    """(B,) between the frames of each pair by its pose, in units of 20 m, at most 3."""
    return (solved.T[:, :3, 3].norm(dim=-1) / 20).clamp(max=3).nan_to_num(3.0)
