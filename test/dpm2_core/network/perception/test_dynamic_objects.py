# SPDX-License-Identifier: Apache-2.0
"""The dynamic objects' network: its grid compared with counts by hand, its size, and points outside the grid."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from dpm2_core.network.perception.dynamic_objects import (
    LAYERS,
    DynamicObjectNet,
    DynamicObjectNetSettings,
    occupancy,
    voxels,
)

SMALL = DynamicObjectNetSettings(cells=16, cell=1.0, channels=4)


def scene(rng: np.random.Generator, points: int = 3000) -> np.ndarray:
    """(points, 4) float32: level ground 1.7 m below the sensor, a fifth of it up to 6 m above that."""
    out = rng.uniform(-12, 12, (points, 4)).astype(np.float32)
    out[:, 2] = -1.7
    out[: points // 5, 2] += rng.uniform(0.3, 6, points // 5).astype(np.float32)
    return out


def test_voxels_are_those_of_counting_by_hand() -> None:
    points = scene(np.random.default_rng(0))
    voxel, inside = voxels(points, SMALL)
    for i in range(0, len(points), 97):
        x, y, z = points[i, :3]
        assert inside[i] == (-8 <= x < 8 and -8 <= y < 8)
        if inside[i]:
            layer = sum(z + 1.7 > bound for bound in LAYERS)
            assert voxel[i] == (layer * 16 + int(np.floor(x)) + 8) * 16 + int(np.floor(y)) + 8
    grid = occupancy([voxel[inside]], SMALL)
    assert grid.shape == (1, len(LAYERS) + 1, 16, 16)
    assert set(np.flatnonzero(grid.flatten())) == set(voxel[inside])


def test_the_height_of_the_sensor_and_the_order_of_the_points_do_not_matter() -> None:
    torch.manual_seed(0)
    net, points = DynamicObjectNet(SMALL).eval(), scene(np.random.default_rng(1))
    found = net.probability(points)
    higher = points - np.float32([0, 0, 0.5, 0])  # a float's last digit may still move a point over a cell's border
    assert np.mean(np.abs(net.probability(higher) - found) < 1e-5) > 0.99
    np.testing.assert_allclose(net.probability(points[::-1]), found[::-1], atol=1e-6)


def test_points_off_the_grid_stand_and_no_point_is_no_error() -> None:
    torch.manual_seed(0)
    net, points = DynamicObjectNet(SMALL).eval(), scene(np.random.default_rng(2))
    found, off = net.probability(points), (np.abs(points[:, :2]) > 8).any(1)
    assert off.any()
    assert (found[off] == 0).all()
    assert ((found[~off] > 0) & (found[~off] < 1)).all()
    assert net.probability(points[:0]).shape == (0,)


@pytest.mark.parametrize("cells", [200, 104])
def test_size_of_the_default(cells: int) -> None:
    net = DynamicObjectNet(DynamicObjectNetSettings(cells=cells)).eval()
    assert sum(p.numel() for p in net.parameters()) == 152_332
    with torch.no_grad():
        assert net(torch.zeros(1, 7, cells, cells)).shape == (1, 7, cells, cells)
