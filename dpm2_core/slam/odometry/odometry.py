# SPDX-License-Identifier: Apache-2.0
"""Scan by scan: predict, register, gate, update. The state says how far the result can be trusted."""

from __future__ import annotations

from copy import copy
from dataclasses import replace
from time import perf_counter

import numpy as np

from dpm2_core.data.repeated import IMAGE_PROBLEM, RepeatedCloud, RepeatedImages
from dpm2_core.data.repeated import PROBLEM as REPEATED
from dpm2_core.data.stream_clock import DOUBTED, NOMINAL, SLOWEST, StreamClock
from dpm2_core.frame import Array, Frame, OdometryResult, Registration, State
from dpm2_core.geometry import se3
from dpm2_core.geometry.motion import OPEN, along_open, combined, covariance, period_by_motion, predicted, spread
from dpm2_core.geometry.sweep import Sweep
from dpm2_core.slam.bridge import Bridge, Limits
from dpm2_core.slam.odometry.inertial import InertialMotion
from dpm2_core.slam.odometry.keyframe_selection import KeyframeSelector
from dpm2_core.slam.odometry.other import OtherMotion, Step
from dpm2_core.slam.odometry.settings import OdometrySettings
from dpm2_core.slam.odometry.starts import starts_from_rest, turned_starts
from dpm2_core.slam.preprocess import Scan
from dpm2_core.slam.registration.protocol import Prediction, ScanRegistration

_KNOWN = 0.5  # m and rad, standard deviation of the second pose, still skewed: where the points find it alone
_BENT = 0.1  # m at half of the sweep and the usual range: by so much a wrong motion must bend a scan to count
_BURST = 0.6  # of the usual period: while no motion is known, a frame that comes sooner was held back
_BETTER = 0.02  # confidence: so much more of the points must fit where the stamp does not lead
_ANY_VELOCITY = 15.0**2 * np.eye(3)  # covariance, m/s: so much until two scans are registered


