# SPDX-License-Identifier: Apache-2.0
"""A first pose from matches most of which may be wrong: matches whose mutual distances agree support each other."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from dpm2_core.geometry.compiled import compiled

Array = NDArray[np.floating]

STRETCH = 0.6  # m, change of the distance between two matches at which they no longer support each other
TOLERANCE = 1.0  # m, residual of a match that supports a pose
HYPOTHESES = 12
MEMBERS = 12  # matches that make up a hypothesis
ROUNDS = 2  # of refitting each hypothesis to all that support it
MAX_SEEDS = 32  # matches that seed the hypotheses of `alternatives`; none that an earlier hypothesis brings together
APART_M, APART_DEG = 2.0, 10.0  # poses nearer than this count as one: they lead to the same solution
_POWER_ITERATIONS = 10


def consensus(source: Tensor, target: Tensor, weight: Tensor) -> Tensor:
    """The pose that most matches support, by second-order spatial compatibility; without a gradient.

    A rigid motion preserves distances. So two right matches agree with each other, and share others that agree with
    both; wrong ones agree only by chance. The matches with most support each seed a hypothesis. (The idea is that of
    SC2-PCR, CVPR 2022.)

    Args:
        source, target: (B, K, 3), m, K >= 1. weight: (B, K) confidence, 0 where dropped.

    Returns:
        T_target_source (B, 4, 4) float64.
    """
    fields = (tensor.detach().float().cpu().numpy() for tensor in (source, target, weight))
    poses = [_consensus(*map(np.ascontiguousarray, row)) for row in zip(*fields, strict=True)]
    return torch.from_numpy(np.stack(poses)).to(source.device)


def alternatives(source: Tensor, target: Tensor, weight: Tensor, known: Tensor, most: int) -> Tensor:
    """Poses (B, most, 4, 4) float64 that differ from those known (B, 4, 4) and from each other: those that bring the
    most matches together, whatever their confidence. If there are fewer, the known pose is repeated.

    Of two places that look alike from afar, the wrong one can have more confident matches, but hardly more of them.
    `source`, `target` and `weight` are those of `consensus`.
    """
    fields = (tensor.detach().float().cpu().numpy() for tensor in (source, target, weight))
    rows = (map(np.ascontiguousarray, row) for row in zip(*fields, strict=True))
    other = [
        _alternatives(x, y, w, T, most)
        for (x, y, w), T in zip(rows, known.detach().double().cpu().contiguous().numpy(), strict=True)
    ]
    return torch.from_numpy(np.stack(other)).to(source.device)


@compiled("f4[:, ::1](f4[:, ::1], f4[:, ::1], f4[::1])")
def _support(source: Array, target: Array, weight: Array) -> Array:
    """(K, K), column i: agreement of each match with match i, times the weight of the matches that agree with both."""
    k = len(weight)
    agree, support, common = np.empty((k, k), np.float32), np.empty((k, k), np.float32), np.empty(k, np.float32)
    for i in range(k):
        for j in range(k):
            target_squared = source_squared = np.float32(0)
            for a in range(3):
                target_squared += (target[i, a] - target[j, a]) ** 2
                source_squared += (source[i, a] - source[j, a]) ** 2
            change = (np.sqrt(source_squared) - np.sqrt(target_squared)) / np.float32(STRETCH)
            agree[i, j] = max(1 - change * change, 0)
    for i in range(k):
        common[:] = 0
        for j in range(k):
            shared = agree[i, j] * weight[j]
            if shared > 0:
                for other in range(k):
                    common[other] += shared * agree[j, other]
        for j in range(k):
            support[j, i] = agree[i, j] * common[j] if weight[j] > 0 else 0
    return support


@compiled("f8[:, ::1](f4[:, ::1], f4[:, ::1], f4[::1])")
def _fit_pose(source: Array, target: Array, weight: Array) -> Array:
    """`kabsch.weighted_kabsch` of one set of matches."""
    total, source_mean, target_mean, C = 0.0, np.zeros(3), np.zeros(3), np.zeros((3, 3))
    for n in range(len(weight)):
        total += weight[n]
        for a in range(3):
            source_mean[a] += weight[n] * source[n, a]
            target_mean[a] += weight[n] * target[n, a]
    source_mean, target_mean = source_mean / max(total, 1e-12), target_mean / max(total, 1e-12)
    for n in range(len(weight)):
        if weight[n] > 0:
            for a in range(3):
                for b in range(3):
                    C[a, b] += weight[n] * (target[n, a] - target_mean[a]) * (source[n, b] - source_mean[b])
    U, _, Vt = np.linalg.svd(C)
    for a in range(3):  # make both right-handed: a reflection is not a pose
        b, c = (a + 1) % 3, (a + 2) % 3
        U[a, 2] = U[b, 0] * U[c, 1] - U[c, 0] * U[b, 1]
        Vt[2, a] = Vt[0, b] * Vt[1, c] - Vt[0, c] * Vt[1, b]
    T = np.eye(4)
    for a in range(3):
        T[a, 3] = target_mean[a]
        for b in range(3):
            T[a, b] = U[a, 0] * Vt[0, b] + U[a, 1] * Vt[1, b] + U[a, 2] * Vt[2, b]
            T[a, 3] -= T[a, b] * source_mean[b]
    return T


@compiled("void(f8[:, ::1], f4[:, ::1], f4[:, ::1], f4[::1], f4[::1])")
def _support_weights(T: Array, source: Array, target: Array, weight: Array, out: Array) -> None:
    """Weights (K,) of the matches that a pose (4, 4) brings together."""
    for n in range(len(weight)):
        squared = 0.0
        for a in range(3):
            moved = T[a, 0] * source[n, 0] + T[a, 1] * source[n, 1] + T[a, 2] * source[n, 2] + T[a, 3]
            squared += (moved - target[n, a]) ** 2
        out[n] = max(1 - squared / TOLERANCE**2, 0.0) * weight[n]


@compiled("f8[:, ::1](f4[:, ::1], f4[:, ::1], f4[::1], f4[::1])")
def _refit_pose(source: Array, target: Array, weight: Array, score: Array) -> Array:
    """The pose (4, 4) fitted to matches with weights `score` (K,), then refitted to all matches that support it;
    `score` is overwritten with the weights of these."""
    T = _fit_pose(source, target, score)
    for _ in range(ROUNDS):
        _support_weights(T, source, target, weight, score)
        T = _fit_pose(source, target, score)
    _support_weights(T, source, target, weight, score)
    return T


def _hypothesis(support: Array, source: Array, target: Array, weight: Array) -> tuple[Array, Array]:
    """The pose (4, 4) of the matches that agree most with one match, given its `support` (K,), and the weights (K,) of
    all matches that support this pose."""
    members = np.argsort(-support)[:MEMBERS]
    score = np.zeros_like(support)
    score[members] = support[members]
    return _refit_pose(source, target, weight, score), score


def _consensus(source: Array, target: Array, weight: Array) -> Array:
    support = _support(source, target, weight)
    eigenvector = weight
    for _ in range(_POWER_ITERATIONS):
        eigenvector = eigenvector @ support
        eigenvector = eigenvector / max(float(np.linalg.norm(eigenvector)), 1e-12)
    poses = [_hypothesis(support[:, seed], source, target, weight) for seed in np.argsort(-eigenvector)[:HYPOTHESES]]
    return max(poses, key=lambda hypothesis: float(hypothesis[1].sum()))[0]


def _is_same_pose(one: Array, other: Array) -> bool:
    """Whether two poses (4, 4) lead to the same solution."""
    shift = one[:3, 3] - other[:3, 3]
    return bool(
        shift @ shift < APART_M**2 and np.vdot(one[:3, :3], other[:3, :3]) > 1 + 2 * np.cos(np.radians(APART_DEG))
    )


def _alternatives(source: Array, target: Array, weight: Array, known: Array, most: int) -> Array:
    support = _support(source, target, weight)
    explained = weight <= 0
    tried: list[tuple[int, Array]] = []  # number of matches that a pose brings together, and the pose
    for seed in np.argsort(-support.sum(0)):
        if not explained[seed] and len(tried) < MAX_SEEDS:
            T, score = _hypothesis(support[:, seed], source, target, weight)
            tried.append((int((score > 0).sum()), T))
            explained |= score > 0
            explained[seed] = True
    chosen = [known]
    for _, T in sorted(tried, key=lambda hypothesis: -hypothesis[0]):
        if len(chosen) <= most and not any(_is_same_pose(T, other) for other in chosen):
            chosen.append(T)
    return np.stack(chosen[1:] + [known] * (most + 1 - len(chosen)))
