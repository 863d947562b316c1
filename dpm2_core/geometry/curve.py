# SPDX-License-Identifier: Apache-2.0
"""The trajectory of a sensor around a time 0: a polynomial in time, in the tangent space of its pose at that time."""

from __future__ import annotations

from collections.abc import Callable
from math import factorial
from typing import TypeVar

import numpy as np
from numba import float32, float64
from numpy.typing import ArrayLike, NDArray

from dpm2_core.frame import Array
from dpm2_core.geometry import se3
from dpm2_core.geometry.compiled import READ_F4, READ_F8, compiled

_N_INTERVALS = 32  # poses along a sweep, linearly interpolated: an error of 0.03 mm at 3 rad/s, 20 m away
_N_FIT_TIMES = 11  # number of times
Cloud = TypeVar("Cloud", NDArray[np.float32], Array)


def poses(times: ArrayLike, motion: Array) -> Array:
    """(..., 4, 4) poses at times (...), s, relative to the pose at time 0.

    Args:
        motion: (K, 6) the twist at 0 [rad/s, m/s] and its time derivatives; a single twist (6,) is constant.
    """
    t = np.asarray(times, np.float64)[..., None]
    xi, factor = np.zeros(1), np.ones(1)
    for k, derivative in enumerate(np.atleast_2d(motion), 1):
        factor = factor * t / k
        xi = xi + factor * derivative
    return se3.exp(xi)


def beyond(time: float, half: float, motion: Array) -> Array:
    """Like `poses` for one time (4, 4), for a motion known from -half to half s; outside, the twist is constant.

    A polynomial must not be extrapolated: half a sweep farther, one of third degree is degrees off.
    """
    end = float(np.clip(time, -half, half))
    twist = np.sum([end**k / factorial(k) * derivative for k, derivative in enumerate(np.atleast_2d(motion))], 0)
    return np.asarray(poses(end, motion) @ se3.exp((time - end) * twist))


def fitted(turn: Callable[[Array], Array | None], half: float) -> Array | None:
    """Derivatives at 0 (3, 3) of a rotation, as rotation vectors [rad/s, rad/s2, rad/s3], fitted from -half to half s.

    `turn` returns the rotations (M, 3, 3) at times (M,), or None; the result is None then."""
    times = np.linspace(-half, half, _N_FIT_TIMES)
    R = turn(times)
    if R is None:
        return None
    powers = np.stack([times, times**2 / 2, times**3 / 6], 1)
    return np.asarray(np.linalg.lstsq(powers, se3.rotation_vector(R), rcond=None)[0])


def moved(points: Cloud, times: NDArray[np.floating], along: Callable[[Array], Array]) -> Cloud:
    """Points (N, 3+), each measured at its time (N,), s, transformed to the sensor pose at time 0.

    Args:
        along: returns the poses (M, 4, 4) at times (M,).
    """
    if len(points) == 0:
        return points
    start, end = float(times.min()), float(times.max())
    step = (times.astype(np.float64) - start) * (_N_INTERVALS / max(end - start, 1e-9))
    return _transform_points(points, step, np.ascontiguousarray(along(np.linspace(start, end, _N_INTERVALS + 1))))


@compiled(
    [
        float32[:, ::1](READ_F4, float64[::1], float64[:, :, ::1]),
        float64[:, ::1](READ_F8, float64[::1], float64[:, :, ::1]),
    ]
)
def _transform_points(points: Cloud, step: Array, T: Array) -> Cloud:
    """`step` (N,): time of each point in units of the pose interval of T (M, 4, 4), with fractions."""
    out = points.copy()
    for n in range(len(points)):
        i = min(int(step[n]), len(T) - 2)
        fraction = step[n] - i
        for row in range(3):
            value = 0.0
            for column in range(4):
                weight = (1 - fraction) * T[i, row, column] + fraction * T[i + 1, row, column]
                value += weight * points[n, column] if column < 3 else weight
            out[n, row] = value
    return out
