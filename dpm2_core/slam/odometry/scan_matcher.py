# SPDX-License-Identifier: Apache-2.0
"""Registers one frame to the map, from all poses where it may be expected."""

from __future__ import annotations

from collections.abc import Callable
from copy import copy
from dataclasses import dataclass, replace
from functools import partial
from typing import NamedTuple

import numpy as np

from dpm2_core.estimates import Registration
from dpm2_core.frame import Array, Frame
from dpm2_core.geometry import curve, se3
from dpm2_core.geometry.deskew import measured_turn, way
from dpm2_core.geometry.motion import OPEN, predicted
from dpm2_core.slam.odometry.bridge import Bridge
from dpm2_core.slam.odometry.motion_state import MotionState
from dpm2_core.slam.odometry.settings import OdometrySettings
from dpm2_core.slam.odometry.starts import starts_from_rest, turned_starts
from dpm2_core.slam.preprocess import Scan
from dpm2_core.slam.registration.protocol import Prediction, ScanRegistration, fits_better
from dpm2_core.slam.registration.swept import JOINT, Swept

_MIN_DISTORTION = 0.02  # m at the ends of the sweep and the usual range: smaller distortions are ignored
_MIN_DISTORTION_AVERAGE = 0.1  # m, the same if only the motion between scans is known


class Match(NamedTuple):
    """A frame registered in the map.

    Attributes:
        scan: the scan of the result: the given one, or one that was prepared anew.
        result: the registration. led: whether it started from another odometry.
        swept: the motion during the sweep, if the points show it.
        contradicted: the points, with their times, show a motion that cannot follow from the previous motion.
    """

    scan: Scan
    result: Registration
    led: bool = False
    swept: Swept | None = None
    contradicted: bool = False


