# SPDX-License-Identifier: Apache-2.0
"""Phase-one objective: pairing, coarse, backbone, offset and pose losses of one batch of encoded frames."""

from __future__ import annotations

import torch
from pydantic import Field
from torch import Tensor

from dpm2_core.config import Settings
from dpm2_core.geometry.se3_torch import transform
from dpm2_core.learning.pose_loss import differentiable_poses, pose_loss
from dpm2_core.network.decoder import Correlated, Decoder
from dpm2_core.network.heads import residuals_in_view
from dpm2_core.network.losses import Labels, cosine, info_nce, label_pairs, mahalanobis_offset, student_offset
from dpm2_core.network.matching import softmax_both, take
from dpm2_core.network.tokens import Tokens

_MAX_OWN_ERROR = 6.0  # m: the network's own matches that are wrong by more are not used for the offsets


class LossSettings(Settings):
    """Weights of the losses, and how pairs are drawn for the offsets."""

    pairing: float = 1.0
    """On correlated descriptors."""
    coarse: float = 0.1
    """On the encoder's descriptors, through the coarse head."""
    backbone: float = 0.1
    """On the point backbone's key-points, through its own head."""
    image: float = 0.1
    """On the features of the first image where descriptors project into it, through its own head."""
    offset: float = 0.2
    """On predicted offsets. The likelihood's gradient is that of a distance divided by its deviation, about 0.1 m: with
    weight 1 it dominates the pairing."""
    pose: float = Field(0.0, ge=0)
    """On the error of the pose, 1/m; for weights that can already register. See `pose_loss`."""
    near: int = Field(128, gt=0)
    """Pairs drawn per set pair among those within `offset_limit` of each other."""
    own: int = Field(128, ge=0)
    """Pairs per set pair that are the network's own best matches, as at inference."""


def registration_loss(
    decoder: Decoder, source: Tokens, target: Tokens, T_target_source: Tensor, settings: LossSettings
) -> tuple[Tensor, dict[str, Tensor]]:
    """Loss of a batch of set pairs, and figures for the log.

    Args:
        T_target_source: (B, 4, 4) truth.
    """
    temperature = decoder.settings.temperature
    labels = label_pairs(source.xyz, target.xyz, T_target_source, (source.mask, target.mask))
    correlated = decoder(source, target)
    scores = cosine(decoder.similarity(correlated.source), decoder.similarity(correlated.target)) / temperature
    pairing = info_nce(scores, labels, neutral_is_negative=True)
    coarse_scores = cosine(decoder.coarse(source.features), decoder.coarse(target.features)) / temperature
    coarse = info_nce(coarse_scores, labels, False)
    limit, masks = decoder.settings.offset_limit, (source.mask, target.mask)
    pairs = offset_pairs(scores.detach(), labels, masks, limit, settings)
    offset, errors = offset_loss(decoder, source, target, T_target_source, correlated, pairs)
    near = pairs[1][:, : settings.near].repeat(2, 1)
    error = (errors[:, : settings.near] * near).sum() / near.sum().clamp(min=1)
    total = settings.pairing * pairing + settings.coarse * coarse + settings.offset * offset
    figures = {"pairing": pairing, "coarse": coarse, "offset": offset, "offset_m": error}
    if settings.pose:
        truth = T_target_source.double()
        T, usable = differentiable_poses(decoder, source, target, correlated, truth)
        figures |= {"pose": pose_loss(T, truth), "diverged": 1 - usable.double().mean()}
        total = total + settings.pose * figures["pose"]
    return total, {**figures, "right": matches_right(scores.detach(), labels, limit)}


def matches_right(scores: Tensor, labels: Labels, limit: float) -> Tensor:
    """Fraction of the sources with a positive whose best match lies within `limit` m."""
    used = labels.forward >= 0
    best = scores.masked_fill(labels.distance.isinf(), -1e4).argmax(2, keepdim=True)
    right = (labels.distance.gather(2, best)[..., 0] <= limit) & used
    return right.sum() / used.sum().clamp(min=1)


def offset_pairs(
    scores: Tensor, labels: Labels, masks: tuple[Tensor, Tensor], limit: float, settings: LossSettings
) -> tuple[Tensor, Tensor]:
    """Pairs whose offsets are compared: near ones, and the network's own best matches.

    Returns:
        (B, near + own) index into the flattened (N, M) pairs of each set pair, and 1 or 0, whether it counts.
    """
    chance = torch.rand_like(labels.distance).masked_fill(labels.distance > limit, -1).flatten(1)
    drawn, flat = chance.topk(settings.near)
    weight = (drawn >= 0).float()
    if not settings.own:
        return flat, weight
    own = softmax_both(scores, *masks).flatten(1).topk(settings.own)[1]
    is_close = (labels.distance.flatten(1).gather(1, own) <= _MAX_OWN_ERROR).float()
    return torch.cat([flat, own], 1), torch.cat([weight, is_close], 1)


def offset_loss(
    decoder: Decoder, source: Tokens, target: Tokens, T: Tensor, correlated: Correlated, pairs: tuple[Tensor, Tensor]
) -> tuple[Tensor, Tensor]:
    """Loss of the offsets of pairs from `offset_pairs`, and error (2 B, pairs) of each, m, in both directions.

    T: (B, 4, 4) T_target_source.
    """
    flat, weight = pairs
    m = target.xyz.shape[1]
    i, j = flat // m, flat % m
    x, y = take(source.xyz, i), take(target.xyz, j)
    a, b = take(correlated.source, i), take(correlated.target, j)
    forward, L_forward = decoder.offset(a, b)
    backward, L_backward = decoder.offset(b, a)
    inverse = torch.linalg.inv(T.double()).to(T.dtype)
    residual = torch.cat(
        [
            residuals_in_view(forward, transform(inverse, y) - x, take(source.axis, i)),
            residuals_in_view(backward, transform(T, x) - y, take(target.axis, j)),
        ]
    )
    weights = weight.repeat(2, 1)
    if decoder.settings.precision:
        loss = student_offset(residual, torch.cat([L_forward, L_backward]), weights)
    else:
        loss = mahalanobis_offset(residual.flatten(0, 1), weights.flatten())
    return loss, residual.detach().norm(dim=-1)