class Odometry:
    """The pose of the LiDAR in the odometry frame, which is that of the first usable scan."""

    scale = ""
    """What the settings are for, where that follows the scans: see `ScaledOdometry`."""

    def __init__(self, settings: OdometrySettings, registration: ScanRegistration, keyframes: KeyframeSelector) -> None:
        self._settings = settings
        self._registration = registration
        self._keyframes = keyframes
        self.reset()

    @property
    def uses_images(self) -> bool:
        """Whether frames should come with their images."""
        return self._registration.uses_images

    def request_keyframe(self) -> None:
        """Make a keyframe of the next registered scan, however short the way."""
        self._keyframes.request()

    def reset(self) -> None:
        """Forget everything; the next scan is the first."""
        self._T = np.eye(4)
        self._twist: Array | None = None  # unknown until two scans are registered
        self._change = np.zeros(6)  # of the twist, from one registered scan to the next
        self._of_velocity = _ANY_VELOCITY
        self._covariance = np.zeros((6, 6))
        self._clock = StreamClock()
        self._sweep = Sweep()
        self._registered = np.eye(4), 0.0  # the last registered pose, and the seconds since
        self._failures = 0
        self._open = 0.0  # s, for which the scene has left a direction open
        self._repeated, self._images = RepeatedCloud(), RepeatedImages()
        self._first: Frame | None = None  # until the second one is registered
        self._first_sweep = Sweep()
        self._bridge: Bridge | None = None
        self._left = 0.0  # the time of the last pose before the pause that is being bridged
        self._breaks = 0
        self._broken = 0  # stamp of the last break, ns
        self._other: OtherMotion | None = None  # since a frame came with a guess
        self._led = False  # by another odometry to the pose of this frame
        self._inertial: InertialMotion | None = None  # since a frame came with samples of an IMU
        self._registration.clear()
        self._keyframes.reset()

    def cross_breaks(self, stamp: int) -> None:
        """A map has shown where the sensor was at that stamp (ns): the way across the breaks before it is known."""
        if self._breaks and stamp > self._broken:
            self._breaks = 0

    def take_over(self, before: Odometry, frame: Frame) -> None:
        """Go on where another one has just registered a frame: its pose and motion, and a map of that scan alone."""
        self.reset()
        self._T, self._twist, self._of_velocity = before._T, before._twist, before._of_velocity
        self._covariance, self._clock, self._registered = before._covariance, before._clock, before._registered
        self._sweep, self._open = before._sweep, before._open
        self._breaks, self._broken = before._breaks, before._broken
        self._other, self._inertial, self._repeated = before._other, before._inertial, before._repeated
        self._images = before._images
        self._keyframes.take_over(before._keyframes)
        twist = np.zeros(6) if self._twist is None else self._twist
        self._registration.update(self._registration.prepare(self._sweep.centered(frame), twist), self._T)

    def process(self, frame: Frame) -> OdometryResult:
        """Pose of one frame; never raises for what a sensor may deliver, and always gives a finite pose."""
        clock = [perf_counter()]
        given, frame = frame, self._sweep.centered(frame)
        dt = self._clock.advance(frame.stamp)
        if self._first is not None and self._sweep.is_part(self._first_sweep.span):
            self._forget_first(dt)
        twist = np.zeros(6) if self._twist is None else self._twist
        seconds = self._registered[1] + dt
        if frame.imu is not None and self._inertial is None:
            self._inertial = InertialMotion(not len(self._registration) and self._bridge is None)
        if self._inertial is not None:
            frame = self._inertial.look(frame)
            twist = self._turned(twist, seconds)
        images = len(frame.images)
        frame = self._without_repetitions(frame, float(np.linalg.norm(twist[3:])) * seconds)
        if frame.guess is not None and self._other is None:
            self._other = OtherMotion()
        if self._other is not None:
            known = None if self._twist is None else twist
            self._other.look(frame.guess, known, seconds, self._of_prediction(seconds))
        scan = self._registration.prepare(frame, twist)
        clock.append(perf_counter())
        pauses = self._pauses(frame, dt) and not self._registration.rejection(scan)
        T_predicted = self._begin_stretch(dt) if pauses else self._predicted(twist, dt)
        prepared = scan
        scan, registration, dt = self._register_in_time(frame, prepared, T_predicted, dt)
        seconds = self._registered[1] + dt
        self._clock.correct(dt)
        if scan is not prepared:  # the IMU was of no use: nor is it on the way to the stamp
            frame = replace(frame, imu=None)
        if self._first is None and registration.ok and registration.method != "first" and not self._led:
            scan, registration = self._straightened(frame, scan, registration, twist, seconds)
        if self._first is not None and registration.ok:
            scan, registration = self._begin_again(self._first, frame, registration, seconds)
        clock.append(perf_counter())
        self._update(scan, registration, dt)
        if registration.ok:
            self._repeated.keep()
        if registration.method == "first" and registration.ok and frame.time_offset is not None:
            self._first, self._first_sweep = frame, copy(self._sweep)
        T = self._T
        if self._bridge is not None and registration.ok:
            registration = self._cross(self._bridge, scan, registration)
            T = registration.T_target_source
        if self._inertial is not None:
            T = self._inertial.T_level_odom @ T
        T_scan_lidar = self._sweep.to_stamp(frame, self._twist)
        T = T @ T_scan_lidar
        keyframe = self._keyframes.select(given, scan, T, registration, T_scan_lidar)
        clock.append(perf_counter())
        return OdometryResult(
            stamp=given.stamp,
            index=frame.index,
            T_odom_lidar=T,
            covariance=self._covariance + self._sweep.covariance(self._change),
            twist=np.zeros(6) if self._twist is None else self._twist,
            state=self._state(registration),
            registration=registration,
            keyframe=keyframe,
            breaks=self._breaks,
            seconds=dict(zip(("preprocess", "register", "update"), np.diff(clock).tolist(), strict=True)),
            comparison=None if self._other is None else self._other.comparison,
            imu=None if self._inertial is None else self._inertial.problem,
            camera=IMAGE_PROBLEM if len(frame.images) < images else "",
        )

    def _forget_first(self, dt: float) -> None:
        """The first scan shows a part of the scene, as drivers begin in mid-sweep: the next one is the first."""
        self._first = None
        self._registration.clear()
        self._keyframes.add_uncertainty(self._unknown(dt))
        self._keyframes.request()

    def _without_repetitions(self, frame: Frame, meters: float) -> Frame:
        """Without what the LiDAR or a camera has sent before; `meters`: the way since the last registered frame."""
        imu = self._inertial
        turn = imu.turn if imu is not None and imu.turns else None
        if self._repeated.repeats(frame, meters, turn) and frame.problem is None:
            frame = replace(frame, problem=REPEATED)
        if imu is not None and frame.problem is not None:
            imu.turns = False  # what shows no turn does not speak against it
        images = self._images.new(frame)
        return frame if len(images) == len(frame.images) else replace(frame, images=images)

    def _turned(self, twist: Array, seconds: float) -> Array:
        """A twist (6,) with the turn since the last registered frame as it was measured, where it was."""
        if self._inertial is None or self._inertial.turn is None:
            return twist
        return np.concatenate([se3.rotation_vector(self._inertial.turn) / seconds, twist[3:]])

    def _predicted(self, twist: Array, dt: float) -> Array:
        """Pose (4, 4) of a frame, `dt` s after the one before, with a measured turn from the last registered one."""
        if self._inertial is None or self._inertial.turn is None:
            return predicted(self._T, twist, dt)
        return predicted(self._registered[0], twist, self._registered[1] + dt)

    def _pauses(self, frame: Frame, dt: float) -> bool:
        """Whether so much time has passed since the last registered scan that this one alone is not accepted.

        Where scans were left out for want of time, the stream is a slow one: what a pause asks for takes more time yet.
        """
        least = SLOWEST if frame.dropped else self._settings.pause
        known = len(self._registration) > 0 and frame.problem is None
        return known and self._registered[1] + dt > self._clock.pause(least)

    def _begin_stretch(self, dt: float) -> Array:
        """After a pause: the scan begins a map of its own, at the predicted pose (4, 4), which it returns."""
        T_registered, seconds = self._registered
        if self._bridge is None:
            limits = Limits(self._settings.steadiness, self._settings.degraded_sigma)
            self._bridge = Bridge(self._registration, T_registered, self._twist, self._of_velocity, limits)
            self._left = self._clock.now - seconds - dt
        self._registration, self._twist, self._first = self._registration.fresh(), None, None
        self._of_velocity = _ANY_VELOCITY
        step = self._step_of_other()
        self._T = self._bridge.begin(self._clock.now - self._left, None if step is None else T_registered @ step.T)
        return self._T

    def _cross(self, bridge: Bridge, scan: Scan, own: Registration) -> Registration:
        """A scan of the stretch after a pause, in the map before it if that is certain; after long enough, a break."""
        result, certain = bridge.register(scan, self._T, self._twist, own)
        if certain:
            self._bridge, self._registration = None, bridge.registration
            self._failures = 0
            self._go_on(scan, result, None)
            return result
        self._covariance = bridge.covariance(self._T) + own.covariance
        if bridge.tries >= self._settings.restart_after and self._twist is not None:
            self._keyframes.add_uncertainty(self._covariance)
            self._bridge, self._failures, self._breaks = None, 0, self._breaks + 1
            self._broken = (self._clock.stamp or 0) - round(self._sweep.middle * 1e9)
            return replace(own, reason=f"broken by a pause: {result.reason}")
        self._failures += 1
        T = result.T_target_source if result.ok else self._T
        return replace(result, T_target_source=T, ok=False, reason=result.reason or "after a pause: not confirmed yet")

    def _register_in_time(
        self, frame: Frame, scan: Scan, T_predicted: Array, dt: float
    ) -> tuple[Scan, Registration, float]:
        """As `_register`, and how long the period was, s: as stamped or, where that is in doubt, as the points say."""
        usable, result, self._led = self._register(frame, scan, T_predicted, dt)
        usual = self._clock.usual or self._sweep.span
        burst = dt < _BURST * usual
        if burst and self._bridge is not None:
            self._bridge.held = True
        if self._twist is None:
            return usable, result, usual if burst else dt
        usual = usual or NOMINAL
        if DOUBTED[0] * usual <= dt <= DOUBTED[1] * usual or result.method == "none":
            return usable, result, dt
        T_usual = self._predicted(self._turned(self._twist, self._registered[1] + usual), usual)
        if dt < usual or not result.ok or result.confidence < Prediction([T_predicted]).convincing:
            other = self._register(frame, scan, T_usual, usual)
            if other[1].ok and (not result.ok or other[1].confidence > result.confidence + _BETTER):
                usable, result, self._led = other
        if result.ok:
            steadiness = self._settings.steadiness
            dt = period_by_motion(result.T_target_source, (dt, T_predicted), (usual, T_usual), steadiness)
        return usable, result, dt

    def _register(self, frame: Frame, scan: Scan, T_predicted: Array, dt: float) -> tuple[Scan, Registration, bool]:
        """The registration of a frame, the scan that it holds for (the given one, or one without the IMU), and whether
        another odometry has led to it."""
        if frame.problem is not None:
            return scan, Registration(T_predicted, self._unknown(dt), 0.0, np.inf, "none", False, frame.problem), False
        if not len(self._registration):
            rejection = self._registration.rejection(scan)
            first = Registration(
                T_predicted, np.zeros((6, 6)), float(not rejection), 0.0, "first", not rejection, rejection
            )
            return scan, first, False
        led, fits = self._register_by_other(scan, dt)
        if led is not None and fits:
            return scan, led, True
        own = self._register_alone(frame, scan, T_predicted, dt)
        # Along a tunnel most of a scan fits a map that was made at rest at rest: it says nothing of the step.
        if led is not None and own[1].worst_sigma >= OPEN:
            return scan, led, True
        return *own, False

    def _register_alone(self, frame: Frame, scan: Scan, T_predicted: Array, dt: float) -> tuple[Scan, Registration]:
        """The same by the motion so far, or from rest."""
        if self._twist is None:
            return scan, self._registered_from_rest(scan, T_predicted, dt)
        seconds = self._registered[1] + dt
        widen = min(seconds / dt, 5.0)
        result = self._registration.register(scan, Prediction([T_predicted], widen, self._information(seconds)))
        result = self._gated(result, T_predicted, dt)
        if not result.ok and self._inertial is not None and self._inertial.turn is not None:
            steady = self._register_without_imu(frame, self._twist, dt)
            scan, result = steady if steady[1].ok else (scan, result)
        if result.ok or not self._settings.turns:
            return scan, result
        starts = turned_starts(T_predicted, self._settings.turns)
        turned = self._gated(self._registration.register(scan, Prediction(starts, widen)), T_predicted, dt)
        return scan, turned if turned.ok else result

    def _register_without_imu(self, frame: Frame, twist: Array, dt: float) -> tuple[Scan, Registration]:
        """Should the IMU be wrong: from a steady motion, in prediction and scan; a wrong turn bends a scan as well."""
        seconds = self._registered[1] + dt
        scan = self._registration.prepare(replace(frame, imu=None), twist)
        T = predicted(self._registered[0], twist, seconds)
        result = self._registration.register(scan, Prediction([T], min(seconds / dt, 5.0)))
        return scan, self._gated(result, T, dt)

    def _step_of_other(self) -> Step | None:
        """What another odometry says of the way since the last registered frame."""
        return None if self._other is None else self._other.step

    def _register_by_other(self, scan: Scan, dt: float) -> tuple[Registration | None, bool]:
        """From where another odometry leads, and whether the scan fits there; None without one, or far from there."""
        T_before, step = self._registered[0], self._step_of_other()
        if self._other is None or step is None:
            return None, False
        T = T_before @ step.T
        information = np.linalg.inv(step.covariance).astype(np.float64)
        prediction = Prediction([T], information=information)
        result = self._gated(self._registration.register(scan, prediction), T, dt)
        # A wrong step holds the scan where it leads; that few of its points fit there is what tells the two apart.
        agrees = result.ok and self._other.agrees(T_before, result)
        return (result if agrees else None), agrees and result.confidence >= prediction.convincing

    def _registered_from_rest(self, scan: Scan, T: Array, dt: float) -> Registration:
        """While the velocity is unknown: the best of many starts; after a pause first as before it."""
        if self._bridge is not None and self._bridge.twist is not None:
            expected = self._bridge.expected(T, dt)
            result = self._registration.register(scan, expected)
            if result.ok and result.confidence >= expected.convincing:
                return result
        for starts in starts_from_rest(T, self._settings.turns):
            prediction = Prediction(starts, widen=2.0)
            result = self._registration.register(scan, prediction)
            if result.ok and result.confidence >= prediction.convincing:
                break
        return result

    def _gated(self, result: Registration, T_predicted: Array, dt: float) -> Registration:
        """Reject what no vehicle can do; the allowance grows while nothing has been registered."""
        time = self._registered[1] + dt
        meters, degrees = se3.magnitude(se3.inverse(T_predicted) @ result.T_target_source)
        unknown = 3 * float(np.linalg.eigvalsh(self._of_velocity)[-1]) ** 0.5 * time
        if result.ok and meters > 0.5 + unknown + self._settings.max_acceleration * time * time:
            return replace(result, ok=False, reason=f"{meters:.1f} m from the prediction")
        if result.ok and degrees > 3 + self._settings.max_turn * time:
            return replace(result, ok=False, reason=f"{degrees:.0f} deg from the prediction")
        return result

    def _straightened(
        self, frame: Frame, scan: Scan, registration: Registration, twist: Array, seconds: float
    ) -> tuple[Scan, Registration]:
        """Anew, where the motion that was found is not that by which the scan was prepared, so that it was bent."""
        if not self._sweep.span or (self._inertial is not None and self._inertial.turn is not None):
            return scan, registration
        T = registration.T_target_source
        found = se3.log(se3.inverse(self._registered[0]) @ T) / seconds
        change = np.linalg.norm((found - twist).reshape(2, 3), axis=1)
        reach = float(np.median(np.linalg.norm(scan.points, axis=1)))
        if self._sweep.span / 2 * (change[0] * reach + change[1]) < _BENT:
            return scan, registration
        again = self._registration.prepare(frame, found)
        result = self._registration.register(again, Prediction([T], information=self._information(seconds)))
        return (again, result) if result.ok else (scan, registration)

    def _begin_again(
        self, first: Frame, frame: Frame, registration: Registration, seconds: float
    ) -> tuple[Scan, Registration]:
        """The second scan has shown the velocity, `seconds` later: undo the motion in the first too; register anew."""
        self._first = None
        T_first_this = se3.inverse(self._T) @ registration.T_target_source
        twist = se3.log(T_first_this) / seconds
        self._T = self._T @ se3.exp(self._first_sweep.middle * twist)  # the first pose was handed out at its stamp
        self._registered = self._T, self._registered[1]
        self._registration.clear()
        self._registration.update(self._registration.prepare(first, twist), self._T)
        scan = self._registration.prepare(frame, twist)
        known = Prediction([self._T @ T_first_this], information=np.eye(6) / _KNOWN**2)
        return scan, self._registration.register(scan, known)

    def _update(self, scan: Scan, registration: Registration, dt: float) -> None:
        """Move on: to the registered pose, or to the predicted one with the uncertainty that it deserves."""
        T_registered, seconds = self._registered
        if not registration.ok:
            self._coast(dt)
            return
        if registration.method != "first":
            step = self._step_of_other() if self._led else None
            of_prediction = self._of_prediction(seconds + dt) if step is None else step.covariance
            of_motion = combined(registration.of_scene[3:, 3:], of_prediction[3:, 3:])
            self._of_velocity = of_motion / (seconds + dt) ** 2
            # Not from the predicted pose of the frame before, of which an error would count as motion in one period.
            T_step = se3.inverse(T_registered) @ registration.T_target_source
            twist = se3.log(T_step) / (seconds + dt)
            self._change = np.zeros(6) if self._twist is None else twist - self._twist
            self._twist = twist
            if self._other is not None:
                self._other.compare(T_step, registration.of_scene, self._led)
        if self._bridge is None:
            self._failures = 0
        self._go_on(scan, registration, None if registration.method == "first" else self._twist)
        self._open = self._open + seconds + dt if registration.worst_sigma >= OPEN else 0.0
        if registration.method != "first" and self._open:
            # What the scene leaves open ends at 1 m; the motion does not, and each pose follows from the one before.
            self._covariance[3:, 3:] += along_open(registration.of_scene[3:, 3:], self._of_velocity) * self._open**2

    def _go_on(self, scan: Scan, registration: Registration, twist: Array | None) -> None:
        """Go on from a registered pose; `twist` (6,): the motion that led there, None where none did."""
        T_before, self._T = self._registered[0], registration.T_target_source
        if self._inertial is not None and self._clock.stamp is not None:
            self._inertial.registered(T_before, self._T, self._clock.stamp, twist)
        self._registered = self._T, 0.0
        if self._other is not None:
            self._other.keep()
        self._covariance = registration.covariance.copy()
        self._registration.update(scan, self._T)

    def _coast(self, dt: float) -> None:
        """Nothing registered: follow the prediction with growing uncertainty."""
        if not len(self._registration):
            return
        self._failures += 1
        self._covariance = self._unknown(dt)
        T_registered, seconds = self._registered
        self._registered = T_registered, seconds + dt
        if (step := self._step_of_other()) is not None:
            self._T, self._covariance = T_registered @ step.T, step.covariance
        elif self._twist is not None:
            self._T = predicted(T_registered, self._turned(self._twist, seconds + dt), seconds + dt)
        if self._bridge is not None:
            self._covariance = self._covariance + self._bridge.covariance(self._T)

    def _of_prediction(self, seconds: float) -> Array:
        """Covariance (6, 6) [rad, m] of a pose that is predicted from one that was registered so long before."""
        result = spread(self._settings.steadiness * seconds * seconds, seconds, self._of_velocity)
        if self._inertial is not None and self._inertial.turn is not None:
            result[:3, :3] = self._inertial.covariance(seconds)
        return result

    def _information(self, seconds: float) -> Array:
        """Inverse (6, 6) of `_of_prediction`."""
        return np.linalg.inv(self._of_prediction(seconds)).astype(np.float64)

    def _unknown(self, dt: float) -> Array:
        """Covariance (6, 6) of what is only predicted."""
        speed = 0.0 if self._twist is None else float(np.linalg.norm(self._twist[3:]))
        return covariance(speed, self._registered[1] + dt, self._settings.steadiness, self._of_velocity)

    def _state(self, registration: Registration) -> State:
        if self._failures >= self._settings.lost_after:
            return State.LOST
        if self._twist is None and self._bridge is None:
            return State.INITIALIZING
        if not registration.ok or registration.worst_sigma > self._settings.degraded_sigma or self._breaks:
            return State.DEGRADED
        return State.TRACKING
