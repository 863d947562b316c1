# SPDX-License-Identifier: Apache-2.0
"""Objects are distinguished from the ground: on a slope, under a roof, and for either precision of points."""

from __future__ import annotations

import tracemalloc

import numpy as np
import pytest

from dpm2_core.geometry.ground import ground_below, height_above_ground


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_a_wall_stands_and_a_slope_does_not(dtype: type) -> None:
    x, y = np.meshgrid(np.arange(-20, 20, 0.5), np.arange(-20, 20, 0.5))
    ground = np.stack([x.ravel(), y.ravel(), 0.1 * x.ravel()], -1)  # 10 %: 0.2 m within a cell of 2 m
    wall = np.stack([np.full(30, 5.0), np.zeros(30), 0.5 + np.linspace(0.6, 3, 30)], -1)
    height = height_above_ground(np.concatenate([ground, wall]).astype(dtype), 2.0, reach=0)
    assert height.dtype == dtype
    assert (height[: len(ground)] <= 0.5).all()
    assert (height[len(ground) :] > 0.5).all()
    assert len(height_above_ground(np.zeros((0, 3), dtype))) == 0


@pytest.mark.parametrize("reach", [0, 2])
def test_a_point_mirrored_below_the_ground_lifts_nothing(reach: int) -> None:
    """A bank of 2 m, steeper than a street and longer than a cell, remains ground on both sides."""
    x, y = np.meshgrid(np.arange(-10, 10, 0.25), np.arange(-10, 10, 0.25))
    ground = np.stack([x.ravel(), y.ravel(), np.where(x < 3, 0.0, -2.0).ravel()], -1)
    mirrored = np.array([[-5.0, 1.0, -9.0], [-4.9, 1.1, -8.0]])
    height = height_above_ground(np.concatenate([ground, mirrored]), 1.0, reach)
    assert (height[len(ground) :] < 0).all()
    np.testing.assert_array_equal(height[: len(ground)], height_above_ground(ground, 1.0, reach))


def test_a_stray_point_far_off_takes_no_memory_and_changes_no_height() -> None:
    x, y = np.meshgrid(np.arange(-10, 10, 0.25), np.arange(-10, 10, 0.25))
    ground = np.stack([x.ravel(), y.ravel(), 0.1 * x.ravel()], -1)
    stray = np.array([[3000.0, 3000.0, 5.0], [-3000.0, -3000.0, 9.0]])
    tracemalloc.start()
    height = height_above_ground(np.concatenate([ground, stray]))
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 50e6  # four arrays of 1001 by 1001 cells; for 6 by 6 km they were 1.2 GB
    np.testing.assert_array_equal(height[: len(ground)], height_above_ground(ground))


def test_the_ground_below_a_roof_is_not_the_roof() -> None:
    """A roof of 5 by 5 m over ground that is only visible around it. It is shorter than the opening of 7 cells of 1
    m."""
    x, y = np.meshgrid(np.arange(-15, 15, 0.25), np.arange(-15, 15, 0.25))
    under = (np.abs(x) < 2.5) & (np.abs(y) < 2.5)
    points = np.stack([x.ravel(), y.ravel(), np.where(under, 3.0, -1.7).ravel()], -1)
    np.testing.assert_allclose(ground_below(points), -1.7)
