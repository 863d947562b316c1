# SPDX-License-Identifier: Apache-2.0
"""Properties of a merged map: the georeference of its parts, and which loops are accepted."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from dpm2_core.estimates import Edge, Registration
from dpm2_core.geometry import se3
from dpm2_core.slam.graph.pose_graph import PoseGraph
from dpm2_core.slam.graph.robust import RobustSettings
from dpm2_core.slam.mapping import merge
from dpm2_core.slam.mapping.merge import merge_maps, optimized
from dpm2_core.slam.store.map_data import load_map, save_as
from dpm2_core.slam.store.map_store import MapStore

from ....helpers.command import dpm2
from ....helpers.maps import GEOREFERENCE, ring

SURE = np.eye(6) * 1e-4
T_A_B = se3.exp(np.array([0, 0, 0.5, 30.0, 10.0, 0]))


@pytest.mark.parametrize(("from_node", "to_node", "known"), [(3, 3, True), (15, 3, False), (3, 15, False)])
def test_a_place_on_earth_goes_only_to_what_is_tied_to_the_keyframes_that_have_it(
    from_node: int, to_node: int, known: bool
) -> None:
    """Two maps, each of two unconnected drives. Only the second map has a georeference, that of its first drive."""
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


def test_a_loop_that_the_merged_map_contradicts_is_rejected_in_its_file_and_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Two drives in one place with a loop that is 14 m off, and a third drive that is found in both of them."""
    one = ring(12, points=10)
    wrong = Edge(
        "loop", 0, 0, Registration(se3.exp(np.array([0, 0, 0, 14.0, 0, 0])), np.eye(6) * 0.3, method="by hand")
    )
    two = merge_maps(one, one, np.eye(4), [wrong])
    found = [Edge("loop", node, node % 12, Registration(np.eye(4), SURE, method="found")) for node in range(24)]
    monkeypatch.setattr(merge, "loops_by", lambda closer: lambda a, b: found)
    save_as(two, tmp_path / "two")
    save_as(one, tmp_path / "one")
    done = dpm2("map", "merge", tmp_path / "two", tmp_path / "one", "--out", tmp_path / "all",
                "--set", "slam.loops.descriptors=false")  # fmt: skip
    assert done.returncode == 0
    assert "loops that contradict the others are rejected, between the new map's keyframes 0 and 12\n" in done.stderr
    with MapStore.open(tmp_path / "all") as store:
        loops = {(e.from_node, e.to_node, e.registration.method): e for e in load_map(store).edges if e.kind == "loop"}
    assert len(loops) == 3 * 2 + 1 + 24
    rejected = {key: edge.registration.reason for key, edge in loops.items() if not edge.ok}
    assert set(rejected) == {(0, 12, "by hand"), *((at, at + 6, "points") for at in (0, 12, 24))}  # each ring has one
    assert "sigma" in rejected[0, 12, "by hand"]
