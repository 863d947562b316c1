# SPDX-License-Identifier: Apache-2.0
"""What a run leaves behind: the pose of every frame after all corrections, and the map as files."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dpm2_core.data.ply import write_ply
from dpm2_core.data.trajectory import write_tum
from dpm2_core.estimates import OdometryResult
from dpm2_core.files import make_folder
from dpm2_core.frame import Array
from dpm2_core.geometry import se3
from dpm2_core.slam.mapping.mapper import Mapper


class TrajectoryRecorder:
    """Remembers odometry poses and gives them back in the map frame, corrected as the keyframes around them were."""

    def __init__(self) -> None:
        self.stamps: list[int] = []
        self.index: list[int] = []
        self.breaks = 0  # of the odometry, see `OdometryResult`
        self._T_odom_lidar: list[Array] = []
        self._keyframe: list[int] = []  # position of each keyframe among the frames

    def __len__(self) -> int:
        return len(self.stamps)

    @property
    def keyframes(self) -> int:
        """How many of the frames became keyframes."""
        return len(self._keyframe)

    def add(self, tracked: OdometryResult) -> None:
        """Take in the result of the next frame."""
        if tracked.keyframe is not None:
            self._keyframe.append(len(self.stamps))
        self.breaks = tracked.breaks
        self.stamps.append(tracked.stamp)
        self.index.append(tracked.index)
        self._T_odom_lidar.append(tracked.T_odom_lidar)

    def poses(self, T_map_kf: Array) -> Array:
        """(N, 4, 4) T_map_lidar of all frames, given the (K, 4, 4) optimized poses of the keyframes."""
        return corrected(np.array(self._T_odom_lidar).reshape(-1, 4, 4), np.array(self._keyframe, np.intp), T_map_kf)


def corrected(T_odom_lidar: Array, keyframes: NDArray[np.intp], T_map_kf: Array) -> Array:
    """Odometry poses in the map frame, corrected as the keyframes around them were.

    The correction of a frame is interpolated between the keyframes before and after it: rigidly following one
    keyframe would put steps into the trajectory where a loop was closed.

    Args:
        T_odom_lidar: (N, 4, 4).
        keyframes: (K,) ascending positions of the keyframes among them.
        T_map_kf: (K, 4, 4) optimized poses of the keyframes.

    Returns:
        (N, 4, 4) T_map_lidar; the odometry itself without any keyframe.
    """
    if not len(keyframes):
        return T_odom_lidar
    corrections = T_map_kf @ se3.inverse(T_odom_lidar[keyframes])
    position = np.arange(len(T_odom_lidar))
    before = np.clip(np.searchsorted(keyframes, position, side="right") - 1, 0, len(keyframes) - 1)
    after = np.minimum(before + 1, len(keyframes) - 1)
    span = np.maximum(keyframes[after] - keyframes[before], 1)
    ratio = np.clip((position - keyframes[before]) / span, 0, 1)
    return se3.interpolated(corrections[before], corrections[after], ratio) @ T_odom_lidar


def save_map(mapper: Mapper, directory: Path) -> None:
    """Write map.ply, trajectory.tum (one pose per keyframe) and pose_graph.g2o, each whole or not at all.

    The graph has all keyframes, the others those whose place in the map is known, the trajectory one robot after the
    other.

    Raises:
        UsageError: the folder cannot be made. Dpm2Error: a file could not be written; the old one survives.
    """
    make_folder(directory)
    write_ply(directory / "map.ply", mapper.cloud())
    ways: dict[str, list[int]] = {}
    for node in np.flatnonzero(mapper.placed).tolist():
        ways.setdefault(mapper.keyframes[node].robot, []).append(node)
    nodes = [node for way in ways.values() for node in way]
    write_tum(directory / "trajectory.tum", [mapper.keyframes[node].stamp for node in nodes], mapper.poses[nodes])
    mapper.write_g2o(directory / "pose_graph.g2o")
