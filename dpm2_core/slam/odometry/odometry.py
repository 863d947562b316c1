# SPDX-License-Identifier: Apache-2.0
"""Odometry, scan by scan: predict, register, gate, update. The state shows how far the result can be trusted."""

from __future__ import annotations

from copy import copy
from dataclasses import dataclass, replace
from time import perf_counter

import numpy as np

from dpm2_core.data.repeated import PART_PROBLEM, REPEATED, RepeatedCloud, RepeatedImages, RepeatedPart
from dpm2_core.data.stream_clock import DOUBTED, NOMINAL, SLOWEST, StreamClock
from dpm2_core.estimates import OdometryResult, Registration, State
from dpm2_core.frame import Array, Frame
from dpm2_core.geometry import se3
from dpm2_core.geometry.motion import period_by_motion
from dpm2_core.geometry.scale import is_enclosed
from dpm2_core.geometry.sweep import Sweep
from dpm2_core.slam.odometry.bridge import Bridge
from dpm2_core.slam.odometry.keyframe_selection import KeyframeSelector, KeyframeSettings
from dpm2_core.slam.odometry.motion_state import MotionState
from dpm2_core.slam.odometry.other import OtherMotion
from dpm2_core.slam.odometry.scan_matcher import Match, ScanMatcher
from dpm2_core.slam.odometry.settings import OdometrySettings
from dpm2_core.slam.preprocess import Scan
from dpm2_core.slam.registration.protocol import Prediction, ScanRegistration, fits_better

_ENCLOSED_REASON = "all points are near: the LiDAR may be in something that moves with it, such as a lift"
_CARRIED_REASON = "broken: the LiDAR was in something that may have moved with it, such as a lift"
_SECOND_SIGMA = 0.5  # m and rad, of the second pose, still skewed; the points find the pose from within it
_MAX_FAILURES = 5  # frames without a registration, after which the state is `lost`, `degraded` before
_MAX_TRIES = 10  # frames after a pause that are registered to the map before it, before the odometry counts as broken
_BURST_RATIO = 0.6  # of the usual period: while no motion is known, a frame that arrives sooner was delayed


@dataclass(frozen=True, eq=False)
class Tools:
    """Parts of an odometry. The registration itself has no state: each odometry makes a fresh one like it."""

    settings: OdometrySettings
    registration: ScanRegistration
    keyframes: KeyframeSettings


