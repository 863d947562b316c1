# SPDX-License-Identifier: Apache-2.0
"""The pose from correspondences, and the decoder around it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from dpm2_core.descriptors import Descriptors
from dpm2_core.geometry import se3
from dpm2_core.geometry.se3_torch import transform
from dpm2_core.network.consensus import alternatives, consensus
from dpm2_core.network.gauss_newton import weighted_gauss_newton, whitened_residuals
from dpm2_core.network.heads import OffsetHead, into_set_frame
from dpm2_core.network.matching import Correspondences, best_pairs, guided_scores, softmax_both
from dpm2_core.network.model import DeepPointMap2
from dpm2_core.network.pointnext import from_view, to_view
from dpm2_core.network.pose_solver import (
    first_pose,
    most_confident,
    robust_kabsch,
    supporting,
)
from dpm2_core.network.tokens import Tokens, to_tokens

from ...helpers.networks import described


def perfect(noise: np.random.Generator, batch: int = 2, pairs: int = 60) -> tuple[Correspondences, torch.Tensor]:
    """Matches without error, and their pose."""
    T = torch.from_numpy(se3.exp(noise.normal(0, 1, (batch, 6)) * [0.3, 0.3, 2, 5, 5, 1]))
    source = torch.from_numpy(noise.normal(0, 15, (batch, 2 * pairs, 3)))
    root = torch.from_numpy(noise.normal(0, 1, (batch, 2 * pairs, 3, 3))).tril()
    root.diagonal(dim1=-2, dim2=-1).abs_().add_(0.5)
    weight = torch.from_numpy(noise.uniform(0.2, 1, (batch, 2 * pairs)))
    return Correspondences(source, transform(T, source), weight, root), T


def test_perfect_matches_give_the_exact_pose(noise: np.random.Generator) -> None:
    """Weighted SVD to rounding; the precision-weighted solver stays there and converges to it from 0.3 rad and 2 m
    off."""
    pairs, T = perfect(noise)
    found, _ = robust_kabsch(pairs, supporting(pairs, first_pose(pairs)))
    torch.testing.assert_close(found, T, atol=1e-6, rtol=0)
    off = T @ torch.from_numpy(se3.exp([0.1, -0.1, 0.3, 1, -2, 0.5]))
    torch.testing.assert_close(weighted_gauss_newton(off, pairs, rounds=30)[0], T, atol=1e-6, rtol=0)


def test_outliers_are_left_out(noise: np.random.Generator) -> None:
    """A fifth of the matches is off by tens of meters, with low confidence: neither solution moves by a millimeter."""
    pairs, T = perfect(noise)
    wrong = torch.arange(pairs.source.shape[1]) % 5 == 0
    target = torch.where(
        wrong[:, None], pairs.target + torch.from_numpy(noise.normal(0, 30, pairs.target.shape)), pairs.target
    )
    pairs = pairs._replace(target=target, weight=torch.where(wrong, 0.05, pairs.weight))
    found, inliers = robust_kabsch(pairs, supporting(pairs, first_pose(pairs)), rounds=10)
    assert not inliers[:, wrong].any()
    torch.testing.assert_close(weighted_gauss_newton(found, pairs)[0], T, atol=1e-3, rtol=0)


def test_the_papers_start_trusts_the_most_confident(noise: np.random.Generator) -> None:
    """The paper's start is correct if its most confident matches are, however wrong the rest is. If they are wrong, it
    fails, but a consensus does not."""
    pairs, T = perfect(noise)
    right = torch.arange(pairs.source.shape[1]) % 12 < 7  # 70 of 120, in both halves
    target = torch.where(
        right[:, None], pairs.target, pairs.target + torch.from_numpy(noise.normal(0, 30, pairs.target.shape))
    )
    pairs = pairs._replace(target=target, weight=torch.where(right, 0.8, 0.01).expand(len(T), -1).double())
    chosen = most_confident(pairs)
    assert chosen[:, right].all()
    found, _ = robust_kabsch(pairs, chosen, rounds=10)
    torch.testing.assert_close(found, T, atol=1e-6, rtol=0)
    misled = pairs._replace(weight=torch.where(right, 0.3, 0.6).expand(len(T), -1).double())
    lost, _ = robust_kabsch(misled, most_confident(misled), rounds=10)
    assert ((lost - T)[:, :3, 3].norm(dim=1) > 1).all()
    torch.testing.assert_close(first_pose(misled), T, atol=1e-3, rtol=0)
    few = Correspondences(*(field[:, :40] for field in pairs))
    assert most_confident(few).all()  # fewer than it would start with


@pytest.mark.parametrize("wrong", [0.5, 0.7])
def test_consensus_survives_a_majority_of_wrong_matches(noise: np.random.Generator, wrong: float) -> None:
    """Wrong matches are as confident as the right ones, to anywhere in the scene: right ones within 0.2 m decide."""
    pairs, T = perfect(noise, batch=4, pairs=100)
    bad = torch.from_numpy(noise.random(pairs.weight.shape) < wrong)
    anywhere = transform(T, torch.from_numpy(noise.normal(0, 15, pairs.target.shape)))
    target = torch.where(
        bad[..., None], anywhere, pairs.target + torch.from_numpy(noise.normal(0, 0.1, (*bad.shape, 3)))
    )
    result = first_pose(pairs._replace(target=target))
    for estimate, truth in zip(result.numpy(), T.numpy(), strict=True):
        error = se3.way(truth, estimate)
        assert np.linalg.norm(error[3:]) < 0.3  # 0.1 m of noise per point, some thirty correct matches
        assert np.linalg.norm(error[:3]) < 0.03


def test_alternatives_are_other_poses_with_the_most_matches_first(noise: np.random.Generator) -> None:
    """Of two consistent motions, the consensus is the one with fewer, more confident matches, and the other is the
    first alternative. No motion is given twice; if no other motion has enough matches, the known one fills up the
    rest."""
    pairs, T = perfect(noise, pairs=100)
    other = torch.from_numpy(se3.exp([0, 0, 2.5, 12, -7, 0.4]))
    source, target, weight = pairs.source[:, :100].clone(), pairs.target[:, :100].clone(), torch.full((2, 100), 0.1)
    target[:, :30], weight[:, :30] = transform(other.expand(2, 4, 4), source[:, :30]), 0.9
    known = consensus(source, target, weight)
    torch.testing.assert_close(known, other.expand(2, 4, 4), atol=1e-3, rtol=0)
    found = alternatives(source, target, weight, known, 4)
    torch.testing.assert_close(found[:, 0], T, atol=1e-3, rtol=0)
    few = alternatives(source[:, :30], target[:, :30], weight[:, :30], known, 3)
    torch.testing.assert_close(few, known[:, None].expand(2, 3, 4, 4), atol=0, rtol=0)
    for poses in torch.cat([known[:, None], found], 1).numpy():
        others = [(a, b) for i, a in enumerate(poses) for b in poses[:i] if (a != b).any()]
        assert all(m > 2 or deg > 10 for m, deg in (se3.apart(a, b) for a, b in others))


def test_alternatives_of_matches_without_weight_are_the_known_pose(noise: np.random.Generator) -> None:
    pairs, T = perfect(noise, pairs=5)
    found = alternatives(pairs.source, pairs.target, torch.zeros_like(pairs.weight), T, 2)
    torch.testing.assert_close(found, T[:, None].expand(2, 2, 4, 4), atol=0, rtol=0)


def test_guidance_leaves_what_the_pose_brings_together() -> None:
    """Descriptors that the pose moves far apart cannot match; for near ones the scores do not change."""
    xyz = torch.tensor([[[0.0, 0, 0], [1, 0, 0], [9, 0, 0]]])
    tokens = Tokens(xyz, torch.zeros(1, 3, 4), torch.zeros(1, 3, 2), torch.ones(1, 3, dtype=torch.bool))
    scores = torch.rand(1, 3, 3)
    guided = guided_scores(scores, torch.eye(4)[None], tokens, tokens)
    assert (guided[0, 2, :2] == -1e4).all()
    assert (guided[0, :2, 2] == -1e4).all()
    assert torch.equal(guided[0, :2, :2], scores[0, :2, :2])


def test_precision_tells_which_direction_to_trust(noise: np.random.Generator) -> None:
    """Points on planes are matched anywhere along them: unusable for the SVD, exact with the precision across the
    planes."""
    pairs, T = perfect(noise, batch=1, pairs=150)
    n = pairs.source.shape[1]
    normal = torch.nn.functional.normalize(torch.from_numpy(noise.normal(0, 1, (n, 3))), dim=-1)
    slide = torch.from_numpy(noise.normal(0, 0.7, (n, 3)))
    slide = slide - (slide * normal).sum(-1, keepdim=True) * normal
    # In the first half the precision is given in the source frame, in the second in the target frame.
    half = n // 2
    R = T[0, :3, :3]
    source = pairs.source.clone()
    source[0, :half] += slide[:half]
    target = pairs.target.clone()
    target[0, half:] += slide[half:]
    across = torch.linalg.cholesky(1e4 * normal[:, :, None] * normal[:, None] + 1e-2 * torch.eye(3).double())
    pairs = Correspondences(source, target, torch.ones(1, n).double(), across[None])
    svd, _ = robust_kabsch(pairs, supporting(pairs, first_pose(pairs)))
    solved, information = weighted_gauss_newton(svd, pairs)
    error = se3.way(T[0].numpy(), solved[0].numpy())
    assert np.linalg.norm(error[3:]) < 0.01
    assert np.linalg.norm(svd[0, :3, 3] - T[0, :3, 3]) > 3 * np.linalg.norm(error[3:])
    assert np.linalg.eigvalsh(information[0].numpy()).min() > 0
    assert torch.linalg.det(R).item() == pytest.approx(1)


def test_a_majority_that_errs_together_does_not_pull_the_solve_away(noise: np.random.Generator) -> None:
    """As in a tunnel: three quarters of the pairs agree on 2 m less along it, with the same precision as the others.
    From the pose of the others, the solution moves by less than their deviation of 0.3 m over the root of their
    number."""
    pairs, T = perfect(noise, batch=1, pairs=160)
    together = torch.arange(pairs.source.shape[1]) % 4 != 0
    target = torch.where(together[:, None], pairs.target + torch.tensor([2.0, 0, 0]).double(), pairs.target)
    pairs = pairs._replace(
        target=target, weight=torch.ones_like(pairs.weight), L=torch.eye(3).double().expand_as(pairs.L) / 0.3
    )
    found, _ = weighted_gauss_newton(T, pairs)
    assert float((found - T)[0, :3, 3].norm()) < 0.3 / 40**0.5


def test_jacobian_of_the_residuals(noise: np.random.Generator) -> None:
    """Against central differences of T exp(xi)."""
    pairs, T = perfect(noise, pairs=5)
    pairs = pairs._replace(target=pairs.target + 0.3)
    _, jacobian = whitened_residuals(T, pairs)
    for k in range(6):
        step = torch.from_numpy(se3.exp(np.eye(6)[k] * 1e-6))
        back = torch.from_numpy(se3.exp(-np.eye(6)[k] * 1e-6))
        numeric = (whitened_residuals(T @ step, pairs)[0] - whitened_residuals(T @ back, pairs)[0]) / 2e-6
        torch.testing.assert_close(jacobian[..., k], numeric, atol=1e-4, rtol=1e-4)


def test_moving_both_clouds_moves_the_answer(noise: np.random.Generator) -> None:
    """T' = A T B^-1 if A moves the target and B moves the source, to 1e-4."""
    pairs, _ = perfect(noise)
    pairs = pairs._replace(
        target=pairs.target + torch.from_numpy(noise.normal(0, 0.2, pairs.target.shape)),
        L=torch.eye(3).expand_as(pairs.L),
    )
    A, B = (torch.from_numpy(se3.exp(noise.normal(0, 1, (2, 6)) * [1, 1, 1, 9, 9, 9])) for _ in range(2))
    moved = pairs._replace(source=transform(B, pairs.source), target=transform(A, pairs.target))
    for solve in (
        first_pose,
        lambda p: robust_kabsch(p, supporting(p, first_pose(p)))[0],
        lambda p: weighted_gauss_newton(first_pose(p), p, rounds=30)[0],
    ):
        expected = A @ solve(pairs) @ torch.linalg.inv(B)
        torch.testing.assert_close(solve(moved), expected, atol=1e-4, rtol=0)


