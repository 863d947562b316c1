# SPDX-License-Identifier: Apache-2.0
"""What a map of several says of its parts: where on Earth they are, and which loops hold."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from dpm2_core.estimates import Edge, Registration
from dpm2_core.geometry import se3
from dpm2_core.slam.graph.pose_graph import PoseGraph
from dpm2_core.slam.graph.robust import RobustSettings
from dpm2_core.slam.mapping.merge import merge_maps, optimized

from ....helpers.maps import GEOREFERENCE, ring

SURE = np.eye(6) * 1e-4
T_A_B = se3.exp(np.array([0, 0, 0.5, 30.0, 10.0, 0]))


@pytest.mark.parametrize(("from_node", "to_node", "known"), [(3, 3, True), (15, 3, False), (3, 15, False)])
def test_a_place_on_earth_goes_only_to_what_is_tied_to_the_keyframes_that_have_it(
    from_node: int, to_node: int, known: bool
) -> None:
    """Two maps of two drives that nothing ties; only the second map has a place on Earth, that of its first drive."""
    one = ring(12, points=10)
    a = merge_maps(one, one, np.eye(4))
    b = replace(a, georeference=GEOREFERENCE)
    T = se3.inverse(a.poses[from_node]) @ T_A_B @ b.poses[to_node]
    merged = merge_maps(a, b, T_A_B, [Edge("loop", from_node, to_node, Registration(T, SURE))])
    for both in (merged, optimized(merged, PoseGraph(RobustSettings()))):
        assert (both.georeference is not None) is known
        if both.georeference is not None:
            T_enu_kf = both.georeference.T_enu_map @ both.poses[24:36]
            np.testing.assert_allclose(T_enu_kf, GEOREFERENCE.T_enu_map @ b.poses[:12], atol=1e-6)
