# SPDX-License-Identifier: Apache-2.0
"""From the stamp of a cloud to the middle of its sweep, and back.

Scans are registered where the LiDAR was in the middle of its sweep, whatever moment of it the driver stamps, and poses
are handed out at the stamp. Were the points brought to the stamp itself, each error of the velocity would move the scan
by half a sweep, and so the next velocity: of clouds stamped at their start such errors never decay.
"""

from __future__ import annotations

from collections import deque
from dataclasses import replace

import numpy as np

from dpm2_core.estimates import isotropic
from dpm2_core.frame import Array, Frame
from dpm2_core.geometry import curve, se3
from dpm2_core.geometry.deskew import measured_turn

_CENTERED = 0.1  # of a sweep: a stamp so near to its middle counts as the middle
_WHOLE = 1.2  # times as long as another one: that one is a part of a sweep
_LATELY, _OFTEN = 50, 5  # of so many clouds so many: of raw ones, however they were moved, hardly any
_WRONG = (
    "the times of the points are not used, the motion contradicts them: clouds that are de-skewed already want "
    "slam.preprocess.deskew: false"
)


class Sweep:
    """The sweep of the last cloud with times. Each has its own: what a driver sends first is a part of a sweep.

    Attributes:
        middle: s after the stamp. span: s from the first to the last point; 0: not known.
        problem: why the times of the points are not used, in words; empty where they are.
    """

    def __init__(self) -> None:
        self.middle = self.span = 0.0
        self.problem = ""
        self._contradicted = deque[bool](maxlen=_LATELY)

    def judge(self, contradicted: bool) -> None:
        """Whether the motion contradicts the times of the last cloud's points; if it does often, they are wrong."""
        self._contradicted.append(contradicted)
        if sum(self._contradicted) >= _OFTEN:
            self.problem = _WRONG

    def look(self, frame: Frame) -> float:
        """How long after the stamp of the frame the middle of its sweep is, s."""
        if frame.time_offset is not None and len(frame.time_offset):
            start, end = float(frame.time_offset.min()), float(frame.time_offset.max())
            middle, self.span = (start + end) / 2, end - start
            self.middle = middle if abs(middle) > _CENTERED * self.span else 0.0
        return self.middle

    def centered(self, frame: Frame) -> Frame:
        """The frame, timed from the middle of its sweep; without times that are wrong, as if taken at its stamp."""
        if self.problem:
            self.middle = self.span = 0.0
            frame = replace(frame, time_offset=None)
        return frame.later(self.look(frame))

    def is_part(self, span: float) -> bool:
        """Whether another sweep, of `span` s, was only a part of one as this."""
        return self.span > _WHOLE * span

    def to_stamp(self, frame: Frame, motion: Array | None) -> Array:
        """T_scan_lidar (4, 4): where the LiDAR was at the stamp, seen from where it was in the middle.

        Args:
            frame: as `centered` gives it, with its IMU if that is of use. motion: (6,) twist [rad/s, m/s] or (K, 6) as
                `curve.poses` takes it; None if not known.
        """
        if not self.middle or motion is None:
            return np.eye(4)
        turn = measured_turn(frame)
        R = None if turn is None or motion.ndim == 2 else turn(np.array([-self.middle]))
        T = curve.beyond(-self.middle, self.span / 2, motion)
        return T if R is None else se3.make(R[0], T[:3, 3])

    def covariance(self, change: Array) -> Array:
        """(6, 6) [rad, m] of that way, where the twist changes by so much (6,) from one scan to the next."""
        off = self.middle * change
        return isotropic(float(np.linalg.norm(off[:3])), float(np.linalg.norm(off[3:])))
