# SPDX-License-Identifier: Apache-2.0
"""The incremental pose graph: results, covariances, and the process that optimizes it in the background."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import gtsam
import numpy as np
import pytest

from dpm2_core.errors import Dpm2Error
from dpm2_core.estimates import Edge, Registration, isotropic
from dpm2_core.frame import Array
from dpm2_core.geometry import se3
from dpm2_core.slam.graph import pose_graph
from dpm2_core.slam.graph.pose_graph import PoseGraph
from dpm2_core.slam.graph.robust import RobustSettings

STEP = np.diag([2e-3, 2e-3, 2e-3, 0.02, 0.02, 0.02]) ** 2
LOOP = np.diag([5e-3, 5e-3, 5e-3, 0.05, 0.05, 0.05]) ** 2
T_STEP = se3.exp([0, 0, 2 * np.pi / 50, 20 * 2 * np.pi / 50, 0, 0])  # 50 steps per lap of 20 m radius
DRIFT = se3.exp([0, 0, 5e-4, 0.01, 0, 0])


def step(graph: PoseGraph, T: Array = T_STEP, covariance: Array = STEP, before: int = -1) -> Edge:
    """Odometry edge from a node, by default the last one, to the next."""
    return Edge("odometry", len(graph) + before if before < 0 else before, len(graph), Registration(T, covariance))


def loop(a: int, b: int, covariance: Array = LOOP) -> Edge:
    """Loop edge: both nodes saw the same place from the same pose."""
    return Edge("loop", a, b, Registration(np.eye(4), covariance))


def drive(graph: PoseGraph, count: int) -> None:
    for _ in range(count):
        if not len(graph):
            graph.add_node(np.eye(4))
        else:
            graph.add_node(graph.poses[-1] @ T_STEP @ DRIFT, step(graph, T_STEP @ DRIFT))


def truth(count: int) -> Array:
    return np.array([np.linalg.matrix_power(T_STEP, n) for n in range(count)])


@pytest.fixture
def background(monkeypatch: pytest.MonkeyPatch) -> Iterator[PoseGraph]:
    """Graph of a lap with a loop. It is solved in the background process even though it is small."""
    monkeypatch.setattr(pose_graph, "SHORT", 0)
    graph = PoseGraph(RobustSettings(), background=True)
    drive(graph, 55)
    graph.add_loop(loop(0, 50))
    yield graph
    graph.close()


def test_a_loop_spreads_the_drift() -> None:
    graph = PoseGraph(RobustSettings())
    drive(graph, 51)
    before = np.linalg.norm((graph.poses - truth(51))[:, :3, 3], axis=1)
    graph.add_loop(loop(0, 50, LOOP / 100))
    graph.optimize()
    after = np.linalg.norm((graph.poses - truth(51))[:, :3, 3], axis=1)
    assert after[-1] < 0.1 * before[-1]
    assert np.sqrt((after**2).mean()) < 0.5 * np.sqrt((before**2).mean())
    np.testing.assert_allclose(graph.poses[0], np.eye(4), atol=1e-6)  # the first pose stays


def test_g2o_reads_back_at_full_precision(tmp_path: Path) -> None:
    graph = PoseGraph(RobustSettings())
    graph.add_node(np.eye(4))
    for _ in range(4):
        T = T_STEP @ se3.exp([1e-3, 2e-3, 3e-3, 0.1, 0.2, 0.3])
        graph.add_node(graph.poses[-1] @ T, step(graph, T))
    graph.write_g2o(tmp_path / "graph.g2o")
    factors, values = gtsam.readG2o(str(tmp_path / "graph.g2o"), True)
    for node in range(5):
        np.testing.assert_allclose(values.atPose3(node).matrix(), graph.poses[node], atol=1e-12)
    # gtsam's error for the file equals that of the graph: the information matrices and their order are right.
    moved = gtsam.Values()
    for node in range(5):
        off = se3.exp(np.array([1e-3, -2e-3, 1e-3, 0.01, 0.02, -0.01]) * node)
        moved.insert(node, gtsam.Pose3(graph.poses[node] @ off))
    expected = 0.0
    for edge in graph.edges:
        a, b = (moved.atPose3(node).matrix() for node in (edge.from_node, edge.to_node))
        off = se3.log(se3.inverse(edge.T_from_to) @ se3.inverse(a) @ b)
        expected += 0.5 * off @ np.linalg.solve(edge.covariance, off)
    assert factors.error(moved) == pytest.approx(expected, rel=1e-3)  # quaternion versus tangent space, to second order


def test_a_wrong_loop_is_rejected_with_a_reason_and_is_no_edge() -> None:
    graph = PoseGraph(RobustSettings())
    drive(graph, 55)
    graph.add_loop(loop(0, 50))
    graph.add_loop(loop(5, 30))  # 40 m wrong
    graph.optimize()
    right, wrong = graph.loops
    assert right.ok
    assert not wrong.ok
    assert "sigma from the optimized poses" in wrong.registration.reason
    assert "from the odometry" in wrong.registration.reason
    assert [(e.from_node, e.to_node) for e in graph.edges if e.kind == "loop"] == [(0, 50)]


def test_background_gives_what_inline_gives(background: PoseGraph) -> None:
    inline = PoseGraph(RobustSettings())
    drive(inline, 55)
    inline.add_loop(loop(0, 50))
    inline.optimize()
    background.optimize()
    assert background.busy
    assert background.collect(wait=True)
    np.testing.assert_allclose(background.poses, inline.poses, atol=1e-9)
    assert [(e.ok, e.registration.reason) for e in background.loops] == [
        (e.ok, e.registration.reason) for e in inline.loops
    ]
    assert not background.collect()


def solvers(parent: int) -> list[int]:
    """Solver processes that are children of the process `parent`."""
    found = []
    for folder in Path("/proc").glob("[0-9]*"):
        with suppress(OSError):  # the process has ended
            fields = (folder / "stat").read_text().rpartition(")")[2].split()
            if int(fields[1]) == parent and fields[0] != "Z" and b"graph.worker" in (folder / "cmdline").read_bytes():
                found.append(int(folder.name))
    return found


def held_solver(graph: PoseGraph) -> int:
    """Stop the process that solves the graph, so that later calls happen during the solve. Returns its id."""
    graph.optimize()
    while not (pids := solvers(os.getpid())):
        time.sleep(0.001)
    os.kill(pids[0], signal.SIGSTOP)
    return pids[0]


def test_nodes_added_meanwhile_follow_the_old_ones(background: PoseGraph) -> None:
    pid = held_solver(background)
    drive(background, 10)
    before = background.poses
    os.kill(pid, signal.SIGCONT)
    assert background.collect(wait=True)
    relative = [se3.inverse(p[54]) @ p[64] for p in (before, background.poses)]
    np.testing.assert_allclose(relative[0], relative[1], atol=1e-9)


def test_nodes_and_loops_added_meanwhile_are_not_lost(background: PoseGraph) -> None:
    """On a busy machine, both graphs may be solved when the first result is requested."""
    pid = held_solver(background)
    drive(background, 10)
    background.add_loop(loop(10, 60))
    background.optimize()  # the worker is busy: this solve is queued
    os.kill(pid, signal.SIGCONT)
    assert background.collect(wait=True)  # the second solve was submitted automatically
    assert not background.busy
    assert all(e.ok and e.registration.reason for e in background.loops)
    assert np.linalg.norm(background.poses[60, :3, 3] - background.poses[10, :3, 3]) < 0.1


@pytest.mark.slow
def test_a_killed_process_is_replaced(background: PoseGraph) -> None:
    background.optimize()
    background.collect(wait=True)
    (pid,) = solvers(os.getpid())
    os.kill(pid, signal.SIGSTOP)  # so that it is killed during the solve
    background.add_loop(loop(2, 52))
    background.optimize()
    os.kill(pid, signal.SIGKILL)
    assert background.collect(wait=True)
    assert background.problem == ""
    assert solvers(os.getpid()) != [pid]
    assert background.loops[1].ok
    assert background.loops[1].registration.reason


@pytest.mark.slow
def test_no_process_outlives_a_killed_program() -> None:
    program = (
        "import time, numpy as np\n"
        "from dpm2_core.slam.graph import pose_graph as p\n"
        "p.SHORT = 0\n"
        "g = p.PoseGraph(p.RobustSettings(), background=True)\n"
        "from dpm2_core.estimates import Edge, Registration, isotropic\n"
        "r = Registration(np.eye(4), np.eye(6) * 1e-2)\n"
        "g.add_node(np.eye(4))\n"
        "for n in range(9): g.add_node(np.eye(4), Edge('odometry', n, n + 1, r))\n"
        "g.add_loop(Edge('loop', 0, 9, r)); g.optimize(); g.collect(wait=True)\n"
        "print('solved', flush=True); time.sleep(60)\n"
    )
    with subprocess.Popen([sys.executable, "-c", program], stdout=subprocess.PIPE, text=True) as parent:
        assert parent.stdout is not None
        assert parent.stdout.readline() == "solved\n"
        (pid,) = solvers(parent.pid)
        parent.kill()
    for _ in range(600):
        try:
            with open(f"/proc/{pid}/stat") as file:
                if file.read().rpartition(")")[2].split()[0] == "Z":  # ended, but its status has not been read yet
                    return
        except FileNotFoundError:
            return
        time.sleep(0.1)
    os.kill(pid, signal.SIGKILL)
    pytest.fail("the optimizer's process lives on")


def test_the_relative_covariance_of_neighbors_is_that_of_their_edge() -> None:
    graph = PoseGraph(RobustSettings())
    drive(graph, 30)
    np.testing.assert_allclose(graph.relative_covariances([(20, 21)])[0], STEP, rtol=1e-3, atol=1e-9)
    assert np.trace(graph.relative_covariances([(0, 29)])[0]) > 20 * np.trace(STEP)
    with pytest.raises(ValueError, match="relative to itself"):
        graph.relative_covariances([(3, 3)])
    pairs = [(node % 29, 29) for node in range(50)]  # more pairs than one query handles at once
    each = [graph.relative_covariances([pair])[0] for pair in pairs]
    np.testing.assert_allclose(graph.relative_covariances(pairs), each, rtol=1e-6, atol=1e-12)


def test_a_node_that_is_held_stays_and_the_others_come_to_it() -> None:
    graph = PoseGraph(RobustSettings())
    drive(graph, 20)
    T = se3.exp(np.array([0, 0, 0.5, 30.0, 0, 0]))
    before = graph.poses
    graph.hold(10, T)
    graph.add_loop(loop(0, 19))
    graph.optimize()
    np.testing.assert_allclose(graph.pose(10), T, atol=1e-5)
    moved = se3.inverse(graph.pose(10)) @ graph.pose(11)
    np.testing.assert_allclose(moved, se3.inverse(before[10]) @ before[11], atol=0.5)
    with pytest.raises(Dpm2Error, match="not a finite rigid transform"):
        graph.hold(3, np.full((4, 4), np.nan))


def test_a_loop_makes_the_far_end_certain() -> None:
    graph = PoseGraph(RobustSettings())
    drive(graph, 55)
    before = np.trace(graph.relative_covariances([(0, 50)])[0])
    graph.add_loop(loop(0, 50))
    graph.optimize()
    after = graph.relative_covariances([(0, 50)])[0]
    assert np.trace(after) < before
    assert np.trace(after) < np.trace(LOOP)


def test_trajectories_that_grow_side_by_side_are_tied_by_loops() -> None:
    """Two robots drive on the same circle. Their nodes are interleaved, and the second has its own frame. A third robot
    stays unconnected."""
    turn = np.linspace(0, np.pi, 12)
    truth = se3.exp(np.array([0, 0, 1.0, 20.0, 0, 0]) * turn[:, None])
    own = se3.exp(np.array([0.0, 0.0, 2.5, 300.0, -40.0, 0.0]))  # the second robot's frame
    sigma = isotropic(1e-3, 0.02)
    graph, last = PoseGraph(RobustSettings()), {}
    for k in range(len(truth)):
        for robot, frame in enumerate((np.eye(4), own)):
            T = frame @ truth[k]
            graph.add_node(T, step(graph, se3.inverse(truth[k - 1]) @ truth[k], sigma, last[robot]) if k else None)
            last[robot] = len(graph) - 1
    graph.add_node(own)
    assert [graph.part(node) for node in (0, 1, 23, 24)] == [0, 1, 1, 2]
    with pytest.raises(ValueError, match="not the last"):
        graph.add_node(np.eye(4), step(graph, before=3))
    for k in (4, 9):
        graph.add_loop(loop(2 * k, 2 * k + 1, sigma))
    graph.optimize()
    np.testing.assert_allclose(graph.poses[0:24:2], truth, atol=1e-6)
    np.testing.assert_allclose(graph.poses[1:24:2], truth, atol=1e-6)
    np.testing.assert_array_equal(graph.poses[24], own)
    assert [graph.part(node) for node in (0, 1, 23, 24)] == [0, 0, 0, 1]
    assert {(e.from_node, e.to_node) for e in graph.edges} == {(n, n + 2) for n in range(22)} | {(8, 9), (18, 19)}
    near, far = graph.relative_covariances([(8, 9), (0, 23)])
    np.testing.assert_allclose(near, near.T)
    assert np.trace(near) < np.trace(far)


def off_rotation(poses: Array) -> float:
    """Largest deviation of R R^T from the identity."""
    R = poses[:, :3, :3]
    return float(np.abs(R @ np.swapaxes(R, -1, -2) - np.eye(3)).max())


def test_rotations_stay_rotations_over_hundreds_of_background_solves(background: PoseGraph) -> None:
    """A keyframe arrives during each solve. Previously, its rounding error tripled each time: after 35 solves no pose
    was a rigid transform any more."""
    for _ in range(300):
        background.optimize()
        background.add_node(background.pose(len(background) - 1) @ T_STEP, step(background))
        assert background.collect(wait=True)
    assert off_rotation(background.poses) < 1e-9  # rounding adds up to about 1e-14; a transform may be off by 1e-3


@pytest.mark.parametrize("moved", [False, True], ids=["by its first loop", "by the optimization"])
def test_rotations_stay_rotations_over_hundreds_of_maps_that_are_solved_again(moved: bool) -> None:
    """Each graph begins with the poses of the last one, and its second trajectory is moved. Previously, the rounding
    error doubled each time."""
    poses = se3.exp(np.random.default_rng(0).normal(size=(4, 6)))
    for _ in range(300):
        graph = PoseGraph(RobustSettings())
        for node, T in enumerate(poses):
            graph.add_node(T, step(graph) if node % 2 else None)
        graph.add_loop(loop(1, 2))
        if moved:
            for node in (2, 3):
                graph.place(node, DRIFT @ poses[node])
        graph.optimize()
        poses = graph.poses
    assert off_rotation(poses) < 1e-9  # as above


@pytest.mark.parametrize("bad", [np.nan, np.inf, -1.0, 0.0])
def test_an_unsound_edge_is_rejected_and_the_graph_stays_as_it_was(bad: float) -> None:
    """One such edge would turn all poses into NaN with the next loop."""
    graph = PoseGraph(RobustSettings())
    drive(graph, 55)
    covariance = STEP.copy()
    covariance[4, 4] = bad
    T_last = graph.pose(54)
    with pytest.raises(Dpm2Error, match="edge to node 55: its covariance"):
        graph.add_node(T_last @ T_STEP, step(graph, covariance=covariance))
    with pytest.raises(Dpm2Error, match="loop to node 50: its covariance"):
        graph.add_loop(loop(0, 50, covariance))
    with pytest.raises(Dpm2Error, match="node 55: not a finite rigid transform"):
        graph.add_node(T_last * bad, step(graph))
    assert len(graph) == 55
    graph.add_node(T_last @ T_STEP, step(graph))  # node 54 is still the last of its trajectory
    graph.add_loop(loop(0, 50))
    graph.optimize()
    assert np.isfinite(graph.poses).all()
    assert [e.ok for e in graph.loops] == [True]
