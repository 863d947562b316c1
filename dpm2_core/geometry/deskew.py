# SPDX-License-Identifier: Apache-2.0
"""What was measured while moving, as if at the stamp: points of a scan, and the camera of an image."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from dpm2_core.frame import Frame, Image
from dpm2_core.geometry import se3
from dpm2_core.geometry.turning import turned

_DESKEW_STEPS = 64  # poses along a sweep: at 1 rad/s and 0.1 s the remaining error is 1 mm at 1 m, 8 cm at 100 m


def deskew(
    points: NDArray[np.float32],
    time_offset: NDArray[np.float32],
    twist: NDArray[np.float64],
    turn: Callable[[se3.Array], se3.Array | None] | None = None,
) -> NDArray[np.float32]:
    """(N, 4) points as if all had been taken at the stamp; `time_offset` (N,) s, `twist` (6,) [rad/s, m/s].

    Args:
        turn: gives, of times (M,) s, the rotations (M, 3, 3) from the axes then to those at the stamp, as they were
            measured; where it gives None, and without it, the sensor turns as steadily as `twist` says.
    """
    if len(points) == 0:
        return points
    start, end = float(time_offset.min()), float(time_offset.max())
    if end - start < 1e-6:
        return points
    step = np.rint((time_offset - start) * ((_DESKEW_STEPS - 1) / (end - start))).astype(np.int64)
    times = np.linspace(start, end, _DESKEW_STEPS)
    R = None if turn is None else turn(times)
    T = (se3.exp(times[:, None] * twist) if R is None else _along(times, R, twist[3:])).astype(np.float32)
    out = points.copy()
    out[:, :3] = np.einsum("nij,nj->ni", T[step, :3, :3], points[:, :3]) + T[step, :3, 3]
    return out


def measured_turn(frame: Frame) -> Callable[[se3.Array], se3.Array | None] | None:
    """How the LiDAR turned around the stamp, for `deskew`; None without an IMU."""
    imu = frame.imu
    return None if imu is None else partial(turned, (imu.stamps - frame.stamp) * 1e-9, imu.rates)


def placed(image: Image, seconds: float, twist: NDArray[np.float64]) -> Image:
    """The image, with its camera where that was so many seconds later, in the LiDAR frame of before.

    `twist` (6,) [rad/s, m/s] is the motion of the LiDAR.
    """
    T_lidar_cam = se3.exp(seconds * twist) @ image.camera.T_lidar_cam
    return replace(image, camera=replace(image.camera, T_lidar_cam=T_lidar_cam))


def _along(times: se3.Array, R: se3.Array, velocity: se3.Array) -> se3.Array:
    """Poses (M, 4, 4) at times (M,) s of a sensor that turns by R (M, 3, 3), at a constant velocity (3,) of its own."""
    ways = R @ velocity
    way = np.concatenate([np.zeros((1, 3)), np.cumsum((ways[1:] + ways[:-1]) / 2 * np.diff(times)[:, None], 0)])
    here = [np.interp(0.0, times, way[:, i]) for i in range(3)] if times[0] <= 0 <= times[-1] else None
    if here is None:  # the stamp is outside the sweep: as if it went on from the nearest end
        nearest = 0 if times[0] > 0 else -1
        here = (way[nearest] - ways[nearest] * times[nearest]).tolist()
    return se3.make(R, way - np.array(here))
