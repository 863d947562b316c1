# SPDX-License-Identifier: Apache-2.0
"""A first pose out of matches of which most may be wrong: those that keep each other's distances vote together."""

from __future__ import annotations

import torch
from torch import Tensor

from dpm2_core.geometry.kabsch import weighted_kabsch

STRETCH = 0.6  # m, change of the distance between two matches at which they no longer support each other
TOLERANCE = 1.0  # m, residual of a match that supports a pose
HYPOTHESES = 12
MEMBERS = 12  # matches that make up a hypothesis
ROUNDS = 2  # of refitting each hypothesis to all that support it


def consensus(source: Tensor, target: Tensor, weight: Tensor) -> Tensor:
    """The pose that most matches support, by second-order spatial compatibility.

    A rigid motion keeps distances: two right matches agree on theirs, and on a third that agrees with both; wrong ones
    agree by chance alone. The matches with most support each head a hypothesis. (The idea is that of SC2-PCR,
    CVPR 2022.)

    Args:
        source, target: (B, K, 3), m, K >= 1. weight: (B, K) confidence, 0 where dropped.

    Returns:
        T_target_source (B, 4, 4) float64.
    """
    source, target, weight = source.float(), target.float(), weight.float()
    batch, k, _ = source.shape
    change = torch.cdist(source, source) - torch.cdist(target, target)
    agree = (1 - (change / STRETCH) ** 2).clamp(min=0) * (weight > 0)[:, None]
    support = agree * ((agree * weight[:, None]) @ agree.mT)
    leading = weight
    for _ in range(10):  # power iteration
        leading = torch.nn.functional.normalize((support @ leading[..., None])[..., 0], dim=-1)
    heads = leading.topk(min(HYPOTHESES, k))[1]
    rows = support.gather(1, heads[..., None].expand(-1, -1, k))
    score, members = rows.topk(min(MEMBERS, k))
    hypotheses = heads.shape[1]

    def fit(source: Tensor, target: Tensor, weight: Tensor) -> Tensor:
        flat = (tensor.flatten(0, 1) for tensor in (source, target, weight))
        return weighted_kabsch(*flat).unflatten(0, (batch, hypotheses))

    every = (batch, hypotheses, k, 3)
    sources, targets = source[:, None].expand(every), target[:, None].expand(every)
    at = members[..., None].expand(*members.shape, 3)
    T = fit(sources.gather(2, at), targets.gather(2, at), score)
    for _ in range(ROUNDS):
        T = fit(sources, targets, _supporting(T, sources, targets, weight))
    best = _supporting(T, sources, targets, weight).sum(-1).argmax(1)
    return T[torch.arange(batch, device=T.device), best]


def _supporting(T: Tensor, sources: Tensor, targets: Tensor, weight: Tensor) -> Tensor:
    """Weights (B, H, K) of the matches that a pose (B, H, 4, 4) brings together."""
    moved = sources @ T[..., :3, :3].float().mT + T[..., None, :3, 3].float()
    squared = (moved - targets).square().sum(-1)
    return (1 - squared / TOLERANCE**2).clamp(min=0) * weight[:, None]
