# SPDX-License-Identifier: Apache-2.0
"""What a run leaves behind: the pose of every frame after all corrections, and the map as files."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from dpm2_core.data.ply import write_ply
from dpm2_core.evaluation.trajectory import write_tum
from dpm2_core.frame import Array, Tracked
from dpm2_core.geometry import se3
from dpm2_core.slam.mapper import Mapper


class TrajectoryRecorder:
    """Remembers odometry poses and gives them back in the map frame, corrected as the keyframes around them were."""

    def __init__(self) -> None:
        self.stamps: list[int] = []
        self.index: list[int] = []
        self._T_odom_lidar: list[Array] = []
        self._keyframe: list[int] = []  # position of each keyframe among the frames

    def __len__(self) -> int:
        return len(self.stamps)

    def add(self, tracked: Tracked) -> None:
        """Take in the result of the next frame."""
        if tracked.keyframe is not None:
            self._keyframe.append(len(self.stamps))
        self.stamps.append(tracked.stamp)
        self.index.append(tracked.index)
        self._T_odom_lidar.append(tracked.T_odom_lidar)

    def poses(self, T_map_kf: Array) -> Array:
        """(N, 4, 4) T_map_lidar of all frames, given the (K, 4, 4) optimised poses of the keyframes.

        The correction of a frame is interpolated between the keyframes before and after it: rigidly following one
        keyframe would put steps into the trajectory where a loop was closed.
        """
        T_odom = np.array(self._T_odom_lidar).reshape(-1, 4, 4)
        if not self._keyframe:
            return T_odom
        at = np.array(self._keyframe)
        corrections = T_map_kf @ se3.inverse(T_odom[at])
        position = np.arange(len(T_odom))
        before = np.clip(np.searchsorted(at, position, side="right") - 1, 0, len(at) - 1)
        after = np.minimum(before + 1, len(at) - 1)
        span = np.maximum(at[after] - at[before], 1)
        share = np.clip((position - at[before]) / span, 0, 1)[:, None]
        between = se3.log(se3.inverse(corrections[before]) @ corrections[after])
        return corrections[before] @ se3.exp(share * between) @ T_odom


def save_map(mapper: Mapper, directory: Path) -> None:
    """Write map.ply, trajectory.tum (one pose a keyframe) and pose_graph.g2o, each whole or not at all.

    Raises:
        Dpm2Error: a file could not be written; the old one survives.
    """
    directory.mkdir(parents=True, exist_ok=True)
    write_ply(directory / "map.ply", mapper.cloud())
    write_tum(directory / "trajectory.tum", [k.stamp for k in mapper.keyframes], mapper.poses)
    mapper.write_g2o(directory / "pose_graph.g2o")
