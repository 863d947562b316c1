# SPDX-License-Identifier: Apache-2.0
"""Keyframes can be removed and maps joined: constraints, trajectory and clouds are kept."""

from __future__ import annotations

import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from dpm2_core.descriptors import Descriptors
from dpm2_core.estimates import Edge, Keyframe, Registration
from dpm2_core.frame import NO_POINTS, Array, Fix
from dpm2_core.geometry import se3
from dpm2_core.slam.graph.pose_graph import PoseGraph
from dpm2_core.slam.graph.robust import RobustSettings
from dpm2_core.slam.mapping.merge import align, merge_maps, optimized
from dpm2_core.slam.mapping.parts import first_part, parts_of
from dpm2_core.slam.mapping.prune import composed, eliminate, inverted, prune, redundant_nodes
from dpm2_core.slam.store.cloud_codec import pack_cloud
from dpm2_core.slam.store.cloud_store import CloudStore, Loan
from dpm2_core.slam.store.map_data import MapData, load_map, save_as, subset, trajectory
from dpm2_core.slam.store.map_store import MapStore
from dpm2_core.slam.store.rows import Session

SIGMA = np.diag([1e-3, 2e-3, 3e-3, 0.01, 0.02, 0.03]) ** 2


def laps(count: int, steps: int = 40, session: bool = False) -> MapData:
    """Laps of one circle. Each keyframe has an edge to the previous one and to the one a lap before."""
    turn = 2 * np.pi / steps * np.arange(count * steps)[:, None]
    poses = se3.exp(turn * np.array([0, 0, 1.0, 30.0, 0, 0]))
    clouds = CloudStore()
    keyframes, edges = [], []
    for node, T in enumerate(poses):
        clouds.append(pack_cloud(np.full((10, 4), node / 100, np.float32)))
        keyframes.append(Keyframe(node, node * 10**8, node, T, NO_POINTS, session=1 + session * (node // steps)))
        for other, kind in ((node - 1, "odometry"), (node - steps, "loop")):
            if other >= 0:
                T_other_node = se3.inverse(poses[other]) @ T
                edges.append(Edge(kind, other, node, Registration(T_other_node, SIGMA)))
    return MapData(keyframes, poses, edges, [], [Session(1, "", "", "", "")], clouds)


def error(edge: Edge, poses: Array) -> Array:
    return se3.log(se3.inverse(edge.T_from_to) @ se3.inverse(poses[edge.from_node]) @ poses[edge.to_node])


def test_composition_and_inversion_carry_the_covariance() -> None:
    """Compared with 20 thousand noisy pairs; 5 % is four standard errors of a variance."""
    rng = np.random.default_rng(0)
    Ta, Tb = se3.exp([0.1, -0.2, 0.5, 3, 1, 0.2]), se3.exp([-0.1, 0.3, 1.0, 2, -4, 0.5])
    a, b = Edge("odometry", 0, 1, Registration(Ta, SIGMA)), Edge("loop", 1, 2, Registration(Tb, 2 * SIGMA))
    noisy_a = Ta @ se3.exp(rng.multivariate_normal(np.zeros(6), a.covariance, 20000))
    noisy_b = Tb @ se3.exp(rng.multivariate_normal(np.zeros(6), b.covariance, 20000))
    ab, back = composed(a, b), inverted(a)
    assert (ab.kind, ab.from_node, ab.to_node) == ("loop", 0, 2)
    for edge, samples in ((ab, noisy_a @ noisy_b), (back, se3.inverse(noisy_a))):
        spread = np.cov(se3.way(edge.T_from_to, samples).T)
        scale = np.sqrt(np.outer(np.diag(edge.covariance), np.diag(edge.covariance)))
        np.testing.assert_allclose(spread / scale, edge.covariance / scale, atol=0.05)


def test_a_chain_keeps_its_ends() -> None:
    """Removing the middle of a chain is exact: one edge remains, whose covariance is the sum along the chain."""
    data = laps(1, 6)
    (edge,) = eliminate(data.edges, [1, 2, 3, 4])
    assert (edge.kind, edge.from_node, edge.to_node) == ("odometry", 0, 5)
    np.testing.assert_allclose(error(edge, data.poses), 0, atol=1e-9)
    whole = data.edges[0]
    for other in data.edges[1:]:
        whole = composed(whole, other)
    np.testing.assert_allclose(edge.covariance, whole.covariance, rtol=1e-9)


def test_pruning_laps_leaves_one_with_all_constraints() -> None:
    data = laps(3)
    nodes = redundant_nodes(data, 2.0, 20.0)
    assert set(nodes) == set(range(40, 119))  # two laps, except the last keyframe
    less = prune(data, nodes)
    assert len(less) == 41
    assert len(less.constraints) < len(data.constraints)
    ends = {(e.from_node, e.to_node) for e in less.constraints}
    assert all((i, i + 1) in ends for i in range(40))  # connected, in a chain
    for edge in less.constraints:
        np.testing.assert_allclose(error(edge, less.poses), 0, atol=1e-6)
        assert np.linalg.eigvalsh(edge.covariance)[0] > 0
    stamps, poses = trajectory(less)  # nothing of the trajectory is lost
    assert stamps == [k.stamp for k in data.keyframes]
    np.testing.assert_allclose(poses, data.poses, atol=1e-9)
    again = prune(less, [5, 6, 40])  # keyframes that took over edges of pruned ones can be pruned, too
    np.testing.assert_allclose(trajectory(again)[1], data.poses, atol=1e-9)
    np.testing.assert_array_equal(again.clouds[5], less.clouds[7])


def test_many_laps_leave_no_more_edges_than_few() -> None:
    """Previously, every loop was carried along the drive to its end: 20 laps of 25 keyframes had not finished after 200
    s."""

    def left(count: int) -> list[Edge]:
        data = laps(count, 12)
        edges = [e if e.kind == "odometry" else e.between(e.to_node % 12, e.to_node) for e in data.edges]
        edges = eliminate(edges, range(12, len(data) - 1))  # loops as `to_lender` returns them
        for edge in edges:
            np.testing.assert_allclose(error(edge, data.poses), 0, atol=1e-6)
        return edges

    def sure(edges: list[Edge]) -> dict[int, float]:
        loops = [e for e in edges if e.kind == "loop"]
        return {node: min(np.trace(e.covariance) for e in loops if e.from_node == node) for node in range(12)}

    few, many = left(3), left(6)
    assert len(few) == len(many) == 12 + 14  # odometry; loops between neighboring places, and two of the last keyframe
    assert sure(many) == pytest.approx(sure(few), rel=1e-6)  # those of the last lap


def test_loops_of_a_street_that_is_driven_again_stay_at_their_places() -> None:
    """Previously, all loops were carried along the second drive. The number of compositions was its length squared, and
    the resulting loops carried little information."""
    data = laps(2, 60)
    street = eliminate(data.edges, range(60, len(data) - 1))
    loops = [edge for edge in street if edge.kind == "loop"]
    assert len(loops) == 60
    assert {edge.to_node - edge.from_node for edge in loops if edge.to_node < 60} == {1}
    step, measured = data.edges[0], Edge("loop", 0, 60, Registration(np.eye(4), SIGMA))
    there_and_back = composed(composed(measured, replace(step, from_node=60, to_node=61)), measured)
    assert max(np.trace(edge.covariance) for edge in loops) <= np.trace(there_and_back.covariance) * 1.01


def test_the_next_storey_is_no_revisit() -> None:
    """A car park: the lap above the first one is 2.8 m away, nearer than the distance at which `dpm2 map prune` assumes
    a revisit."""
    data = laps(2)
    poses = data.poses.copy()
    poses[40:, 2, 3] += 2.8
    assert redundant_nodes(replace(data, poses=poses), 3.0, 30.0) == []


def test_what_has_descriptors_does_not_go_for_what_has_none() -> None:
    """For example a first drive with point-to-plane registration alone, or one whose payloads `dpm2 map check
    --recover` could not read."""
    data = laps(2, session=True)
    seen = Descriptors(np.zeros((1, 3), np.float32), np.ones((1, 4), np.int8), np.ones(1, np.float32))
    described = [replace(keyframe, descriptors=seen) for keyframe in data.keyframes]
    mixed = replace(data, keyframes=[*data.keyframes[:20], *described[20:]])
    assert redundant_nodes(mixed, 3.0, 30.0) == list(range(60, 79))
    assert redundant_nodes(replace(data, keyframes=described), 3.0, 30.0) == list(range(40, 79))
    bare = replace(data, keyframes=[*described[:40], *data.keyframes[40:]])
    assert redundant_nodes(bare, 3.0, 30.0) == list(range(40, 79))


def test_a_drive_that_nothing_ties_to_the_map_stays_where_it_seems_to_be_a_revisit() -> None:
    """Without a localization, a second drive begins in the frame of the first, on top of it, wherever it really was."""
    data = laps(2, session=True)
    assert redundant_nodes(data, 2.0, 20.0) == list(range(40, 79))
    session = [keyframe.session for keyframe in data.keyframes]
    within = [edge for edge in data.edges if session[edge.from_node] == session[edge.to_node]]
    refused = [edge.rejected("no") for edge in data.edges if edge not in within]
    apart = replace(data, edges=[*within, *refused])
    assert redundant_nodes(apart, 2.0, 20.0) == []


def test_pruned_keyframes_stay_with_the_part_that_they_are_tied_to() -> None:
    """This is so even if keyframes of an unconnected drive lie between them and the rest, or lend them their clouds."""
    one = laps(1)
    again = [Edge("loop", node, node, Registration(np.eye(4), SIGMA)) for node in range(40)]
    revisit = merge_maps(merge_maps(one, one, np.eye(4)), one, np.eye(4), again)  # the second one is elsewhere
    borrowing = merge_maps(merge_maps(one, one, np.eye(4)), one, np.eye(4), again)
    for node in range(40, 120):
        borrowing.clouds.borrow(node, Loan(node % 40, np.eye(4)))  # the second one by loops that were rejected later
    for data, stay in ((revisit, [*range(80), 119]), (borrowing, [*range(40), *range(79, 120)])):
        gone = redundant_nodes(data, 2.0, 20.0)
        assert sorted({*range(len(data))} - {*gone}) == stay
        less = prune(data, gone)
        np.testing.assert_array_equal(parts_of(less), parts_of(data)[stay])
        known = first_part(data)
        stamps, poses = trajectory(first_part(less))
        assert stamps == trajectory(known)[0]
        np.testing.assert_allclose(poses, trajectory(known)[1], atol=1e-9)
    with pytest.raises(ValueError, match="nothing that is tied to keyframe 40 stays"):
        prune(borrowing, range(40, 80))


def test_the_fixes_of_a_pruned_drive_stay_in_the_map() -> None:
    """The antenna keeps its position in the map. A keyframe with its own fix keeps that fix."""
    data, antenna = laps(2, session=True), np.array([0.5, 0.2, 1.0])
    poses = np.concatenate([data.poses[:40], data.poses[40:] @ se3.exp([0, 0, 0.1, 0.5, 0.3, 0])])
    fixes = {node: Fix(node, np.array([49.0, 8.4, node]), np.eye(3), antenna) for node in (3, *range(40, 79))}
    keyframes = [replace(keyframe, fix=fixes.get(node)) for node, keyframe in enumerate(data.keyframes)]
    data = replace(data, poses=poses, keyframes=keyframes)
    less = prune(data, redundant_nodes(data, 2.0, 20.0))
    assert len(less) == 41
    for node, keyframe in enumerate(less.keyframes[:39]):
        was = 3 if node == 3 else node + 40
        assert keyframe.fix is not None
        assert keyframe.fix.geodetic[2] == was
        at, before = less.poses[node] @ np.append(keyframe.fix.antenna, 1), poses[was] @ np.append(antenna, 1)
        np.testing.assert_allclose(at, before, atol=1e-9)  # rounding
    (last,) = prune(data, range(79)).keyframes  # if all are pruned: only the nearest fix, as some would be 60 m off
    assert last.fix is not None
    assert last.fix.geodetic[2] == 78


def test_the_optimum_stays_when_nodes_go() -> None:
    """A lap with drift and a loop: solving before or after pruning gives about the same poses."""
    data = laps(1)
    drift = se3.exp([0, 0, 0.002, 0.01, 0.02, 0])
    edges = [
        replace(edge, registration=replace(edge.registration, T_target_source=edge.T_from_to @ drift))
        for edge in data.edges
    ]
    T_first_last = se3.inverse(data.poses[0]) @ data.poses[39]
    edges.append(Edge("loop", 0, 39, Registration(T_first_last, SIGMA * 0.01)))
    data = replace(data, edges=edges)
    before = optimized(data, PoseGraph(RobustSettings())).poses
    gone = [n for n in range(1, 39) if n % 3]
    after = optimized(prune(data, gone), PoseGraph(RobustSettings())).poses
    kept = [n for n in range(40) if n not in gone]
    moved = np.linalg.norm(before[kept][:, :3, 3] - data.poses[kept][:, :3, 3], axis=1).max()
    assert moved > 0.1
    assert np.linalg.norm(after[:, :3, 3] - before[kept][:, :3, 3], axis=1).max() < 0.02 * moved


def test_borrowers_go_before_their_lenders() -> None:
    """Except the last one, and those that show how a place was last seen."""
    data = laps(3)
    for node in range(40, 120):
        data.clouds.borrow(node, Loan(node % 40, np.eye(4)))
        if node == 99:
            nodes = redundant_nodes(subset(data, range(100), data.edges, []), 0, 0)
            assert nodes == list(range(40, 60))
    nodes = redundant_nodes(data, 0, 0)
    assert nodes == list(range(40, 80))
    less = prune(data, nodes)
    assert less.clouds.kept.all()
    assert [less.clouds.packed(node) for node in range(80)] == [
        data.clouds.packed(node) for node in range(120) if node not in nodes
    ]
    with pytest.raises(ValueError, match="borrows the cloud of 39"):
        prune(data, [39])


def test_what_is_near_a_borrower_only_stays() -> None:
    """A third lap runs 2.5 m next to the second, which borrows from the first: no cloud of the map is within 3 m of
    it."""
    data = laps(3)
    poses = data.poses.copy()
    poses[:, 2, 3] += np.repeat([0, 2.5, 5.0], 40) / 4  # height counts four times
    for node in range(40, 80):
        data.clouds.borrow(node, Loan(node - 40, np.eye(4)))
    assert redundant_nodes(replace(data, poses=poses), 3.0, 30.0) == []
    poses[80:, 2, 3] = 2.5 / 4
    assert redundant_nodes(replace(data, poses=poses), 3.0, 30.0) == list(range(80, 119))


def test_merged_side_by_side(tmp_path: Path, map_file: Path) -> None:
    T = se3.exp([0, 0, 0.5, 100, 0, 0])
    with MapStore.open(map_file) as a, MapStore.open(map_file) as b:
        one, two = load_map(a), load_map(b)
        save_as(merge_maps(one, two, T), tmp_path / "both.dpm2map")
        with MapStore.open(tmp_path / "both.dpm2map") as store:
            both = load_map(store)
            assert len(both) == 24
            assert [k.session for k in both.keyframes] == [1] * 12 + [2] * 12
            np.testing.assert_allclose(both.poses[12:], T @ one.poses)
            np.testing.assert_array_equal(both.clouds[15], one.clouds[3])
            assert [(e.from_node, e.to_node) for e in both.edges[13:14]] == [(12, 13)]
            assert len(both.edges) == 26


def test_maps_are_aligned_by_their_loops_though_one_of_them_is_off() -> None:
    a, b = laps(1), laps(1)
    T_a_b = se3.exp([0, 0, 1.0, 50, 20, 1])
    b = replace(b, poses=se3.inverse(T_a_b) @ b.poses)  # the same places in another frame
    same = Registration(np.eye(4), SIGMA)
    loops = [Edge("loop", a, b, same) for a, b in ((3, 3), (13, 13), (23, 23), (5, 30))]
    found = align(a, b, lambda one, two: loops)
    assert found is not None
    T, used = found
    np.testing.assert_allclose(T, T_a_b, atol=1e-6)
    both = optimized(merge_maps(a, b, T, used[:3]), PoseGraph(RobustSettings()))
    np.testing.assert_allclose(both.poses[40:], both.poses[:40], atol=1e-3)
    assert align(a, b, lambda one, two: []) is None


def test_maps_with_thousands_of_loops_between_them_are_aligned_at_once() -> None:
    """Previously, each of 1,000 loops was compared with each other one in Python: 2.7 s, and 100 times as long for 10
    times as many."""
    a = laps(1)
    loops = [Edge("loop", node % 40, node % 40, Registration(np.eye(4), SIGMA)) for node in range(2000)]
    began = time.process_time()
    assert align(a, a, lambda one, two: loops) is not None
    assert time.process_time() - began < 2


def test_a_map_that_is_merged_again_and_again_stays_rigid() -> None:
    """It is the second map each time, as in `dpm2 map merge new old`. Previously, the rounding error of its rotations
    doubled."""
    new, old = laps(1, 4), laps(1, 4)
    loop = Edge("loop", 1, 2, Registration(se3.exp([0.1, 0.2, 0.3, 1, 2, 3]), SIGMA))
    for _ in range(60):
        found = align(new, old, lambda one, two: [loop])
        assert found is not None
        old = replace(old, poses=merge_maps(new, old, found[0]).poses[len(new) :])
    R = old.poses[:, :3, :3]
    np.testing.assert_allclose(R @ np.swapaxes(R, -1, -2), np.broadcast_to(np.eye(3), R.shape), atol=1e-9)
