# SPDX-License-Identifier: Apache-2.0
"""The benchmark distinguishes a correct covariance from one that is too small or too large."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.covariance import calibration
from dpm2_core.estimates import Registration
from dpm2_core.geometry import se3


@pytest.mark.slow
@pytest.mark.parametrize("claimed", [0.25, 1.0, 4.0])
def test_errors_drawn_from_a_covariance_have_a_ratio_of_one(claimed: float) -> None:
    rng = np.random.default_rng(0)
    A = rng.normal(size=(6, 6)) * 1e-3
    S = A @ A.T
    rows = []
    for xi in rng.multivariate_normal(np.zeros(6), S, 4000):
        T = se3.exp(rng.normal(size=6))
        rows.append((T @ se3.exp(xi), Registration(T, claimed * S)))
    ratios = calibration(rows)["chi2_ratio"]
    # The median of 4000 samples varies by 2 to 3 %.
    assert [ratios[name] for name in ("pose", "rotation", "translation")] == pytest.approx([1 / claimed] * 3, rel=0.1)


def test_one_wrong_direction_shows_in_its_part_alone() -> None:
    rng = np.random.default_rng(1)
    sigma = np.repeat([0.001, 0.02], 3)
    errors = rng.normal(size=(500, 6)) * sigma * [1, 1, 1, 5, 5, 5]
    rows = [(se3.exp(xi), Registration(np.eye(4), np.diag(sigma**2))) for xi in errors]
    ratios = calibration(rows)["chi2_ratio"]
    assert ratios["rotation"] == pytest.approx(1, rel=0.2)
    assert ratios["translation"] > 20


def test_nothing_registered_has_no_ratio() -> None:
    assert calibration([]) == {"registered": 0, "median_m": None, "median_deg": None, "chi2_ratio": None}
