# SPDX-License-Identifier: Apache-2.0
"""Fog and dust are detected between surfaces, and hardly any surface is taken for them."""

from __future__ import annotations

import numpy as np
import pytest

from dpm2_core.data.corrupt import in_dust
from dpm2_core.geometry import se3
from dpm2_core.geometry.scatter import scattered
from test.helpers.rooms import frames

HERE = se3.make(np.eye(3), [[0.3, 0, 0.6]])


@pytest.mark.parametrize("street", [False, True])
@pytest.mark.parametrize("fraction", [0.3, 0.6, 0.8])
def test_dust_is_found(street: bool, fraction: float) -> None:
    clean = frames(HERE, street)[0].points
    points = in_dust(clean, fraction, np.random.default_rng(0))
    met, found = (points != clean).any(1), scattered(points, 0)
    assert found[met].mean() > 0.75  # points next to a surface are not distinguished from it
    assert found[~met].mean() < 0.1


@pytest.mark.parametrize("street", [False, True])
def test_of_clean_scans_nearly_nothing_is_found(street: bool) -> None:
    points = frames(HERE, street)[0].points
    assert scattered(points, 0).mean() < 0.02
    assert not scattered(points).any()


def test_less_than_asked_for_is_left() -> None:
    points = frames(HERE, street=True)[0].points
    assert not scattered(in_dust(points, 0.1, np.random.default_rng(0))).any()
    assert scattered(in_dust(points, 0.9, np.random.default_rng(0))).any()


def test_what_is_far_away_stays() -> None:
    rng = np.random.default_rng(0)
    points = rng.uniform(-40, 40, (4000, 4)).astype(np.float32)
    away = np.linalg.norm(points[:, :3], axis=1)
    assert not scattered(points, 0)[away > 8.1].any()


def test_what_is_overhead_is_not_compared_with_the_floor() -> None:
    rng = np.random.default_rng(0)
    points = np.ones((40_000, 4), np.float32)
    points[:, :2] = rng.uniform(-0.9, 0.9, (40_000, 2))
    points[:20_000, :3] *= rng.uniform(0.8, 4.9, (20_000, 1))  # scattered straight up
    points[20_000:, 2] = -1.2  # the floor
    found = scattered(points, 0)
    assert found[:20_000].mean() > 0.75
    assert not found[20_000:].any()


@pytest.mark.parametrize("way", [0, 1, 2])
def test_a_wall_is_a_surface_where_faces_of_the_cube_meet(way: int) -> None:
    """In directions there, some of the strips have points on one face only."""
    along = np.random.default_rng(way).uniform(0.5, 4, (5000, 2))
    points = np.ones((5000, 4), np.float32)
    points[:, way] = 2.0
    points[:, [way - 2, way - 1]] = along  # another face from 2 m on
    assert scattered(points, 0).mean() < 0.01


@pytest.mark.parametrize("least", [0, 0.35])
@pytest.mark.parametrize("count", [0, 1, 4])
def test_too_few_points_say_nothing(count: int, least: float) -> None:
    points = np.full((count, 4), 1, np.float32)
    points.flags.writeable = False  # read-only, as in messages
    assert scattered(points, least).tolist() == [False] * count


def test_what_is_no_direction_does_no_harm() -> None:
    points = np.tile(np.float32([[0, 0, 0, 0], [np.nan, 1, 1, 1], [np.inf, 1, 1, 1], [2, 0, 0, 1]]), (50, 1))
    assert not scattered(np.asfortranarray(points), 0).any()
