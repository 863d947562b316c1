# SPDX-License-Identifier: Apache-2.0
"""Registration across a pause: the pose of the scans after it in the map before it, and when that is accepted.

After a pause the previous motion predicts little, and one scan can fit a map at many poses: road to road, wall to wall.
So the scans after a pause make a map of their own, a new stretch; its motion is known, whatever happened in the pause.
Each of them is also registered to the map before the pause. The results are accepted when several of them, found
independently of each other, move as the stretch does, when they leave no direction unconstrained, and when a vehicle
can have reached that pose.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from dpm2_core.estimates import Registration
from dpm2_core.frame import Array
from dpm2_core.geometry import se3
from dpm2_core.geometry.motion import between, covariance, predicted, spread, velocity_change
from dpm2_core.slam.odometry.inertial import InertialMotion, Reckoned
from dpm2_core.slam.odometry.motion_state import MotionState
from dpm2_core.slam.preprocess import Scan
from dpm2_core.slam.registration.protocol import Prediction, ScanRegistration, agree

_MIN_AGREEING = 3
"""This many results must agree, and they must be a majority: two may agree by chance."""
_MIN_SEPARATION = 0.5
"""Results count as separate only if the robot has moved this far between them, m."""
_GOOD_FIT_RATIO = 0.85
"""A scan that fits the map before the pause this well, relative to its own stretch, also counts at a halt."""
_DISTANCE_MARGIN = 1.0  # m, added to the distance that a vehicle can cover
_MIN_DRIVING = 1.0  # m/s: the slowest speed that counts as driving
_SEARCH_GROWTH = 0.35  # m/s2: times seconds squared, range of the search around a constant change of the motion
_HEADING_GROWTH = 0.06  # rad/s2: the same for the heading
_FRACTIONS = (0.75, 0.5, 0.25, 0.0)  # fractions of that motion that are searched too if the robot, braking by
_MAX_BRAKING = 4.0  # m/s2, may have stood for a while
_MIN_SEARCH = 4.0  # m: the search covers at least this, to find other poses that may fit as well
_MAX_SEARCH, _MAX_YAW = 12.0, 0.6  # m and rad: limits of the search
_START_SPACING, _HEADING_SPACING = 1.0, 0.07  # m and rad between two starts: the registration converges from within
_MAX_SWAY = 0.05  # rad/s
_MAX_IMU_CHI2 = 16.0  # squared sigmas from the motion by an IMU


@dataclass(frozen=True, eq=False)
class _Crossing:
    """One scan twice: registered to the map before the pause, and its pose T_odom_lidar (4, 4) in the new stretch."""

    before: Registration
    T_stretch: Array


class Bridge:
    """The connection from the last pose before a pause to the stretch after it.

    Attributes:
        registration: the map before the pause.
        twist: (6,) [rad/s, m/s] the motion before the pause; None if it was not known.
        agreed: whether most scans of the stretch agree on its pose, and only motion is missing to confirm it.
        tries: scans that were registered to the map before the pause, without those after which `agreed` was true: a
            robot that has halted shows no motion.
        delayed: whether the scans were delayed in transport: the pause may have been as short as a period.
        went_back: time has gone back: the pause may be as short, or the stretch is another drive, from anywhere.
    """

    def __init__(self, registration: ScanRegistration, motion: MotionState, left: float) -> None:
        """`motion` has the last registered pose before the pause, at `left` s by the clock of the stream."""
        self.registration = registration
        self.twist, self._twist_before = motion.twist, motion.known_twist
        self._speed = float(np.linalg.norm(self._twist_before[3:]))
        self.tries, self.agreed = 0, False
        self.delayed = self._stepped = self.went_back = False
        self._T, self._velocity_covariance, self._left = motion.T_registered, motion.velocity_covariance, left
        self._settings = motion.settings
        self._crossings: list[_Crossing] = []

    def begin(
        self,
        now: float,
        T_other: Array | None,
        imu: InertialMotion | None,
        reckoned: Reckoned | None,
        stepped: bool,
    ) -> Array:
        """Begin a new stretch, at `now` s by the clock of the stream; returns its first pose (4, 4).

        Args:
            T_other: that pose by another odometry, if known. imu, reckoned: rotation and motion since the last pose, if
                known.
            stepped: the length of the pause is uncertain, since a clock was set meanwhile.
        """
        self._seconds = seconds = now - self._left
        self._stepped |= stepped
        self.delayed = self._stepped or self.went_back
        self._crossings.clear()
        self._twist_after: Array | None = None
        self._turning = None if imu is None else imu.turning
        self._by_imu = None if reckoned is None else replace(reckoned, T=self._T @ reckoned.T)
        self._begins = [T for T in (T_other, None if self._by_imu is None else self._by_imu.T) if T is not None]
        self._T_begin = (
            self._begins[0] if self._begins else predicted(self._T, self._twist_before, seconds, self._turning)
        )
        if T_other is None and reckoned is not None:
            self._begin_covariance = reckoned.covariance
        else:
            acceleration, velocity_covariance = self._settings.steadiness, self._velocity_covariance
            rotation_covariance = None if imu is None else imu.covariance(seconds)
            pause = np.inf if self.went_back else seconds
            self._begin_covariance = covariance(
                self._speed, pause, acceleration, velocity_covariance, of_turn=rotation_covariance
            )
        return self._T_begin

    def expected(self, T: Array, dt: float) -> Prediction:
        """Prediction for the second scan of the stretch, `dt` s after the first at T (4, 4): the motion before the
        pause, with a larger covariance."""
        sigma = dt * velocity_change(self._speed, self._seconds, self._settings.steadiness)
        information = np.linalg.inv(spread(sigma, dt, self._velocity_covariance)).astype(np.float64)
        return Prediction([predicted(T, self._twist_before, dt)], 2.0, information)

    def covariance(self, T_stretch: Array) -> Array:
        """(6, 6) [rad, m] of a pose (4, 4) of the stretch relative to the last pose before the pause."""
        A = se3.adjoint(se3.inverse(T_stretch) @ self._T_begin)
        return np.asarray(A @ self._begin_covariance @ A.T)

    def register(
        self, scan: Scan, T_stretch: Array, twist: Array | None, own: Registration
    ) -> tuple[Registration, bool]:
        """Register a scan of the stretch to the map before; `ok`: the pose is possible, second value: it is confirmed.

        Args:
            scan: its pose in the stretch is T_stretch (4, 4), its motion `twist` (6,), None if unknown, and `own` is
                its registration there.
        """
        self.tries, self.agreed = self.tries + 1, False
        if self._twist_after is None and twist is not None:
            self._twist_after = twist
            self._crossings = [c for c in self._crossings if not self._why_unreachable(self._begin_of(c))]
        T_this_begin = se3.inverse(T_stretch) @ self._T_begin
        starts = self._search_begins() @ se3.inverse(T_this_begin)
        search = Prediction(list(starts), unique=True, possible=lambda T: not self._why_unreachable(T @ T_this_begin))
        result = self.registration.register(scan, search)
        fits = result.confidence >= _GOOD_FIT_RATIO * own.confidence
        problem = self._problem(result)
        if not problem and not fits:  # a scan that fits well is at its old pose, whatever the clock shows
            problem = self._why_unreachable(result.T_target_source @ T_this_begin)
        if problem:
            return result.rejected(problem), False
        self._crossings.append(_Crossing(result, T_stretch))
        agreeing = self._agreeing_distances()
        confirmed = bool(agreeing) and (fits or _count_separate(agreeing) >= _MIN_AGREEING)
        if agreeing and not confirmed:
            self.tries, self.agreed = self.tries - 1, True
        return result, confirmed

    def _search_begins(self) -> Array:
        """Poses where the stretch may begin (P, 4, 4), the most likely first."""
        before, after = (_without_sway(twist) for twist in self._twists)
        seconds = self._seconds
        reach = min(max(_SEARCH_GROWTH * seconds**2, _MIN_SEARCH), _MAX_SEARCH)
        max_yaw = min(_HEADING_GROWTH * seconds**2, _MAX_YAW) if self._turning is None else 0.0
        ahead = _direction(before, after)
        left, up = np.array([-ahead[1], ahead[0], 0.0]), np.array([0.0, 0.0, 1.0])
        lateral = _START_SPACING * np.array([np.zeros(3), left, -left, up, -up])
        offsets = np.array(
            [x * ahead + offset for offset in lateral for x in _symmetric_steps(reach, _START_SPACING / 2)]
        )
        rates = [np.array([0, 0, yaw / seconds, 0, 0, 0]) for yaw in _symmetric_steps(max_yaw, _HEADING_SPACING)]
        ends = list(self._begins)
        ends += [between(self._T, before + rate, after + rate, seconds, self._turning) for rate in rates]
        distance = seconds * float(np.linalg.norm(before[3:] + after[3:])) / 2
        fractions = [f for f in _FRACTIONS if self.delayed or (1 - f) * distance <= _MAX_BRAKING * seconds**2 / 4]
        ends += [between(self._T, f * before, f * after, seconds, self._turning) for f in fractions]
        poses = np.repeat(ends, len(offsets), 0)
        poses[:, :3, 3] += np.concatenate([offsets @ T[:3, :3].T for T in ends])
        return poses

    @property
    def _twists(self) -> tuple[Array, Array]:
        """Twists (6,) before and after the pause; each replaces the other while that is unknown."""
        known = [twist for twist in (self.twist, self._twist_after) if twist is not None] or [self._twist_before]
        return known[0], known[-1]

    def _problem(self, result: Registration) -> str:
        """Why a result cannot be used; empty if it can."""
        if not result.ok:
            return result.reason
        if (sigma := result.worst_sigma) > self._settings.degraded_sigma:
            return f"after a pause: position uncertain by {sigma:.2f} m"
        return ""

    def _begin_of(self, crossing: _Crossing) -> Array:
        """Pose where the stretch began (4, 4), by one result."""
        return crossing.before.T_target_source @ se3.inverse(crossing.T_stretch) @ self._T_begin

    def _why_unreachable(self, T_begin: Array) -> str:
        """Why a vehicle cannot have reached T_begin (4, 4) in the pause; empty if it can."""
        if self._by_imu is not None:
            xi, position_covariance = se3.way(self._by_imu.T, T_begin)[3:], self._by_imu.covariance[3:, 3:]
            if xi @ np.linalg.solve(position_covariance, xi) > _MAX_IMU_CHI2:
                return f"after a pause: {np.linalg.norm(xi):.0f} m from the IMU's prediction"
        if self._twist_after is None or self.twist is None:
            return ""
        # With a bounded acceleration, the distance differs from the mean of two known velocities times the time by a
        # bounded amount.
        T_before_begin = se3.inverse(self._T) @ T_begin
        before, after = self.twist[3:], T_before_begin[:3, :3] @ self._twist_after[3:]
        displacement, mean = T_before_begin[:3, 3], (before + after) / 2
        seconds = self._seconds
        if self.delayed:  # use the time that fits best
            seconds = float(np.clip(displacement @ mean / (mean @ mean + 1e-9), 0.0, seconds))
        deviation = float(np.linalg.norm(displacement - seconds * mean))
        if deviation > _DISTANCE_MARGIN + self._settings.steadiness * self._seconds**2 / 4:
            return f"after a pause: {deviation:.0f} m from the prediction by the motion before and after"
        speeds, limit = np.linalg.norm([before, after], axis=1), self._settings.steadiness
        if (
            not self.delayed
            and speeds.min() > _MIN_DRIVING
            and before @ after > 0
            and speeds.sum() < limit * self._seconds
        ):
            # It did not reverse: it has moved at least the distance to stop and to reach its speed again.
            ahead = mean / np.linalg.norm(mean)
            needed, covered = float(speeds @ [before @ ahead, after @ ahead]) / (2 * limit), float(displacement @ ahead)
            if covered < needed - _DISTANCE_MARGIN:
                return f"after a pause: {covered:.0f} m further, but to stop and start again takes {needed:.0f} m"
        return ""

    def _agreeing_distances(self) -> list[float]:
        """Distances of results that move as the stretch does from the last one, m; empty unless they are a majority."""
        last = self._crossings[-1]
        motions = [se3.inverse(crossing.T_stretch) @ last.T_stretch for crossing in self._crossings]
        agreeing = [
            float(np.linalg.norm(T[:3, 3]))
            for crossing, T in zip(self._crossings, motions, strict=True)
            if agree(replace(crossing.before, T_target_source=crossing.before.T_target_source @ T), last.before)
        ]
        return agreeing if len(agreeing) >= _MIN_AGREEING and 2 * len(agreeing) > len(self._crossings) else []


def _count_separate(distances: Sequence[float]) -> int:
    """Number of distances that are far enough from one another to be evidence."""
    count, reached = 0, -np.inf
    for distance in sorted(distances):
        if distance >= reached + _MIN_SEPARATION:
            count, reached = count + 1, distance
    return count


def _direction(before: Array, after: Array) -> Array:
    """Unit vector (3,) of the robot's motion; ahead if it stands."""
    v = before[3:] + after[3:]
    speed = np.linalg.norm(v)
    return v / speed if speed > 0.1 else np.array([1.0, 0.0, 0.0])


def _without_sway(twist: Array) -> Array:
    """A twist (6,) without the sway of the body: slower rotations would not continue for seconds."""
    return twist if np.linalg.norm(twist[:3]) > _MAX_SWAY else np.concatenate([np.zeros(3), twist[3:]])


def _symmetric_steps(most: float, step: float) -> Array:
    """Multiples of a step up to `most` to both sides, the smallest first."""
    values = np.arange(np.ceil(most / step) + 1) * step
    return np.stack([values, -values], 1).ravel()[1:]
