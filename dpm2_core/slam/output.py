# SPDX-License-Identifier: Apache-2.0
"""Results of a run: the pose of every frame after all corrections, and the map as files."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dpm2_core.data.ply import write_ply
from dpm2_core.data.trajectory import write_tum
from dpm2_core.estimates import BETWEEN, OdometryResult
from dpm2_core.files import make_folder
from dpm2_core.frame import Array
from dpm2_core.geometry import se3
from dpm2_core.slam.mapping.mapper import Mapper


class TrajectoryRecorder:
    """Stores odometry poses and returns them in the map frame, corrected like the keyframes around them."""

    def __init__(self) -> None:
        self.stamps: list[int] = []
        self.index: list[int] = []
        self.breaks = 0  # of the odometry, see `OdometryResult`
        self._T_odom_lidar: list[Array] = []
        self._keyframe_at: list[int] = []  # position of each keyframe among the frames
        self._last_registered = 0  # its position
        self._first_compared: int | None = None  # of the first frame after it that was at least compared with a map
        self._last_before_break: list[int] = []  # the last frame before each break, the end of a known trajectory
        self._first_after_break: list[int] = []  # the first frame after each break

    def __len__(self) -> int:
        return len(self.stamps)

    @property
    def keyframes(self) -> int:
        """Number of frames that became keyframes."""
        return len(self._keyframe_at)

    def add(self, tracked: OdometryResult) -> None:
        """Add the result of the next frame."""
        position, registered = len(self), tracked.registration
        if self._first_compared is None and (registered.ok or registered.method not in ("none", BETWEEN)):
            self._first_compared = position
        if tracked.breaks > self.breaks and self._first_compared is not None:
            self._last_before_break.append(self._last_registered)
            self._first_after_break.append(self._first_compared)
        if registered.ok:
            self._last_registered, self._first_compared = position, None
        if tracked.keyframe is not None:
            self._keyframe_at.append(position)
        self.breaks = tracked.breaks
        self.stamps.append(tracked.stamp)
        self.index.append(tracked.index)
        self._T_odom_lidar.append(tracked.T_odom_lidar)

    @property
    def stretches(self) -> NDArray[np.intp]:
        """(N,) number of breaks before each frame; different numbers: related by loops only, if at all."""
        return np.searchsorted(self._first_after_break, np.arange(len(self)), side="right")

    def poses(self, T_map_kf: Array) -> Array:
        """(N, 4, 4) T_map_lidar of all frames, given the (K, 4, 4) optimized poses of the keyframes."""
        T_odom_lidar = np.array(self._T_odom_lidar).reshape(-1, 4, 4)
        if not self._keyframe_at:
            return T_odom_lidar
        at, keyframe = self._known_corrections()
        corrections = T_map_kf @ se3.inverse(T_odom_lidar[self._keyframe_at])
        return corrected(T_odom_lidar, at, corrections[keyframe])

    def _known_corrections(self) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """Positions of frames, ascending, and for each the keyframe whose correction it takes.

        Across a break the odometry is a guess: a loop may move the part after it by far more than the part before. So
        the frames at both sides are corrected like the nearest keyframe on their own side, if there is one.
        """
        positions, known = np.array(self._keyframe_at, np.intp), {(at, kf) for kf, at in enumerate(self._keyframe_at)}
        for first, last in zip([None, *self._first_after_break], [*self._last_before_break, None], strict=True):
            own = np.flatnonzero((positions >= (first or 0)) & (positions <= (len(self) if last is None else last)))
            if len(own) and first is not None:
                known.add((first, int(own[0])))
            if len(own) and last is not None:
                known.add((last, int(own[-1])))
        at, keyframe = np.array(sorted(known), np.intp).T
        return at, keyframe


def corrected(T_odom_lidar: Array, at: NDArray[np.intp], corrections: Array) -> Array:
    """Odometry poses in the map frame, corrected like the frames around them.

    The correction of a frame is interpolated between the known corrections before and after it: to take one of them
    rigidly would cause steps in the trajectory where a loop was closed.

    Args:
        T_odom_lidar: (N, 4, 4).
        at: (K,) ascending positions of frames whose corrections are known, at least one.
        corrections: (K, 4, 4) T_map_odom of these frames.

    Returns:
        (N, 4, 4) T_map_lidar.
    """
    position = np.arange(len(T_odom_lidar))
    before = np.clip(np.searchsorted(at, position, side="right") - 1, 0, len(at) - 1)
    after = np.minimum(before + 1, len(at) - 1)
    span = np.maximum(at[after] - at[before], 1)
    ratio = np.clip((position - at[before]) / span, 0, 1)
    return se3.interpolated(corrections[before], corrections[after], ratio) @ T_odom_lidar


def save_map(mapper: Mapper, directory: Path) -> None:
    """Write map.ply, trajectory.tum (one pose per keyframe) and pose_graph.g2o, each whole or not at all.

    The graph has all keyframes, the other files only keyframes with a known pose in the map. The trajectory has one
    robot after the other.

    Raises:
        UsageError: the folder cannot be made. Dpm2Error: a file could not be written; the old one is kept.
    """
    make_folder(directory)
    write_ply(directory / "map.ply", mapper.cloud())
    nodes_by_robot: dict[str, list[int]] = {}
    for node in np.flatnonzero(mapper.placed).tolist():
        nodes_by_robot.setdefault(mapper.keyframes[node].robot, []).append(node)
    nodes = [node for own in nodes_by_robot.values() for node in own]
    write_tum(directory / "trajectory.tum", [mapper.keyframes[node].stamp for node in nodes], mapper.poses[nodes])
    mapper.graph.write_g2o(directory / "pose_graph.g2o")
