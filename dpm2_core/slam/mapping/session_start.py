# SPDX-License-Identifier: Apache-2.0
"""Where a session in a loaded map begins, and what ties its first keyframe to the map."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from dpm2_core.estimates import Edge, Registration
from dpm2_core.frame import Array
from dpm2_core.geometry import se3


@dataclass(frozen=True, eq=False)
class SessionStart:
    """As `Mapper.start_session` is told it, which says what is what."""

    T_map_odom: Array | None
    covariance: Array
    node: int | None

    def after(self, way: Registration | None) -> SessionStart:
        """With the uncertainty of the way to the first keyframe, where it has one from a keyframe before the session:
        a break of the odometry may be in it."""
        return self if way is None else replace(self, covariance=self.covariance + way.covariance)

    def T_map_kf(self, T_odom_kf: Array, poses: Array) -> Array:
        """(4, 4) of the first keyframe; poses: (N, 4, 4) of the map."""
        if self.T_map_odom is None:
            assert self.node is not None
            return np.asarray(poses[self.node])
        return self.T_map_odom @ T_odom_kf

    def edge(self, first: int, T_map_kf: Array, poses: Array, placed: NDArray[np.bool_]) -> Edge:
        """The edge to the first keyframe of the session: a loop to the nearest one, or odometry from `node`.

        Args:
            first: its node. T_map_kf: (4, 4) its pose. poses: (N, 4, 4) of the map. placed: (N,) whose place is known.
        """
        other = self.node
        if other is None:
            known = np.flatnonzero(placed)
            other = int(known[np.linalg.norm(poses[known, :3, 3] - T_map_kf[:3, 3], axis=1).argmin()])
        tie = Registration(se3.inverse(poses[other]) @ T_map_kf, self.covariance)
        return Edge("loop" if self.node is None else "odometry", other, first, tie)
