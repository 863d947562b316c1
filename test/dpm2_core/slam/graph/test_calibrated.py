# SPDX-License-Identifier: Apache-2.0
"""Graphs whose covariances are wrong by a common factor: which loops are kept, and what is reported."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from dpm2_core.estimates import isotropic
from dpm2_core.frame import Array
from dpm2_core.geometry import se3
from dpm2_core.slam.graph.calibrated import optimize_calibrated, scaled
from dpm2_core.slam.graph.graph_data import GraphData, integrate, total_chi2
from dpm2_core.slam.graph.robust import least_squares

from .test_robust import STEP, laps, right_loops, rmse, with_loops

RIGHT = [(k, k + 50) for k in range(0, 70, 3)]


def with_wrong(count: int, right: list[tuple[int, int]] = RIGHT) -> tuple[Array, GraphData]:
    """True poses, and laps with right loops followed by `count` wrong ones, whose ends are all more than 18 m apart."""
    poses, graph = laps()
    rng = np.random.default_rng(4)
    false = [(int(n), int(n + k)) for n, k in zip(rng.integers(0, 50, count), rng.integers(15, 36, count), strict=True)]
    T = [right_loops(poses, right)] if right else []
    return poses, with_loops(graph, right + false, np.concatenate([*T, se3.exp(rng.normal(size=(count, 6)))]))


def sphere(radians: float, laps: int = 20, lap: int = 20) -> tuple[Array, GraphData]:
    """True poses of a spiral on a sphere of 10 m radius, and its graph: loops connect each node to two nodes of the
    next lap."""
    rng, number = np.random.default_rng(0), np.arange(laps * lap)
    cov = isotropic(radians, 0.1)
    azimuth, tilt = 2 * np.pi * number / lap, np.pi * (0.8 * number / len(number) - 0.4)
    turns = se3.exp(azimuth[:, None] * np.eye(6)[2]) @ se3.exp(-tilt[:, None] * np.eye(6)[1])
    poses = turns @ se3.make(np.eye(3), [10.0, 0, 0])
    ends = np.concatenate([np.column_stack([number, number + lap + side])[: -lap - 1] for side in (0, 1)])

    def measured(a: Array, b: Array) -> Array:
        noise = rng.normal(size=(len(a), 6)) * np.sqrt(np.diag(cov))
        return np.asarray(se3.inverse(poses[a]) @ poses[b] @ se3.exp(noise))

    steps = np.concatenate([np.eye(4)[None], measured(number[:-1], number[1:])])
    chained = number > 0
    tied = np.where(chained[:, None, None], cov, 0)
    loops = measured(ends[:, 0], ends[:, 1])
    graph = GraphData(poses.copy(), chained, steps, tied, ends, loops, np.tile(cov, (len(ends), 1, 1)))
    return poses, replace(graph, poses=integrate(graph))


@pytest.mark.parametrize("factor", [1e-9, 1e-3, 1, 1e3, 1e9])
def test_half_of_the_loops_wrong_and_covariances_of_any_size(factor: float) -> None:
    """Covariances of public graphs are 5 to 20,000 times too large. Previously, wrong loops then counted as near and
    bent the map by a third of its extent. Where covariances were far too small, every right loop was rejected."""
    poses, graph = with_wrong(len(RIGHT))
    result = optimize_calibrated(scaled(graph, factor), 6)
    np.testing.assert_array_equal(result.solution.kept, np.arange(len(graph.ends)) < len(RIGHT))
    assert 0.2 < result.scale * factor < 5  # the noise matches the unscaled covariances
    assert result.solution.settled
    assert not result.undecided
    assert rmse(result.solution.poses, poses) < 0.6  # odometry noise on a loop of 20 m radius, as in test_robust


def test_wrong_loops_alone_are_not_fitted() -> None:
    """Covariances large enough to fit some wrong loops would make the graph look consistent."""
    _, graph = with_wrong(20, right=[])
    result = optimize_calibrated(graph, 6)
    assert not result.solution.kept.any()
    assert result.scale == 1


def test_a_few_loops_do_not_say_how_large_covariances_are() -> None:
    _, graph = with_wrong(1, right=RIGHT[:3])
    result = optimize_calibrated(graph, 6)
    assert result.scale == 1
    np.testing.assert_array_equal(result.solution.kept, [True, True, True, False])


@pytest.mark.parametrize("right", [1, 3, 5])
def test_a_few_loops_that_a_loose_odometry_does_not_check_are_said_to_be_so(right: int) -> None:
    """Some programs write the identity for every covariance. Previously, all wrong loops of a real drive were kept
    without a warning, and the map was 100 m off."""
    _, graph = with_wrong(2, right=RIGHT[:right])
    loose = optimize_calibrated(scaled(graph, 1e5), 6)
    assert loose.solution.kept.all(), "else they are told apart"
    assert loose.undecided
    assert not optimize_calibrated(graph, 6).undecided


@pytest.mark.parametrize("factor", [1.0, 1 / 64])
def test_a_sphere_is_found_however_the_odometry_is_bent(factor: float) -> None:
    """Similar to the public graph "sphere" with high noise: 0.3 rad per step wind the odometry up. From such a start a
    solver ends in a local optimum. With covariances that are too small, all loops but 23 were previously rejected, and
    the map was 49 m off."""
    poses, graph = sphere(0.3)
    graph = scaled(graph, factor)
    result = optimize_calibrated(graph, 6)
    kept = result.solution.kept
    assert kept.mean() > 0.98
    found = least_squares(replace(graph, poses=result.solution.poses), kept)
    from_truth = least_squares(replace(graph, poses=poses), kept)
    assert total_chi2(graph, found, kept) < 1.01 * total_chi2(graph, from_truth, kept)
    assert rmse(found, poses) < 1.5  # for a radius of 10 m; the optimum itself is 1.1 m off


def test_loops_that_nothing_checks_are_said_to_be_so() -> None:
    """Previously, a graph of 20 loops and an odometry that is off by a third of its extent kept wrong loops without a
    warning."""
    _, graph = with_wrong(2, right=RIGHT[::2])
    noise = np.random.default_rng(0).normal(size=(len(graph), 6)) * 150 * np.sqrt(np.diag(STEP))
    loose = replace(graph, steps=graph.steps @ se3.exp(noise), step_covariances=graph.step_covariances * 150**2)
    assert optimize_calibrated(loose, 6).undecided
    assert not optimize_calibrated(graph, 6).undecided


def test_each_stage_is_reported() -> None:
    stages: list[str] = []
    optimize_calibrated(with_wrong(5)[1], 6, stages.append)
    assert stages[0].startswith("stage 1: covariances times")
    assert len(stages) > 1
