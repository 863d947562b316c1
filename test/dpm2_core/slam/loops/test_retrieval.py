# SPDX-License-Identifier: Apache-2.0
"""The index returns similar places in any order and number, but never places without descriptors, nor places that are
not allowed."""

from __future__ import annotations

import numpy as np
import pytest

from dpm2_core.descriptors import Descriptors
from dpm2_core.slam.loops.retrieval import PlaceIndex, pooled


def place(seed: int, noise: float = 0.0, count: int = 256) -> Descriptors:
    """Descriptors whose features have their own distribution; `noise` changes them a little."""
    kind, rng = np.random.default_rng(seed), np.random.default_rng([seed, int(1e6 * noise)])
    mixing = kind.normal(size=(16, 128))
    features = rng.normal(size=(count, 16)) @ mixing + noise * rng.normal(size=(count, 128))
    return Descriptors.of(rng.normal(size=(count, 3)).astype(np.float32), features)


@pytest.mark.slow
def test_a_place_is_found_among_a_thousand() -> None:
    index = PlaceIndex()
    for seed in range(1000):
        index.append(place(seed))
    everywhere = np.ones(1000, bool)
    for seed in (0, 255, 256, 999):  # around the size at which the arrays grow
        assert index.nearest(pooled(place(seed, 0.05)), everywhere, 3)[0] == seed


def test_the_order_of_the_descriptors_does_not_matter() -> None:
    one = place(3)
    shuffled = np.random.default_rng(0).permutation(len(one))
    other = Descriptors(one.xyz[shuffled], one.features[shuffled], one.step[shuffled])
    np.testing.assert_allclose(pooled(one), pooled(other), atol=1e-4)  # sums in float32


def test_similarities_are_the_cosines_of_the_centered_vectors() -> None:
    index = PlaceIndex()
    vectors = np.array([pooled(place(seed)) for seed in range(40)], np.float64)
    for seed in range(40):
        index.append(place(seed))
    query = pooled(place(7, 0.1))
    mean = vectors.mean(0)
    centered, requested = vectors - mean, query - mean
    cosine = centered @ requested / np.linalg.norm(centered, axis=1) / np.linalg.norm(requested)
    np.testing.assert_allclose(index.similarities(query), cosine, atol=1e-3)  # float32, as a difference of squares


def test_what_is_not_allowed_or_has_no_descriptors_is_never_found() -> None:
    index = PlaceIndex()
    for seed in range(10):
        index.append(None if seed == 4 else place(seed))
    index.append(place(11, count=20))  # too few to be distinctive
    allowed = np.ones(11, bool)
    allowed[6] = False
    found = index.nearest(pooled(place(6)), allowed, 20)
    assert sorted(found) == [0, 1, 2, 3, 5, 7, 8, 9]
    assert index.nearest(pooled(place(6)), np.zeros(11, bool), 5) == []


def test_neighbors_of_one_found_are_passed_over() -> None:
    index = PlaceIndex()
    for seed in range(12):
        index.append(place(5, 0.01 * seed) if seed < 6 else place(seed))
    found = index.nearest(pooled(place(5)), np.ones(12, bool), 3, apart=1)
    assert found[0] == 0
    assert min(np.diff(sorted(found))) > 1


@pytest.mark.parametrize("count", [0, 5])
def test_few_descriptors_are_no_place(count: int) -> None:
    assert not pooled(place(0, count=count)).any()
