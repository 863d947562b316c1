# SPDX-License-Identifier: Apache-2.0
"""Pairs of points to a pose: consensus, precision-weighted solve or robust SVD, and its overlap probability.

Beyond the paper: the first pose is a consensus of pairs that keep each other's distances, and with it the descriptors
are matched again, each to what lies near it. The paper's own way is the solver `confident`.
"""

from __future__ import annotations

from typing import Literal, NamedTuple

import numpy as np
import torch
from torch import Tensor

from dpm2_core.frame import Registration
from dpm2_core.geometry import se3
from dpm2_core.geometry.calibration import with_calibration
from dpm2_core.geometry.kabsch import transform, weighted_kabsch
from dpm2_core.network.consensus import TOLERANCE, consensus
from dpm2_core.network.decoder import Correlated, Decoder
from dpm2_core.network.gauss_newton import solve_pose
from dpm2_core.network.losses import cosine
from dpm2_core.network.matching import (
    Correspondences,
    best_pairs,
    correspond,
    guided_scores,
    match_scores,
    softmax_both,
    take,
)
from dpm2_core.network.tokens import Tokens

MIN_INLIERS = 30
CONFIDENT = 30  # pairs whose mean confidence is that of the registration
CHI2 = 11.3  # 99 % quantile with 3 degrees of freedom: inliers of the precision-weighted solve
ROUNDS = 8  # of the precision-weighted solve
SOFT = 3.0  # squared residual from which the weights of the precision-weighted solve fall
MOST_CONFIDENT, SURE = 64, 0.5  # the solver `confident` starts from so many pairs, and from those that are so probable

Solver = Literal["consensus", "confident"]
"""How pairs become a pose: by a consensus and matched again with the pose at hand; or, as in the paper, by a robust SVD
that starts from the most confident pairs, matched once."""


def first_pose(pairs: Correspondences) -> Tensor:
    """The pose (B, 4, 4) that most pairs support, however many are wrong."""
    half = pairs.source.shape[1] // 2  # the other half are the same pairs, seen from the target
    return consensus(pairs.source[:, :half], pairs.target[:, :half], pairs.weight[:, :half])


def agreement(source: Tokens, target: Tokens, temperature: float, ratio: float) -> Tensor:
    """How far two sets, matched as they are before either has seen the other, agree on a motion: the part (B,) of the
    best pairs that one pose brings together. Of two views of a place it is large, of two places small, and it takes a
    tenth of the time of a registration."""
    scores = cosine(source.features, target.features) / temperature
    weight, i, j = best_pairs(softmax_both(scores, source.mask, target.mask), ratio)
    if weight.shape[1] == 0:
        return weight.new_zeros(len(weight))
    at_source, at_target = take(source.xyz, i), take(target.xyz, j)
    error = (transform(consensus(at_source, at_target, weight), at_source) - at_target).norm(dim=-1)
    return ((error <= TOLERANCE) & (weight > 0)).float().mean(1)


def supporting(pairs: Correspondences, T: Tensor) -> Tensor:
    """The pairs (B, 2K) within `TOLERANCE` of a rough pose (B, 4, 4); all where they are few."""
    usable = pairs.weight > 0
    error = (transform(T, pairs.source) - pairs.target).norm(dim=-1)
    inliers = (error <= TOLERANCE) & usable
    few = inliers.sum(1, keepdim=True) < MIN_INLIERS
    return torch.where(few, usable, inliers)


def most_confident(pairs: Correspondences) -> Tensor:
    """The pairs (B, 2K) that the paper's solver starts from: the `MOST_CONFIDENT`, and all that are `SURE`."""
    least = pairs.weight.topk(min(MOST_CONFIDENT, pairs.weight.shape[1]))[0][:, -1:]
    return (pairs.weight >= least.clamp(max=SURE)) & (pairs.weight > 0)


def robust_kabsch(pairs: Correspondences, inliers: Tensor, rounds: int = 3) -> tuple[Tensor, Tensor]:
    """Weighted SVD on inliers that are chosen anew each round: those within mean + 3 deviations of the inliers.

    Args:
        inliers: (B, 2K), the first.

    Returns:
        T (B, 4, 4) float64 and inliers (B, 2K).
    """
    usable = pairs.weight > 0
    T = weighted_kabsch(pairs.source, pairs.target, pairs.weight * inliers)
    for _ in range(rounds):
        error = (transform(T, pairs.source) - pairs.target).norm(dim=-1)
        count = inliers.sum(1, keepdim=True).clamp(min=1)
        mean = (error * inliers).sum(1, keepdim=True) / count
        spread = (((error - mean) ** 2 * inliers).sum(1, keepdim=True) / count).sqrt()
        chosen = (error <= mean + 3 * spread) & usable
        enough = chosen.sum(1, keepdim=True) >= MIN_INLIERS
        inliers = torch.where(enough, chosen, inliers)
        T = weighted_kabsch(pairs.source, pairs.target, pairs.weight * inliers)
    return T, inliers


