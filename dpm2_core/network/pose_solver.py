# SPDX-License-Identifier: Apache-2.0
"""Pairs of points to a pose: consensus, precision-weighted solve or robust SVD.

Beyond the paper: the first pose is a consensus of pairs whose mutual distances agree. With it the descriptors are
matched again, each only to those that lie near it. If few pairs fit, other poses are tried. The paper's own method is
the solver `confident`.
"""

from __future__ import annotations

from typing import Any, Literal, NamedTuple

import numpy as np
import torch
from torch import Tensor

from dpm2_core.geometry.kabsch import weighted_kabsch
from dpm2_core.geometry.se3_torch import transform
from dpm2_core.network.consensus import TOLERANCE, alternatives, consensus
from dpm2_core.network.decoder import Correlated, Decoder
from dpm2_core.network.gauss_newton import solve_pose, weighted_gauss_newton, whitened_residuals
from dpm2_core.network.losses import cosine
from dpm2_core.network.matching import (
    Correspondences,
    best_pairs,
    correspond,
    guided_scores,
    match_scores,
    pairs_wanted,
    softmax_both,
    take,
)
from dpm2_core.network.solved import Solved, confidence_of
from dpm2_core.network.tokens import Tokens

MIN_INLIERS = 30
BEST_PAIRS = 30  # pairs whose mean probability measures how well the matches support a pose
CHI2 = 11.3  # 99 % quantile with 3 degrees of freedom: inliers of the precision-weighted solve
MIN_SHARE = 0.5  # share of the pairs: if fewer of them fit, other poses are tried, too
MAX_ALTERNATIVES = 8  # other poses
MIN_LOGIT_GAIN = 1.0  # logit by which the most probable of them must exceed that of the first pose to replace it
STARTING_PAIRS, STARTING_PROBABILITY = 64, 0.5  # the solver `confident` starts from these

Solver = Literal["consensus", "confident"]
"""Method that computes a pose from pairs: a consensus, with which they are matched again; or, as in the paper, a robust
SVD that starts from the most confident pairs, matched once."""


def first_pose(pairs: Correspondences) -> Tensor:
    """The pose (B, 4, 4) that most pairs support, however many are wrong."""
    half = pairs.source.shape[1] // 2  # the other half are the same pairs, seen from the target
    return consensus(pairs.source[:, :half], pairs.target[:, :half], pairs.weight[:, :half])


def agreement(source: Tokens, target: Tokens, temperature: float, ratio: float) -> Tensor:
    """How far two sets agree on a motion: the share (B,) of the best pairs that one pose brings together. They are
    matched before either has seen the other. The share is large for two views of a place, and small for two places. It
    takes a tenth of the time of a registration."""
    scores = cosine(source.features, target.features) / temperature
    weight, i, j = best_pairs(softmax_both(scores, source.mask, target.mask), source.mask, target.mask, ratio)
    if weight.shape[1] == 0:
        return weight.new_zeros(len(weight))
    source_points, target_points = take(source.xyz, i), take(target.xyz, j)
    error = (transform(consensus(source_points, target_points, weight), source_points) - target_points).norm(dim=-1)
    return ((error <= TOLERANCE) & (weight > 0)).float().mean(1)


def supporting(pairs: Correspondences, T: Tensor) -> Tensor:
    """The pairs (B, 2K) within `TOLERANCE` under a rough pose (B, 4, 4); all pairs if these are few."""
    usable = pairs.weight > 0
    error = (transform(T, pairs.source) - pairs.target).norm(dim=-1)
    inliers = (error <= TOLERANCE) & usable
    few = inliers.sum(1, keepdim=True) < MIN_INLIERS
    return torch.where(few, usable, inliers)


def most_confident(pairs: Correspondences) -> Tensor:
    """The pairs (B, 2K) that the paper's solver starts from: the `STARTING_PAIRS` most confident ones, and all
    of probability `STARTING_PROBABILITY`."""
    threshold = pairs.weight.topk(min(STARTING_PAIRS, pairs.weight.shape[1]))[0][:, -1:]
    return (pairs.weight >= threshold.clamp(max=STARTING_PROBABILITY)) & (pairs.weight > 0)