@dataclass(frozen=True)
class ScanMatcher:
    """Registers frames from a prediction by the motion so far, an IMU or another odometry, or from rest.

    Attributes:
        registration: the map. motion: up to the last registered frame. bridge: across a pause, during one.
    """

    settings: OdometrySettings
    registration: ScanRegistration
    motion: MotionState
    bridge: Bridge | None

    def match(self, frame: Frame, scan: Scan, T_predicted: Array, dt: float) -> Match:
        """Match a prepared frame, predicted at T_predicted (4, 4), `dt` s after the previous one."""
        if frame.problem is not None:
            unknown = self.motion.unknown(dt)
            return Match(scan, Registration(T_predicted, unknown, 0.0, np.inf, "none", False, frame.problem))
        if not len(self.registration):
            problem = self.registration.rejection(scan)
            fits = float(not problem)
            return Match(scan, Registration(T_predicted, np.zeros((6, 6)), fits, 0.0, "first", not problem, problem))
        led, fits_there = self._register_by_other(scan, dt)
        if led is not None and fits_there:
            return Match(scan, led, led=True)
        own = self._match_by_motion(frame, scan, T_predicted, dt)
        # In a tunnel a map made at rest fits most of a scan at the same pose: that does not determine the step.
        if led is not None and own.result.worst_sigma >= OPEN:
            return Match(scan, led, led=True)
        return own

    def straightened(self, frame: Frame, match: Match, twist: Array, dt: float, half: float) -> Match:
        """Prepare and register a matched frame anew with the motion that its points show during the sweep, if that
        differs from the twist (6,) it was prepared by; `half`: s from the middle of the sweep to its ends. A frame that
        did not fit may fit then."""
        motion = self.motion
        if not half or match.led or match.result.method in ("none", "first"):
            return match
        if not match.result.ok and motion.twist is None:  # its pose is unknown
            return match
        seconds, T_predicted = motion.seconds + dt, motion.predicted(twist, dt)
        turn = measured_turn(frame)
        sweep_prior = without_imu = motion.sweep_prior(match.result.T_target_source, seconds, half)
        if turn is not None and (measured := curve.fitted(turn, half)) is not None:
            sweep_prior = without_imu.turning(measured)
        swept = self.registration.swept(match.scan, match.result, sweep_prior)
        if swept is None:
            if sweep_prior is not without_imu:  # find out whether the points or the IMU contradict it
                swept = self.registration.swept(match.scan, match.result, without_imu)
            has_times = match.result.ok and len(match.scan.times) > 0
            match = match._replace(contradicted=has_times and swept is None)
            return match if turn is not None else self._straightened_by_average(frame, match, twist, seconds, half)
        if _distortion(match.scan, partial(way, motion=twist, turn=turn), swept.motion, half) > _MIN_DISTORTION:
            scan = self.registration.prepare(frame, swept.motion)
            information = np.linalg.inv(swept.covariance[:6, :6] + JOINT[:6, :6]).astype(np.float64)
            result = self.registration.register(scan, Prediction([swept.T], information=information))
            result = motion.gated(result, T_predicted, dt)
            match = match._replace(scan=scan, result=result) if result.ok else match
        return match._replace(swept=swept.placed(match.result)) if match.result.ok else match

    def again_without_imu(self, frame: Frame, dt: float, half: float) -> Match:
        """Match and straighten a frame without its IMU, after it fitted nowhere with it: after a wrong rotation the
        points of the sweep do not show the start of a rotation."""
        motion = copy(self.motion)
        motion.inertial, motion.reckoned = None, None
        motion.T = predicted(motion.T_registered, motion.ahead, motion.seconds)
        frame, twist, matcher = replace(frame, imu=None), motion.ahead, replace(self, motion=motion)
        match = matcher._match_by_motion(
            frame, self.registration.prepare(frame, twist), motion.predicted(twist, dt), dt
        )
        return matcher.straightened(frame, match, twist, dt, half)

    def _straightened_by_average(self, frame: Frame, match: Match, twist: Array, seconds: float, half: float) -> Match:
        """As `straightened`, by the average motion during the `seconds` since the last scan, if the points of the sweep
        do not show it."""
        motion, T = self.motion, match.result.T_target_source
        average = se3.way(motion.T_registered, T) / seconds
        prepared = partial(curve.poses, motion=twist)
        if not match.result.ok or _distortion(match.scan, prepared, average, half) < _MIN_DISTORTION_AVERAGE:
            return match
        scan = self.registration.prepare(frame, average)
        result = self.registration.register(scan, Prediction([T], information=motion.information(seconds)))
        return match._replace(scan=scan, result=result) if result.ok else match

    def _match_by_motion(self, frame: Frame, scan: Scan, T_predicted: Array, dt: float) -> Match:
        """Match from the prediction by the motion so far, or from rest."""
        motion = self.motion
        if motion.twist is None:
            return Match(scan, self._register_from_rest(scan, T_predicted, dt))
        seconds = motion.seconds + dt
        widen = min(seconds / dt, 5.0)
        result = self.registration.register(scan, Prediction([T_predicted], widen, motion.information(seconds)))
        result = motion.gated(result, T_predicted, dt)
        # A wrong rotation leads to a wrong pose where the scan gets stuck: only that few of its points fit shows it.
        if motion.turn is not None and not Prediction([T_predicted]).fits_well(result):
            without_imu = self._match_without_imu(frame, motion.twist, dt)
            if fits_better(without_imu.result, result):
                scan, result = without_imu.scan, without_imu.result
        if result.ok:
            return Match(scan, result)
        starts = turned_starts(T_predicted, motion.T_registered, self.settings.turns)
        turned = motion.gated(self.registration.register(scan, Prediction(starts, widen)), T_predicted, dt)
        return Match(scan, turned if turned.ok else result)

    def _match_without_imu(self, frame: Frame, twist: Array, dt: float) -> Match:
        """Match without the IMU in case it is wrong, in prediction and scan: a wrong rotation distorts a scan, too."""
        motion = self.motion
        seconds = motion.seconds + dt
        scan = self.registration.prepare(replace(frame, imu=None), twist)
        T = predicted(motion.T_registered, twist, seconds)
        result = self.registration.register(scan, Prediction([T], min(seconds / dt, 5.0)))
        return Match(scan, motion.gated(result, T, dt))

    def _register_by_other(self, scan: Scan, dt: float) -> tuple[Registration | None, bool]:
        """The result from the other odometry's prediction, if they agree, and whether the scan fits there."""
        motion = self.motion
        if motion.other is None or (step := motion.other.step) is None:
            return None, False
        T = motion.T_registered @ step.T
        information = np.linalg.inv(step.covariance).astype(np.float64)
        prediction = Prediction([T], information=information)
        result = motion.gated(self.registration.register(scan, prediction), T, dt)
        # From a wrong step the scan gets stuck near the wrong pose: only the small part of fitting points shows that.
        agrees = result.ok and motion.other.agrees(motion.T_registered, result)
        return (result if agrees else None), agrees and prediction.fits_well(result)

    def _register_from_rest(self, scan: Scan, T: Array, dt: float) -> Registration:
        """While the velocity is unknown: the best of many starts; after a pause first with the motion before it."""
        if self.bridge is not None and self.bridge.twist is not None:
            expected = self.bridge.expected(T, dt)
            result = self.registration.register(scan, expected)
            if expected.fits_well(result):
                return result
        for starts in starts_from_rest(T, self.settings.turns):
            prediction = Prediction(starts, widen=2.0)
            result = self.registration.register(scan, prediction)
            if prediction.fits_well(result):
                break
        return result


def _distortion(scan: Scan, prepared: Callable[[Array], Array], motion: Array, half: float) -> float:
    """Largest displacement, m, of the ends of a scan, `half` s from its middle, between the motion it was prepared by
    and another one, (6,) or (K, 6)."""
    times = np.array([-half, 0.0, half])
    displacements = se3.way(prepared(times), curve.poses(times, motion))[[0, 2]]
    reach = float(np.median(np.linalg.norm(scan.points[:, :3], axis=1)))
    return float((np.linalg.norm(displacements.reshape(2, 2, 3), axis=2) @ [reach, 1.0]).max())