def whitened_residuals(T: Tensor, pairs: Correspondences) -> tuple[Tensor, Tensor]:
    """Residuals in units of their deviation (B, 2K, 3) and their Jacobian (B, 2K, 3, 6) for T exp(xi)."""
    half = pairs.source.shape[1] // 2
    R, t = T[:, None, :3, :3], T[:, None, :3, 3]
    source, target, L = pairs.source.double(), pairs.target.double(), pairs.L.double()
    moved_back = ((target - t)[..., None, :] @ R)[..., 0, :]  # R^T (y - t)
    L = torch.cat([L[:, :half], R.transpose(-1, -2) @ L[:, half:]], 1)  # all in the source frame
    # In the source frame the step turns the target's point, in the target frame the source's.
    lever_arm = torch.cat([moved_back[:, :half], source[:, half:]], 1)
    zero = torch.zeros_like(lever_arm[..., 0])
    x, y, z = lever_arm.unbind(-1)
    minus_hat = torch.stack([zero, z, -y, -z, zero, x, y, -x, zero], -1).unflatten(-1, (3, 3))
    eye = torch.eye(3, dtype=source.dtype, device=source.device).expand_as(minus_hat)
    jacobian = L.transpose(-1, -2) @ torch.cat([minus_hat, eye], -1)
    residual = (L.transpose(-1, -2) @ (source - moved_back)[..., None])[..., 0]
    return residual, jacobian


def weighted_gauss_newton(T: Tensor, pairs: Correspondences, rounds: int = ROUNDS) -> tuple[Tensor, Tensor]:
    """Iteratively reweighted Gauss-Newton on the residuals weighed with their predicted precision.

    The weights are those of Geman and McClure: in a tunnel the points of a scan claim together, each unsure, that
    nothing moved; what a few corners of an image say otherwise stands, if it is where the steps start.

    Args:
        T: (B, 4, 4) start. pairs: the correspondences.

    Returns:
        T (B, 4, 4) and the information matrix (B, 6, 6) of xi in T exp(xi), rotation first.
    """
    information = T.new_zeros(len(T), 6, 6)
    damping = torch.eye(6, dtype=T.dtype, device=T.device) * 1e-6
    for _ in range(rounds):
        residual, jacobian = whitened_residuals(T, pairs)
        squared = (residual * residual).sum(-1)
        weight = pairs.weight * ((SOFT + 3) / (SOFT + squared)) ** 2
        weighted = jacobian * weight[..., None, None]
        information = (weighted.flatten(1, 2).transpose(1, 2) @ jacobian.flatten(1, 2)) + damping
        gradient = weighted.flatten(1, 2).transpose(1, 2) @ residual.flatten(1, 2)[..., None]
        T = T @ exp(-torch.linalg.solve(information, gradient)[..., 0])
    return T, information


def exp(xi: Tensor) -> Tensor:
    """SE(3) exponential of (B, 6) [rotation, translation]."""
    w, v = xi[:, :3], xi[:, 3:]
    zero = torch.zeros_like(w[:, 0])
    x, y, z = w.unbind(-1)
    generator = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], -1).unflatten(-1, (3, 3))
    out = xi.new_zeros(len(xi), 4, 4)
    out[:, :3, :3], out[:, :3, 3] = generator, v
    return torch.linalg.matrix_exp(out)


class Solved(NamedTuple):
    """Poses of a batch.

    Attributes:
        T: (B, 4, 4) float64. information: (B, 6, 6) of xi in T exp(xi). inliers: (B, 2K) of `pairs`.
        confidence: (B,) 0..1.
    """

    T: Tensor
    information: Tensor
    pairs: Correspondences
    inliers: Tensor
    confidence: Tensor


def solve_batch(
    decoder: Decoder, source: Tokens, target: Tokens, correlated: Correlated, solver: Solver = "consensus"
) -> Solved | None:
    """Match and solve; None where there is nothing to match."""
    scores = match_scores(decoder, correlated)
    unguided = pairs = correspond(decoder, source, target, correlated, scores)
    if pairs.weight.shape[1] == 0:
        return None
    if solver == "confident":
        T, information, inliers = _solve_svd(pairs, most_confident(pairs))
        return Solved(T, information, pairs, inliers, _confidence(pairs, T))
    T = first_pose(pairs)
    solve = _solve_precise if decoder.settings.precision else _solve_svd_near
    T, information, inliers = solve(pairs, T)
    for _ in range(decoder.settings.guided):
        pairs = correspond(decoder, source, target, correlated, guided_scores(scores, T, source, target))
        T, information, inliers = solve(pairs, T)
    return Solved(T, information, pairs, inliers, _confidence(unguided, T))


