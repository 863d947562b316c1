# SPDX-License-Identifier: Apache-2.0
"""Loosely coupled IMU: rotation of the LiDAR, the up direction, and the motion where no scan determines it.

The rotation between two scans and during one is measured instead of assumed to be constant. So is the change of
velocity since the last scan, as far as gravity is known; a scan that fits determines the motion. The gyroscope's bias
is the difference to the scans over a second or more: at rest, where they show no rotation at all, and in motion, with a
larger covariance. A gyroscope whose rotations differ from those of the scans, as with a wrong orientation in
/tf_static, is ignored until they agree for a while.

Forces, corrected by the changes of velocity, show the up direction. It levels the odometry frame at a start at rest,
and keeps it level: the correction is no faster than the odometry may drift. The error of the accelerations is also
estimated from the difference to the scans.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from dpm2_core.data.imu import KEPT
from dpm2_core.frame import Array, Frame, Inertial
from dpm2_core.geometry import se3
from dpm2_core.geometry.turning import turned
from dpm2_core.slam.odometry.other import Doubt, Step
from dpm2_core.slam.odometry.vertical import Vertical, metric

_MAX_SAMPLES = 25_000  # samples that are kept at most
_PARTS = 10  # parts of the time since the last registered frame

# Gyroscope, standard deviations: error of a rotation, rad, and as a fraction of it (scale, axes, time).
_ROTATION_SIGMA, _ROTATION_SHARE = np.radians(0.1), 0.02
_BIAS_SIGMA, _BIAS_DRIFT = 0.03, 1e-4  # rad/s of an unknown bias, and its change in 1 s
_BIAS_AT_REST = 0.003  # rad/s of a bias measured at rest: "rest" may be a slow rotation
_MAX_BIAS = 0.2  # rad/s
_MIN_SPAN = 1.0  # s over which scans and gyroscope are compared for the bias
_NEWEST_WEIGHT = 0.15  # weight of the newest rotation in the doubt
_UNREGISTERED_CHI2 = 30.0  # squared sigmas that count for a rotation after which the scan fits nowhere
_MIN_RATE = 0.1  # rad/s: slower rotations prove nothing

_REST_LIMITS = (0.05, 0.1, 0.3)  # noise and mean of the rates, rad/s, and noise of the forces, m/s2, at rest
_MAX_SLOPE = np.radians(60.0)  # no vehicle stands on a steeper slope
_MAX_ACCELERATION_SIGMA = 0.6  # m/s2: with a larger error of the accelerations there is no dead reckoning
_REST_TIME, _MIN_SAMPLES = 1_000_000_000, 5  # ns of samples that show rest, and their minimum number
_MAX_LEVELING = np.radians(0.02)  # rad per m or per s: maximum rotation of the frame


@dataclass(frozen=True, eq=False)
class Reckoned(Step):
    """A step by dead reckoning.

    Attributes:
        gained: (2, 3) additional distance, m, and additional final velocity, m/s, relative to constant velocity, in the
            axes at the beginning.
        sigma: standard deviation of the accelerations, m/s2.
    """

    gained: Array
    sigma: float


class InertialMotion:
    """The samples so far, and the motion and vertical that they show.

    Attributes:
        turning: R_before_t (K + 1, 3, 3) from the last registered frame to the middle of each of K equal parts of the
            time since then, and to now; None if it is not known or not credible.
        turns: whether that rotation is more than a bias could cause; no scan has confirmed it yet.
        problem: why `turning` is None, or why a start at rest is not level or may be upside down; else empty.
        T_level_odom: (4, 4), transforms poses into the level frame.
    """

    def __init__(self, starts: bool = True) -> None:
        """`starts`: the drive begins with the next frame; else the IMU's samples begin during a drive."""
        self._drive_starts = starts
        self.turning: Array | None = None
        self.problem = ""
        self.T_level_odom = np.eye(4)
        self._samples = Inertial(np.zeros(0, np.int64), np.zeros((0, 3)), np.zeros((0, 3)))
        self._bias, self._bias_variance = np.zeros(3), _BIAS_SIGMA**2  # of the bias, (rad/s)^2
        self._measured_turning: Array | None = None  # as `turning`, credible or not
        self._last_stamp: int | None = None  # stamp of the last registered frame
        self.turns = False
        self._doubt = Doubt(_NEWEST_WEIGHT)
        self._span = _Span(np.eye(3))
        self._vertical = Vertical()

    def look(self, frame: Frame) -> Frame:
        """Add a new frame's samples; returns the frame with the recent samples, without their bias, or with none."""
        if self.turns:  # the last frame was not registered
            self._doubt.add(_UNREGISTERED_CHI2)
        self.add(frame.imu)
        self.turning, self._measured_turning, self.turns = None, None, False
        if self._last_stamp is None:
            self.problem = "" if len(self._samples) else "no samples"
        else:
            self._measured_turning = self._integrate_rates(frame.stamp, self._last_stamp)
            self.problem = "" if self._measured_turning is not None else "no samples at the time of the scan"
        if not self.problem and not self._doubt.is_credible:
            self.problem = (
                "its rotations are not those of the scans, and odom may be tilted: check its orientation and unit"
            )
        if self.problem:
            return frame if frame.imu is None else replace(frame, imu=None)
        self.turning = self._measured_turning
        if self.turn is not None and self._last_stamp is not None:
            self.turns = _angle(self.turn) > _MIN_RATE * (frame.stamp - self._last_stamp) * 1e-9
        return replace(frame, imu=replace(self._samples, rates=self._samples.rates - self._bias))

    @property
    def turn(self) -> Array | None:
        """R_before_now (3, 3) since the last registered frame; None if it is not known or not credible."""
        return None if self.turning is None else self.turning[-1]

    def covariance(self, seconds: float) -> Array | None:
        """(3, 3) rad2 of `turn` over `seconds`; None if `turn` is None."""
        if self.turn is None:
            return None
        angle = _angle(self.turn)
        variance = _ROTATION_SIGMA**2 + (_ROTATION_SHARE * angle) ** 2
        return np.asarray((variance + self._bias_variance * seconds**2) * np.eye(3))

    def step(self, now: int, R: Array, velocity: Array, velocity_covariance: Array) -> Reckoned | None:
        """The motion since the last registered frame by its velocity, rotations and forces; None if it is unknown.

        Args:
            now: stamp of the new frame, ns. R: (3, 3) of the last registered frame in the odometry frame. velocity:
                (3,) m/s at that frame, in its axes, with the covariance `velocity_covariance` (3, 3).
        """
        before = self._last_stamp
        if before is None or self.turn is None or self._vertical.sigma > _MAX_ACCELERATION_SIGMA:
            return None
        times, forces = self._forces_since(before, now)
        accelerations = self._vertical.accelerations(R, forces) if len(times) else None
        seconds = (now - before) * 1e-9
        rotation_covariance = self.covariance(seconds)
        if accelerations is None or rotation_covariance is None:
            return None
        times, accelerations = np.r_[0.0, times, seconds], np.r_[accelerations[:1], accelerations, accelerations[-1:]]
        distance, speed = (_integral(a, times) for a in ((seconds - times)[:, None] * accelerations, accelerations))
        gained, sigma = np.stack([distance, speed]) @ R, self._vertical.sigma
        translation = velocity * seconds + gained[0]
        translation_covariance = velocity_covariance * seconds**2 + (0.5 * sigma * seconds**2) ** 2 * np.eye(3)
        covariance = np.zeros((6, 6))
        covariance[:3, :3] = rotation_covariance
        covariance[3:, 3:] = (
            self.turn.T @ translation_covariance @ self.turn + 0.25 * (translation @ translation) * rotation_covariance
        )
        return Reckoned(se3.make(self.turn, translation), covariance, gained, sigma)

    def registered(self, T_before: Array, T: Array, stamp: int, twist: Array | None, by_imu: bool = False) -> None:
        """Process the registration of a frame at T (4, 4), the previous one at T_before.

        Args:
            twist: (6,) [rad/s, m/s] the motion between the two; None: it is unknown, as T begins a map.
            by_imu: the velocity is in part that of `step`.
        """
        measured, before, self._last_stamp, self.turns = self._measured_turning, self._last_stamp, stamp, False
        if self._drive_starts:
            self._start_at_rest(T)
        if measured is None or before is None or twist is None:
            self._span = _Span(T[:3, :3])
            if twist is None and before is not None:
                self._vertical.break_off()
            else:
                self._vertical.pause()
            return
        seconds = (stamp - before) * 1e-9
        self._judge_rotation(measured[-1], T_before[:3, :3].T @ T[:3, :3], seconds)
        self._span.add(measured[-1], seconds)
        self._bias_variance += _BIAS_DRIFT**2 * seconds
        if self._span.seconds >= _MIN_SPAN:
            self._correct_bias(T[:3, :3])
        forces = self._forces_since(before, stamp)[1]
        if not len(forces) or not self._doubt.is_credible or by_imu:
            self._vertical.pause()
            return
        self._vertical.add(T_before[:3, :3], forces.mean(0), T[:3, :3] @ twist[3:], seconds)
        self._level_frame(T_before, T, seconds)

    def _start_at_rest(self, T: Array) -> None:
        """If a drive begins at rest, the samples before the first frame show the bias and the up direction."""
        s, self._drive_starts = self._samples, False
        s = s[s.stamps > s.stamps.max(initial=0) - _REST_TIME]
        if len(s) < _MIN_SAMPLES or not _is_at_rest(s.rates, s.forces):
            return
        self._bias, self._bias_variance = s.rates.mean(0), _BIAS_AT_REST**2
        if s.up is None:
            return
        if not self._vertical.start(T[:3, :3], s.forces.mean(0), s.up):
            self.problem = "its acceleration at rest is not gravity: odom is not level"
            return
        R = self._vertical.turn
        self.T_level_odom = se3.make(R, T[:3, 3] - R @ T[:3, 3])
        if (angle := _angle(R)) > _MAX_SLOPE:  # correct only for an upside-down LiDAR that /tf_static does not describe
            self.problem = (
                f"its acceleration at rest is {np.degrees(angle):.0f} deg away from up, and odom is tilted by that: "
                f"check its orientation and sign"
            )

    def add(self, new: Inertial | None) -> None:
        """Append samples that are later than the previous ones; start anew if time has gone back."""
        old = self._samples
        if new is None or not len(new):
            return
        later = new.stamps > old.stamps.max(initial=new.stamps[0] - 1)
        if not later.any():
            self._last_stamp, self._samples = None, new
            return
        new = new[later]
        keep = (old.stamps > new.stamps[-1] - KEPT) & (np.arange(len(old), 0, -1) < _MAX_SAMPLES)
        self._samples = old[keep].then(new)

    def _integrate_rates(self, stamp: int, before: int) -> Array | None:
        """`turning` for the frame at `stamp`, since the stamp `before`."""
        s, parts = self._samples, np.append((np.arange(_PARTS) + 0.5) / _PARTS, 1.0)
        return turned((s.stamps - before) * 1e-9, s.rates - self._bias, parts * (stamp - before) * 1e-9)

    def turning_after(self, before: int, stamp: int) -> Array | None:
        """`turning` from the stamp `before` to `stamp`, ns; None if it is not known or not credible."""
        return self._integrate_rates(stamp, before) if self._doubt.is_credible and stamp > before else None

    def contradicted_by(self, scans: Array, seconds: float) -> bool:
        """Whether scans with a rotation (3, 3) in the `seconds` since the last registered frame contradict the IMU's.

        The scans of a drive's first map are de-skewed by the IMU before any scan has confirmed it.
        """
        return self.turn is not None and self._squared_sigmas(self.turn, scans, seconds) > _UNREGISTERED_CHI2

    def _judge_rotation(self, measured: Array, scans: Array, seconds: float) -> None:
        """Compare a measured rotation (3, 3) with that of the scans."""
        if max(_angle(measured), _angle(scans)) >= _MIN_RATE * seconds:
            self._doubt.add(self._squared_sigmas(measured, scans, seconds))

    def _squared_sigmas(self, measured: Array, scans: Array, seconds: float) -> float:
        """Squared sigmas between two rotations (3, 3)."""
        variance = (3 * _ROTATION_SIGMA) ** 2 + (0.05 * _angle(measured)) ** 2 + self._bias_variance * seconds**2
        return _angle(measured.T @ scans) ** 2 / variance

    def _correct_bias(self, R: Array) -> None:
        """Correct the bias by the scans of the last second or more; the last scan has the axes R (3, 3)."""
        span, self._span = self._span, _Span(R)
        if not self._doubt.is_credible:
            return
        rate_error = se3.rotation_vector(R.T @ span.R_start @ span.R_start_now) / span.seconds
        variance = (2 * _ROTATION_SIGMA**2 + (_ROTATION_SHARE * span.angle) ** 2) / span.seconds**2
        gain = self._bias_variance / (self._bias_variance + variance)
        self._bias = np.clip(self._bias + gain * rate_error, -_MAX_BIAS, _MAX_BIAS)
        self._bias_variance *= 1 - gain

    def _forces_since(self, before: int, stamp: int) -> tuple[Array, Array]:
        """Times (N,), s since the stamp `before`, and forces (N, 3) up to `stamp` in the axes at `before`; none if
        they are not known."""
        s = self._samples
        s = s[(s.stamps > before) & (s.stamps <= stamp) & np.isfinite(s.forces).all(1)]
        times = np.asarray((s.stamps - before) * 1e-9, np.float64)
        R = turned(times, s.rates - self._bias, times) if len(s) > 1 else None
        if R is None:
            return np.zeros(0), np.zeros((0, 3))
        return times, np.einsum("nij,nj->ni", R, s.forces)

    def _level_frame(self, T_before: Array, T: Array, seconds: float) -> None:
        """Rotate the level frame by a small angle about the LiDAR's position, so that no pose jumps."""
        correction = self._vertical.turn @ self.T_level_odom[:3, :3].T
        angle = _angle(correction)
        if angle < 1e-9:
            return
        max_angle = _MAX_LEVELING * max(float(np.linalg.norm(T[:3, 3] - T_before[:3, 3])), seconds)
        step = se3.rotation_vector(correction) * min(1.0, max_angle / angle)
        position = (self.T_level_odom @ T)[:3, 3]
        R = se3.rotation(step) @ self.T_level_odom[:3, :3]
        self.T_level_odom = se3.orthonormalized(se3.make(R, position - R @ T[:3, 3]))


class _Span:
    """The gyroscope's rotation since the axes R_start (3, 3) in the odometry frame."""

    def __init__(self, R_start: Array) -> None:
        self.R_start, self.R_start_now, self.seconds, self.angle = R_start, np.eye(3), 0.0, 0.0

    def add(self, R: Array, seconds: float) -> None:
        self.R_start_now, self.seconds, self.angle = (
            self.R_start_now @ R,
            self.seconds + seconds,
            self.angle + _angle(R),
        )


def _angle(R: Array) -> float:
    return float(np.linalg.norm(se3.rotation_vector(R)))


def _is_at_rest(rates: Array, forces: Array) -> bool:
    noise, mean, shaking = _REST_LIMITS
    still = rates.std(0).max() < noise and np.abs(rates.mean(0)).max() < mean
    return bool(still and metric(forces).std(0).max() < shaking)  # False for unknown forces


def _integral(values: Array, times: Array) -> Array:
    """(3,) integral of (N, 3) values at (N,) s by trapezoids: `np.trapezoid`, which numpy has only since 2.0."""
    return np.asarray((np.diff(times)[:, None] * (values[1:] + values[:-1]) / 2.0).sum(0))
