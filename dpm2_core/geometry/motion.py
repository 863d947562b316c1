# SPDX-License-Identifier: Apache-2.0
"""Predicts the motion of a vehicle without sensor data, at constant velocity, with its covariance."""

from __future__ import annotations

import numpy as np

from dpm2_core.frame import Array
from dpm2_core.geometry import se3

OPEN = 0.9
"""Standard deviation of a registered position, m, from which a direction is open: the scene does not constrain it. The
largest value is 1 m."""
_NORMAL_NOISE = 0.12**2
"""Share of a scene's information that is noise of its normals, as for its covariance. It rotates the open direction, by
that many rad, towards a direction with all other information. On a road seen for 10 m it was 20 to 70 deg per scan."""
_MIN_TRANSLATION = 0.05  # m: shorter translations do not show a period
_HORIZON = 10.0  # s: motion is not extrapolated farther
_MAX_GROWTH_TIME = 3600.0  # s: after that time the covariance grows no further
_STEPS = 10  # integration steps of a changing motion
_YAW_RATE_SIGMA = 0.3  # rad/s, standard deviation of the yaw rate in traffic
_TILT_RATIO = 0.1  # roll and pitch relative to the heading: slopes
_UNKNOWN_HEADING_SIGMA = np.pi / np.sqrt(3)  # rad, standard deviation of an unknown heading


def predicted(T: Array, twist: Array, seconds: float, turns: Array | None = None) -> Array:
    """The pose (4, 4) after that time at a constant `twist` (6,) [rad/s, m/s]; `turns` as in `between`."""
    if turns is not None:
        return between(T, twist, twist, seconds, turns)
    return T @ se3.exp(twist * min(seconds, _HORIZON))


def between(T: Array, before: Array, after: Array, seconds: float, turns: Array | None = None) -> Array:
    """The pose (4, 4) after that time if the motion changes linearly from one twist (6,) [rad/s, m/s] to the other.

    Args:
        turns: measured rotations R_T_t (K + 1, 3, 3), in the middle of each of K equal parts of the time and at its
            end. With them only the velocities of the twists are used.
    """
    if turns is not None:
        fractions = (np.arange(len(turns) - 1)[:, None] + 0.5) / (len(turns) - 1)
        t = np.einsum("kij,kj->ki", turns[:-1], (1 - fractions) * before[3:] + fractions * after[3:]).mean(0) * seconds
        return T @ se3.make(turns[-1], t)
    step = seconds / _STEPS
    for i in range(_STEPS):
        fraction = (i + 0.5) / _STEPS
        T = T @ se3.exp(((1 - fraction) * before + fraction * after) * step)
    return T


def period_by_motion(T: Array, stamped: tuple[float, Array], usual: tuple[float, Array], steadiness: float) -> float:
    """Duration, s, of a period whose stamp is in doubt, from the distance that the LiDAR has moved in it.

    A driver or network that holds frames back, and stamps them on arrival, makes one period long and those of the burst
    after it short; if frames are lost, the stamps are right. The real speed is unaffected by both. The period is as
    stamped if an acceleration explains the pose, else between the stamped and the usual period.

    Args:
        T: estimated pose (4, 4).
        stamped, usual: period, s, and pose (4, 4) that the previous motion predicts after it.
        steadiness: standard deviation of the acceleration, m/s2.
    """
    dt, T_stamped = stamped
    to_estimate, to_usual = ((se3.inverse(T_stamped) @ end)[:3, 3] for end in (T, usual[1]))
    if min(np.linalg.norm(to_estimate), np.linalg.norm(to_usual)) <= _MIN_TRANSLATION + 0.5 * steadiness * dt * dt:
        return dt
    return dt + float(np.clip(to_estimate @ to_usual / (to_usual @ to_usual), 0.0, 1.0)) * (usual[0] - dt)


def covariance(
    speed: float,
    seconds: float,
    acceleration: float,
    of_velocity: Array,
    turn: float = 0.0,
    of_turn: Array | None = None,
) -> Array:
    """Covariance (6, 6) [rad, m] of the pose that `predicted` returns, for a velocity with the covariance `of_velocity`
    (3, 3) [m/s] and an error of the angular rate of `turn`, rad/s, about any axis. The heading's deviation is at most
    that of an unknown heading, and the time at most an hour. If the rotation was measured, `of_turn` (3, 3) [rad] is
    its covariance."""
    seconds = min(seconds, _MAX_GROWTH_TIME)
    meters = 0.5 * seconds * velocity_change(speed, seconds, acceleration)
    drift, heading = (min(rate * seconds, _UNKNOWN_HEADING_SIGMA) for rate in (turn, _YAW_RATE_SIGMA))
    result = np.diag([_TILT_RATIO * heading, _TILT_RATIO * heading, heading, meters, meters, meters]) ** 2
    result[:3, :3] += drift**2 * np.eye(3)
    result[3:, 3:] += of_velocity * seconds**2
    if of_turn is not None:
        result[:3, :3] = of_turn
    return result


def velocity_change(speed: float, seconds: float, acceleration: float) -> float:
    """Standard deviation of the velocity after that time, m/s, for that acceleration (m/s2) in every direction; not
    more than a vehicle at this speed can change it."""
    return min(acceleration * seconds, speed + acceleration)


def spread(sigma: float, seconds: float, of_velocity: Array) -> Array:
    """Covariance (6, 6) [rad, m] of `sigma` in every direction plus that of a velocity with the covariance
    `of_velocity` (3, 3) [m/s] over that time."""
    result = sigma**2 * np.eye(6)
    result[3:, 3:] += of_velocity * seconds**2
    return result


def combined(of_scene: Array, of_prediction: Array) -> Array:
    """Covariance (3, 3) [m] of a position fused from scene and prediction; 1 m of the scene is no information."""
    information, axes = np.linalg.eigh(np.linalg.inv(of_scene))
    scene_information = (axes * np.maximum(information - 1, 0)) @ axes.T
    return np.asarray(np.linalg.inv(scene_information + np.linalg.inv(of_prediction)))


def turned_open(of_scene: Array, of_prediction: Array) -> Array:
    """A covariance of_scene (3, 3) [m] with larger variances across its open directions, since these directions are
    uncertain themselves. Along them the prediction, of_prediction (3, 3), decides.

    Otherwise the small changes of the open direction from scan to scan would seem to measure the motion along it.
    """
    variances, axes = np.linalg.eigh(of_scene)
    is_open = variances >= OPEN**2
    if not is_open.any():
        return of_scene
    open_variance = float(np.linalg.eigvalsh(axes[:, is_open].T @ of_prediction @ axes[:, is_open])[-1])
    rotation = np.minimum(_NORMAL_NOISE * (1 / variances).sum() * variances, 1.0)
    variances = np.where(is_open, variances, np.minimum(variances + rotation**2 * open_variance, 1.0))
    return np.asarray((axes * variances) @ axes.T)


def along_open(of_scene: Array, other: Array) -> Array:
    """The part of a covariance `other` (3, 3) along the directions that are open in a scene, of_scene (3, 3) [m]."""
    variances, axes = np.linalg.eigh(of_scene)
    open_axes = axes[:, variances >= OPEN**2]
    return np.asarray(open_axes @ (open_axes.T @ other @ open_axes) @ open_axes.T)
