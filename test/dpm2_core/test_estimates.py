# SPDX-License-Identifier: Apache-2.0
"""Registrations and edges."""

from __future__ import annotations

import numpy as np
import pytest

from dpm2_core.estimates import Edge, Registration


def test_a_rejected_edge_keeps_what_was_measured() -> None:
    loop = Edge("loop", 3, 90, Registration(2 * np.eye(4), np.eye(6), 0.9, 0.05, "points"))
    rejected = loop.rejected("too far")
    assert loop.ok
    assert not rejected.ok
    assert (rejected.from_node, rejected.to_node, rejected.registration.reason) == (3, 90, "too far")
    np.testing.assert_array_equal(rejected.T_from_to, loop.T_from_to)


def test_the_open_direction_is_that_of_the_largest_uncertainty_of_the_scene() -> None:
    """The part of the uncertainty that grew with the motion is equal in all directions and independent of the scene."""
    axis = np.array([0.6, 0.8, 0.0])
    scene = np.diag(np.full(6, 1e-4))
    scene[3:, 3:] += 0.25 * np.outer(axis, axis)
    floor = (0.01, 0.3)
    result = Registration(np.eye(4), scene + np.diag(np.repeat(floor, 3) ** 2), floor=floor)
    assert abs(result.open_direction @ axis) == pytest.approx(1.0)
    assert result.worst_sigma == pytest.approx(np.sqrt(0.25 + 1e-4))
