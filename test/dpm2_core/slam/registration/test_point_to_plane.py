# SPDX-License-Identifier: Apache-2.0
"""The compiled loops compute the same as the formulas in matrix form."""

from __future__ import annotations

import numpy as np

from dpm2_core.geometry import se3
from dpm2_core.slam.registration.point_to_plane import ORDER, distances, linearize, moments

N, M = 500, 200


def test_distances_from_planes_and_none_where_there_is_no_plane() -> None:
    rng = np.random.default_rng(0)
    queries, points, normals = rng.normal(size=(N, 3)), rng.normal(size=(M, 3)), rng.normal(size=(M, 3))
    variances, index = rng.uniform(size=M), rng.integers(-1, M, N).astype(np.int32)
    residual, normal, variance = distances(queries, index, points, normals, variances)
    there = index >= 0
    at = index[there]
    np.testing.assert_allclose(
        residual[there], np.einsum("ij,ij->i", queries[there] - points[at], normals[at]), atol=1e-13
    )
    np.testing.assert_array_equal(normal[there], normals[at])
    np.testing.assert_array_equal(variance[there], variances[at])
    for values in (residual, normal, variance):
        assert np.isnan(values[~there]).all()


def test_normal_equations_are_those_of_the_jacobian() -> None:
    rng = np.random.default_rng(1)
    source, T = rng.normal(size=(N, 3)) * 20, se3.exp(rng.normal(size=6))
    normals = rng.normal(size=(N, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    residual, variances = rng.normal(size=N) * 0.2, rng.uniform(0.003, 0.05, N)
    residual[::7] = np.nan
    H, gradient, fits, rmse = linearize(source, np.ascontiguousarray(T[:3, :3]), residual, normals, variances)
    used = ~np.isnan(residual)
    s, n, r, v = source[used], normals[used] @ T[:3, :3], residual[used], variances[used]
    J = np.concatenate([np.cross(s, n), n], 1)
    weight = 1 / (v + r * r)
    # Sums of a few hundred terms in another order: only rounding differs.
    np.testing.assert_allclose(H, J.T @ (J * weight[:, None]), rtol=1e-11, atol=1e-9)
    np.testing.assert_allclose(gradient, J.T @ (weight * r), rtol=1e-11, atol=1e-9)
    assert fits == (r * r < 9 * v).sum()
    np.testing.assert_allclose(rmse, np.sqrt(np.mean(r[r * r < 9 * v] ** 2)), rtol=1e-12)


def test_nothing_matched() -> None:
    nothing = np.full(N, np.nan)
    H, gradient, fits, rmse = linearize(np.zeros((N, 3)), np.eye(3), nothing, np.zeros((N, 3)), nothing)
    assert not H.any()
    assert not gradient.any()
    assert fits == 0
    assert rmse == np.inf


def test_moments_are_normal_equations_weighed_by_powers_of_the_times() -> None:
    rng = np.random.default_rng(2)
    source, times, T = rng.normal(size=(N, 3)) * 20, rng.uniform(-0.05, 0.05, N), se3.exp(rng.normal(size=6))
    normals = rng.normal(size=(N, 3))
    residual, variances = rng.normal(size=N) * 0.2, rng.uniform(0.003, 0.05, N)
    residual[::7] = np.nan
    H, gradient = moments(source, times, np.ascontiguousarray(T[:3, :3]), residual, normals, variances)
    used = ~np.isnan(residual)
    n, r, t = normals[used] @ T[:3, :3], residual[used], times[used]
    J = np.concatenate([np.cross(source[used], n), n], 1)
    weight = 1 / (variances[used] + r * r)
    assert (len(H), len(gradient)) == (2 * ORDER + 1, ORDER + 1)
    for k in range(2 * ORDER + 1):  # sums in another order: rounding, of terms that shrink by 0.05 with each power
        np.testing.assert_allclose(H[k], J.T @ (J * (weight * t**k)[:, None]), rtol=1e-9, atol=1e-9 * 0.05**k)
    for k in range(ORDER + 1):
        np.testing.assert_allclose(gradient[k], J.T @ (weight * t**k * r), rtol=1e-9, atol=1e-9 * 0.05**k)
