# SPDX-License-Identifier: Apache-2.0
"""An IMU beside the scans, loosely coupled: how the LiDAR turned, which way is up, and where no scan fits the way.

The turn between two scans, and during one, is measured instead of taken to be steady, and so is the change of velocity
since the last scan, as far as gravity is known; a scan that fits decides on the way. The gyroscope's bias is what the
scans say differently over a second or more: at rest, where they show no turn at all, as well as on the way, though
there less surely. A gyroscope whose turns are not those of the scans, as with a wrong orientation in /tf_static, is
left out until they agree for a while.

Forces, averaged over a minute from which the changes of velocity are taken out, show which way is up. By that the
odometry's frame is level at a start at rest, and stays so: it follows no faster than the odometry may drift. How far
the accelerations are off is what the scans say differently, too.
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

_MOST = 25_000  # samples, at most
_PARTS = 10  # of the time since the last registered frame

# Gyroscope, standard deviations: a turn is off by so much, rad, and this fraction of it (scale, axes, time).
_TURN, _SHARE = np.radians(0.1), 0.02
_BIAS, _BIAS_DRIFT = 0.03, 1e-4  # rad/s of an unknown one, and its change in 1 s
_BIAS_AT_REST = 0.003  # rad/s of one that was measured at rest: "rest" may be a slow turn
_LARGEST_BIAS = 0.2  # rad/s
_SPAN = 1.0  # s over which scans and gyroscope are compared for the bias
_MEMORY = 0.15  # fraction of the newest turn in the doubt
_UNSEEN = 30.0  # squared sigmas: so much a turn counts at whose end the scan fits nowhere
_TURNING = 0.1  # rad/s: slower turns prove nothing

_STEADY = (0.05, 0.1, 0.3)  # noise and mean of the rates, rad/s, and noise of the forces, m/s2, of a sensor at rest
_SLOPE = np.radians(60.0)  # no vehicle stands on a steeper one
_SHAKEN = 0.6  # m/s2 that accelerations may be off, to lead anywhere
_AT_REST, _FEWEST = 1_000_000_000, 5  # ns of samples that show it, and so many at least
_FOLLOWS = np.radians(0.02)  # rad for each m or s: so fast is the frame turned


@dataclass(frozen=True, eq=False)
class Reckoned(Step):
    """A step by dead reckoning.

    Attributes:
        gained: (2, 3) by how much it is longer, m, and faster in the end, m/s, than at the velocity of the beginning,
            along the axes there.
        sigma: standard deviation of its accelerations, m/s2.
    """

    gained: Array
    sigma: float


class InertialMotion:
    """The samples so far, and what they say.

    Attributes:
        turning: R_before_t (K + 1, 3, 3) from the last registered frame to the middle of each of K even parts of the
            time since then, and to now; None where it is not known, or not believed.
        turns: whether that is more than a bias could be; no scan has confirmed it yet.
        problem: why it is None, or why a start at rest is not level or may be upside down; else empty.
        T_level_odom: (4, 4), by which poses become level.
    """

    def __init__(self, starts: bool = True) -> None:
        """`starts`: the drive begins with the next frame; else an IMU has come to one that is under way."""
        self._starts = starts
        self.turning: Array | None = None
        self.problem = ""
        self.T_level_odom = np.eye(4)
        self._samples = Inertial(np.zeros(0, np.int64), np.zeros((0, 3)), np.zeros((0, 3)))
        self._bias, self._variance = np.zeros(3), _BIAS**2  # of the bias, (rad/s)^2
        self._measured: Array | None = None  # the same, believed or not
        self._before: int | None = None  # stamp of the last registered frame
        self.turns = False
        self._doubt = Doubt(_MEMORY)
        self._span = _Span(np.eye(3))
        self._vertical = Vertical()

    def look(self, frame: Frame) -> Frame:
        """Take in a new frame's samples; returns the frame with those around its sweep, without their bias, or none."""
        if self.turns:  # the last frame was not registered
            self._doubt.add(_UNSEEN)
        self._join(frame)
        self.turning, self._measured, self.turns = None, None, False
        if self._before is None:
            self.problem = "" if len(self._samples) else "no samples"
        else:
            self._measured = self._turned(frame.stamp, self._before)
            self.problem = "" if self._measured is not None else "no samples at the time of the scan"
        if not self.problem and not self._doubt.is_credible:
            self.problem = (
                "its turns are not those of the scans, and odom may be tilted: is its orientation or unit right?"
            )
        if self.problem:
            return frame if frame.imu is None else replace(frame, imu=None)
        self.turning = self._measured
        if self.turn is not None and self._before is not None:
            self.turns = _angle(self.turn) > _TURNING * (frame.stamp - self._before) * 1e-9
        return replace(frame, imu=replace(self._samples, rates=self._samples.rates - self._bias))

    @property
    def turn(self) -> Array | None:
        """R_before_now (3, 3) since the last registered frame; None where it is not known, or not believed."""
        return None if self.turning is None else self.turning[-1]

    def covariance(self, seconds: float) -> Array | None:
        """(3, 3) rad2 of `turn` over that time; None where it is."""
        if self.turn is None:
            return None
        angle = _angle(self.turn)
        of_turn = _TURN**2 + (_SHARE * angle) ** 2
        return np.asarray((of_turn + self._variance * seconds**2) * np.eye(3))

    def step(self, now: int, R: Array, velocity: Array, of_velocity: Array) -> Reckoned | None:
        """The way since the last registered frame, from its velocity on by turns and forces; None where it is unknown.

        Args:
            now: stamp of the new frame, ns. R: (3, 3) of the last one in the odometry's frame. velocity: (3,) m/s
                there, along its axes, of the covariance `of_velocity` (3, 3).
        """
        before = self._before
        if before is None or self.turn is None or self._vertical.sigma > _SHAKEN:
            return None
        at, forces = self._forces(before, now)
        found = self._vertical.accelerations(forces @ R.T) if len(at) else None
        seconds = (now - before) * 1e-9
        of_turn = self.covariance(seconds)
        if found is None or of_turn is None:
            return None
        at, found = np.r_[0.0, at, seconds], np.r_[found[:1], found, found[-1:]]
        farther, faster = (_integral(a, at) for a in ((seconds - at)[:, None] * found, found))
        gained, sigma = np.stack([farther, faster]) @ R, self._vertical.sigma
        way = velocity * seconds + gained[0]
        along = of_velocity * seconds**2 + (0.5 * sigma * seconds**2) ** 2 * np.eye(3)
        covariance = np.zeros((6, 6))
        covariance[:3, :3] = of_turn
        covariance[3:, 3:] = self.turn.T @ along @ self.turn + 0.25 * (way @ way) * of_turn
        return Reckoned(se3.make(self.turn, way), covariance, gained, sigma)

    def registered(self, T_before: Array, T: Array, stamp: int, twist: Array | None, by_imu: bool = False) -> None:
        """A frame was registered at T (4, 4), the last one at T_before.

        Args:
            twist: (6,) [rad/s, m/s] the motion between the two; None: nothing is known of it, T begins a map.
            by_imu: its velocity is that of `step`, in part.
        """
        measured, before, self._before, self.turns = self._measured, self._before, stamp, False
        if self._starts:
            self._start_at_rest(T)
        if measured is None or before is None or twist is None:
            self._span = _Span(T[:3, :3])
            self._vertical.pause()
            return
        seconds = (stamp - before) * 1e-9
        self._judge(measured[-1], T_before[:3, :3].T @ T[:3, :3], seconds)
        self._span.add(measured[-1], seconds)
        self._variance += _BIAS_DRIFT**2 * seconds
        if self._span.seconds >= _SPAN:
            self._correct(T[:3, :3])
        forces = self._forces(before, stamp)[1]
        if not len(forces) or not self._doubt.is_credible or by_imu:
            self._vertical.pause()
            return
        self._vertical.add(T_before[:3, :3] @ forces.mean(0), T[:3, :3] @ twist[3:], seconds)
        self._level_frame(T_before, T, seconds)

    def _start_at_rest(self, T: Array) -> None:
        """Where a drive begins at rest, the samples before the first frame show the bias and which way is up."""
        s, self._starts = self._samples, False
        s = s[s.stamps > s.stamps.max(initial=0) - _AT_REST]
        if len(s) < _FEWEST or not _at_rest(s.rates, s.forces):
            return
        self._bias, self._variance = s.rates.mean(0), _BIAS_AT_REST**2
        if s.up is None:
            return
        if not self._vertical.start(T[:3, :3] @ s.forces.mean(0), T[:3, :3] @ s.up):
            self.problem = "its forces at rest are not gravity: odom is not level"
            return
        R = self._vertical.turn
        self.T_level_odom = se3.make(R, T[:3, 3] - R @ T[:3, 3])
        if (angle := _angle(R)) > _SLOPE:  # right for a LiDAR that hangs where /tf_static does not say so
            self.problem = (
                f"its forces at rest point {np.degrees(angle):.0f} deg away from up, and odom is turned by that: "
                f"is its orientation or sign right?"
            )

    def _join(self, frame: Frame) -> None:
        """The samples with those of a frame that it does not share with the one before; from anew where time has gone
        back."""
        old, new = self._samples, frame.imu
        if new is None or not len(new):
            return
        later = new.stamps > old.stamps.max(initial=new.stamps[0] - 1)
        if not later.any():
            self._before, self._samples = None, new
            return
        new = new[later]
        keep = (old.stamps > new.stamps[-1] - KEPT) & (np.arange(len(old), 0, -1) < _MOST)
        self._samples = old[keep].then(new)

    def _turned(self, stamp: int, before: int) -> Array | None:
        """As `turning`."""
        s, parts = self._samples, np.append((np.arange(_PARTS) + 0.5) / _PARTS, 1.0)
        return turned((s.stamps - before) * 1e-9, s.rates - self._bias, parts * (stamp - before) * 1e-9)

    def denied(self, scans: Array, seconds: float) -> bool:
        """Whether scans that show a turn (3, 3) in the `seconds` since the last registered frame deny the measured one.

        A drive's first map is of scans that were straightened by it before any has confirmed it.
        """
        return self.turn is not None and self._off(self.turn, scans, seconds) > _UNSEEN

    def _judge(self, measured: Array, scans: Array, seconds: float) -> None:
        """Compare two turns (3, 3)."""
        if max(_angle(measured), _angle(scans)) >= _TURNING * seconds:
            self._doubt.add(self._off(measured, scans, seconds))

    def _off(self, measured: Array, scans: Array, seconds: float) -> float:
        """Squared sigmas between two turns (3, 3)."""
        variance = (3 * _TURN) ** 2 + (0.05 * _angle(measured)) ** 2 + self._variance * seconds**2
        return _angle(measured.T @ scans) ** 2 / variance

    def _correct(self, R: Array) -> None:
        """The bias, by what the scans say of the last second or more; the last of them has the axes R (3, 3)."""
        span, self._span = self._span, _Span(R)
        if not self._doubt.is_credible:
            return
        off = se3.rotation_vector(R.T @ span.R_start @ span.R_start_now) / span.seconds
        variance = (2 * _TURN**2 + (_SHARE * span.angle) ** 2) / span.seconds**2
        gain = self._variance / (self._variance + variance)
        self._bias = np.clip(self._bias + gain * off, -_LARGEST_BIAS, _LARGEST_BIAS)
        self._variance *= 1 - gain

    def _forces(self, before: int, stamp: int) -> tuple[Array, Array]:
        """Times (N,) s since the first of two stamps, and forces (N, 3) there along the axes at the first; none where
        they are not known."""
        s = self._samples
        s = s[(s.stamps > before) & (s.stamps <= stamp) & np.isfinite(s.forces).all(1)]
        at = np.asarray((s.stamps - before) * 1e-9, np.float64)
        R = turned(at, s.rates - self._bias, at) if len(s) > 1 else None
        if R is None:
            return np.zeros(0), np.zeros((0, 3))
        return at, np.einsum("nij,nj->ni", R, s.forces)

    def _level_frame(self, T_before: Array, T: Array, seconds: float) -> None:
        """Turn the level frame a little about the LiDAR's position, so that no pose jumps."""
        wanted = self._vertical.turn @ self.T_level_odom[:3, :3].T
        angle = _angle(wanted)
        if angle < 1e-9:
            return
        most = _FOLLOWS * max(float(np.linalg.norm(T[:3, 3] - T_before[:3, 3])), seconds)
        part = se3.rotation_vector(wanted) * min(1.0, most / angle)
        here = (self.T_level_odom @ T)[:3, 3]
        R = se3.rotation(part) @ self.T_level_odom[:3, :3]
        self.T_level_odom = se3.orthonormalized(se3.make(R, here - R @ T[:3, 3]))


class _Span:
    """What the gyroscope says since axes R_start (3, 3) of the odometry's frame."""

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


def _at_rest(rates: Array, forces: Array) -> bool:
    noise, mean, shaking = _STEADY
    still = rates.std(0).max() < noise and np.abs(rates.mean(0)).max() < mean
    return bool(still and metric(forces).std(0).max() < shaking)  # False where they are unknown


def _integral(values: Array, at: Array) -> Array:
    """(3,) of (N, 3) values at (N,) s, by trapezoids: `np.trapezoid`, which numpy before 2.0 does not have."""
    return np.asarray((np.diff(at)[:, None] * (values[1:] + values[:-1]) / 2.0).sum(0))
