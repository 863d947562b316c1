# SPDX-License-Identifier: Apache-2.0
"""Registration of a sweep in motion to a local map: its pose together with the motion that distorted it.

A rigid scan assumes a constant velocity during a sweep, but a walking, hovering or bouncing platform changes it. Here
the motion during the sweep is a polynomial of third degree in time. It starts with the pose and the velocity at the end
of the previous sweep.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from math import factorial

import numpy as np

from dpm2_core.estimates import Registration
from dpm2_core.frame import Array
from dpm2_core.geometry import curve, se3
from dpm2_core.slam.preprocess import Scan
from dpm2_core.slam.registration.point_to_plane import ORDER, moments

_ITERATIONS = 12
_CHI2 = 21.03
"""95 % quantile of chi2 with 12 degrees of freedom. Of sweeps on foot, on legs and of cars the largest was 10; with
times that run backwards in a driver it is 30 on average."""
_STEP_LIMITS = (3e-4, 3e-3)  # rad and m: iterations end at smaller changes of the pose, and of the ends of the sweep
JOINT = np.diag(np.repeat([np.radians(0.05), 0.005, 0.1, 0.1], 3) ** 2)
"""Covariance (12, 12) [rad, m, rad/s, m/s] of the difference between the end of a sweep and the start of the next."""

_GYROSCOPE_SIGMA = 0.07
"""Standard deviation of a measured rotation rate next to the points, rad/s, as that of a rotation between scans."""

Matched = Callable[[Array, Array], tuple[Array, Array, Array]]
"""For points (N, 3) at a pose (4, 4): distances from the map's planes (N,), m, normals (N, 3), variances (N,), m2."""


@dataclass(frozen=True, eq=False)
class SweepPrior:
    """Prior of a sweep before it is registered.

    Attributes:
        T: (4, 4) T_odom_lidar at its first point. twist: (6,) [rad/s, m/s] there. covariance: (12, 12) of both.
        half: s from the first point to the middle of the sweep.
        expected, deviation: (ORDER, 6) additional prior of the motion around the middle.
    """

    T: Array
    twist: Array
    covariance: Array
    half: float
    expected: Array
    deviation: Array

    def turning(self, measured: Array) -> SweepPrior:
        """The same with the rotation during the sweep measured by an IMU, its derivatives (ORDER, 3)."""
        expected, deviation = self.expected.copy(), self.deviation.copy()
        expected[:, :3] = measured
        deviation[:, :3] = _GYROSCOPE_SIGMA / self.half ** np.arange(ORDER)[:, None]
        return replace(self, expected=expected, deviation=deviation)


@dataclass(frozen=True, eq=False)
class Swept:
    """A registered sweep.

    Attributes:
        T: (4, 4) T_odom_lidar at its middle. motion: (ORDER, 6) around it, see `curve.poses`.
        covariance: (6 + 6 ORDER, 6 + 6 ORDER) of the pose, on its right, and of the motion.
        half: s from its middle to its ends.
    """

    T: Array
    motion: Array
    covariance: Array
    half: float

    def placed(self, result: Registration) -> Swept:
        """Take the pose of a result, which may use more than the points; the motion changes by the correlated part."""
        T = result.T_target_source
        difference = se3.way(self.T, T)
        gain = np.linalg.solve(self.covariance[:6, :6] + result.of_scene, self.covariance[:6]).T
        motion = self.motion + (gain @ difference)[6:].reshape(ORDER, 6)
        return replace(self, T=T, motion=motion, covariance=self.covariance - gain @ self.covariance[:6])

    def next(self, seconds: float, half: float, steadiness: float) -> SweepPrior:
        """The prior of a sweep whose middle is `seconds` later."""
        pause = max(seconds - self.half - half, 0.0)
        J_end = _state_jacobian(self.half)
        propagation = np.eye(12)
        propagation[:6, 6:] = pause * np.eye(6)
        J_next = propagation @ J_end
        added_variance = np.repeat([steadiness * pause * pause / 2, steadiness * pause], 6) ** 2
        twist = _twist(J_end, self.motion)
        T = self.T @ curve.poses(self.half, self.motion) @ se3.exp(pause * twist)
        return SweepPrior(
            T,
            twist,
            J_next @ self.covariance @ J_next.T + np.diag(added_variance) + JOINT,
            half,
            *_steady_prior(half, steadiness),
        )


