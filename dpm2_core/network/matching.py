# SPDX-License-Identifier: Apache-2.0
"""Correlated descriptors to pairs of points: dual softmax, the best pairs, and their offsets."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from dpm2_core.geometry.se3_torch import transform
from dpm2_core.network.decoder import Correlated, Decoder
from dpm2_core.network.heads import into_set_frame
from dpm2_core.network.losses import cosine
from dpm2_core.network.tokens import Tokens

NEAR = 4.0  # m, descriptors that are farther apart under a rough pose do not match


class Correspondences(NamedTuple):
    """Points that should coincide, both directions of each pair, most confident first.

    Attributes:
        source, target: (B, 2K, 3) m, in the source and in the target frame.
        weight: (B, 2K) confidence 0..1, 0 where dropped.
        L: (B, 2K, 3, 3), precision L L^T, the first K in the source frame, the others in the target frame.
    """

    source: Tensor
    target: Tensor
    weight: Tensor
    L: Tensor


def softmax_both(scores: Tensor, source_mask: Tensor, target_mask: Tensor) -> Tensor:
    """Dual softmax of scores (B, N, M), over rows times over columns: probability of each match; 0 at padding."""
    valid = source_mask[:, :, None] & target_mask[:, None]
    scores = scores.masked_fill(~valid, -1e4)
    return scores.softmax(2) * scores.softmax(1) * valid


def pairs_wanted(source_mask: Tensor, target_mask: Tensor, ratio: float) -> Tensor:
    """Number of pairs (B,) for the pose of sets with masks (B, N) and (B, M): floor(ratio (n + m)) // 2 with their n
    and m descriptors."""
    return (ratio * (source_mask.sum(1) + target_mask.sum(1))).long() // 2


def best_pairs(
    probability: Tensor, source_mask: Tensor, target_mask: Tensor, ratio: float
) -> tuple[Tensor, Tensor, Tensor]:
    """The `pairs_wanted` most probable pairs of (B, N, M): probability, row and column (B, K). For sets smaller than
    others of the batch, pairs of probability 0 follow."""
    _, n, m = probability.shape
    wanted = pairs_wanted(source_mask, target_mask, ratio)
    value, flat = probability.flatten(1).topk(min(int(ratio * (n + m)) // 2, n * m))
    value = value * (torch.arange(value.shape[1], device=value.device) < wanted[:, None])
    return value, flat // m, flat % m


def take(values: Tensor, index: Tensor) -> Tensor:
    """values (B, N, C) at index (B, K): (B, K, C)."""
    return values.gather(1, index[..., None].expand(-1, -1, values.shape[-1]))


def match_scores(decoder: Decoder, correlated: Correlated) -> Tensor:
    """Similarities (B, N, M) in units of the temperature."""
    similarity = cosine(decoder.similarity(correlated.source), decoder.similarity(correlated.target))
    return similarity / decoder.settings.temperature


def correspond(
    decoder: Decoder, source: Tokens, target: Tokens, correlated: Correlated, scores: Tensor
) -> Correspondences:
    """Choose pairs by their scores (B, N, M) and predict, for each, the offsets in both directions."""
    settings = decoder.settings
    probability = softmax_both(scores, source.mask, target.mask)
    weight, i, j = best_pairs(probability, source.mask, target.mask, settings.pair_ratio)
    x, y = take(source.xyz, i), take(target.xyz, j)
    a, b = take(correlated.source, i), take(correlated.target, j)
    axis = torch.cat([take(source.axis, i), take(target.axis, j)])
    offset, L = decoder.offset(torch.cat([a, b]), torch.cat([b, a]))  # both directions at once
    (forward, backward), (L_forward, L_backward) = (part.chunk(2) for part in into_set_frame(offset, L, axis))
    weights = weight * (offset.norm(dim=-1) <= settings.offset_limit).unflatten(0, (2, -1))
    return Correspondences(
        torch.cat([x + forward, x], 1),
        torch.cat([y, y + backward], 1),
        weights.transpose(0, 1).flatten(1),
        torch.cat([L_forward, L_backward], 1),
    )


def guided_scores(scores: Tensor, T: Tensor, source: Tokens, target: Tokens) -> Tensor:
    """Scores given a rough pose: only descriptors that it brings near each other can match.

    Nearer ones are not preferred: that would confirm the rough pose, and made good poses worse.
    """
    distance = torch.cdist(transform(T, source.xyz), target.xyz)
    return scores.masked_fill(distance > NEAR, -1e4)
