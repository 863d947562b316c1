# SPDX-License-Identifier: Apache-2.0
"""Registrations from solved poses, with the probability that a pose is right, and that both sets saw the same place."""

from __future__ import annotations

import torch
from torch import Tensor

from dpm2_core.estimates import Registration
from dpm2_core.geometry import se3
from dpm2_core.geometry.calibration import with_calibration
from dpm2_core.network.decoder import Correlated, Decoder
from dpm2_core.network.pose_solver import Solver, solve_batch
from dpm2_core.network.solved import Solved, confidence_of, overlap_features
from dpm2_core.network.tokens import Tokens

LEAST = 0.1  # confidence: a pose below it is rejected
LEAST_SHARE = 0.4  # of the pairs: fewer fit only at wrong poses
LEAST_MATCHED = 0.15  # mean probability of the best pairs, if the confidence head does not apply: solver `confident`


def register_batch(
    decoder: Decoder, source: Tokens, target: Tokens, correlated: Correlated, solver: Solver = "consensus"
) -> list[Registration]:
    """The registrations of a batch, T_target_source each."""
    solved = solve_batch(decoder, source, target, correlated, solver)
    if solved is None:
        return [Registration.failed("neural", "0 matching descriptors, want 3")] * len(source.xyz)
    if decoder.settings.precision and solver == "consensus":  # the head was trained on its figures
        confidence = confidence_of(decoder, solved).sigmoid()
        fit_objections = [_fit_objection(*row) for row in zip(solved.share.tolist(), confidence.tolist(), strict=True)]
    else:
        confidence = solved.support
        fit_objections = [_match_objection(value) for value in confidence.tolist()]
    count_objections = [_count_objection(count) for count in solved.inliers.tolist()]
    objections = [first or second for first, second in zip(count_objections, fit_objections, strict=True)]
    overlap = overlap_probability(decoder, source, target, correlated, solved)
    figures = (field.tolist() for field in (confidence, solved.residual, overlap))
    return [
        _registration(*row) for row in zip(solved.T.cpu(), solved.covariance.cpu(), *figures, objections, strict=True)
    ]


def overlap_probability(
    decoder: Decoder, source: Tokens, target: Tokens, correlated: Correlated, solved: Solved
) -> Tensor:
    """Probability (B,) that each pair was seen from within 20 m; NaN while the head is untrained."""
    if not decoder.overlap_trained:
        return torch.full(source.mask.shape[:1], torch.nan)
    return decoder.overlap(*correlated, source.mask, target.mask, overlap_features(solved)).sigmoid()


def _count_objection(count: int) -> str:
    """Why this number of pairs gives no pose; empty if it does."""
    return f"{count} matching descriptors, want 3" if count < 3 else ""


def _fit_objection(share: float, confidence: float) -> str:
    """Why a pose is rejected that brings this share of the pairs together; empty if it is not."""
    if share < LEAST_SHARE:
        return f"only {share:.0%} of the matched descriptors fit one motion"
    return "" if confidence >= LEAST else f"right with a probability of only {confidence:.0%}"


def _match_objection(support: float) -> str:
    """The same for a pose that is judged only by the mean probability of the matches that support it."""
    return "" if support >= LEAST_MATCHED else f"descriptors match with a confidence of only {support:.2f}"


def _registration(
    T: Tensor, covariance: Tensor, confidence: float, rmse: float, overlap: float, objection: str
) -> Registration:
    if not bool(T.isfinite().all() and covariance.isfinite().all()):
        return Registration.failed("neural", "no finite pose")
    # Rigid to float64: the solver composes many steps, and the exponential of a large one is rigid only to 2e-15.
    rigid = se3.orthonormalized(T.double().numpy())
    result = Registration(rigid, covariance.numpy(), confidence, rmse, "neural", not objection, objection, overlap)
    return with_calibration(result, rigid)
