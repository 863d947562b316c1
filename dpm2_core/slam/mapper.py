# SPDX-License-Identifier: Apache-2.0
"""Keyframes in, a globally consistent map out."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from dpm2_core.config import Settings
from dpm2_core.frame import Array, Keyframe, LoopClosure, Points
from dpm2_core.geometry import se3
from dpm2_core.geometry.voxel import voxel_first
from dpm2_core.slam.loop_closure import LoopCloser
from dpm2_core.slam.pose_graph import PoseGraph


class MapSettings(Settings):
    """The map that is shown and saved."""

    voxel: float = 0.5
    """Spacing of its points, m."""


class Mapper:
    """Holds keyframes and pose graph; the odometry runs on untouched, `T_map_odom` carries every correction."""

    def __init__(self, settings: MapSettings, graph: PoseGraph, loops: LoopCloser) -> None:
        self._settings = settings
        self._graph = graph
        self._loops = loops
        self.keyframes: list[Keyframe] = []
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
        edge = keyframe.edge
        first = edge is None or not self.keyframes
        self.keyframes.append(keyframe)
        T_map_kf = self.T_map_odom @ keyframe.T_odom_kf
        if edge is None or first:
            self._graph.add_node(T_map_kf, None, None)
        else:
            self._graph.add_node(T_map_kf, edge.T_target_source, edge.covariance)
        closure = self._loops.close(self.keyframes, self.poses)
        if closure is None:
            return []
        self.closures.append(closure)
        if closure.registration.ok:
            index = {k.id: n for n, k in enumerate(self.keyframes)}
            found = closure.registration
            self._graph.add_loop(index[closure.from_id], index[closure.to_id], found.T_target_source, found.covariance)
            self._graph.optimise()
            self.T_map_odom = se3.orthonormalised(self.poses[-1] @ se3.inverse(keyframe.T_odom_kf))
        return [closure]

    def cloud(self, voxel_size: float | None = None) -> Points:
        """The map (M, 4) float32 in the map frame, one point in each voxel of that size (default: settings)."""
        if not self.keyframes:
            return np.zeros((0, 4), np.float32)
        clouds = [se3.transform(T, k.cloud) for T, k in zip(self.poses, self.keyframes, strict=True)]
        joined = np.concatenate(clouds)
        return joined[voxel_first(joined, voxel_size or self._settings.voxel)]

    def write_g2o(self, path: Path) -> None:
        """The pose graph as a g2o file."""
        self._graph.write_g2o(path)