def robust_kabsch(pairs: Correspondences, inliers: Tensor, rounds: int = 3) -> tuple[Tensor, Tensor]:
    """Weighted SVD on inliers that are chosen again each round: those within mean + 3 deviations of the inliers.

    Args:
        inliers: (B, 2K), the first ones.

    Returns:
        T (B, 4, 4) float64 and inliers (B, 2K).
    """
    usable = pairs.weight > 0
    T = weighted_kabsch(pairs.source, pairs.target, pairs.weight * inliers)
    for _ in range(rounds):
        error = (transform(T, pairs.source) - pairs.target).norm(dim=-1)
        count = inliers.sum(1, keepdim=True).clamp(min=1)
        mean = (error * inliers).sum(1, keepdim=True) / count
        deviation = (((error - mean) ** 2 * inliers).sum(1, keepdim=True) / count).sqrt()
        chosen = (error <= mean + 3 * deviation) & usable
        enough = chosen.sum(1, keepdim=True) >= MIN_INLIERS
        inliers = torch.where(enough, chosen, inliers)
        T = weighted_kabsch(pairs.source, pairs.target, pairs.weight * inliers)
    return T, inliers


class Matched(NamedTuple):
    """A batch of set pairs that the decoder has correlated, with the scores (B, N, M) of their matches, and the pairs
    chosen from these without a pose."""

    source: Tokens
    target: Tokens
    correlated: Correlated
    scores: Tensor
    unguided: Correspondences


def solve_batch(
    decoder: Decoder, source: Tokens, target: Tokens, correlated: Correlated, solver: Solver = "consensus"
) -> Solved | None:
    """Match and solve; None if there is nothing to match."""
    scores = match_scores(decoder, correlated)
    unguided = correspond(decoder, source, target, correlated, scores)
    if unguided.weight.shape[1] == 0:
        return None
    matched = Matched(source, target, correlated, scores, unguided)
    if solver == "confident":
        T, information, inliers = _solve_svd(unguided, most_confident(unguided))
        return _assess(decoder, matched, unguided, (T, information, inliers))
    solved = _solve_from(decoder, matched, first_pose(unguided))
    return _try_alternatives(decoder, matched, solved) if decoder.settings.precision else solved


def _solve_from(decoder: Decoder, matched: Matched, T: Tensor) -> Solved:
    """Solve from rough poses (B, 4, 4); then match again, only what is near under the current pose, and solve again."""
    source, target, correlated, scores, pairs = matched
    solve = _solve_precise if decoder.settings.precision else _solve_svd_near
    T, information, inliers = solve(pairs, T)
    for _ in range(decoder.settings.guided):
        pairs = correspond(decoder, source, target, correlated, guided_scores(scores, T, source, target))
        T, information, inliers = solve(pairs, T)
    return _assess(decoder, matched, pairs, (T, information, inliers))


def _assess(
    decoder: Decoder, matched: Matched, pairs: Correspondences, solution: tuple[Tensor, Tensor, Tensor]
) -> Solved:
    """Poses (B, 4, 4), information (B, 6, 6) and inliers (B, 2K) of pairs, with figures of their quality."""
    T, information, inliers = solution
    covariance = decoder.settings.covariance_scale * torch.linalg.inv_ex(information)[0]
    count = inliers.sum(1)
    wanted = pairs_wanted(matched.source.mask, matched.target.mask, decoder.settings.pair_ratio)
    share = count / (2 * wanted).clamp(min=1)
    return Solved(T, covariance, _residual(pairs, T, inliers), count, _support(matched.unguided, T), share)


