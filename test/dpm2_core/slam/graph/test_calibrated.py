# SPDX-License-Identifier: Apache-2.0
"""Graphs whose covariances are wrong by a common factor: which loops are kept, and what is said of it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from dpm2_core.frame import Array
from dpm2_core.geometry import se3
from dpm2_core.slam.graph.calibrated import optimize_calibrated, scaled
from dpm2_core.slam.graph.graph_data import GraphData

from .test_robust import STEP, laps, right_loops, rmse, with_loops

RIGHT = [(k, k + 50) for k in range(0, 70, 3)]


def with_wrong(count: int, right: list[tuple[int, int]] = RIGHT) -> tuple[Array, GraphData]:
    """True poses, and laps with right loops and then `count` wrong ones, all more than 18 m apart."""
    poses, graph = laps()
    rng = np.random.default_rng(4)
    false = [(int(n), int(n + k)) for n, k in zip(rng.integers(0, 50, count), rng.integers(15, 36, count), strict=True)]
    T = [right_loops(poses, right)] if right else []
    return poses, with_loops(graph, right + false, np.concatenate([*T, se3.exp(rng.normal(size=(count, 6)))]))


@pytest.mark.parametrize("factor", [1e-9, 1e-3, 1, 1e3, 1e9])
def test_half_of_the_loops_wrong_and_covariances_of_any_size(factor: float) -> None:
    """Public graphs' covariances are 5 to 20,000 times too large: wrong loops counted as near and bent the map by a
    third of its extent. Where they were far too small every right loop was rejected."""
    poses, graph = with_wrong(len(RIGHT))
    result = optimize_calibrated(scaled(graph, factor), 6)
    np.testing.assert_array_equal(result.solution.kept, np.arange(len(graph.ends)) < len(RIGHT))
    assert 0.2 < result.scale * factor < 5  # the noise is as the unscaled covariances say
    assert result.solution.settled
    assert not result.undecided
    assert rmse(result.solution.poses, poses) < 0.6  # odometry noise on a loop of 20 m radius: as in test_robust


def test_wrong_loops_alone_are_not_fitted() -> None:
    """Covariances large enough for some of them would say that all is well."""
    _, graph = with_wrong(20, right=[])
    result = optimize_calibrated(graph, 6)
    assert not result.solution.kept.any()
    assert result.scale == 1


def test_a_few_loops_do_not_say_how_large_covariances_are() -> None:
    _, graph = with_wrong(1, right=RIGHT[:3])
    result = optimize_calibrated(graph, 6)
    assert result.scale == 1
    np.testing.assert_array_equal(result.solution.kept, [True, True, True, False])


def test_loops_that_nothing_checks_are_said_to_be_so() -> None:
    """A graph of 20 loops and an odometry that is off by a third of its extent kept wrong ones without a word."""
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
