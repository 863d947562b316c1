# SPDX-License-Identifier: Apache-2.0
"""Corrects for motion during the measurement: points of a scan, and the camera of an image, as if at the stamp."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from dpm2_core.frame import Array, Frame, Image
from dpm2_core.geometry import curve, se3
from dpm2_core.geometry.turning import turned

Turn = Callable[[Array], Array | None]


def deskew(
    points: NDArray[np.float32],
    time_offset: NDArray[np.float32],
    motion: Array,
    turn: Turn | None = None,
) -> NDArray[np.float32]:
    """(N, 4) points as if all had been measured at the stamp; `time_offset` (N,) s.

    Args:
        motion: (6,) twist [rad/s, m/s], or (K, 6), see `curve.poses`; with (K, 6) `turn` is not used.
        turn: returns for times (M,) s the measured rotations (M, 3, 3) from the axes at those times to the axes at the
            stamp. If it returns None, and without it, the rotation is that of `motion`.
    """
    return curve.moved(points, time_offset, partial(way, motion=motion, turn=turn))


def way(times: Array, motion: Array, turn: Turn | None) -> Array:
    """Poses (M, 4, 4) at increasing times (M,) s of a sensor with that motion; arguments as in `deskew`."""
    R = None if turn is None or motion.ndim == 2 else turn(times)
    return curve.poses(times, motion) if R is None else _integrate_velocity(times, R, motion[3:])


def measured_turn(frame: Frame) -> Turn | None:
    """The LiDAR's rotation around the stamp as measured by the IMU, for `deskew`; None without an IMU."""
    imu = frame.imu
    return None if imu is None else partial(turned, (imu.stamps - frame.stamp) * 1e-9, imu.rates)


def placed(image: Image, seconds: float, twist: Array) -> Image:
    """The image with its camera moved to its pose `seconds` later, in the LiDAR frame before the motion.

    `twist` (6,) [rad/s, m/s] is the motion of the LiDAR.
    """
    T_lidar_cam = se3.exp(seconds * twist) @ image.camera.T_lidar_cam
    return replace(image, camera=replace(image.camera, T_lidar_cam=T_lidar_cam))


def _integrate_velocity(times: Array, R: Array, velocity: Array) -> Array:
    """Poses (M, 4, 4) at times (M,) s with rotations R (M, 3, 3), at a constant velocity (3,) in the sensor's axes."""
    v = R @ velocity
    positions = np.concatenate([np.zeros((1, 3)), np.cumsum((v[1:] + v[:-1]) / 2 * np.diff(times)[:, None], 0)])
    origin = [np.interp(0.0, times, positions[:, i]) for i in range(3)] if times[0] <= 0 <= times[-1] else None
    if origin is None:  # the stamp is outside the sweep: continue from the nearest end
        nearest = 0 if times[0] > 0 else -1
        origin = (positions[nearest] - v[nearest] * times[nearest]).tolist()
    return se3.make(R, positions - np.array(origin))
