# SPDX-License-Identifier: Apache-2.0
"""Planes in closed form agree with an eigensolver, whatever the neighborhood."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from dpm2_core.geometry.planes import fit_planes


@given(st.integers(0, 10_000), st.floats(-4, 2), st.integers(3, 20))
def test_agrees_with_eigh(seed: int, log_scale: float, k: int) -> None:
    rng = np.random.default_rng(seed)
    spread = 10**log_scale * np.array([1.0, 0.7, rng.uniform(0, 0.3)])
    Q = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    neighborhoods = rng.normal(size=(50, k, 3)) * spread @ Q.T + rng.normal(size=3) * 100
    normals, variances = fit_planes(neighborhoods)
    centered = neighborhoods - neighborhoods.mean(1, keepdims=True)
    values, vectors = np.linalg.eigh(np.einsum("nki,nkj->nij", centered, centered) / k)
    scale = values[:, 2]
    assert (np.abs(variances - values[:, 0]) <= 1e-7 * scale + 1e-18).all()  # the cubic loses half of the digits
    clear = values[:, 1] - values[:, 0] > 1e-3 * scale  # else the normal is undetermined
    assert (np.abs(np.einsum("ni,ni->n", normals, vectors[:, :, 0]))[clear] > 1 - 1e-6).all()
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1, atol=1e-9)


def test_degenerate_neighborhoods_are_finite() -> None:
    line = np.zeros((1, 5, 3))
    line[0, :, 0] = np.arange(5)
    point = np.ones((1, 5, 3))
    for neighborhood in (line, point):
        normals, variances = fit_planes(neighborhood)
        assert np.isfinite(normals).all()
        np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1)
        np.testing.assert_allclose(variances, 0, atol=1e-12)
    assert abs(fit_planes(line)[0][0, 0]) < 1e-6  # perpendicular to the line
