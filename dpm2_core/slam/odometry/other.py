# SPDX-License-Identifier: Apache-2.0
"""Another odometry, such as that of wheels, beside ours: what it says of the way, and how far it is believed.

Only its steps count, from the last registered frame to this one, so that its drift does no harm. A step that the motion
before makes impossible (a jump, a restart) is not used, nor are those after it until a frame is registered; nor is one
that the scan contradicts. Those that are far off again and again make all that follow doubtful, until they are right
for a while. Where the scene leaves a direction open, as in a tunnel, nothing contradicts it: it decides.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dpm2_core.estimates import Comparison, Registration, isotropic
from dpm2_core.frame import Array, Guess
from dpm2_core.geometry import se3
from dpm2_core.geometry.motion import predicted
from dpm2_core.slam.registration.protocol import MAP_NOISE

# Standard deviations of a step: of a robot that stands, and for each m (or rad) of the way. Points outweigh so much.
_STANDING = np.array([0.5 * np.pi / 180, 0.05])
_SHARE = 0.05
_POSSIBLE = 9.0  # squared sigmas from the scan, or from the motion before, of which one is hard braking already
_JUDGED = (0.5, 1.0)  # m or s: a shorter way of a slow robot is within what a step may be off, whatever is wrong
_MEMORY = 0.1  # fraction of the newest way in how far the steps are doubted
_USUAL = 3.0  # squared sigmas that a measurement may be off; more makes the sensor doubtful,
_WORST = 25.0  # up to so many times that: a single jump is forgiven
_CREDIBLE = 4.0  # doubt up to which it is used


class Doubt:
    """How far off a sensor beside the scans has been of late, relative to what is usual; 1 at the start.

    Attributes:
        value: weighted mean of the squares.
    """

    def __init__(self, memory: float, least: float = 0.0) -> None:
        """`memory`: fraction of the newest measurement in it. `least`: no less, however right the sensor is."""
        self._memory, self._least, self.value = memory, least, 1.0

    def add(self, squared: float) -> None:
        """A measurement was off by so many squared sigmas."""
        newest = min(squared / _USUAL, _WORST)
        self.value = max(self._least, (1 - self._memory) * self.value + self._memory * newest)

    @property
    def is_credible(self) -> bool:
        """Whether it is used."""
        return self.value <= _CREDIBLE


@dataclass(frozen=True, eq=False)
class Step:
    """T_before_now (4, 4) since the last registered frame, and its covariance (6, 6) [rad, m] if it does not slip."""

    T: Array
    covariance: Array


@dataclass(frozen=True, eq=False)
class _Way:
    """Some steps in a row, by both: each T (4, 4), the covariance (6, 6) of that by the scans, and how long it took."""

    T_other: Array
    T_scans: Array
    of_scans: Array
    seconds: float

    def and_then(self, step: _Way) -> _Way:
        return _Way(
            self.T_other @ step.T_other,
            self.T_scans @ step.T_scans,
            self.of_scans + step.of_scans,
            self.seconds + step.seconds,
        )

    @property
    def is_judged(self) -> bool:
        meters = max(se3.magnitude(T)[0] for T in (self.T_other, self.T_scans))
        return meters >= _JUDGED[0] or self.seconds >= _JUDGED[1]


class OtherMotion:
    """The steps of another odometry, judged by what the scans show.

    Attributes:
        step: since the last registered frame; None without one, or where it is not used.
        comparison: of this frame, if there was a step and the frame was registered.
    """

    def __init__(self, steadiness: float) -> None:
        """`steadiness`: standard deviation of the acceleration, m/s2 and rad/s2."""
        self._steadiness = steadiness
        self.step: Step | None = None
        self.comparison: Comparison | None = None
        self._raw: Array | None = None  # the step, possible or not
        self._unsure = False  # by its own covariance, and by nothing else
        self._jumped = False  # since the last registered frame; or it repeats a pose that it cannot have stopped at
        self._now: Guess | None = None
        self._last: Guess | None = None  # that of the last registered frame
        self._before: Guess | None = None  # the last one, and how long that is after `_last`, s, and its motion (6,)
        self._seconds, self._twist = 0.0, np.zeros(6)
        self._way: _Way | None = None  # since it was last judged
        self._doubt = Doubt(_MEMORY, least=1.0)

    def look(self, guess: Guess | None, twist: Array | None, seconds: float, of_prediction: Array) -> None:
        """Of a new frame, `seconds` after the last registered one.

        Args:
            twist: (6,) [rad/s, m/s] there; None if it is not known.
            of_prediction: covariance (6, 6) of the pose that follows from it.
        """
        self._now, self.step, self._raw, self.comparison, self._unsure = guess, None, None, None, False
        if guess is None or self._last is None:
            return
        T = self._raw = se3.orthonormalized(se3.inverse(self._last.T_other_lidar) @ guess.T_other_lidar)
        grown = _grown(self._last, guess)
        covariance = _spread(T) + grown
        lost, unsteady = self._before is not self._last, self._is_unsteady(guess, seconds)
        if twist is not None:
            T_predicted = predicted(np.eye(4), twist, seconds)
            impossible = se3.squared_sigmas(T_predicted, T, covariance + of_prediction) > _POSSIBLE
            same = np.array_equal(self._last.T_other_lidar, guess.T_other_lidar)
            self._jumped = impossible or (lost and unsteady) or (self._jumped and (lost or same))
            if self._jumped or not self._doubt.is_credible:
                return
            self._unsure = bool(np.trace(grown[3:, 3:]) > np.trace(of_prediction[3:, 3:]))
            if self._unsure:
                return
        self.step = Step(T, covariance)

    def _is_unsteady(self, guess: Guess, seconds: float) -> bool:
        """Whether a guess, `seconds` after the last registered frame, follows the last guess as no vehicle moves."""
        assert self._before is not None
        before, period = self._before, seconds - self._seconds
        T, T_steady = se3.inverse(before.T_other_lidar) @ guess.T_other_lidar, predicted(np.eye(4), self._twist, period)
        self._before, self._seconds, self._twist = guess, seconds, se3.log(T) / period
        covariance = _spread(T) + _spread(T_steady) + _grown(before, guess)
        covariance += (self._steadiness * period**2) ** 2 * np.eye(6)
        return se3.squared_sigmas(T_steady, T, covariance) > _POSSIBLE

    def agrees(self, T_before: Array, result: Registration) -> bool:
        """Whether a scan that was registered from the step's end (the last one at T_before (4, 4)) confirms it."""
        assert self.step is not None
        covariance = result.of_scene + self.step.covariance + MAP_NOISE
        return se3.squared_sigmas(T_before @ self.step.T, result.T_target_source, covariance) <= _POSSIBLE

    def compare(self, T_scans: Array, of_scene: Array, seconds: float, used: bool) -> None:
        """With the step (4, 4) that the scans show, to a covariance (6, 6), since the last registered frame."""
        if self._raw is None:
            self._way = None
            return
        step = _Way(self._raw, T_scans, of_scene, seconds)
        way = self._way = step if self._way is None else self._way.and_then(step)
        if way.is_judged:
            covariance = way.of_scans + _spread(way.T_other) + MAP_NOISE
            self._doubt.add(se3.squared_sigmas(way.T_other, way.T_scans, covariance))
            self._way = None
        self.comparison = Comparison(self._raw, T_scans, used, self._doubt.value**0.5, self._unsure)

    def keep(self) -> None:
        """This frame was registered: the next step begins here."""
        self._last = self._before = self._now
        self._seconds = 0.0


def _spread(T: Array) -> Array:
    """Covariance (6, 6) of a step (4, 4)."""
    meters, degrees = se3.magnitude(T)
    return isotropic(*(_STANDING + _SHARE * np.array([np.radians(degrees), meters])))


def _grown(before: Guess, now: Guess) -> Array:
    """By how much the covariance (6, 6) that the odometry itself states has grown, along fixed axes; 0 where it states
    none, or always the same."""
    if before.covariance is None or now.covariance is None:
        return np.zeros((6, 6))
    turn = np.kron(np.eye(2), now.T_other_lidar[:3, :3].T @ before.T_other_lidar[:3, :3])
    values, axes = np.linalg.eigh(now.covariance - turn @ before.covariance @ turn.T)
    return np.asarray((axes * np.maximum(values, 0.0)) @ axes.T)
