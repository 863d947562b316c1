# SPDX-License-Identifier: Apache-2.0
"""Solving a fleet's graph in stages gives the graph of the whole."""

from __future__ import annotations

import numpy as np

from dpm2_core.evaluation.metrics import ape_rmse
from dpm2_core.fleet.regions import regions_of, solve
from dpm2_core.slam.graph.robust import RobustSettings
from test.helpers.fleets import fleet_maps


def test_stages_give_the_poses_of_the_whole_and_refuse_what_cannot_be() -> None:
    """Regions of two drives, then their borders, equal a full solution: wrong loops are rejected, right ones kept."""
    truth, maps, joins = fleet_maps(5)
    sizes = {name: len(data) for name, data in maps.items()}
    assert [len(regions_of(sizes, joins, largest)) for largest in (1000, 130)] == [1, 3]
    whole, staged = (solve(maps, joins, RobustSettings(), largest) for largest in (1000, 130))
    for region in (whole, staged):
        assert len(region.joins) == len(joins)
        for join in region.joins:
            right = (join.loop.from_node, join.loop.to_node) != (5, 5)
            assert join.loop.ok is right
            assert right or "sigma" in join.loop.registration.reason
    for name in maps:
        np.testing.assert_allclose(staged.poses[name], whole.poses[name], atol=0.02)
    true = np.concatenate(list(truth.values()))
    assert ape_rmse(true, np.concatenate(list(whole.poses.values()))) < 2.0  # 600 m, by 1 mrad per keyframe
