# SPDX-License-Identifier: Apache-2.0
"""Keyframes in, a globally consistent map out."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from dpm2_core.config import Settings
from dpm2_core.frame import Array, Keyframe, LoopClosure, Points
from dpm2_core.geometry import se3
from dpm2_core.geometry.voxel import voxel_first
from dpm2_core.slam.cloud_store import CloudStore
from dpm2_core.slam.loop_closure import LoopCloser
from dpm2_core.slam.pose_graph import PoseGraph

_NO_POINTS: Points = np.zeros((0, 4), np.float32)


class MapSettings(Settings):
    """The map that is shown and saved."""

    voxel: float = 0.3
    """Spacing of its points, m."""


class Mapper:
    """Holds keyframes and pose graph; the odometry runs on untouched, `T_map_odom` carries every correction."""

    def __init__(self, settings: MapSettings, graph: PoseGraph, loops: LoopCloser) -> None:
        self._settings = settings
        self._graph = graph
        self._loops = loops
        self.keyframes: list[Keyframe] = []  # without their clouds, which are on disk
        self._clouds = CloudStore()
        self.closures: list[LoopClosure] = []
        self.T_map_odom: Array = np.eye(4)

    @property
    def poses(self) -> Array:
        """(N, 4, 4) optimised T_map_kf of all keyframes."""
        return self._graph.poses

    @property
    def edges(self) -> list[tuple[int, int, Array, Array]]:
        """Odometry edges and accepted loops: from, to, T_from_to, covariance."""
        return self._graph.edges

    def add(self, keyframe: Keyframe) -> list[LoopClosure]:
        """Take a keyframe in; returns the loops that were tried, accepted or not."""
        self._add_node(keyframe)
        self._clouds.append(keyframe.cloud)
        self.keyframes.append(replace(keyframe, cloud=_NO_POINTS))
        tried = self._loops.close(self._clouds, self.poses)
        if tried is None:
            return []
        node, found = tried
        closure = LoopClosure(self.keyframes[node].id, keyframe.id, found)
        self.closures.append(closure)
        if found.ok:
            self._graph.add_loop(node, len(self.keyframes) - 1, found.T_target_source, found.covariance)
            self._graph.optimise()
            self.T_map_odom = se3.orthonormalised(self.poses[-1] @ se3.inverse(keyframe.T_odom_kf))
        return [closure]

    def cloud(self, voxel_size: float | None = None) -> Points:
        """The map (M, 4) float32 in the map frame, one point in each voxel of that size (default: settings)."""
        voxel = voxel_size or self._settings.voxel
        cloud, poses = _NO_POINTS, self.poses
        for start in range(0, len(poses), 50):  # in parts: memory is that of the map, not of all the clouds
            part = range(start, min(start + 50, len(poses)))
            cloud = np.concatenate([cloud, *(se3.transform(poses[i], self._clouds[i]) for i in part)])
            cloud = cloud[voxel_first(cloud, voxel)]
        return cloud

    def _add_node(self, keyframe: Keyframe) -> None:
        """A node with an edge to the keyframe before, also when some between them never arrived."""
        T_map_kf = self.T_map_odom @ keyframe.T_odom_kf
        if keyframe.edge is None or not self.keyframes:
            self._graph.add_node(T_map_kf, None, None)
            return
        before = self.keyframes[-1]
        missed = max(keyframe.id - before.id, 1)
        T_before_this = se3.inverse(before.T_odom_kf) @ keyframe.T_odom_kf
        self._graph.add_node(T_map_kf, T_before_this, keyframe.edge.covariance * missed)

    def write_g2o(self, path: Path) -> None:
        """The pose graph as a g2o file."""
        self._graph.write_g2o(path)
