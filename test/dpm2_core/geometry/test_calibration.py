# SPDX-License-Identifier: Apache-2.0
"""Errors that grow with the motion between two scans are in the covariance, but not in the part that the scene leaves
open."""

from __future__ import annotations

import numpy as np
import pytest

from dpm2_core.estimates import Registration
from dpm2_core.frame import Array
from dpm2_core.geometry import se3
from dpm2_core.geometry.calibration import with_calibration
from dpm2_core.slam.registration.protocol import agree


def registration() -> Registration:
    """As along a tunnel: the position is open along one axis."""
    A = np.random.default_rng(0).normal(size=(6, 6))
    return Registration(np.eye(4), A @ A.T * 1e-4 + np.diag([0, 0, 0, 0.3**2, 0, 0]))


def sigmas(covariance: Array) -> tuple[float, float]:
    """Standard deviations of rotation, rad, and position, m, each in its best known direction."""
    turn, way = (np.linalg.eigvalsh(covariance[part, part])[0] for part in (slice(0, 3), slice(3, 6)))
    return float(np.sqrt(turn)), float(np.sqrt(way))


def test_every_direction_of_the_position_is_less_certain_far_away() -> None:
    own = registration()
    far = [with_calibration(own, se3.exp([0, 0, 0, meters, 0, 0])) for meters in (0, 1, 15)]
    grown = [result.covariance - own.covariance for result in far]
    np.testing.assert_array_equal(grown[0], 0)
    positions = [np.diag(g)[3:] for g in grown]
    assert (positions[1] > 0).all()
    np.testing.assert_allclose(positions[2], 15**2 * positions[1])
    assert sigmas(grown[2])[1] == pytest.approx(far[2].floor[1])


@pytest.mark.parametrize("meters", [0.0, 2.0, 40.0])
def test_what_the_scene_leaves_open_does_not_depend_on_the_distance(meters: float) -> None:
    own = registration()
    result = with_calibration(own, se3.exp([0, 0, 1.0, 0, meters, 0]))
    assert result.worst_sigma == pytest.approx(own.worst_sigma)  # rounding
    np.testing.assert_allclose(result.of_scene, own.covariance, atol=1e-12)


def test_errors_that_two_registrations_share_do_not_make_them_agree() -> None:
    """Results that are 0.3 m apart are so at a distance of 40 m as well."""
    known = np.eye(6) * 0.01**2
    one, other = (
        with_calibration(Registration(T, known), se3.exp([0, 0, 0, 40, 0, 0]))
        for T in (np.eye(4), se3.exp([0, 0, 0, 0.3, 0, 0]))
    )
    assert one.floor[1] > 0.1
    assert not agree(one, other)
    assert agree(one, one)


def test_a_turn_costs_certainty_and_facing_the_other_way_none() -> None:
    own = registration()
    turned = {deg: with_calibration(own, se3.exp([0, 0, np.radians(deg), 0, 0, 0])) for deg in (0, 90, 180)}
    grown = {deg: sigmas(r.covariance - own.covariance)[0] for deg, r in turned.items()}
    assert grown[90] > np.radians(0.3)
    assert max(grown[0], grown[180]) < 1e-9
