# SPDX-License-Identifier: Apache-2.0
"""The pose graph of the keyframes, solved with gtsam; loop edges are robust, so that one wrong loop cannot bend it."""

from __future__ import annotations

from pathlib import Path

import gtsam
import numpy as np

from dpm2_core.config import Settings
from dpm2_core.files import atomic_write
from dpm2_core.frame import Array
from dpm2_core.geometry import se3


class PoseGraphSettings(Settings):
    """Optimisation of the keyframe poses."""

    loop_kernel: float = 5.0
    """Width of the Cauchy kernel on loop edges, in standard deviations: what is many times farther off hardly pulls."""
    iterations: int = 50
    """At most so many Levenberg-Marquardt steps a solve."""


class PoseGraph:
    """Keyframe poses T_map_kf, odometry edges and loop edges; node n is the n-th one added."""

    def __init__(self, settings: PoseGraphSettings) -> None:
        self._settings = settings
        self._poses: list[Array] = []
        self._graph = gtsam.NonlinearFactorGraph()
        self.edges: list[tuple[int, int, Array, Array]] = []

    def __len__(self) -> int:
        return len(self._poses)

    @property
    def poses(self) -> Array:
        """(N, 4, 4) T_map_kf."""
        return np.array(self._poses).reshape(-1, 4, 4)

    def add_node(self, T_map_kf: Array, T_before_this: Array | None, covariance: Array | None) -> None:
        """Append a keyframe: with an edge to the one before, or as a fixed start."""
        node = len(self._poses)
        self._poses.append(T_map_kf)
        if T_before_this is None or covariance is None:
            noise = gtsam.noiseModel.Isotropic.Sigma(6, 1e-6)
            self._graph.add(gtsam.PriorFactorPose3(node, gtsam.Pose3(T_map_kf), noise))
        else:
            self._add_edge(node - 1, node, T_before_this, covariance, robust=False)

    def add_loop(self, from_node: int, to_node: int, T_from_to: Array, covariance: Array) -> None:
        """Tie two keyframes that saw the same place."""
        self._add_edge(from_node, to_node, T_from_to, covariance, robust=True)

    def optimise(self) -> None:
        """Move all poses to the least-squares optimum."""
        values = gtsam.Values()
        for node, pose in enumerate(self._poses):
            values.insert(node, gtsam.Pose3(pose))
        parameters = gtsam.LevenbergMarquardtParams()
        parameters.setMaxIterations(self._settings.iterations)
        solved = gtsam.LevenbergMarquardtOptimizer(self._graph, values, parameters).optimize()
        self._poses = [solved.atPose3(node).matrix() for node in range(len(self._poses))]

    def write_g2o(self, path: Path) -> None:
        """All vertices and edges in g2o's SE3:QUAT format at full precision."""
        with atomic_write(path) as file:
            for node, pose in enumerate(self._poses):
                file.write(f"VERTEX_SE3:QUAT {node} {_pose_text(pose)}\n")
            for a, b, T, covariance in self.edges:
                # Translation first; rotation in rad, as gtsam, Ceres and SE-Sync read it.
                order = [3, 4, 5, 0, 1, 2]
                information = np.linalg.inv(covariance)[np.ix_(order, order)]
                upper = " ".join(f"{x:.17g}" for x in information[np.triu_indices(6)])
                file.write(f"EDGE_SE3:QUAT {a} {b} {_pose_text(T)} {upper}\n")

    def _add_edge(self, a: int, b: int, T_a_b: Array, covariance: Array, robust: bool) -> None:
        noise: gtsam.noiseModel.Base = gtsam.noiseModel.Gaussian.Covariance(covariance)
        if robust:
            kernel = gtsam.noiseModel.mEstimator.Cauchy.Create(self._settings.loop_kernel)
            noise = gtsam.noiseModel.Robust.Create(kernel, noise)
        self._graph.add(gtsam.BetweenFactorPose3(a, b, gtsam.Pose3(T_a_b), noise))
        self.edges.append((a, b, T_a_b, covariance))


def _pose_text(T: Array) -> str:
    x, y, z, w = se3.quaternion(T)
    return " ".join(f"{v:.17g}" for v in (*T[:3, 3], x, y, z, w))
