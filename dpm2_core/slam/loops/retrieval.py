# SPDX-License-Identifier: Apache-2.0
"""Place retrieval: one vector per keyframe, compared with all others in one matrix product.

The vector is the square root of the covariance of a keyframe's descriptors: P. Li, J. Xie, Q. Wang, Z. Gao, "Towards
Faster Training of Global Covariance Pooling Networks by Iterative Matrix Square Root Normalization", CVPR 2018. It
needs no training and, like the descriptors, does not depend on the heading of the sensor.
"""

from __future__ import annotations

from functools import cache

import numpy as np
from numpy.typing import NDArray

from dpm2_core.descriptors import Descriptors

Vector = NDArray[np.float32]

CHANNELS = 32
"""Directions of the feature space whose covariance is used."""
WIDTH = CHANNELS * (CHANNELS + 1) // 2
"""Length of a vector: 528."""
_MIN_DESCRIPTORS = 2 * CHANNELS  # descriptors; the covariance of fewer is not reliable


def pooled(descriptors: Descriptors) -> Vector:
    """The (528,) float32 vector of a place; zeros, similar to no place, if there are too few descriptors."""
    rows, columns = np.triu_indices(CHANNELS)
    if len(descriptors) < _MIN_DESCRIPTORS:
        return np.zeros(len(rows), np.float32)
    features = descriptors.values @ _random_directions(descriptors.features.shape[1])
    features -= features.mean(0)
    covariance = features.T @ features / len(features)
    eigenvalues, axes = np.linalg.eigh(covariance + 1e-3 * np.trace(covariance) / CHANNELS * np.eye(CHANNELS))
    root = (axes * np.sqrt(np.maximum(eigenvalues, 0))) @ axes.T
    return np.asarray(root[rows, columns] * np.where(rows == columns, 1.0, np.sqrt(2)), np.float32)


def centered(vectors: Vector, mean: Vector) -> Vector:
    """(N, 528) minus the mean, normalized to length 1, so that products are cosines. Zero vectors stay zero.

    The mean is subtracted since the part that all places share does not distinguish them.
    """
    differences = np.where(np.any(vectors, axis=1, keepdims=True), vectors - mean, 0)
    return np.asarray(differences / np.maximum(np.linalg.norm(differences, axis=1, keepdims=True), 1e-6), np.float32)


@cache
def _random_directions(channels: int) -> NDArray[np.float32]:
    """(channels, 32) orthonormal columns, always the same ones."""
    random = np.random.default_rng(0).normal(size=(channels, max(channels, CHANNELS)))
    return np.linalg.qr(random)[0][:, :CHANNELS].astype(np.float32)


class PlaceIndex:
    """The vectors of all keyframes in their order; a search is one matrix product, 10 ms for 20,000 keyframes."""

    def __init__(self) -> None:
        self._vectors = np.zeros((256, WIDTH), np.float32)
        self._squared = np.zeros(256, np.float32)  # lengths
        self._sum = np.zeros(self._vectors.shape[1])
        self._nonzero = 0  # vectors that are not zero
        self._count = 0

    def __len__(self) -> int:
        return self._count

    def append(self, descriptors: Descriptors | None) -> None:
        """Add the next keyframe; one without descriptors is never found."""
        if self._count == len(self._vectors):
            self._vectors = np.concatenate([self._vectors, np.zeros_like(self._vectors)])
            self._squared = np.concatenate([self._squared, np.zeros_like(self._squared)])
        if descriptors is not None:
            vector = pooled(descriptors)
            self._vectors[self._count] = vector
            self._squared[self._count] = vector @ vector
            self._sum += vector
            self._nonzero += bool(vector.any())
        self._count += 1

    def similarities(self, query: Vector) -> NDArray[np.float32]:
        """Cosine (N,) of each keyframe's vector and the (528,) query, both minus the mean of all; -1 if no vector."""
        mean = (self._sum / max(self._nonzero, 1)).astype(np.float32)
        requested = query - mean
        vectors, squared = self._vectors[: self._count], self._squared[: self._count]
        dots = vectors @ np.stack([requested, mean], 1)
        length = np.sqrt(np.maximum(squared - 2 * dots[:, 1] + mean @ mean, 1e-12))
        cosine = (dots[:, 0] - mean @ requested) / (length * max(float(np.linalg.norm(requested)), 1e-6))
        return np.where(squared > 0, cosine, np.float32(-1))

    def nearest(self, query: Vector, allowed: NDArray[np.bool_], count: int, apart: int = 0) -> list[int]:
        """At most `count` of the `allowed` (N,) keyframes, the most similar first.

        Args:
            apart: a keyframe within this distance, in the order, of a selected one is skipped: neighbors show the same
                place, and other places should be tried, too.
        """
        order = np.flatnonzero(allowed & (self._squared[: self._count] > 0))
        similar = self.similarities(query)[order]
        requested = min(len(order), count * (2 * apart + 1))
        if requested < len(order):
            best = np.argpartition(-similar, requested)[:requested]
            order, similar = order[best], similar[best]
        found: list[int] = []
        for node in order[np.argsort(-similar, kind="stable")].tolist():
            if len(found) < count and all(abs(node - other) > apart for other in found):
                found.append(node)
        return found
