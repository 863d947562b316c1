# SPDX-License-Identifier: Apache-2.0
"""From solved poses to registrations: which are accepted, and their probability."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest
import torch

from dpm2_core.descriptors import Descriptors, merge
from dpm2_core.geometry import se3
from dpm2_core.network.model import DeepPointMap2
from dpm2_core.network.pose_solver import solve_batch
from dpm2_core.network.registrations import LEAST
from dpm2_core.network.solved import Solved, confidence_of, overlap_features
from dpm2_core.network.tokens import to_tokens

from ...helpers.networks import described, tiny


def test_registration_of_sets_of_different_sizes(model: DeepPointMap2, noise: np.random.Generator) -> None:
    """A batch gives the same results as its members alone: frames, merged maps and sparse scans together."""
    T = se3.exp(noise.normal(0, 1, 6))
    frames = [described(model, noise, 48) for _ in range(3)]
    part = replace(frames[2], **{name: getattr(frames[2], name)[:30] for name in ("xyz", "features", "step")})
    sources, targets = [*frames[:2], part], [merge([d.moved(T)] * n) for d, n in zip(frames, (1, 3, 1), strict=True)]
    together = model.register_many(sources, targets)
    np.testing.assert_array_equal(model.overlap(sources, targets), [result.overlap for result in together])
    for source, target, result in zip(sources, targets, together, strict=True):
        assert result.T_target_source.shape == (4, 4)
        assert np.linalg.eigvalsh(result.covariance).min() > 0
        assert 0 <= result.confidence <= 1
        assert result.method == "neural"
        alone = model.register(source, target)
        # padding adds columns to products, which bf16 rounds differently
        np.testing.assert_allclose(alone.T_target_source, result.T_target_source, atol=0.02)
        assert alone.confidence == pytest.approx(result.confidence, abs=0.05)


def test_every_pose_is_rigid_to_float64(model: DeepPointMap2, noise: np.random.Generator) -> None:
    """This includes cases where nothing matches and the solver has diverged far: a map keeps rejected loops, too."""
    for scale in (1, 10, 100):
        sets = [described(model, noise, 90) for _ in range(12)]
        sets = [replace(d, xyz=d.xyz * np.float32(scale)) for d in sets]
        for result in model.register_many(sets[:6], sets[6:]):
            assert (result.T_target_source[3] == [0, 0, 0, 1]).all()
            R = result.T_target_source[:3, :3]
            np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-14)
            assert np.linalg.det(R) > 0


def test_other_places_are_no_registration_and_the_same_place_is_one(
    model: DeepPointMap2, noise: np.random.Generator
) -> None:
    """The fraction of matched descriptors that fit one motion decides; the pose that fits best is returned in any
    case."""
    here = described(model, noise, 60)
    T = se3.exp([0, 0, 2.0, 9, -4, 0.2])
    same, other = model.register_many([here, here], [here.moved(T), described(model, noise, 60)])
    assert same.ok
    np.testing.assert_allclose(same.T_target_source, T, atol=0.05)  # bf16
    assert not other.ok
    assert other.confidence < same.confidence
    assert re.fullmatch(r"only \d+% of the matched descriptors fit one motion", other.reason)
    assert np.isfinite(other.T_target_source).all()


def test_an_improbable_pose_is_no_registration(model: DeepPointMap2, noise: np.random.Generator) -> None:
    """It is rejected however many pairs fit."""
    here = described(model, noise, 60)
    with torch.no_grad():
        model.decoder.confidence.bias.fill_(-100)
    result = model.register(here, here)
    assert result.confidence < LEAST
    assert not result.ok
    assert re.fullmatch(r"right with a probability of only \d+%", result.reason)


def test_the_papers_solver_wants_probable_matches(model: DeepPointMap2, noise: np.random.Generator) -> None:
    """After its robust SVD most pairs fit, whatever they are: their number shows nothing."""
    model.solver = "confident"
    here = described(model, noise, 60)
    same, other = model.register_many([here, here], [here, described(model, noise, 60)])
    assert same.ok
    assert not other.ok
    assert re.fullmatch(r"descriptors match with a confidence of only 0\.\d\d", other.reason)


def test_the_overlap_head_is_told_how_much_of_a_pair_fits(model: DeepPointMap2, noise: np.random.Generator) -> None:
    """All of a set and itself 10 m away, less than half of two different sets; equally in a batch with a larger set."""
    here, larger = described(model, noise, 60), described(model, noise, 90)
    away = here.moved(se3.exp([0, 0, 0.4, 10, 0, 0]))
    sources, targets = [here, here, larger], [away, described(model, noise, 60), larger]
    with torch.inference_mode():
        given = []
        for row in (slice(0, 2), slice(0, 3)):
            source, target = to_tokens(sources[row], True), to_tokens(targets[row], True)
            solved = solve_batch(model.decoder, source, target, model.decoder(source, target))
            assert solved is not None
            given.append(overlap_features(solved))
    borne_out, distance, share = given[0].T
    assert (share[0], share[1]) == (1, pytest.approx(0.2, abs=0.25))
    assert distance[0] == pytest.approx(0.5, abs=0.01)  # units of 20 m
    assert borne_out[0] > borne_out[1]
    torch.testing.assert_close(given[1][0], given[0][0], atol=0.02, rtol=0)
    assert given[1][2, 2] == 1


def test_too_few_descriptors_are_no_registration(model: DeepPointMap2, noise: np.random.Generator) -> None:
    """The result is not ok, with a reason, and without an exception."""
    result = model.register(described(model, noise, 1), described(model, noise, 1))
    assert not result.ok
    assert result.confidence == 0
    assert "matching descriptors" in result.reason


def test_a_pose_is_the_surer_the_better_its_pairs_fit() -> None:
    """Each of these alone makes it less probable: a larger residual, less probable pairs, fewer that fit, a smaller
    distance, a larger deviation; a pose that is not finite is improbable."""
    decoder = DeepPointMap2(tiny()).decoder.requires_grad_(False)

    def confidence(rmse: float = 0.4, weight: float = 0.3, fit: float = 0.6, far: float = 8.0, L: float = 5.0) -> float:
        T = torch.from_numpy(se3.exp([0, 0, 0.3, far, 0, 0]))[None]
        covariance = torch.eye(6, dtype=torch.float64)[None] / (20 * L**2)
        figures = (torch.tensor([value]) for value in (rmse, 120, weight, fit))
        return float(confidence_of(decoder, Solved(T, covariance, *figures)))

    worse = confidence(rmse=1.0), confidence(weight=0.1), confidence(fit=0.4), confidence(far=0.5), confidence(L=1)
    assert max(worse) < confidence()
    assert confidence(far=np.nan, rmse=np.nan) < -10  # a logit


def test_sets_that_stay_give_the_same_answer_again(model: DeepPointMap2, noise: np.random.Generator) -> None:
    """What is cached of a set between calls does not change results, and no other set is mistaken for it."""

    def some(n: int) -> Descriptors:
        features = noise.standard_normal((n, model.settings.channels))
        return Descriptors.of(noise.uniform(-20, 20, (n, 3)).astype(np.float32), features)

    target, other, sources = some(40), some(40), [some(30), some(30)]
    together = model.register_many([sources[0], sources[1], sources[0]], [target, target, other])
    one_by_one = [model.register(s, t) for s, t in zip([*sources, sources[0]], [target, target, other], strict=True)]
    for a, b in zip(together, one_by_one, strict=True):
        np.testing.assert_allclose(a.confidence, b.confidence, rtol=0.05)  # bf16: batches round differently
    assert model.register(sources[0], target).confidence == one_by_one[0].confidence
    for _ in range(3):  # more sets than are cached, and the source of one call as the target of the next
        model.register(some(20), sources[0])
    assert model.register(sources[0], target).confidence == one_by_one[0].confidence
