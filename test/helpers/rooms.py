# SPDX-License-Identifier: Apache-2.0
"""Scans of a LiDAR with 16 beams in a box that contains boxes, by ray casting: a furnished room, or a street under the
sky."""

from __future__ import annotations

import numpy as np

from dpm2_core.frame import Array, Frame, Inertial, Points
from dpm2_core.geometry import se3
from dpm2_core.sim.imu import Imu
from dpm2_core.sim.settings import ImuConfig

_AZIMUTH, _ELEVATION = np.meshgrid(np.radians(np.arange(0, 360, 0.8)), np.radians(np.arange(-15, 16, 2.0)))
RAYS = np.stack(
    [np.cos(_ELEVATION) * np.cos(_AZIMUTH), np.cos(_ELEVATION) * np.sin(_AZIMUTH), np.sin(_ELEVATION)], -1
).reshape(-1, 3)


REACH = 90.0


def boxes(low: tuple[float, float], high: tuple[float, float], count: int, size: Array, seed: int = 0) -> Array:
    """Low and high corners (count, 2, 3) of boxes on the floor, at least 1 m off the line y = 0."""
    rng = np.random.default_rng(seed)
    at = np.column_stack([rng.uniform(low[0], high[0], count), rng.uniform(1.0, high[1], count)])
    at[:, 1] = np.where(rng.random(count) < 0.5, at[:, 1], at[:, 1] * low[1] / high[1] - size[1])
    extent = size * rng.uniform(0.5, 1.5, (count, 3))
    return np.stack([np.column_stack([at, np.zeros(count)]), np.column_stack([at + extent[:, :2], extent[:, 2]])], 1)


def scan(T: Array, hull: Array, things: Array, seed: int) -> Points:
    """Scan (N, 4) from a pose T_world_lidar (4, 4), or from one pose per ray, within a hull (2, 3) that contains things
    (K, 2, 3); 1 cm of noise."""
    return _measured(_distances(T, hull, things), seed)


def _distances(T: Array, hull: Array, things: Array) -> Array:
    """Distance of each ray."""
    # (3, N), so that the largest of three is taken over whole rows.
    origin = np.atleast_2d(T[..., :3, 3]).T
    rays = np.ascontiguousarray(np.einsum("...ij,...j->...i", T[..., :3, :3], RAYS).T)
    with np.errstate(divide="ignore", invalid="ignore"):
        distance = np.fmax(*((corner[:, None] - origin) / rays for corner in hull)).min(0)
        for thing in things:
            low, high = ((corner[:, None] - origin) / rays for corner in thing)
            entry = np.minimum(low, high).max(0)
            hit = (entry < np.maximum(low, high).min(0)) & (entry > 0)
            distance = np.where(hit, np.minimum(distance, entry), distance)
    return np.asarray(distance)


def _measured(distance: Array, seed: int) -> Points:
    rng = np.random.default_rng(seed)
    seen = distance < REACH
    points = np.full((int(seen.sum()), 4), 0.5, np.float32)
    points[:, :3] = RAYS[seen] * (distance[seen] + rng.normal(0, 0.01, int(seen.sum())))[:, None]
    return points


ROOM = np.array([[-2.5, -2, 0], [2.5, 2, 2.6]])
FURNITURE = boxes((-2.3, -1.9), (2.0, 1.5), 6, np.array([0.6, 0.4, 0.9]))
HALL = np.array([[-3, -2, 0], [3, 2, 2.6]])
_CORNER = np.array([[[-3, -2, 0], [-2.4, -0.5, 0.8]], [[-1, -2, 0], [0.4, -1.5, 1.9]]])
BOTH_ENDS = np.concatenate([_CORNER, np.sort(_CORNER * [-1, -1, 1], axis=1)])
"""Objects in the hall, which looks the same from its other end."""
CABINET = np.array([[[-3, 1.2, 0], [-2.2, 2, 1.2]]])  # distinguishes the ends of the hall
ROUND = [
    (-1.5, -1, 0), (-0.5, -1, 0), (0.5, -1, 0), (1.5, -1, 0), (1.5, 0, 90), (1.5, 1, 90),
    (1.5, 1, 180), (0.5, 1, 180), (-0.5, 1, 180), (-1.5, 1, 180), (-1.5, 1, 270), (-1.5, 0, 270),
]  # fmt: skip
"""Poses around the hall: x and y, m, and heading, degrees."""
STREET = np.array([[-80, -20, 0], [200, 20, 500.0]])
HOUSES = boxes((-70, -16), (190, 16), 40, np.array([6, 4, 7.0]), 1)


def standing(x: float, y: float, heading: float) -> Array:
    """Pose (4, 4) of a LiDAR 0.6 m above the floor; the heading in degrees."""
    return se3.make(se3.rotation(np.array([0, 0, np.radians(heading)])), [x, y, 0.6])


def frames(poses: Array, street: bool = False, start: int = 0) -> list[Frame]:
    """Frames at 10 Hz, numbered from `start`."""
    hull, things = (STREET, HOUSES) if street else (ROOM, FURNITURE)
    return [Frame((start + i) * 10**8, scan(T, hull, things, start + i), index=start + i) for i, T in enumerate(poses)]


def turning(count: int) -> tuple[list[Frame], Array]:
    """Frames of a robot in the street, and its (count, 4, 4) true poses. It stands for 1 s, then drives at 1.5 m/s and
    swings at up to 100 deg/s, with the LiDAR tilted by 0.1 rad. Points have times, and the IMU has realistic errors."""
    since = lambda t: np.maximum(t - 1.5, 0)  # noqa: E731

    def poses(t: Array) -> Array:
        swing = 0.55 * np.sin(np.pi * since(t)) * np.minimum(since(t), 1)
        twists = np.stack([0 * t, 0 * t, swing, 0 * t, 0 * t, 0 * t], -1)
        place = np.stack([1.5 * np.maximum(since(t) - 0.5, 0), 0 * t, 0 * t + 1.5], -1)
        return se3.make(np.eye(3), place) @ se3.exp(twists) @ se3.exp([0, 0.1, 0, 0, 0, 0])

    imu, stamps = Imu(ImuConfig(), np.random.default_rng(5)), 0.5 + 0.1 * np.arange(count)
    times = imu.times(0, stamps[-1] + 0.1)
    rates, forces = (measured @ imu.R_lidar_imu.T for measured in imu.measure(times, poses))
    offset = (_AZIMUTH.ravel() / (2 * np.pi) - 0.5) * 0.1
    frames = []
    for i, stamp in enumerate(stamps):
        distance = _distances(poses(stamp + offset), STREET, HOUSES)
        used = (times <= stamp + 0.05) & (times > (stamp - 0.05 if i else 0))
        samples = Inertial(np.round(times[used] * 1e9).astype(np.int64), rates[used], forces[used])
        when = offset[distance < REACH].astype(np.float32)
        frames.append(Frame(round(stamp * 1e9), _measured(distance, i), when, index=i, imu=samples))
    return frames, poses(stamps)


def walk(count: int) -> Array:
    """Poses (count, 4, 4) on a circle of 0.7 m around the center of the room, 0.6 m above the floor, starting at
    rest."""
    angle = np.cumsum(np.minimum(np.arange(count) * 0.01, 0.08))
    return np.array([se3.exp([0, 0, a, 0, 0, 0]) @ se3.make(np.eye(3), [0.7, 0, 0.6]) for a in angle])