def begun_steadily(T_before: Array, twist: Array, seconds: float, half: float, steadiness: float) -> SweepPrior:
    """The prior of a sweep whose middle is `seconds` after the pose T_before (4, 4), if only the twist (6,) between the
    two is known."""
    sigma = steadiness * seconds / 2
    covariance = np.diag(np.repeat([sigma * half, sigma], 6) ** 2)
    return SweepPrior(
        T_before @ se3.exp((seconds - half) * twist), twist, covariance, half, *_steady_prior(half, steadiness)
    )


def register_sweep(scan: Scan, matched: Matched, T: Array, sweep_prior: SweepPrior, shared: float) -> Swept | None:
    """Pose and motion of a sweep by least squares, starting from a pose T (4, 4) and a constant motion. None if they
    contradict the prior: the times of the points are wrong, or they are matched to the wrong walls.

    Args:
        scan: with times relative to the middle of the sweep. matched: matches points with the map.
        shared: number of points that count as one, since the points of a plane are not independent.
    """
    motion = np.concatenate([sweep_prior.twist[None], np.zeros((ORDER - 1, 6))])
    information = np.linalg.inv(sweep_prior.covariance)
    expected = np.concatenate([np.zeros(6), sweep_prior.expected.ravel()])
    motion_information = np.concatenate([np.zeros(6), sweep_prior.deviation.ravel() ** -2])
    J_start = _state_jacobian(-sweep_prior.half)
    for _ in range(_ITERATIONS):
        points = curve.moved(scan.seen, scan.times, partial(curve.poses, motion=motion))
        H, gradient = _normal_equations(points, scan.times, T, matched(points, T), shared)
        T_start = T @ curve.poses(-sweep_prior.half, motion)
        difference = np.concatenate([se3.way(sweep_prior.T, T_start), _twist(J_start, motion) - sweep_prior.twist])
        H += J_start.T @ information @ J_start + np.diag(motion_information + 1e-9)
        gradient += J_start.T @ information @ difference + motion_information * (
            np.concatenate([np.zeros(6), motion.ravel()]) - expected
        )
        step = np.linalg.solve(H, -gradient)
        T, change = T @ se3.exp(step[:6]), step[6:].reshape(ORDER, 6)
        motion = motion + change
        moved = np.abs([step[:6], sweep_prior.half * change[0]]).reshape(4, 3).max(1)
        if max(moved[0], moved[2]) < _STEP_LIMITS[0] and max(moved[1], moved[3]) < _STEP_LIMITS[1]:
            break
    if difference @ information @ difference > _CHI2:
        return None
    T = se3.orthonormalized(T)  # removes accumulated rounding errors
    return Swept(T, motion, np.asarray(np.linalg.inv(H), np.float64), sweep_prior.half)


def _normal_equations(
    points: Array, times: Array, T: Array, matched: tuple[Array, Array, Array], shared: float
) -> tuple[Array, Array]:
    """Hessian (6 + 6 ORDER, 6 + 6 ORDER) and gradient of a step on the right of T and of a change of the motion."""
    H, gradient = moments(points, times, np.ascontiguousarray(T[:3, :3]), *matched)
    weight = [1 / factorial(k) for k in range(ORDER + 1)]
    rows = [np.hstack([weight[i] * weight[j] * H[i + j] for j in range(ORDER + 1)]) for i in range(ORDER + 1)]
    return np.vstack(rows) / shared, (np.array(weight)[:, None] * gradient).ravel() / shared


def _steady_prior(half: float, steadiness: float) -> tuple[Array, Array]:
    """`expected` and `deviation` of a `SweepPrior`: an acceleration with this standard deviation (m/s2 and rad/s2),
    which may reverse in half a sweep."""
    deviation = [np.inf, *(steadiness * (2 / half) ** k for k in range(ORDER - 1))]
    return np.zeros((ORDER, 6)), np.repeat(np.array(deviation)[:, None], 6, 1)


def _state_jacobian(time: float) -> Array:
    """(12, 6 + 6 ORDER) Jacobian of pose and twist at a time, s, with respect to the pose at 0 and the motion; to first
    order in the motion."""
    powers = [time**k / factorial(k) for k in range(ORDER + 1)]
    return np.concatenate([np.kron(powers, np.eye(6)), np.kron([0.0, *powers[:-1]], np.eye(6))])


def _twist(J: Array, motion: Array) -> Array:
    """(6,) twist at the time of J, a `_state_jacobian`."""
    return np.asarray(J[6:, 6:] @ motion.ravel())
