# SPDX-License-Identifier: Apache-2.0
"""Robust optimization of graphs whose solution is known, and covariances compared with the closed form."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dpm2_core.errors import Dpm2Error
from dpm2_core.frame import Array
from dpm2_core.geometry import se3
from dpm2_core.slam.graph.graph_data import CondensedOdometry, GraphData, chain_chi2, integrate
from dpm2_core.slam.graph.robust import RobustSettings, joint_covariance, least_squares, optimize

STEP = np.diag([2e-3, 2e-3, 2e-3, 0.02, 0.02, 0.02]) ** 2
LOOP = np.diag([5e-3, 5e-3, 5e-3, 0.05, 0.05, 0.05]) ** 2


def laps(count: int = 120, lap: int = 50, seed: int = 0) -> tuple[Array, GraphData]:
    """True poses of a drive in a circle, and its odometry with noise that matches its covariances; no loops."""
    rng = np.random.default_rng(seed)
    turn = 2 * np.pi / lap
    poses = se3.exp(np.array([0, 0, 1.0, 20, 0, 1]) * (turn * np.arange(count))[:, None])
    steps = np.tile(np.eye(4), (count, 1, 1))
    noise = rng.normal(size=(count - 1, 6)) * np.sqrt(np.diag(STEP))
    steps[1:] = se3.inverse(poses[:-1]) @ poses[1:] @ se3.exp(noise)
    chained = np.arange(count) > 0
    graph = GraphData(poses.copy(), chained, steps, np.where(chained[:, None, None], STEP, 0))
    return poses, replace(graph, poses=integrate(graph))


def with_loops(graph: GraphData, ends: list[tuple[int, int]], T: Array) -> GraphData:
    return replace(graph, ends=np.array(ends, np.intp), T_from_to=T, covariances=np.tile(LOOP, (len(ends), 1, 1)))


def right_loops(poses: Array, ends: list[tuple[int, int]], seed: int = 1) -> Array:
    noise = np.random.default_rng(seed).normal(size=(len(ends), 6)) * np.sqrt(np.diag(LOOP))
    a, b = np.array(ends).T
    return np.asarray(se3.inverse(poses[a]) @ poses[b] @ se3.exp(noise))


def rmse(a: Array, b: Array) -> float:
    return float(np.sqrt(((a[:, :3, 3] - b[:, :3, 3]) ** 2).sum(1).mean()))


ENDS = [(k, k + 50) for k in range(0, 70, 10)]


@settings(max_examples=15, deadline=None)
@given(seed=st.integers(0, 10_000), wrong=st.integers(1, 20))
def test_wrong_loops_are_rejected_and_leave_no_trace(seed: int, wrong: int) -> None:
    poses, graph = laps(seed=seed)
    rng = np.random.default_rng(seed)
    clean = optimize(with_loops(graph, ENDS, right_loops(poses, ENDS)), RobustSettings())
    assert clean.kept.all()
    a = rng.integers(0, 50, wrong)
    false = [(int(n), int(n + k)) for n, k in zip(a, rng.integers(15, 36, wrong), strict=True)]  # more than 18 m apart
    T = se3.exp(rng.normal(size=(wrong, 6)) * [0.02, 0.02, 1.0, 1, 1, 0.1])
    both = with_loops(graph, ENDS + false, np.concatenate([right_loops(poses, ENDS), T]))
    result = optimize(both, RobustSettings())
    assert result.settled
    np.testing.assert_array_equal(result.kept, np.arange(len(both.ends)) < len(ENDS))
    # A rejected loop has no effect: only the point where Levenberg-Marquardt stops may differ.
    assert rmse(result.poses, clean.poses) < 0.01


def test_a_right_loop_comes_back_when_the_graph_has_improved() -> None:
    poses, graph = laps()
    graph = with_loops(graph, ENDS, right_loops(poses, ENDS))
    apart = np.sqrt(chain_chi2(graph, integrate(graph)))
    result = optimize(graph, RobustSettings(odometry_sigmas=float(apart.max()) - 1e-3))  # rejects one at first
    assert result.kept.all()
    assert result.rounds == 2


def test_few_unknowns_give_the_optimum_of_all() -> None:
    poses, graph = laps(seed=3)
    graph = with_loops(graph, ENDS, right_loops(poses, ENDS))
    few = optimize(graph, RobustSettings(loop_kernel=1e6))  # with such a wide kernel, this is plain least squares
    every = least_squares(graph, np.ones(len(ENDS), np.bool_))
    assert rmse(few.poses, every) < 2e-3  # to first order in corrections of about 1 m per lap


def test_spreading_what_is_not_off_changes_nothing() -> None:
    _, graph = laps(seed=5)
    stretches = CondensedOdometry(graph, graph.poses, np.array([17, 3, 80]))
    np.testing.assert_array_equal(stretches.nodes, [0, 3, 17, 80, 119])
    np.testing.assert_allclose(stretches.spread(graph.poses[stretches.nodes]), graph.poses, atol=1e-9)


def test_a_trajectory_in_another_frame_is_joined_by_the_loops_that_agree() -> None:
    poses, graph = laps(100)
    chained = graph.chained.copy()
    chained[50] = False
    moved = graph.poses.copy()
    moved[50:] = se3.exp([0, 0, 2.5, 300, -100, 0]) @ moved[50:]
    steps, covariances = graph.steps.copy(), graph.step_covariances.copy()
    steps[50], covariances[50] = np.eye(4), 0
    ends = [(k, 50 + k) for k in range(0, 50, 10)]
    T = right_loops(poses, ends)
    T[1] = se3.exp([0, 0, 1, 5, 5, 0])  # one of five loops is wrong
    graph = with_loops(GraphData(moved, chained, steps, covariances), ends, T)
    result = optimize(graph, RobustSettings())
    np.testing.assert_array_equal(result.kept, [True, False, True, True, True])
    assert rmse(result.poses, poses) < 0.6  # odometry noise: 0.02 m per step and 0.002 rad at a lever of 20 m


@pytest.mark.parametrize("fixed", [[], [60]], ids=["nothing fixed", "one of the second fixed"])
def test_a_trajectory_is_placed_by_its_loops_to_what_is_placed_however_they_are_numbered(fixed: list[int]) -> None:
    """The last trajectory has three loops to the first one, and eight to the second one, whose position then
    follows."""
    poses, graph = laps(150)
    chained, moved = graph.chained.copy(), graph.poses.copy()
    steps, covariances = graph.steps.copy(), graph.step_covariances.copy()
    for first, frame in ((50, [0, 0, 2.5, 60, -40, 0]), (100, [0, 0, -1.5, -50, 70, 0])):
        chained[first], steps[first], covariances[first] = False, np.eye(4), 0
        moved[first : first + 50] = se3.exp(np.array(frame, float)) @ graph.poses[first : first + 50]
    ends = [(k, 100 + (k + 5) % 50) for k in range(0, 48, 16)] + [(50 + k, 100 + k) for k in range(0, 48, 6)]
    rng = np.random.default_rng(0)
    a = np.concatenate([rng.integers(0, 50, 2), rng.integers(50, 100, 5)])
    false = list(zip(a.tolist(), rng.integers(100, 150, 7).tolist(), strict=True))
    T = np.concatenate([right_loops(poses, ends), se3.exp(rng.normal(size=(7, 6)) * [0.1, 0.1, 0.8, 1.5, 1.5, 0.3])])
    graph = with_loops(GraphData(moved, chained, steps, covariances), ends + false, T)
    result = optimize(replace(graph, fixed=np.array(fixed, np.intp)), RobustSettings())
    np.testing.assert_array_equal(result.kept, np.arange(len(T)) < len(ends))


def test_covariance_grows_along_the_chain_as_its_steps_add_up() -> None:
    _, graph = laps(20)
    joint = joint_covariance(graph, np.zeros(0, np.bool_), np.array([19]))
    expected = np.zeros((6, 6))
    for node in range(1, 20):
        A = se3.adjoint(se3.inverse(graph.poses[19]) @ graph.poses[node])
        expected += A @ STEP @ A.T
    np.testing.assert_allclose(joint, expected, rtol=1e-3, atol=1e-9)  # the first node is held with 1e-6, not with 0


def test_an_empty_and_a_single_node_graph_are_solved() -> None:
    _, graph = laps(1)
    np.testing.assert_allclose(optimize(graph, RobustSettings()).poses, graph.poses, atol=1e-12)


def test_a_covariance_that_is_none_is_rejected() -> None:
    """Previously, when numpy and not gtsam detected this, `dpm2 map optimize` and the solver process ended with a
    traceback."""
    poses, graph = laps()
    graph = with_loops(graph, ENDS, right_loops(poses, ENDS))
    bad = replace(graph, covariances=graph.covariances * 0)
    with pytest.raises(Dpm2Error, match="pose graph: Singular matrix"):
        optimize(bad, RobustSettings(odometry_sigmas=1e9))
