# SPDX-License-Identifier: Apache-2.0
"""Another odometry, such as wheel odometry, as a prior for ours: its motion, and how far that is trusted.

Only its steps count, from the last registered frame to the current one, so that its drift does no harm. A step that is
impossible after the previous motion (a jump, a restart) is not used, nor are the next ones until a frame is registered;
nor is a step that the scan contradicts. If steps are far off repeatedly, all later steps are rejected until they have
been right for a while. Where the scene leaves a direction unconstrained, as in a tunnel, nothing contradicts the other
odometry: it decides.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dpm2_core.estimates import Comparison, Registration, isotropic
from dpm2_core.frame import Array, Guess
from dpm2_core.geometry import se3
from dpm2_core.geometry.motion import predicted
from dpm2_core.slam.registration.protocol import MAP_NOISE

# Standard deviations of a step: at rest, and per m (or rad) of motion. They are so large that points outweigh them.
_REST_SIGMAS = np.array([0.5 * np.pi / 180, 0.05])
_MOTION_SHARE = 0.05
_MAX_CHI2 = 9.0  # squared sigmas from the scan, or from the previous motion; hard braking already takes one
_MIN_JUDGED = (0.5, 1.0)  # m or s: over less, any error of a slow robot is within the assumed error of a step
_NEWEST_WEIGHT = 0.1  # weight of the newest motion in the doubt
_USUAL_CHI2 = 3.0  # squared sigmas of a usual measurement; more makes the sensor doubtful,
_MAX_ERROR = 25.0  # up to this multiple of it, so that a single jump is forgiven
_MAX_DOUBT = 4.0  # largest doubt at which the sensor is used


class Doubt:
    """The recent errors of an additional sensor, relative to usual errors; 1 at the start.

    Attributes:
        value: weighted mean of the squared errors.
    """

    def __init__(self, memory: float, least: float = 0.0) -> None:
        """`memory`: weight of the newest measurement. `least`: lower limit, however accurate the sensor is."""
        self._memory, self._least, self.value = memory, least, 1.0

    def add(self, squared: float) -> None:
        """Add a measurement with this error in squared sigmas."""
        newest = min(squared / _USUAL_CHI2, _MAX_ERROR)
        self.value = max(self._least, (1 - self._memory) * self.value + self._memory * newest)

    @property
    def is_credible(self) -> bool:
        """Whether the sensor is used."""
        return self.value <= _MAX_DOUBT


@dataclass(frozen=True, eq=False)
class Step:
    """T_before_now (4, 4) since the last registered frame, and its covariance (6, 6) [rad, m] without slip."""

    T: Array
    covariance: Array


@dataclass(frozen=True, eq=False)
class _Motion:
    """Consecutive steps by both: each T (4, 4), the covariance (6, 6) of the scans' T, and the duration."""

    T_other: Array
    T_scans: Array
    scans_covariance: Array
    seconds: float

    def and_then(self, step: _Motion) -> _Motion:
        return _Motion(
            self.T_other @ step.T_other,
            self.T_scans @ step.T_scans,
            self.scans_covariance + step.scans_covariance,
            self.seconds + step.seconds,
        )

    @property
    def is_long_enough(self) -> bool:
        meters = max(se3.magnitude(T)[0] for T in (self.T_other, self.T_scans))
        return meters >= _MIN_JUDGED[0] or self.seconds >= _MIN_JUDGED[1]


