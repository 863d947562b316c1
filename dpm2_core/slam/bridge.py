# SPDX-License-Identifier: Apache-2.0
"""Across a pause: where the scans after it lie in the map before it, and when that is accepted.

After a pause the motion so far says little, and one scan can fit a map at many places: road to road, wall to wall. So
the scans after a pause make a map of their own, a new stretch, whose motion is known whatever happened in the pause.
Each of them is registered to the map before, too. The results are accepted when several of them, found independently
of each other, move as the stretch does, when no direction is left open, and when a vehicle can have come there.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, replace

import numpy as np

from dpm2_core.frame import Array, Registration
from dpm2_core.geometry import se3
from dpm2_core.geometry.motion import covariance, predicted, velocity_change
from dpm2_core.slam.preprocess import Scan
from dpm2_core.slam.registration.protocol import Prediction, ScanRegistration, agree

_TIES = 3
"""So many results must agree: two meet by chance."""
_MOVED = 1.0
"""They are evidence only when the robot has moved in between, m..."""
_AS_WELL = 0.9
"""...or when the scan fits the map before at least this much as well as its own stretch: one stands where one stood."""
_SPEEDS = (1.0, 0.75, 0.5, 0.25, 0.0, 1.25)
"""Fractions of the motion so far from which the pose is searched: a vehicle brakes and stops sooner than it
gains."""
_TURNS = (0.15, -0.15, 0.3, -0.3)  # rad/s: the same for the change of the yaw rate


@dataclass(frozen=True)
class Limits:
    """What a vehicle can do and a result must reach: `acceleration`, m/s2; `sigma` of its position at most, m."""

    acceleration: float
    sigma: float


@dataclass(frozen=True, eq=False)
class _Tie:
    """One scan twice: registered to the map before, and its pose T_odom_lidar (4, 4) in the new stretch."""

    before: Registration
    T_stretch: Array


class Bridge:
    """From the last pose before a pause to the stretch after it.

    Attributes:
        registration: the map before the pause.
        twist: (6,) [rad/s, m/s] the motion there; None where it was not known.
        tries: scans of the stretch that were registered to the map before.
    """

    def __init__(self, registration: ScanRegistration, T: Array, twist: Array | None, limits: Limits) -> None:
        """`T` (4, 4) is the last pose before the pause."""
        self.registration = registration
        self.twist = twist
        self.tries = 0
        self._T = T
        self._limits = limits
        self._ties: deque[_Tie] = deque(maxlen=_TIES)

    def begin(self, seconds: float) -> Array:
        """A new stretch, so long after the last pose before the pause: where it begins (4, 4)."""
        self._seconds = seconds
        self._ties.clear()
        self._T_begin = predicted(self._T, self._motion, seconds)
        return self._T_begin

    def expected(self, T: Array, dt: float) -> Prediction:
        """Of the second scan of the stretch, `dt` s after the first at T (4, 4): the motion before, less certain."""
        sigma = dt * velocity_change(self._speed, self._seconds, self._limits.acceleration)
        return Prediction([predicted(T, self._motion, dt)], 2.0, np.eye(6) / sigma**2)

    def covariance(self, T_stretch: Array) -> Array:
        """(6, 6) [rad, m] of a pose (4, 4) of the stretch relative to the last one before the pause."""
        A = se3.adjoint(se3.inverse(T_stretch) @ self._T_begin)
        of_begin = covariance(self._speed, self._seconds, self._limits.acceleration)
        return np.asarray(A @ of_begin @ A.T)

    def register(
        self, scan: Scan, T_stretch: Array, twist: Array | None, own: Registration
    ) -> tuple[Registration, bool]:
        """Where a scan of the stretch lies in the map before: `ok` says that it may, the second value that it does.

        Args:
            scan: its pose in the stretch is T_stretch (4, 4), its motion `twist` (6,), None where that is unknown, and
                `own` is how it was registered there.
        """
        self.tries += 1
        T_begin_this = se3.inverse(self._T_begin) @ T_stretch
        motions = [part * self._motion for part in _SPEEDS]
        motions += [self._motion + np.array([0, 0, turn, 0, 0, 0]) for turn in _TURNS]
        if twist is not None:  # as if the motion had changed evenly
            motions.insert(1, (self._motion + twist) / 2)
        starts = [predicted(self._T, motion, self._seconds) @ T_begin_this for motion in motions]
        result = self.registration.register(scan, Prediction(starts, widen=2.0))
        problem = self._problem(result, twist)
        if problem:
            return replace(result, ok=False, reason=problem), False
        self._ties.append(_Tie(result, T_stretch))
        return result, self._together(result.confidence >= _AS_WELL * own.confidence)

    @property
    def _motion(self) -> Array:
        return np.zeros(6) if self.twist is None else self.twist

    @property
    def _speed(self) -> float:
        return float(np.linalg.norm(self._motion[3:]))

    def _problem(self, result: Registration, twist: Array | None) -> str:
        """Why a result cannot be right."""
        if not result.ok:
            return result.reason
        if (sigma := result.worst_sigma) > self._limits.sigma:
            return f"after a pause: position uncertain by {sigma:.2f} m"
        if twist is None or self.twist is None:
            return ""
        # Between two known velocities, with a bounded acceleration, nothing is farther from their mean times the time.
        way = self._T[:3, :3].T @ (result.T_target_source[:3, 3] - self._T[:3, 3])
        turned = (se3.inverse(self._T) @ result.T_target_source)[:3, :3]
        off = float(np.linalg.norm(way - self._seconds / 2 * (self.twist[3:] + turned @ twist[3:])))
        if off > _MOVED + self._limits.acceleration * self._seconds**2 / 4:
            return f"after a pause: {off:.0f} m from where the motion before and after leads"
        return ""

    def _together(self, fits: bool) -> bool:
        """Whether the last results move as the stretch does; at a halt that says little, unless the scan `fits`."""
        last = self._ties[-1]
        moved = [se3.inverse(tie.T_stretch) @ last.T_stretch for tie in self._ties]
        if len(moved) < _TIES or not (fits or np.linalg.norm(moved[0][:3, 3]) >= _MOVED):
            return False
        return all(
            agree(replace(tie.before, T_target_source=tie.before.T_target_source @ way), last.before)
            for tie, way in zip(self._ties, moved, strict=True)
        )
