# SPDX-License-Identifier: Apache-2.0
"""The folder of a map: what is tied to it, and each way by itself."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from dpm2_core.data.trajectory import read_trajectory
from dpm2_core.estimates import Edge, Keyframe, Registration
from dpm2_core.frame import NO_POINTS
from dpm2_core.geometry import se3
from dpm2_core.slam.build import make_loops
from dpm2_core.slam.graph.pose_graph import PoseGraph
from dpm2_core.slam.mapping.mapper import Mapper
from dpm2_core.slam.output import save_map
from dpm2_core.slam.settings import SlamSettings


def test_a_trajectory_has_what_is_tied_to_the_map_robot_by_robot(tmp_path: Path) -> None:
    """Keyframes of two robots come in turns; those of one whose place is not known stood between those of the other."""
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
