# SPDX-License-Identifier: Apache-2.0
"""The up direction, by the forces that an IMU measures and the velocities that the scans show."""

from __future__ import annotations

import numpy as np

from dpm2_core.frame import Array
from dpm2_core.geometry.turning import leveled

_GRAVITY = 9.81
_GRAVITY_TOLERANCE = 1.5  # m/s2, allowed difference between gravity and a mean force without the changes of velocity
_NO_GRAVITY = 0.5  # m/s2: forces that differ by less from the changes of velocity do not contain gravity
_MIN_SPAN = 1.0  # s over which forces and velocities are compared
_REST_WEIGHT = 5.0  # s, weight of a start at rest
_AVERAGING_TIME = 60.0  # s over which the mean force shows the vertical
_INITIAL_SIGMAS = (1.0, 0.3)  # m/s2, sigma of accelerations before scans have confirmed any, and after a start at rest
_MAX_REST_SPEED = 0.3  # m/s: a robot that is faster than the forces explain was not at rest, perhaps in a bend
_MIN_ERROR = 0.06  # m/s2, minimum error of the mean over seconds: a bias that rotates with the robot does not show
_NEWEST_WEIGHT = 0.1  # weight of the newest span in the error of the accelerations


class Vertical:
    """The recent up direction (3,) in the odometry frame, and the direction that should be up.

    Attributes:
        sigma: standard deviation of the accelerations, m/s2, in the mean over a second or more, as the scans show it.
    """

    def __init__(self) -> None:
        self._up = np.zeros(3)
        self._wanted_up: Array | None = None
        self._seconds = 0.0  # over which `_up` is averaged
        self._velocity: Array | None = None
        self._gravity_free = False  # whether the forces contain no gravity, as a start at rest has shown
        self._unit = 0.0  # of the forces, m/s2; 0 while gravity is not known
        self._started = False  # apparently at rest, while no velocity is known yet
        self.sigma = _INITIAL_SIGMAS[0]
        self.pause()

    def start(self, force: Array, axis: Array) -> bool:
        """Start at rest; `axis` (3,) should be up. False: the force is not gravity, and shows no vertical."""
        unit = _unit_of(force)
        up = unit * force
        self._gravity_free = not _is_gravity(up)
        if self._gravity_free:
            return False
        self._unit, self._up, self._wanted_up, self._seconds, self._started = unit, up, axis, _REST_WEIGHT, True
        return True

    def pause(self) -> None:
        """The next step does not follow the previous one."""
        self._velocity, self._force_sum, self._time = None, np.zeros(3), 0.0

    def add(self, force: Array, velocity: Array, seconds: float) -> None:
        """Add a step with its mean force (3,) m/s2, and the mean velocity (3,) m/s."""
        if self._started:
            speed_gain = float(np.linalg.norm(self._unit * force - self._up)) * seconds
            was_at_rest = float(np.linalg.norm(velocity)) < _MAX_REST_SPEED + speed_gain
            self.sigma, self._started = _INITIAL_SIGMAS[int(was_at_rest)], False
        if self._velocity is None:
            self._velocity = velocity
            return
        self._force_sum, self._time = self._force_sum + force * seconds, self._time + seconds
        if self._time < _MIN_SPAN:
            return
        mean, change, time = self._force_sum / self._time, (velocity - self._velocity) / self._time, self._time
        self.pause()
        self._velocity = velocity
        unit = self._unit or _unit_of(mean)
        up = unit * mean - change
        # Without gravity, 1 m/s2 looks like gravity in g: then the forces equal the change of velocity.
        if self._gravity_free or not _is_gravity(up) or np.linalg.norm(mean - change) < _NO_GRAVITY:
            return
        self._unit = unit
        if self._wanted_up is not None:
            error = up - self._up
            self.sigma = float(
                np.sqrt((1 - _NEWEST_WEIGHT) * self.sigma**2 + _NEWEST_WEIGHT * (error @ error / 3 + _MIN_ERROR**2))
            )
        self._seconds = min(self._seconds + time, _AVERAGING_TIME)
        self._up = self._up + time / self._seconds * (up - self._up)
        if self._wanted_up is None and self._seconds >= 2 * _REST_WEIGHT:
            self._wanted_up = self._up / np.linalg.norm(self._up)  # the tilt of the start, whatever it is, is kept

    def accelerations(self, forces: Array) -> Array | None:
        """Accelerations (N, 3) m/s2 of forces (N, 3), in the odometry's axes; None while gravity is not known."""
        return None if self._wanted_up is None else self._unit * forces - self._up

    @property
    def turn(self) -> Array:
        """(3, 3) rotation of the estimated up direction to the wanted one."""
        return np.eye(3) if self._wanted_up is None else leveled(self._up, self._wanted_up)


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
