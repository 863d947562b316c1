# SPDX-License-Identifier: Apache-2.0
"""Sessions in the same place have the clouds of one session, even if a loop was accepted later than it was found."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from dpm2_core.estimates import Edge, Keyframe, Registration
from dpm2_core.geometry import se3
from dpm2_core.slam.graph.pose_graph import PoseGraph
from dpm2_core.slam.graph.robust import RobustSettings
from dpm2_core.slam.mapping.mapper import Mapper, MapSettings
from dpm2_core.slam.store.check import check_map
from dpm2_core.slam.store.map_data import load_map
from dpm2_core.slam.store.map_store import MapStore
from test.helpers.loops import KnownLoops
from test.helpers.maps import FIRM

LENGTH = 6
"""Keyframes per session."""


def first_waits(node: int) -> list[Edge]:
    """Loop to the keyframe of the previous session. The first loop waits for the second, and is accepted with it."""
    if node < LENGTH:
        return []
    found = Edge("loop", node - LENGTH, node, Registration(np.eye(4), FIRM, 0.9, 0.05, "known"))
    if node % LENGTH == 0:
        return [found.rejected("waits for a second loop that agrees")]
    return [found, found.between(node - 1 - LENGTH, node - 1)] if node % LENGTH == 1 else [found]


def add_session(path: Path, noise: np.random.Generator) -> Mapper:
    """Add a straight drive of `LENGTH` keyframes to a map file."""
    with MapStore.open(path, read_only=False) if path.exists() else MapStore.create(path) as store:
        store.begin_session()
        mapper = Mapper(MapSettings(), PoseGraph(RobustSettings()), KnownLoops(first_waits), store)
        way = Registration(se3.make(np.eye(3), np.array([5.0, 0, 0])), FIRM, 0.9, 0.05, "test")
        for i in range(LENGTH):
            T, points = se3.make(np.eye(3), np.array([5.0 * i, 0, 0])), noise.uniform(-30, 30, (100, 4))
            mapper.add(Keyframe(i, 10**8 * i, i, T, points.astype(np.float32), way if i else None))
        mapper.finish()
    return mapper


def test_sessions_that_begin_where_others_did_have_the_clouds_of_one(
    tmp_path: Path, noise: np.random.Generator
) -> None:
    """Previously, the first keyframe of each session kept its own cloud: every session added one more place to be
    found. The newest cloud of each place is kept, too."""
    path = tmp_path / "a.dpm2map"
    for _ in range(4):
        written = add_session(path, noise)
    assert not check_map(path).problems
    with MapStore.open(path) as store:
        data = load_map(store)
        kept = np.flatnonzero(data.clouds.kept).tolist()
        assert np.flatnonzero(data.clouds.own).tolist() == list(range(LENGTH))
        assert kept == [*range(LENGTH), *range(3 * LENGTH, 4 * LENGTH)]
        assert [node for (node,) in store.rows("payloads", "node")] == kept
        assert [keyframe.session for keyframe in data.keyframes] == np.repeat([1, 2, 3, 4], LENGTH).tolist()
        for node in range(4 * LENGTH):
            loan, expected = data.clouds.loan(node), written.clouds.loan(node)
            assert (loan and loan.lender) == (expected and expected.lender)


def test_a_loop_that_waited_for_another_one_is_one_constraint_of_the_file(
    tmp_path: Path, noise: np.random.Generator
) -> None:
    """Previously, the rejection of the same measurement was changed to an acceptance at the end: the map had the loop
    twice."""
    path = tmp_path / "a.dpm2map"
    for _ in range(2):
        mapper = add_session(path, noise)
    with MapStore.open(path) as store:
        loops = [edge for edge in load_map(store).edges if edge.kind == "loop"]
    accepted = [(edge.from_node, edge.to_node) for edge in loops if edge.ok]
    assert sorted(accepted) == [(node, node + LENGTH) for node in range(LENGTH)]
    assert len(mapper.graph.loops) == LENGTH
    assert [edge.registration.reason for edge in loops if not edge.ok] == ["waits for a second loop that agrees"]