def _try_alternatives(decoder: Decoder, matched: Matched, solved: Solved) -> Solved:
    """The solution, replaced where few pairs fit, as on both sides of a corner, and another pose is clearly more
    probable."""
    rows = (solved.share < MIN_SHARE).nonzero()[:, 0]
    if len(rows) == 0:
        return solved
    matched = _rows(matched, rows)
    half = matched.unguided.source.shape[1] // 2
    source, target, weight = (field[:, :half] for field in matched.unguided[:3])
    starts = alternatives(source, target, weight, solved.T[rows], MAX_ALTERNATIVES)
    member = torch.arange(len(rows), device=rows.device)
    others = _solve_from(decoder, _rows(matched, member.repeat_interleave(MAX_ALTERNATIVES)), starts.flatten(0, 1))
    best_logit, best = confidence_of(decoder, others).view(-1, MAX_ALTERNATIVES).max(1)
    is_better = best_logit > confidence_of(decoder, solved)[rows] + MIN_LOGIT_GAIN
    return _with_rows(solved, rows[is_better], _rows(others, (member * MAX_ALTERNATIVES + best)[is_better]))


def _rows(batch: Any, index: Tensor) -> Any:
    """Some members of a batch: tensors in arbitrarily nested named tuples."""
    return batch[index] if isinstance(batch, Tensor) else type(batch)(*(_rows(field, index) for field in batch))


def _with_rows(batch: Any, index: Tensor, others: Any) -> Any:
    """The batch with its members `index` replaced by others."""
    if isinstance(batch, Tensor):
        return batch.index_copy(0, index, others)
    return type(batch)(*(_with_rows(*fields) for fields in zip(batch, [index] * len(batch), others, strict=True)))


def _solve_precise(pairs: Correspondences, T: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Pose, information and inliers by the predicted precisions; compiled on the CPU if no gradient is needed."""
    if T.device.type == "cpu" and not torch.is_grad_enabled():
        T, information, squared = _solve_compiled(pairs, T)
    else:
        T, information = weighted_gauss_newton(T, pairs)
        squared = whitened_residuals(T, pairs)[0].square().sum(-1)
    return T, information, (squared <= CHI2) & (pairs.weight > 0)


def _solve_compiled(pairs: Correspondences, T: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """`weighted_gauss_newton`, and the squared residuals after it."""
    poses = T.double().clone()
    fields = (pairs.source, pairs.target, pairs.weight, pairs.L)
    arrays = [np.ascontiguousarray(field.double().numpy()) for field in fields]
    solved = [solve_pose(*row) for row in zip(poses.numpy(), *arrays, strict=True)]
    information, squared = (torch.from_numpy(np.stack(parts)) for parts in zip(*solved, strict=True))
    return poses, information, squared


def _solve_svd_near(pairs: Correspondences, T: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """`_solve_svd` from the pairs that support a pose."""
    return _solve_svd(pairs, supporting(pairs, T))


def _solve_svd(pairs: Correspondences, inliers: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Pose, information and inliers by the robust SVD: all offsets count as equally precise."""
    T, inliers = robust_kabsch(pairs, inliers)
    sigma = _residual(pairs, T, inliers).clamp(min=0.02)[:, None, None, None] / 3**0.5
    _, jacobian = whitened_residuals(T, pairs._replace(L=torch.eye(3, device=T.device).expand_as(pairs.L)))
    jacobian = (jacobian * inliers[..., None, None] / sigma).flatten(1, 2)
    return T, jacobian.transpose(1, 2) @ jacobian + 1e-6 * torch.eye(6, device=T.device), inliers


def _residual(pairs: Correspondences, T: Tensor, inliers: Tensor) -> Tensor:
    """Root mean square distance (B,) between the points of the inliers (B, 2K), m."""
    error = (transform(T, pairs.source.double()) - pairs.target).norm(dim=-1)
    return ((error**2 * inliers).sum(1) / inliers.sum(1).clamp(min=1)).sqrt()


def _support(unguided: Correspondences, T: Tensor) -> Tensor:
    """Mean probability (B,) of the best pairs, matched without the poses, that the poses bring together."""
    error = (transform(T, unguided.source.double()) - unguided.target).norm(dim=-1)
    weight = unguided.weight * (error <= TOLERANCE)
    return weight.topk(min(BEST_PAIRS, weight.shape[1]))[0].mean(1)
