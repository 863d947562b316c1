# SPDX-License-Identifier: Apache-2.0
"""The folder of a map: which trajectories it contains, and how corrections reach every frame."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from dpm2_core.data.trajectory import read_trajectory
from dpm2_core.estimates import BETWEEN, Edge, Keyframe, OdometryResult, Registration, State
from dpm2_core.frame import NO_POINTS, Array
from dpm2_core.geometry import se3
from dpm2_core.slam.build import make_loops
from dpm2_core.slam.graph.pose_graph import PoseGraph
from dpm2_core.slam.mapping.mapper import Mapper
from dpm2_core.slam.output import TrajectoryRecorder, save_map
from dpm2_core.slam.settings import SlamSettings


def test_a_trajectory_has_what_is_tied_to_the_map_robot_by_robot(tmp_path: Path) -> None:
    """Keyframes of two robots alternate. Previously, keyframes of a robot whose position was not known were written
    between those of the other."""
    settings = SlamSettings.model_validate({"loops": {"enabled": False}})
    graph = PoseGraph(settings.pose_graph)
    mapper, step = Mapper(settings.map, graph, make_loops(settings)), se3.exp([0, 0, 0, 3.0, 0, 0])
    for n in range(3):
        edge = Registration(step, np.eye(6) * 1e-4, method="odometry") if n else None
        for robot in ("red", "blue"):
            mapper.add(Keyframe(n, n * 10**8, n, np.linalg.matrix_power(step, n), NO_POINTS, edge, robot))
    save_map(mapper, tmp_path)
    written = read_trajectory(tmp_path / "trajectory.tum")
    assert written.keys.tolist() == [0, 10**8, 2 * 10**8]
    np.testing.assert_allclose(written.poses, mapper.poses[[0, 2, 4]], atol=1e-9)
    graph.add_loop(Edge("loop", 0, 1, Registration(se3.exp([0, 0, 0, 0, 5.0, 0]), np.eye(6) * 1e-4)))
    mapper.finish()
    save_map(mapper, tmp_path)
    written = read_trajectory(tmp_path / "trajectory.tum")
    assert written.keys.tolist() == [0, 10**8, 2 * 10**8] * 2
    np.testing.assert_allclose(written.poses, mapper.poses[[0, 2, 4, 1, 3, 5]], atol=1e-9)
    np.testing.assert_allclose(written.poses[3, :3, 3], [0.0, 5.0, 0.0], atol=1e-6)


def found(T: Array, ok: bool = True) -> Registration:
    return Registration(T, np.eye(6) * 1e-4, method="test", ok=ok)


def tracked(index: int, T: Array, keyframe: Keyframe | None) -> OdometryResult:
    return OdometryResult(index * 10**8, index, T, np.zeros((6, 6)), np.zeros(6), State.TRACKING, found(T), keyframe)


def test_corrections_reach_the_frames_between_keyframes() -> None:
    recorder = TrajectoryRecorder()
    poses = se3.exp(np.arange(11)[:, None] * np.array([0, 0, 0.01, 1.0, 0, 0]))
    for i, T in enumerate(poses):
        recorder.add(tracked(i, T, Keyframe(i // 5, i, i, T, NO_POINTS) if i % 5 == 0 else None))
    shift = se3.exp([0, 0, 0, 0, 1.0, 0])
    corrected = np.array([poses[0], shift @ poses[5], shift @ poses[10]])
    out = recorder.poses(corrected)
    np.testing.assert_allclose(out[[0, 5, 10]], corrected, atol=1e-12)
    np.testing.assert_allclose(out[:6, 1, 3] - poses[:6, 1, 3], np.linspace(0, 1, 6), atol=1e-9)  # evenly, no step
    np.testing.assert_allclose(out[6:, 1, 3] - poses[6:, 1, 3], 1.0, atol=1e-9)


@pytest.mark.parametrize("unseen", ["none", BETWEEN])
def test_a_loop_after_a_break_moves_what_comes_after_it_alone(unseen: str) -> None:
    """Frames 6 and 7 follow a pause. Frame 8 gives up bridging it, and frame 10 is the next keyframe. Previously,
    frames on both sides were interpolated between the two keyframes: registered frames, whose position the loop
    determines, were off by as much as the guess across the pause. Frames 4 and 5 have no registered scan, or are parts
    of a sweep before the pause, and are still interpolated."""
    recorder = TrajectoryRecorder()
    poses = se3.exp(np.arange(12)[:, None] * np.array([0, 0, 0, 0.4, 0, 0]))
    for i, T in enumerate(poses):
        keyframe = Keyframe(i // 10, i, i, T, NO_POINTS) if i in (0, 10) else None
        how = replace(found(T, ok=i not in (4, 5, 6, 7)), method=unseen if i in (4, 5) else "test")
        recorder.add(replace(tracked(i, T, keyframe), registration=how, breaks=int(i >= 8)))
    shift = se3.exp([0, 0, 0, 0, 30.0, 0])
    out = recorder.poses(np.array([poses[0], shift @ poses[10]]))
    np.testing.assert_allclose(out[:, 1, 3], [0, 0, 0, 0, 10, 20, *[30] * 6], atol=1e-9)


def test_no_keyframe_no_correction() -> None:
    recorder = TrajectoryRecorder()
    recorder.add(tracked(0, np.eye(4), None))
    np.testing.assert_array_equal(recorder.poses(np.zeros((0, 4, 4))), np.eye(4)[None])
