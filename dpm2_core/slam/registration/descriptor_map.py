# SPDX-License-Identifier: Apache-2.0
"""The descriptors of the last keyframes of the odometry, merged around a pose."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np

from dpm2_core.descriptors import Descriptors, LazyDescriptors, merge
from dpm2_core.frame import Array
from dpm2_core.geometry import se3
from dpm2_core.slam.registration.spacing import Spacing

_MAX_FRAMES = 20  # frames: at least as many as can be around the next one


@dataclass(frozen=True, eq=False)
class _MapFrame:
    """Pose of a frame, T_odom_kf (4, 4), and its descriptors."""

    T_odom_kf: Array
    description: LazyDescriptors


class DescriptorMap:
    """The descriptors of the last keyframes of the odometry."""

    def __init__(self, spacing: Spacing, radius: float) -> None:
        self._spacing, self._radius = spacing, radius
        self._frames: deque[_MapFrame] = deque(maxlen=_MAX_FRAMES)
        self._merged: tuple[list[_MapFrame], Descriptors] | None = None

    def __len__(self) -> int:
        return len(self._frames)

    def wants(self, T_odom_lidar: Array) -> bool:
        """Whether a frame at that pose shows enough that is new."""
        if not self._frames:
            return True
        meters, degrees = se3.apart(self._frames[-1].T_odom_kf, T_odom_lidar)
        return meters >= self._spacing.meters or degrees >= 15

    def insert(self, description: LazyDescriptors, T_odom_lidar: Array) -> None:
        """Add the descriptors of a frame at that pose."""
        self._frames.append(_MapFrame(T_odom_lidar, description))

    def around(self, T_odom_lidar: Array, frames: int) -> tuple[Array, Descriptors] | None:
        """Pose T_odom_kf of the nearest frame, and in its frame the merged descriptors of up to `frames` frames.

        None if the frames nearby have no descriptors.
        """
        distances = [float(np.linalg.norm(frame.T_odom_kf[:3, 3] - T_odom_lidar[:3, 3])) for frame in self._frames]
        order = np.argsort(distances, kind="stable")[:frames]
        near = [self._frames[i] for i in order if distances[i] <= self._radius or i == order[0]]
        if self._merged is not None and self._merged[0] == near:  # the same object: the decoder caches its part of it
            return near[0].T_odom_kf, self._merged[1]
        found = [(frame, d) for frame in near if (d := frame.description.get()) is not None]
        if not found:
            return None
        T_kf_odom = se3.inverse(found[0][0].T_odom_kf)
        sets = [found[0][1], *(d.moved(T_kf_odom @ frame.T_odom_kf) for frame, d in found[1:])]
        merged = merge(sets)
        if len(found) == len(near):
            self._merged = near, merged
        return found[0][0].T_odom_kf, merged
