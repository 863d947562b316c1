# SPDX-License-Identifier: Apache-2.0
"""Trees and distances find the same neighbors, never padding, also far from the origin."""

from __future__ import annotations

import torch
from torch import Tensor

from dpm2_core.diffslam.neighbors import NeighborSearch, nearest_by_distance


def clouds(offset: float = 0.0) -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(0)
    points = torch.rand(3, 80, 3, generator=generator, dtype=torch.float64) * 10 + offset
    valid = torch.rand(3, 80, generator=generator) < 0.6
    return points, valid


def by_tree(points: Tensor, valid: Tensor, queries: Tensor, k: int = 1) -> Tensor:
    """The search that is used on the CPU."""
    return NeighborSearch(points, valid).nearest(queries, k)


def by_distance(points: Tensor, valid: Tensor, queries: Tensor, k: int = 1) -> Tensor:
    """The search that is used on a GPU."""
    return nearest_by_distance(queries, points.masked_fill(~valid[..., None], torch.inf), k)


def test_tree_and_distance_agree_with_brute_force() -> None:
    """Indices of the 5 nearest valid points, in order, also at an offset of 100 m: no cancellation."""
    for offset in (0.0, 100.0):
        points, valid = clouds(offset)
        queries = points + 0.3
        distance = (queries[:, :, None] - points[:, None]).norm(dim=-1).masked_fill(~valid[:, None], torch.inf)
        requested = distance.argsort(-1)[..., :5]
        for nearest in (by_tree, by_distance):
            torch.testing.assert_close(nearest(points, valid, queries, 5), requested)
            torch.testing.assert_close(nearest(points, valid, queries), requested[..., :1])


def test_fewer_points_than_asked_repeat_the_nearest() -> None:
    """A cloud without any valid point returns its first."""
    points, valid = clouds()
    valid[0] = False
    valid[1] = False
    valid[1, 7] = True
    for nearest in (by_tree, by_distance):
        found = nearest(points, valid, points, 4)
        assert bool((found[1] == 7).all())
        assert bool((found[0] == found[0, :, :1]).all())
        short = nearest(points[:, :3], torch.ones(3, 3, dtype=torch.bool), points, 5)
        assert short.shape == (3, 80, 5)
        assert int(short.max()) <= 2


def test_select_keeps_each_cloud_with_its_points() -> None:
    """Clouds are in the requested order, also if repeated."""
    points, valid = clouds()
    search = NeighborSearch(points, valid)
    both = search.select([2, 0, 2]).nearest(points[[2, 0, 2]], 3)
    torch.testing.assert_close(both, search.nearest(points, 3)[[2, 0, 2]])
