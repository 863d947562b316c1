# SPDX-License-Identifier: Apache-2.0
"""The frame whose pose is published, and the LiDAR's pose in it: read from /tf_static, never assumed."""

from __future__ import annotations

import numpy as np

from dpm2_core.data.naming import frame_name
from dpm2_core.data.transforms import TransformTree
from dpm2_core.errors import UsageError
from dpm2_core.frame import Array
from dpm2_core.geometry import se3

_POSE_TOLERANCE = 1e-5  # m, and of a rotation's matrix: rounding error of the same pose


class BaseFrame:
    """The requested frame, once /tf_static connects it; without a request the root above the LiDAR, also if it changes.

    /tf_static has several publishers, which arrive in any order: a driver publishes the frames within the sensor, the
    robot the pose of the sensor. A frame with a parent in /tf_static must not have a second one on /tf.

    Attributes:
        name: the frame whose pose is published; empty before it is known.
        problem: why it is not known, or that a new pose of the LiDAR in it is not used yet, in words.
        above: the root above the requested frame. If it is another frame, the requested one has a parent in /tf_static.
        T_start_lidar: (4, 4) LiDAR in the frame with which the drive began: its first pose is the origin of odom.
        T_base_start: (4, 4) that frame in the one of `name`: identity, unless a parent arrived later.
    """

    def __init__(self, requested: str, own_frames: tuple[str, ...]) -> None:
        """`requested`: the requested frame, or empty; `own_frames`: frames that this node publishes as parents."""
        self._requested, self._own_frames = frame_name(requested), own_frames
        self._tree: TransformTree | None = None  # of the last `look`
        self.name = self.problem = ""
        self.above = self._requested
        self.T_start_lidar = self.T_base_start = np.eye(4)
        self._T_base_lidar: Array = np.eye(4)  # by the last `look`

    @property
    def child_problem(self) -> str:
        """Why the frame must not be a child on /tf, in words; empty if it may."""
        if self.above == self._requested:
            return ""
        return (
            f"{self._requested} has a parent in /tf_static, and can have only one: set ros.base_frame to {self.above}"
        )

    @property
    def optional(self) -> bool:
        """Whether the LiDAR's own frame may be used."""
        return not self._requested

    def restart(self) -> None:
        """Begin a new drive, with the present frame and the present pose of the LiDAR in it."""
        self.T_start_lidar, self.T_base_start = self._T_base_lidar, np.eye(4)
        if self.name:
            self.problem = ""

    def forget(self) -> None:
        """Begin with another LiDAR: neither its pose nor the root above it is known yet."""
        self._tree, self.name, self.T_base_start = None, "", np.eye(4)

    def look(self, tree: TransformTree, lidar_frame: str) -> bool:
        """Find the frame, or check whether it has changed; returns whether it is a new one.

        If the LiDAR has moved in it, the drive continues with the pose from before, and `problem` reports it.
        """
        if tree is self._tree:
            return False
        self._tree = tree
        if self._requested:
            self.above = tree.root(self._requested, self._own_frames)
        lidar_frame = frame_name(lidar_frame)
        name = self._requested or tree.root(lidar_frame, self._own_frames)
        try:
            self._T_base_lidar = np.eye(4) if name == lidar_frame else tree.lookup(name, lidar_frame)
        except UsageError as error:
            if not self.name:
                self.problem = f"ros.base_frame: {error}; no dpm2/odom and no /tf until /tf_static has it"
            return False
        if name == self.name:
            moved = not np.allclose(self._T_base_lidar, self.T_base_start @ self.T_start_lidar, atol=_POSE_TOLERANCE)
            self.problem = f"/tf_static has moved the LiDAR in {name}: ~/reset applies its new pose" if moved else ""
            return False
        if self.name:
            self.T_base_start = self._T_base_lidar @ se3.inverse(self.T_start_lidar)
        else:
            self.T_start_lidar = self._T_base_lidar
        self.name, self.problem = name, ""
        return True
