# SPDX-License-Identifier: Apache-2.0
"""The up direction, by the forces that an IMU measures and the velocities that the scans show.

A Kalman filter separates three causes of the forces that remain: gravity in the odometry frame of the start, the drift
of that frame, and the error of the accelerometer, its bias and mounting, which rotates with the robot. Without the
last, each turn by 180 degrees would tilt the frame by twice that error.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from dpm2_core.frame import Array
from dpm2_core.geometry.turning import leveled

_GRAVITY = 9.81
_GRAVITY_TOLERANCE = 1.5  # m/s2, allowed difference between gravity and a mean force without the changes of velocity
_NO_GRAVITY = 0.5  # m/s2: forces that differ by less from the changes of velocity do not contain gravity
_MIN_SPAN = 1.0  # s over which forces and velocities are compared
_INITIAL_SIGMAS = (1.0, 0.3)  # m/s2, sigma of accelerations before scans have confirmed any, and after a start at rest
_MAX_REST_SPEED = 0.3  # m/s: a robot that is faster than the forces explain was not at rest, perhaps in a bend
_MIN_ERROR = 0.06  # m/s2, minimum error of the mean over a second
_NEWEST_WEIGHT = 0.1  # weight of the newest span in the error of the accelerations

_ANY, _ACCELEROMETER_SIGMA = 1e4, 0.2  # m/s2 of an unknown gravity, and of a bias with a mounting error of a degree
_DRIFT = _GRAVITY * 5e-4  # m/s2 per root of a m or s: drives tilt by 1e-4 rad, or steadily in one direction
_ACCELEROMETER_DRIFT = 1e-3  # m/s2 per root of a s: 0.06 in an hour, by temperature
_BREAK = _GRAVITY * np.radians(3.0)  # m/s2: tilt of the odometry frame after an unknown motion
_MAX_SIGMAS = 3.0  # of an error that counts in full
_GRAVITY_PART, _DRIFT_PART, _ERROR_PART = slice(0, 3), slice(3, 6), slice(6, 9)


class Vertical:
    """The up direction (3,) in the odometry frame.

    Attributes:
        sigma: standard deviation of the accelerations, m/s2, in the mean over a second or more, as the scans show it.
    """

    def __init__(self) -> None:
        self._leveling = np.eye(3)  # of the start, if it was at rest
        self._velocity: Array | None = None
        self._gravity_free = False  # whether the forces contain no gravity, as a start at rest has shown
        self._started = False  # apparently at rest, while no velocity is known yet
        self.sigma = self._noise = _INITIAL_SIGMAS[0]
        self._error = np.zeros(3)  # the last one, m/s2
        self._forget_gravity()
        self.pause()

    def _forget_gravity(self) -> None:
        self._unit = 0.0  # of the forces, m/s2; 0 while gravity is not known
        # In m/s2: gravity in the odometry frame of the start, its change by the frame's drift, and the accelerometer's
        # error in the robot's axes.
        self._state, self._covariance = np.zeros(9), np.diag(np.repeat([_ANY, 0.0, _ACCELEROMETER_SIGMA], 3) ** 2)

    def start(self, R: Array, force: Array, axis: ArrayLike) -> bool:
        """Start at rest with the axes R (3, 3); `force` and `axis`, which should be up, (3,) are in these axes.

        False: the force is not gravity, and shows no vertical.
        """
        unit = _unit_of(force)
        up = unit * R @ force
        self._gravity_free = not _is_gravity(up)
        if self._gravity_free:
            return False
        self._unit, self._started, self._leveling = unit, True, leveled(up, np.dot(R, axis))
        self._measure(R, up, _MIN_ERROR)
        return True

    def pause(self) -> None:
        """The next step does not follow the previous one."""
        self._velocity, self._force_sum, self._axes_sum, self._time = None, np.zeros(3), np.zeros((3, 3)), 0.0

    def break_off(self) -> None:
        """The motion until the next step is unknown, and the odometry frame may be tilted after it."""
        self.pause()
        if self._unit:
            self._covariance[_DRIFT_PART, _DRIFT_PART] += _BREAK**2 * np.eye(3)

    def add(self, R: Array, force: Array, velocity: Array, seconds: float) -> None:
        """Add a step with the axes R (3, 3), its mean force (3,) m/s2 in these axes, and the mean velocity (3,) m/s."""
        if self._started:
            speed_gain = float(np.linalg.norm(self._unit * R @ force - self._up(R))) * seconds
            self._started = False
            if float(np.linalg.norm(velocity)) < _MAX_REST_SPEED + speed_gain:
                self.sigma = self._noise = _INITIAL_SIGMAS[1]
            else:  # a bend or an acceleration looked like a slope; the frame stays as it is, whatever its tilt
                self._forget_gravity()
        if self._velocity is None:
            self._velocity = velocity
            return
        self._force_sum, self._axes_sum = self._force_sum + R @ force * seconds, self._axes_sum + R * seconds
        self._time += seconds
        if self._time < _MIN_SPAN:
            return
        mean, R_mean, time = self._force_sum / self._time, self._axes_sum / self._time, self._time
        change = (velocity - self._velocity) / time
        self.pause()
        self._velocity = velocity
        unit = self._unit or _unit_of(mean)
        up = unit * mean - change
        # Without gravity, 1 m/s2 looks like gravity in g: then the forces equal the change of velocity.
        if self._gravity_free or not _is_gravity(up) or np.linalg.norm(mean - change) < _NO_GRAVITY:
            return
        path = max(float(np.linalg.norm(velocity)), 1.0) * time
        self._covariance[_DRIFT_PART, _DRIFT_PART] += _DRIFT**2 * path * np.eye(3)
        self._covariance[_ERROR_PART, _ERROR_PART] += _ACCELEROMETER_DRIFT**2 * time * np.eye(3)
        if self._unit:
            error = up - self._up(R_mean)
            self.sigma = _averaged(self.sigma, error)
            # Without what the last two errors have in common, since a drift of the odometry is not noise.
            self._noise, self._error = _averaged(self._noise, (error - self._error) / np.sqrt(2)), error
        self._unit = unit
        self._measure(R_mean, up, self._noise)

    def _measure(self, R: Array, up: Array, sigma: float) -> None:
        """Measure gravity as `up` (3,) m/s2, with axes R (3, 3) in the mean: one step of a Kalman filter, in which a
        large error counts only linearly (Huber)."""
        H, P = np.hstack([np.eye(3), np.eye(3), R]), self._covariance
        error, S = up - H @ self._state, H @ P @ H.T + sigma**2 * np.eye(3)
        sigmas = float(np.sqrt(error @ np.linalg.solve(S, error) / 3))
        weight = _MAX_SIGMAS / max(sigmas, _MAX_SIGMAS)
        gain = weight * np.linalg.solve(S, H @ P).T
        self._state = self._state + gain @ error
        P = P - gain @ H @ P
        self._covariance = (P + P.T) / 2

    def _up(self, R: Array) -> Array:
        """(3,) m/s2 gravity as an IMU with the axes R (3, 3) measures it, in the odometry frame."""
        s = self._state
        return np.asarray(s[_GRAVITY_PART] + s[_DRIFT_PART] + R @ s[_ERROR_PART])

    def accelerations(self, R: Array, forces: Array) -> Array | None:
        """Accelerations (N, 3) m/s2 of forces (N, 3) in axes R (3, 3), in the odometry's; None while gravity is not
        known."""
        return self._unit * forces @ R.T - self._up(R) if self._unit else None

    @property
    def turn(self) -> Array:
        """(3, 3) rotation of the odometry frame to one that is as level as at the start."""
        gravity, drift = self._state[_GRAVITY_PART], self._state[_DRIFT_PART]
        return self._leveling @ leveled(gravity + drift, gravity) if self._unit else self._leveling


def _averaged(sigma: float, error: Array) -> float:
    """A standard deviation, averaged with a new error (3,)."""
    square = float(error @ error / 3 + _MIN_ERROR**2)
    return float(np.sqrt((1 - _NEWEST_WEIGHT) * sigma**2 + _NEWEST_WEIGHT * square))


def metric(forces: Array) -> Array:
    """Forces (N, 3) of about a second at rest, in m/s2."""
    return forces * _unit_of(forces.mean(0))


def _unit_of(mean: Array) -> float:
    """Unit, m/s2, of forces with that mean (3,) over a second or more: some drivers use g, and the mean is then 1. Over
    0.1 s a bump could make it anything."""
    return _GRAVITY if _is_gravity(_GRAVITY * mean) else 1.0


def _is_gravity(up: Array) -> bool:
    """Whether a mean force (3,) m/s2 without the changes of velocity is gravity."""
    return bool(abs(np.linalg.norm(up) - _GRAVITY) <= _GRAVITY_TOLERANCE)