@pytest.mark.parametrize(("n", "m", "k"), [(256, 256, 128), (256, 512, 192), (3, 2, 1), (1, 1, 0)])
def test_number_of_pairs(n: int, m: int, k: int) -> None:
    """floor(0.5 (M + N)) // 2 of the most probable, in descending order; next to a larger set, as many as alone."""
    probability, masks = torch.rand(2, n, m), (torch.ones(2, n, dtype=torch.bool), torch.ones(2, m, dtype=torch.bool))
    value, row, column = best_pairs(probability, *masks, 0.5)
    assert value.shape == (2, k)
    assert torch.equal(value, probability[torch.arange(2)[:, None], row, column])
    assert (value.diff() <= 0).all()
    masks[0][1, n // 2 :] = False
    probability = probability * masks[0][:, :, None]
    beside = best_pairs(probability, *masks, 0.5)
    alone = best_pairs(probability[1:, : n // 2], masks[0][1:, : n // 2], masks[1][1:], 0.5)
    number = alone[0].shape[1]
    assert torch.equal(beside[0][1, :number], alone[0][0])
    assert (beside[0][1, number:] == 0).all()


def test_dual_softmax_at_padding_is_zero() -> None:
    """Probabilities of valid pairs do not depend on what is padded."""
    scores = torch.randn(1, 4, 5)
    masks = torch.tensor([[True, True, True, False]]), torch.tensor([[True, True, True, True, False]])
    probability = softmax_both(scores, *masks)
    assert (probability[0, 3] == 0).all()
    assert (probability[0, :, 4] == 0).all()
    torch.testing.assert_close(probability[:, :3, :4], scores[:, :3, :4].softmax(2) * scores[:, :3, :4].softmax(1))


def test_view_frames_are_inverse() -> None:
    """Offsets and precisions are transformed into the set's frame and back; R L has the covariance R C R^T."""
    axis = torch.nn.functional.normalize(torch.randn(7, 2), dim=-1)
    vectors = torch.randn(7, 3)
    torch.testing.assert_close(to_view(from_view(vectors, axis), axis), vectors)
    L = torch.randn(7, 3, 3).tril()
    offset, turned = into_set_frame(vectors, L, axis)
    precision = L @ L.mT
    torch.testing.assert_close(
        (offset[:, None] @ (turned @ turned.mT) @ offset[..., None]).squeeze(),
        (vectors[:, None] @ precision @ vectors[..., None]).squeeze(),
        atol=1e-4,
        rtol=1e-4,
    )


def test_offset_head_starts_without_offset() -> None:
    """The offset is zero and its deviation half a meter, for any features; the triangle is always valid."""
    head = OffsetHead(32, precision=True)
    offset, L = head(torch.randn(5, 32), torch.randn(5, 32))
    assert (offset == 0).all()
    torch.testing.assert_close(L, torch.eye(3).expand(5, 3, 3) * 2.0, atol=0.03, rtol=0)
    torch.nn.init.normal_(head.out.weight)
    assert (head(torch.randn(5, 32), torch.randn(5, 32))[1].diagonal(dim1=-2, dim2=-1) > 0).all()


def test_descriptors_of_one_place_agree_on_a_motion_and_others_do_not(
    model: DeepPointMap2, noise: np.random.Generator
) -> None:
    """This holds before the decoder is applied, also if half of them differ; sets of one descriptor have no
    agreement."""
    here, elsewhere, one = described(model, noise, 60), described(model, noise, 60), described(model, noise, 1)
    moved = here.moved(se3.exp([0, 0, 2.0, 9, -4, 0.2]))
    half = Descriptors.of(
        np.concatenate([moved.xyz[:30], elsewhere.xyz[:30]]),
        np.concatenate([moved.values[:30], elsewhere.values[:30]]),
    )
    same, partly, other = model.agreement(here, [moved, half, elsewhere])
    assert same == 1
    assert partly >= 0.9  # only half as many pairs as descriptors are used, the best first
    assert other < 0.3
    assert model.agreement(one, [one]) == [0]
    assert model.agreement(here, []) == []


def test_swapping_the_heading_frame_of_a_set_changes_nothing(model: DeepPointMap2, noise: np.random.Generator) -> None:
    """Correlated descriptors do not depend on the frame in which a set is given: no prior pose is needed."""
    a, b = described(model, noise, 48), described(model, noise, 48)
    moved = b.moved(se3.exp([0, 0, 2.5, 12, -7, 0.4]))
    tokens = to_tokens([a], True)
    one = model.decoder(tokens, to_tokens([replace(b, axis=b.axes)], True))
    other = model.decoder(tokens, to_tokens([moved], True))
    torch.testing.assert_close(one.source, other.source, atol=1e-4, rtol=0)
    torch.testing.assert_close(one.target, other.target, atol=1e-4, rtol=0)