class OtherMotion:
    """The steps of another odometry, checked against the scans.

    Attributes:
        step: since the last registered frame; None without one, or if it is not used.
        comparison: for this frame, if there was a step and the frame was registered.
    """

    def __init__(self, steadiness: float) -> None:
        """`steadiness`: standard deviation of the acceleration, m/s2 and rad/s2."""
        self._steadiness = steadiness
        self.step: Step | None = None
        self.comparison: Comparison | None = None
        self._raw_step: Array | None = None  # the step, possible or not
        self._uncertain = False  # only by its own covariance
        self._jumped = False  # since the last registered frame; or it repeats a pose where it cannot have stopped
        self._guess: Guess | None = None
        self._registered_guess: Guess | None = None  # that of the last registered frame
        self._previous_guess: Guess | None = None  # below: its time after `_registered_guess`, s, and motion (6,)
        self._seconds, self._twist = 0.0, np.zeros(6)
        self._compared: _Motion | None = None  # motion since the last judgement
        self._doubt = Doubt(_NEWEST_WEIGHT, least=1.0)

    def look(self, guess: Guess | None, twist: Array | None, seconds: float, prediction_covariance: Array) -> None:
        """Process the guess of a new frame, `seconds` after the last registered one.

        Args:
            twist: (6,) [rad/s, m/s] predicted for it; None if unknown.
            prediction_covariance: (6, 6) of the pose predicted by it.
        """
        self._guess, self.step, self._raw_step, self.comparison, self._uncertain = guess, None, None, None, False
        if guess is None or self._registered_guess is None:
            return
        T = self._raw_step = se3.orthonormalized(
            se3.inverse(self._registered_guess.T_other_lidar) @ guess.T_other_lidar
        )
        increase = _reported_increase(self._registered_guess, guess)
        covariance = _step_covariance(T) + increase
        unregistered, unsteady = self._previous_guess is not self._registered_guess, self._is_unsteady(guess, seconds)
        if twist is not None:
            T_predicted = predicted(np.eye(4), twist, seconds)
            impossible = se3.squared_sigmas(T_predicted, T, covariance + prediction_covariance) > _MAX_CHI2
            repeated = np.array_equal(self._registered_guess.T_other_lidar, guess.T_other_lidar)
            self._jumped = impossible or (unregistered and unsteady) or (self._jumped and (unregistered or repeated))
            if self._jumped or not self._doubt.is_credible:
                return
            self._uncertain = bool(np.trace(increase[3:, 3:]) > np.trace(prediction_covariance[3:, 3:]))
            if self._uncertain:
                return
        self.step = Step(T, covariance)

    def _is_unsteady(self, guess: Guess, seconds: float) -> bool:
        """Whether a guess, `seconds` after the last registered frame, cannot follow the previous guess by driving."""
        assert self._previous_guess is not None
        before, period = self._previous_guess, seconds - self._seconds
        T, T_steady = se3.inverse(before.T_other_lidar) @ guess.T_other_lidar, predicted(np.eye(4), self._twist, period)
        self._previous_guess, self._seconds, self._twist = guess, seconds, se3.log(T) / period
        covariance = _step_covariance(T) + _step_covariance(T_steady) + _reported_increase(before, guess)
        covariance += (self._steadiness * period**2) ** 2 * np.eye(6)
        return se3.squared_sigmas(T_steady, T, covariance) > _MAX_CHI2

    def agrees(self, T_before: Array, result: Registration) -> bool:
        """Whether a scan registered from the end of the step (the last one at T_before (4, 4)) confirms the step."""
        assert self.step is not None
        covariance = result.of_scene + self.step.covariance + MAP_NOISE
        return se3.squared_sigmas(T_before @ self.step.T, result.T_target_source, covariance) <= _MAX_CHI2

    def compare(self, T_scans: Array, of_scene: Array, seconds: float, used: bool) -> None:
        """Compare with the step (4, 4) of the scans, covariance (6, 6), since the last registered frame."""
        if self._raw_step is None:
            self._compared = None
            return
        step = _Motion(self._raw_step, T_scans, of_scene, seconds)
        motion = self._compared = step if self._compared is None else self._compared.and_then(step)
        if motion.is_long_enough:
            covariance = motion.scans_covariance + _step_covariance(motion.T_other) + MAP_NOISE
            self._doubt.add(se3.squared_sigmas(motion.T_other, motion.T_scans, covariance))
            self._compared = None
        self.comparison = Comparison(self._raw_step, T_scans, used, self._doubt.value**0.5, self._uncertain)

    def keep(self) -> None:
        """This frame was registered: the next step starts here."""
        self._registered_guess = self._previous_guess = self._guess
        self._seconds = 0.0


def _step_covariance(T: Array) -> Array:
    """Covariance (6, 6) of a step (4, 4)."""
    meters, degrees = se3.magnitude(T)
    return isotropic(*(_REST_SIGMAS + _MOTION_SHARE * np.array([np.radians(degrees), meters])))


def _reported_increase(before: Guess, now: Guess) -> Array:
    """Increase of the covariance (6, 6) that the odometry itself reports, in fixed axes; 0 if it reports none, or
    always the same."""
    if before.covariance is None or now.covariance is None:
        return np.zeros((6, 6))
    rotation = np.kron(np.eye(2), now.T_other_lidar[:3, :3].T @ before.T_other_lidar[:3, :3])
    values, axes = np.linalg.eigh(now.covariance - rotation @ before.covariance @ rotation.T)
    return np.asarray((axes * np.maximum(values, 0.0)) @ axes.T)