def overlap_features(solved: Solved) -> Tensor:
    """What the pose of a pair says about its overlap (B, 2): its confidence, and the distance in units of 20 m."""
    distance = (solved.T[:, :3, 3].norm(dim=-1) / 20).clamp(max=3).nan_to_num(3.0)
    return torch.stack([solved.confidence.nan_to_num(0.0), distance.to(solved.confidence.dtype)], -1).float()


def overlap_probability(
    decoder: Decoder, source: Tokens, target: Tokens, correlated: Correlated, solved: Solved
) -> Tensor:
    """Probability (B,) that each pair was seen from within 20 m; NaN while the head is untrained."""
    if not decoder.overlap_trained:
        return torch.full(source.mask.shape[:1], torch.nan)
    return decoder.overlap(*correlated, source.mask, target.mask, overlap_features(solved)).sigmoid()


def register_batch(
    decoder: Decoder, source: Tokens, target: Tokens, correlated: Correlated, solver: Solver = "consensus"
) -> list[Registration]:
    """The registrations of a batch, T_target_source each."""
    solved = solve_batch(decoder, source, target, correlated, solver)
    if solved is None:
        return [_nothing("0 matching descriptors, want 3")] * len(source.xyz)
    T, inliers = solved.T, solved.inliers
    error = (transform(T, solved.pairs.source.double()) - solved.pairs.target).norm(dim=-1)
    count = inliers.sum(1)
    rmse = ((error**2 * inliers).sum(1) / count.clamp(min=1)).sqrt()
    covariance = decoder.settings.covariance_scale * torch.linalg.inv(solved.information)
    overlap = overlap_probability(decoder, source, target, correlated, solved)
    figures = (field.tolist() for field in (solved.confidence, rmse, count, overlap))
    return [_registration(*row) for row in zip(T.cpu(), covariance.cpu(), *figures, strict=True)]


def _solve_precise(pairs: Correspondences, T: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Pose, information and inliers by the predicted precisions; as machine code where no gradient is asked for."""
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
    solved = [
        solve_pose(pose, source, target, weight, L, (SOFT, float(ROUNDS)))
        for pose, source, target, weight, L in zip(poses.numpy(), *arrays, strict=True)
    ]
    information, squared = (torch.from_numpy(np.stack(parts)) for parts in zip(*solved, strict=True))
    return poses, information, squared


def _solve_svd_near(pairs: Correspondences, T: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """`_solve_svd` from the pairs that support a pose."""
    return _solve_svd(pairs, supporting(pairs, T))


def _solve_svd(pairs: Correspondences, inliers: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Pose, information and inliers by the robust SVD: every offset counts as known like the others."""
    T, inliers = robust_kabsch(pairs, inliers)
    error = (transform(T, pairs.source.double()) - pairs.target).norm(dim=-1)
    rmse = ((error**2 * inliers).sum(1) / inliers.sum(1).clamp(min=1)).sqrt()
    sigma = rmse.clamp(min=0.02)[:, None, None, None] / 3**0.5
    _, jacobian = whitened_residuals(T, pairs._replace(L=torch.eye(3, device=T.device).expand_as(pairs.L)))
    jacobian = (jacobian * inliers[..., None, None] / sigma).flatten(1, 2)
    return T, jacobian.transpose(1, 2) @ jacobian + 1e-6 * torch.eye(6, device=T.device), inliers


def _confidence(unguided: Correspondences, T: Tensor) -> Tensor:
    """Mean probability of the best pairs that the pose bears out, as matched without knowing it."""
    error = (transform(T, unguided.source.double()) - unguided.target).norm(dim=-1)
    weight = unguided.weight * (error <= TOLERANCE)
    return weight.topk(min(CONFIDENT, weight.shape[1]))[0].mean(1)


def _registration(
    T: Tensor, covariance: Tensor, confidence: float, rmse: float, count: int, overlap: float
) -> Registration:
    if not bool(T.isfinite().all() and covariance.isfinite().all()):
        return _nothing("no finite pose")
    if count < 3:
        return _nothing(f"{count} matching descriptors, want 3")
    # Rigid to float64: the solver composes many steps, and an exponential of a large one leaves 1 + 2e-15 behind.
    rigid = se3.orthonormalized(T.double().numpy())
    result = Registration(rigid, covariance.numpy(), confidence, rmse, "neural", overlap=overlap)
    return with_calibration(result, rigid)


def _nothing(reason: str) -> Registration:
    return Registration(np.eye(4), np.eye(6) * 1e6, 0.0, np.inf, "neural", False, reason)
