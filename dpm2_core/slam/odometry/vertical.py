# SPDX-License-Identifier: Apache-2.0
"""Which way is up, by the forces that an IMU measures beside the velocities that the scans show."""

from __future__ import annotations

import numpy as np

from dpm2_core.frame import Array
from dpm2_core.geometry.turning import leveled

_GRAVITY = 9.81
_POSSIBLE = 1.5  # m/s2 that a mean force without the changes of velocity may differ from it
_NO_GRAVITY = 0.5  # m/s2: forces that differ by less from the changes of velocity have none in them
_SPAN = 1.0  # s over which forces and velocities are compared
_WEIGHT = 5.0  # s that a start at rest counts as much as
_MINUTE = 60.0  # s of which the mean force shows the vertical
_UNPROVEN = (1.0, 0.3)  # m/s2 that accelerations are off before scans have confirmed any, and after a start at rest
_STANDS = 0.3  # m/s: what seemed at rest and is faster than forces have made it was on its way, perhaps in a bend
_LEAST = 0.06  # m/s2 that it is off at least, in the mean over seconds: a bias that turns with the robot does not show
_MEMORY = 0.1  # fraction of the newest span in how far the accelerations are off


class Vertical:
    """Which way (3,) is up in the odometry's frame, of late, and which way it is to be.

    Attributes:
        sigma: standard deviation of the accelerations, m/s2, in the mean over a second or more, as scans show it.
    """

    def __init__(self) -> None:
        self._up = np.zeros(3)
        self._axis: Array | None = None
        self._seconds = 0.0  # that `_up` is the mean of
        self._velocity: Array | None = None
        self._without = False  # gravity, as a start at rest has shown
        self._unit = 0.0  # of the forces, m/s2; 0 while gravity is not known
        self._started = False  # at rest as it seems, and no velocity is known yet
        self.sigma = _UNPROVEN[0]
        self.pause()

    def start(self, force: Array, axis: Array) -> bool:
        """At rest at the start; `axis` (3,) is to be up. False: the force is not gravity, and shows no vertical."""
        unit = _unit_of(force)
        up = unit * force
        self._without = not _is_gravity(up)
        if self._without:
            return False
        self._unit, self._up, self._axis, self._seconds, self._started = unit, up, axis, _WEIGHT, True
        return True

    def pause(self) -> None:
        """What comes next does not follow on."""
        self._velocity, self._sum, self._time = None, np.zeros(3), 0.0

    def add(self, force: Array, velocity: Array, seconds: float) -> None:
        """A step with its mean force (3,) m/s2, and the mean velocity (3,) m/s."""
        if self._started:
            gained = float(np.linalg.norm(self._unit * force - self._up)) * seconds
            stood = float(np.linalg.norm(velocity)) < _STANDS + gained
            self.sigma, self._started = _UNPROVEN[int(stood)], False
        if self._velocity is None:
            self._velocity = velocity
            return
        self._sum, self._time = self._sum + force * seconds, self._time + seconds
        if self._time < _SPAN:
            return
        mean, change, time = self._sum / self._time, (velocity - self._velocity) / self._time, self._time
        self.pause()
        self._velocity = velocity
        unit = self._unit or _unit_of(mean)
        up = unit * mean - change
        # An acceleration of 1 m/s2 without gravity looks as gravity in g: then the forces are the change of velocity.
        if self._without or not _is_gravity(up) or np.linalg.norm(mean - change) < _NO_GRAVITY:
            return
        self._unit = unit
        if self._axis is not None:
            off = up - self._up
            self.sigma = float(np.sqrt((1 - _MEMORY) * self.sigma**2 + _MEMORY * (off @ off / 3 + _LEAST**2)))
        self._seconds = min(self._seconds + time, _MINUTE)
        self._up = self._up + time / self._seconds * (up - self._up)
        if self._axis is None and self._seconds >= 2 * _WEIGHT:
            self._axis = self._up / np.linalg.norm(self._up)  # however tilted the start was: it stays like that

    def accelerations(self, forces: Array) -> Array | None:
        """Those (N, 3) m/s2 of forces (N, 3) along the odometry's axes; None while gravity is not known."""
        return None if self._axis is None else self._unit * forces - self._up

    @property
    def turn(self) -> Array:
        """(3, 3) that makes it so."""
        return np.eye(3) if self._axis is None else leveled(self._up, self._axis)


def metric(forces: Array) -> Array:
    """Forces (N, 3) of a second or so at rest, in m/s2."""
    return forces * _unit_of(forces.mean(0))


def _unit_of(mean: Array) -> float:
    """Of forces with that mean (3,) over a second or more, m/s2: some drivers count in g, in which it is 1 then. A bump
    of 0.1 s may make it anything."""
    return _GRAVITY if _is_gravity(_GRAVITY * mean) else 1.0


def _is_gravity(up: Array) -> bool:
    """A mean force (3,) m/s2 without the changes of velocity."""
    return bool(abs(np.linalg.norm(up) - _GRAVITY) <= _POSSIBLE)
