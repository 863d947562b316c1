# SPDX-License-Identifier: Apache-2.0
"""The coarse fit of a scan is best where it was taken, whatever the order and the number of the poses."""

from __future__ import annotations

import numpy as np

from dpm2_core.geometry import se3
from dpm2_core.slam.registration.occupied_voxels import OccupiedVoxels

WORLD = np.random.default_rng(0).uniform([-20, -20, -2], [20, 20, 4], (3000, 3))
T = se3.exp([0, 0, 0.3, 4, 2, 0])
SCAN = se3.transform(se3.inverse(T), WORLD[::7])


def test_the_pose_where_the_scan_was_taken_fits_best() -> None:
    others = np.array(
        [T @ se3.exp(xi) for xi in np.random.default_rng(1).uniform(-3, 3, (200, 6)) * [0, 0, 0.2, 1, 1, 0]]
    )
    fit = OccupiedVoxels(WORLD, np.zeros(3)).fit(SCAN, np.concatenate([others, T[None]]))
    assert fit[-1] == 2.0  # every point in an occupied voxel
    assert fit[:-1].max() < 2.0
    np.testing.assert_array_equal(fit[::-1], OccupiedVoxels(WORLD, np.zeros(3)).fit(SCAN, np.array([T, *others[::-1]])))


def test_what_lies_outside_counts_nothing() -> None:
    for meters in (500.0, 1e12):  # the last one is too large for an integer
        far = se3.exp([0, 0, 0, meters, meters, meters])
        assert OccupiedVoxels(WORLD, np.zeros(3)).fit(SCAN, np.array([far, se3.inverse(far)])).tolist() == [0, 0]
    assert OccupiedVoxels(WORLD + 1000, np.zeros(3)).fit(SCAN, T[None]).tolist() == [0]
