# SPDX-License-Identifier: Apache-2.0
"""The motion of a vehicle while no sensor shows it: at constant velocity, and how far off that may be by then."""

from __future__ import annotations

import numpy as np

from dpm2_core.frame import Array
from dpm2_core.geometry import se3

OPEN = 0.9
"""Standard deviation of a registered position, m, from which the scene leaves a direction open: it ends at 1 m."""
_TURNED = 0.12**2
"""Share of a scene's information that is noise of its normals, as for its covariance: by so much, rad, it turns the
open direction towards another one that has all the rest. On a road seen for 10 m it was 20 to 70 degrees per scan."""
_FREE = 0.05  # m: the speed tells nothing where it leads less far
_HORIZON = 10.0  # s: farther ahead no motion is extrapolated
_LONGEST = 3600.0  # s: after it nothing more is to be forgotten
_STEPS = 10  # of a motion that changes
_TURN = 0.3  # rad/s, standard deviation of the yaw rate in traffic
_TILT = 0.1  # of the heading's: slopes
_ANY_TURN = np.pi / np.sqrt(3)  # rad, standard deviation of a heading of which nothing is known


def predicted(T: Array, twist: Array, seconds: float, turns: Array | None = None) -> Array:
    """The pose (4, 4) after that time at a constant `twist` (6,) [rad/s, m/s]; `turns` as of `between`."""
    if turns is not None:
        return between(T, twist, twist, seconds, turns)
    return T @ se3.exp(twist * min(seconds, _HORIZON))


def between(T: Array, before: Array, after: Array, seconds: float, turns: Array | None = None) -> Array:
    """The pose (4, 4) after that time if the motion changes evenly from one twist (6,) [rad/s, m/s] to the other.

    Args:
        turns: rotations R_T_t (K + 1, 3, 3) in the middle of each of K even parts of the time, and in the end, where
            they were measured: of the twists then the velocity counts alone.
    """
    if turns is not None:
        parts = (np.arange(len(turns) - 1)[:, None] + 0.5) / (len(turns) - 1)
        way = np.einsum("kij,kj->ki", turns[:-1], (1 - parts) * before[3:] + parts * after[3:]).mean(0) * seconds
        return T @ se3.make(turns[-1], way)
    step = seconds / _STEPS
    for i in range(_STEPS):
        part = (i + 0.5) / _STEPS
        T = T @ se3.exp(((1 - part) * before + part * after) * step)
    return T


def period_by_motion(T: Array, stamped: tuple[float, Array], usual: tuple[float, Array], steadiness: float) -> float:
    """Seconds that a period lasted of which the stamp is in doubt, by how far the LiDAR has moved in it.

    A driver or network that holds frames back, and whose stamps are those of arrival, makes one period long and those
    of the burst after it short; of lost frames the stamps are right. The speed goes on through both: the period is as
    stamped where an acceleration explains the pose, or between that and as usual.

    Args:
        T: pose (4, 4) that was found.
        stamped, usual: period, s, and pose (4, 4) to which the motion so far leads in it.
        steadiness: standard deviation of the acceleration, m/s2.
    """
    dt, T_stamped = stamped
    off, way = ((se3.inverse(T_stamped) @ end)[:3, 3] for end in (T, usual[1]))
    if min(np.linalg.norm(off), np.linalg.norm(way)) <= _FREE + 0.5 * steadiness * dt * dt:
        return dt
    return dt + float(np.clip(off @ way / (way @ way), 0.0, 1.0)) * (usual[0] - dt)


def covariance(
    speed: float,
    seconds: float,
    acceleration: float,
    of_velocity: Array,
    turn: float = 0.0,
    of_turn: Array | None = None,
) -> Array:
    """Covariance (6, 6) [rad, m] of the pose that `predicted` gives, of a velocity with the covariance `of_velocity`
    (3, 3) [m/s] and a rate of turn that is off by `turn`, rad/s, about any axis; no heading is worse than any heading,
    and no pause longer than an hour. Where the turn was measured, `of_turn` (3, 3) [rad] is its covariance."""
    seconds = min(seconds, _LONGEST)
    meters = 0.5 * seconds * velocity_change(speed, seconds, acceleration)
    swing, heading = (min(rate * seconds, _ANY_TURN) for rate in (turn, _TURN))
    result = np.diag([_TILT * heading, _TILT * heading, heading, meters, meters, meters]) ** 2
    result[:3, :3] += swing**2 * np.eye(3)
    result[3:, 3:] += of_velocity * seconds**2
    if of_turn is not None:
        result[:3, :3] = of_turn
    return result


def velocity_change(speed: float, seconds: float, acceleration: float) -> float:
    """Standard deviation of the velocity after that time, m/s: by that acceleration (m/s2) in every direction, but not
    more than a vehicle as fast as this one can change it."""
    return min(acceleration * seconds, speed + acceleration)


def spread(sigma: float, seconds: float, of_velocity: Array) -> Array:
    """Covariance (6, 6) [rad, m] of `sigma` in every direction, and of a velocity with the covariance `of_velocity`
    (3, 3) [m/s] over that time."""
    result = sigma**2 * np.eye(6)
    result[3:, 3:] += of_velocity * seconds**2
    return result


def combined(of_scene: Array, of_prediction: Array) -> Array:
    """Covariance (3, 3) [m] of a position that the scene and the motion so far show; 1 m of the scene says nothing."""
    information, axes = np.linalg.eigh(np.linalg.inv(of_scene))
    shown = (axes * np.maximum(information - 1, 0)) @ axes.T
    return np.asarray(np.linalg.inv(shown + np.linalg.inv(of_prediction)))


def turned_open(of_scene: Array, of_prediction: Array) -> Array:
    """A covariance of_scene (3, 3) [m], as uncertain beside the directions that it leaves open as these are not known
    themselves: in them the prediction, of_prediction (3, 3), decides.

    Otherwise each scan, whose open direction is a little beside that of the one before, seems to show the way along it.
    """
    variances, axes = np.linalg.eigh(of_scene)
    left = variances >= OPEN**2
    if not left.any():
        return of_scene
    unknown = float(np.linalg.eigvalsh(axes[:, left].T @ of_prediction @ axes[:, left])[-1])
    turn = np.minimum(_TURNED * (1 / variances).sum() * variances, 1.0)
    variances = np.where(left, variances, np.minimum(variances + turn**2 * unknown, 1.0))
    return np.asarray((axes * variances) @ axes.T)


def along_open(of_scene: Array, other: Array) -> Array:
    """Of a covariance `other` (3, 3) the part along the directions that a scene, of_scene (3, 3) [m], leaves open."""
    variances, axes = np.linalg.eigh(of_scene)
    left = axes[:, variances >= OPEN**2]
    return np.asarray(left @ (left.T @ other @ left) @ left.T)
