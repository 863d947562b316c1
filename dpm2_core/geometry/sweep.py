# SPDX-License-Identifier: Apache-2.0
"""Conversion between the stamp of a cloud and the middle of its sweep.

Scans are registered at the LiDAR's pose in the middle of the sweep, whichever time of the sweep the driver stamps;
poses are returned for the stamp. If the points were moved to the stamp instead, each velocity error would move the scan
by half a sweep, and so change the next velocity: for clouds stamped at their start such errors never decay.
"""

from __future__ import annotations

from collections import deque
from dataclasses import replace

import numpy as np

from dpm2_core.estimates import isotropic
from dpm2_core.frame import Array, Frame
from dpm2_core.geometry import curve, se3
from dpm2_core.geometry.deskew import measured_turn

_CENTER_TOLERANCE = 0.1  # of a sweep: a stamp this close to the middle counts as the middle
_WHOLE_RATIO = 1.2  # a sweep is partial if another one is this many times as long
_MORE_POINTS = 2.0  # or, if the points have no times, has this many times as many points
# Times are wrong if _MIN_CONTRADICTED of _N_RECENT clouds contradict them; raw ones hardly ever do.
_N_RECENT, _MIN_CONTRADICTED = 50, 5
_WRONG_TIMES = (
    "the point times are not used, because the motion contradicts them; if the clouds are de-skewed already, set "
    "slam.preprocess.deskew: false"
)


class Sweep:
    """The sweep of the last cloud with times. It differs between clouds: a driver's first cloud is a partial sweep.

    Attributes:
        middle: s after the stamp. span: s from the first to the last point; 0: not known. points: their number.
        problem: why the times of the points are not used, in words; empty if they are used.
    """

    def __init__(self) -> None:
        self.middle = self.span = 0.0
        self.points, self.problem = 0, ""
        self._contradicted = deque[bool](maxlen=_N_RECENT)

    def judge(self, contradicted: bool) -> None:
        """Record whether the motion contradicts the times of the last cloud; if it does often, the times are wrong."""
        self._contradicted.append(contradicted)
        if sum(self._contradicted) >= _MIN_CONTRADICTED:
            self.problem = _WRONG_TIMES

    def look(self, frame: Frame) -> float:
        """Time from the frame's stamp to the middle of its sweep, s."""
        self.points = len(frame.points)
        if frame.time_offset is not None and len(frame.time_offset):
            start, end = frame.time_range
            middle, self.span = (start + end) / 2, end - start
            self.middle = middle if abs(middle) > _CENTER_TOLERANCE * self.span else 0.0
        return self.middle

    def centered(self, frame: Frame) -> Frame:
        """The frame, timed from the middle of its sweep; if its times are wrong, without them and at its stamp."""
        if self.problem:
            self.middle = self.span = 0.0
            frame = replace(frame, time_offset=None)
        return frame.later(self.look(frame))

    def shows_part(self, other: Sweep) -> bool:
        """Whether the `other` sweep, if it has points, was only a part of a sweep like this one."""
        is_short = self.span > _WHOLE_RATIO * other.span or self.points > _MORE_POINTS * other.points
        return other.points > 0 and is_short

    def to_stamp(self, frame: Frame, motion: Array | None) -> Array:
        """T_scan_lidar (4, 4): pose of the LiDAR at the stamp relative to its pose in the middle of the sweep.

        Args:
            frame: as returned by `centered`, with its IMU if usable. motion: (6,) twist [rad/s, m/s] or (K, 6) as for
                `curve.poses`; None if not known.
        """
        if not self.middle or motion is None:
            return np.eye(4)
        turn = measured_turn(frame)
        R = None if turn is None or motion.ndim == 2 else turn(np.array([-self.middle]))
        T = curve.beyond(-self.middle, self.span / 2, motion)
        return T if R is None else se3.make(R[0], T[:3, 3])

    def covariance(self, change: Array) -> Array:
        """(6, 6) [rad, m] of that transform if the twist changes by `change` (6,) from one scan to the next."""
        error = self.middle * change
        return isotropic(float(np.linalg.norm(error[:3])), float(np.linalg.norm(error[3:])))
