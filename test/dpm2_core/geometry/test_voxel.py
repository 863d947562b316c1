# SPDX-License-Identifier: Apache-2.0
"""The fast voxel grid returns exactly the first point of every cell."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from dpm2_core.geometry.voxel import VoxelCells, voxel_first


@given(st.integers(0, 10_000), st.integers(0, 3000), st.floats(0.05, 5), st.sampled_from([np.float32, np.float64]))
def test_first_of_every_cell(seed: int, count: int, size: float, dtype: type) -> None:
    points = (np.random.default_rng(seed).normal(size=(count, 4)) * 40).astype(dtype)
    cells = np.floor(points[:, :3] * points.dtype.type(1 / size)).astype(int)
    seen: dict[tuple[int, ...], int] = {}
    for i, cell in enumerate(map(tuple, cells)):
        seen.setdefault(cell, i)
    points.flags.writeable = False  # read-only, as in messages
    assert voxel_first(points, size).tolist() == sorted(seen.values())


@given(st.integers(0, 10_000), st.lists(st.integers(0, 1500), max_size=6), st.floats(0.3, 50))
def test_clouds_one_after_the_other_give_what_all_at_once_do(seed: int, counts: list[int], size: float) -> None:
    """Also if the table has to grow, and if a later cloud is in the cells of earlier ones."""
    noise, cells = np.random.default_rng(seed), VoxelCells(size)
    clouds = [(noise.normal(size=(count, 4)) * 40).astype(np.float32) for count in counts]
    joined = np.concatenate([np.zeros((0, 4), np.float32), *(cloud[cells.first(cloud)] for cloud in clouds)])
    whole = np.concatenate([np.zeros((0, 4), np.float32), *clouds])
    np.testing.assert_array_equal(joined, whole[voxel_first(whole, size)])


def test_many_cells_that_share_slots() -> None:
    """More cells than fit into the hash table without collisions: still exact."""
    points = np.random.default_rng(0).uniform(-500, 500, (400_000, 3))
    cells = np.floor(points).astype(int)
    assert len(voxel_first(points, 1.0)) == len(np.unique(cells, axis=0))


def test_nothing_in_nothing_out() -> None:
    assert len(voxel_first(np.zeros((0, 4), np.float32), 0.5)) == 0


def test_range_rejects_what_is_not_finite() -> None:
    """NaN, inf and the origin of a missing return are outside, and hide no other point of their cell."""
    points = np.array([[np.nan, 0, 0], [np.inf, 0, 0], [0, 0, 0], [0.1, 0.1, 0.1], [3, 4, 0], [61, 0, 0]], np.float32)
    assert voxel_first(points, 2.0, 1, 60).tolist() == [4]
    assert voxel_first(points, 2.0, 0.1, 60).tolist() == [3, 4]