class Odometry:
    """Estimates the pose of the LiDAR in the odometry frame: that of the first usable scan, level by its `Frame.up`."""

    def __init__(self, tools: Tools, robot: str = "") -> None:
        """`robot`: namespace of its keyframes."""
        self._keyframes = KeyframeSelector(tools.keyframes, robot)
        self._use_tools(tools)
        self.reset()

    @property
    def scale(self) -> str:
        """Scene type of the tools, if it follows the scans: see `ScaledOdometry`."""
        return ""

    @property
    def T_start(self) -> Array:
        """(4, 4) the initial pose, without the vertical measured by an IMU: level by `Frame.up`."""
        return self._motion.T_start

    @property
    def uses_images(self) -> bool:
        """Whether frames should have their images."""
        return self._registration.uses_images

    @property
    def _matcher(self) -> ScanMatcher:
        return ScanMatcher(self._settings, self._registration, self._motion, self._bridge)

    def request_keyframe(self) -> None:
        """Make a keyframe of the next registered scan, however short the distance."""
        self._keyframes.request()

    def reset(self) -> None:
        """Reset the state; the next scan is the first."""
        self._motion = MotionState(self._settings)
        self._clock, self._sweep, self._failures = StreamClock(), Sweep(), 0
        self._repeated, self._part, self._images = RepeatedCloud(), RepeatedPart(), RepeatedImages()
        self._bridge: Bridge | None = None
        self._breaks: list[tuple[int, bool]] = []  # id of the first keyframe after each; whether loops may cross it
        self._begin_map()
        self._keyframes.reset()

    def _begin_map(self) -> None:
        """Continue with an empty local map: the next scan is its first."""
        self._registration, self._motion.settings = self._tools.registration.fresh(), self._settings
        self._first_sweep = Sweep()  # of the first scan, until the second is registered; then without points
        self._first: Frame | None = None  # the same for the frame, if its points have times

    def _use_tools(self, tools: Tools) -> None:
        """Use these tools from now on; the registration and the motion follow in `_begin_map`."""
        self._tools, self._settings = tools, tools.settings
        self._keyframes.use(tools.keyframes)

    def _switch_tools(self, tools: Tools, frame: Frame) -> None:
        """Continue with other tools after a registered frame: same pose and motion, and a map of that scan only."""
        self._use_tools(tools)
        self._failures, self._bridge = 0, None
        self._begin_map()
        scan = self._registration.prepare(self._sweep.centered(frame), self._motion.known_twist)
        self._registration.update(scan, self._motion.T)

    @property
    def next_keyframe(self) -> int:
        """Id of the next keyframe."""
        return self._keyframes.next_id

    def between(self, last: OdometryResult, frame: Frame) -> OdometryResult:
        """See `MotionState.between`."""
        return self._motion.between(last, frame)

    def cross_breaks(self, found: int, since: int | None = None) -> None:
        """The motion across the breaks before keyframe `found` is known: a map has given its pose. With `since`: a loop
        to that keyframe has; then it is known across the breaks between them but lifts, as storeys look alike."""
        crossed = [id <= found and (since is None or (since < id and loops)) for id, loops in self._breaks]
        self._breaks = [one for one, known in zip(self._breaks, crossed, strict=True) if not known]

    def process(self, frame: Frame) -> OdometryResult:
        """Pose of one frame; never raises for data that a sensor may deliver, and always returns a finite pose."""
        ticks, motion = [perf_counter()], self._motion
        motion.start(frame.up)
        received = self._part.new(frame)
        is_part, frame = received is not frame, self._sweep.centered(received)
        dt = self._clock.advance(frame.stamp)
        if self._sweep.shows_part(self._first_sweep):
            self._discard_first(frame, dt)
        frame, twist = self._use_priors(frame, motion.seconds + dt)
        scan = self._registration.prepare(frame, twist)
        ticks.append(perf_counter())
        frame, match, dt = self._match(frame, scan, twist, dt)
        ticks.append(perf_counter())
        scan, registration = match.scan, match.result
        enclosed = is_enclosed(scan.points)
        if is_part:
            registration = registration.because(PART_PROBLEM)
        if enclosed:
            registration = registration.because(_ENCLOSED_REASON)
        self._update(match, dt)
        if registration.ok:
            self._sweep.judge(match.contradicted)
            self._repeated.keep(motion.T, self._part.same)
            self._first_sweep = copy(self._sweep) if registration.method == "first" else Sweep()
            self._first = frame if self._first_sweep.points and frame.time_offset is not None else None
        T = motion.T
        if self._bridge is not None and registration.ok:
            registration = self._cross_pause(self._bridge, scan, registration)
            T = registration.T_target_source
        elif registration.ok and motion.leaves_enclosure(enclosed, self._clock.now):
            registration = self._leave_enclosure(scan, registration)
        if motion.inertial is not None:
            T = motion.inertial.T_level_odom @ T
        T_scan_lidar = self._sweep.to_stamp(frame, motion.during)
        T = T @ T_scan_lidar
        keyframe = self._keyframes.select(received, scan, T, registration, T_scan_lidar)
        used, delivered = ({image.camera.name for image in one.images} for one in (frame, received))
        ticks.append(perf_counter())
        return OdometryResult(
            stamp=received.stamp,
            index=frame.index,
            T_odom_lidar=T,
            covariance=motion.covariance + self._sweep.covariance(motion.change),
            twist=motion.known_twist,
            state=self._state(registration, enclosed),
            registration=registration,
            keyframe=keyframe,
            breaks=len(self._breaks),
            seconds=dict(zip(("preprocess", "register", "update"), np.diff(ticks).tolist(), strict=True)),
            comparison=None if motion.other is None else motion.other.comparison,
            imu=None if motion.inertial is None else motion.inertial.problem,
            times=self._sweep.problem,
            repeated=frozenset(delivered - used),
        )

    def _match(self, frame: Frame, scan: Scan, twist: Array, dt: float) -> tuple[Frame, Match, float]:
        """Register a frame, prepared by a twist (6,): the frame, without an unusable IMU, its match, the period, s."""
        pauses = self._is_after_pause(frame, dt) and not self._registration.rejection(scan)
        T_predicted = self._begin_stretch(dt, frame.stepped) if pauses else self._motion.predicted(twist, dt)
        match, dt = self._register(frame, scan, T_predicted, dt)
        self._clock.correct(dt)
        if match.scan is not scan:  # the IMU was unusable: do not use it for the motion to the stamp either
            frame, self._motion.reckoned = replace(frame, imu=None), None
        motion, imu = self._motion, self._motion.inertial
        if self._first is not None and imu is not None and match.result.ok:
            T_first_this = se3.inverse(motion.T) @ match.result.T_target_source
            if imu.contradicted_by(T_first_this[:3, :3], motion.seconds + dt):
                self._first, frame = replace(self._first, imu=None), replace(frame, imu=None)
        match = self._straighten(frame, match, twist, dt)
        known = motion.twist is not None and match.result.method not in ("none", "first")
        if known and motion.turn is not None and not match.result.ok:
            without_imu = self._matcher.again_without_imu(frame, dt, self._sweep.span / 2)
            if without_imu.result.ok:
                frame, match, motion.reckoned = replace(frame, imu=None), without_imu, None
        return frame, match, dt

    def _use_priors(self, frame: Frame, seconds: float) -> tuple[Frame, Array]:
        """Process IMU and other odometry of a frame, `seconds` after the last registered one: returns the frame with
        its usable data, and the twist (6,) that predicts its pose."""
        motion = self._motion
        frame = motion.look(frame, starts=not len(self._registration) and self._bridge is None)
        twist = motion.turned(motion.ahead, seconds)
        frame = self._without_repetitions(frame, float(np.linalg.norm(twist[3:])))
        if frame.guess is not None and motion.other is None:
            motion.other = OtherMotion(self._settings.steadiness)
        if motion.other is not None:
            known = None if motion.twist is None else twist
            motion.other.look(frame.guess, known, seconds, motion.prediction_covariance(seconds))
        return frame, twist

    def _discard_first(self, frame: Frame, dt: float) -> None:
        """The first scan shows only a part of the scene, as drivers start in mid-sweep: this frame is the first."""
        self._begin_map()
        self._keyframes.add_uncertainty(self._motion.unknown(dt))
        self._keyframes.request()

    def _without_repetitions(self, frame: Frame, speed: float) -> Frame:
        """The frame without data that LiDAR or camera repeat; `speed`: m/s, by the motion so far."""
        imu = self._motion.inertial
        turn = imu.turn if imu is not None and imu.turns else None
        if self._repeated.repeats(frame, speed, turn) and frame.problem is None:
            frame = replace(frame, problem=REPEATED)
        if imu is not None and frame.problem is not None:
            imu.turns = False  # a frame without a valid scan does not contradict the rotation
        images = self._images.new(frame)
        return frame if len(images) == len(frame.images) else replace(frame, images=images)

    def _is_after_pause(self, frame: Frame, dt: float) -> bool:
        """Whether the last registered scan is so old that a single scan is not accepted.

        If scans were dropped for lack of time, the limit is higher: the work after a pause would drop even more.
        """
        min_pause = SLOWEST if frame.dropped else self._settings.pause
        known = len(self._registration) > 0 and frame.problem is None
        return known and (self._clock.went_back or self._motion.seconds + dt > self._clock.pause(min_pause))

    def _begin_stretch(self, dt: float, stepped: bool) -> Array:
        """After a pause: the scan starts its own map at the predicted pose (4, 4), which is returned; `stepped` if the
        pause may be only a step of the clock."""
        motion, imu, reckoned, step = self._motion, None, None, self._motion.step
        if self._bridge is None:
            imu, reckoned, step = motion.inertial, motion.reckoned, None if motion.other is None else motion.other.step
            self._bridge = Bridge(self._registration, motion, self._clock.now - motion.seconds - dt)
        self._bridge.went_back |= self._clock.went_back
        self._clock.went_back = False
        self._begin_map()
        T_other = None if step is None else motion.T_registered @ step.T
        motion.begin(self._bridge.begin(self._clock.now, T_other, imu, reckoned, stepped))
        return motion.T

    def _cross_pause(self, bridge: Bridge, scan: Scan, own: Registration) -> Registration:
        """Register a scan after a pause to the map before it; accept if it is confirmed; after enough tries, break."""
        motion = self._motion
        result, certain = bridge.register(scan, motion.T, motion.twist, own)
        if certain:
            self._bridge, self._registration, self._failures = None, bridge.registration, 0
            motion.register(result, self._clock.stamp, moved=False)
            self._registration.update(scan, motion.T)
            return result
        motion.covariance = bridge.covariance(motion.T) + own.covariance
        if bridge.tries >= _MAX_TRIES and motion.twist is not None:
            self._bridge, self._failures = None, 0
            self._record_break(loops=True)
            return replace(own, reason=f"broken by a pause: {result.reason}")
        self._failures += not bridge.agreed
        T = result.T_target_source if result.ok else motion.T
        return replace(result, T_target_source=T, ok=False, reason=result.reason or "after a pause: not confirmed yet")

    def _leave_enclosure(self, scan: Scan, registration: Registration) -> Registration:
        """The LiDAR leaves what enclosed it: a break, and a new map of what is seen outside."""
        self._motion.add_ride_uncertainty()
        self._record_break(loops=False)
        self._keyframes.request()
        self._begin_map()
        self._registration.update(scan, self._motion.T)
        return registration.because(_CARRIED_REASON)

    def _record_break(self, loops: bool) -> None:
        """Record a break: the motion from earlier to later keyframes is known no better than the current pose."""
        self._keyframes.add_uncertainty(self._motion.covariance)
        self._breaks.append((self.next_keyframe, loops))

    def _register(self, frame: Frame, scan: Scan, T_predicted: Array, dt: float) -> tuple[Match, float]:
        """Register a prepared frame, predicted at T_predicted (4, 4); returns its match and the period, s: as stamped,
        or if that is doubtful, as the points show."""
        motion = self._motion
        match = self._matcher.match(frame, scan, T_predicted, dt)
        usual = self._clock.usual or self._sweep.span
        if (burst := dt < _BURST_RATIO * usual) and self._bridge is not None:
            self._bridge.delayed = True
        if motion.twist is None:
            return match, usual if burst else dt
        usual, result = usual or NOMINAL, match.result
        if DOUBTED[0] * usual <= dt <= DOUBTED[1] * usual or result.method == "none":
            return match, dt
        T_usual = motion.at_constant_velocity(motion.ahead, usual)
        if dt < usual or not Prediction([T_predicted]).fits_well(result):
            other = self._matcher.match(frame, scan, T_usual, usual)
            if fits_better(other.result, result):
                match, result = other, other.result
        if result.ok:
            steadiness = self._settings.steadiness
            dt = period_by_motion(result.T_target_source, (dt, T_predicted), (usual, T_usual), steadiness)
        return match, dt

    def _straighten(self, frame: Frame, match: Match, twist: Array, dt: float) -> Match:
        """Prepare and register a scan anew if its points show another motion than the one (6,) that it was prepared by;
        `dt`: s since the previous frame. Also prepare the first scan of a map anew."""
        if self._first is None:
            return self._matcher.straightened(frame, match, twist, dt, self._sweep.span / 2)
        return self._redo_first(self._first, frame, match, self._motion.seconds + dt) if match.result.ok else match

    def _redo_first(self, first: Frame, frame: Frame, match: Match, seconds: float) -> Match:
        """The second scan shows the velocity, `seconds` later: undo the motion in the first scan too; register anew."""
        self._first, motion = None, self._motion
        T_first_this = se3.inverse(motion.T) @ match.result.T_target_source
        twist = se3.log(T_first_this) / seconds
        # The first pose was returned for its stamp.
        motion.T = motion.T_registered = motion.T @ se3.exp(self._first_sweep.middle * twist)
        self._registration = self._registration.fresh()
        self._registration.update(self._registration.prepare(first, twist), motion.T)
        scan = self._registration.prepare(frame, twist)
        known = Prediction([motion.T @ T_first_this], information=np.eye(6) / _SECOND_SIGMA**2)
        return match._replace(scan=scan, result=self._registration.register(scan, known))

    def _update(self, match: Match, dt: float) -> None:
        """Advance to the registered pose, or to the predicted one with the uncertainty of the prediction."""
        motion, result = self._motion, match.result
        if not result.ok:
            if len(self._registration):
                self._failures += 1
                motion.coast(dt)
                if self._bridge is not None:
                    motion.covariance = motion.covariance + self._bridge.covariance(motion.T)
            return
        if self._bridge is None:
            self._failures = 0
        motion.advance(result, dt, self._clock.stamp, match.led, match.swept)
        self._keyframes.leave_open(motion.open_covariance)
        self._registration.update(match.scan, motion.T)

    def _state(self, registration: Registration, enclosed: bool) -> State:
        if self._failures >= _MAX_FAILURES:
            return State.LOST
        if self._motion.twist is None and self._bridge is None:
            return State.INITIALIZING
        uncertain = not registration.ok or registration.worst_sigma > self._settings.degraded_sigma
        return State.DEGRADED if uncertain or enclosed or self._breaks else State.TRACKING
