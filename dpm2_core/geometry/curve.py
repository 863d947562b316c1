# SPDX-License-Identifier: Apache-2.0
"""The way of a sensor around a moment: a curve that is a polynomial in time, in the tangent space of its pose then."""

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

_STEPS = 32  # along a sweep, between which its points are moved in a straight line: 0.03 mm at 3 rad/s, 20 m away
_FITTED = 11  # times
Cloud = TypeVar("Cloud", NDArray[np.float32], Array)


def poses(times: ArrayLike, motion: Array) -> Array:
    """(..., 4, 4) poses at times (...), s, as seen from where the sensor was at 0.

    Args:
        motion: (K, 6) the twist at 0 [rad/s, m/s] and its derivatives by time; a twist (6,) alone is constant.
    """
    t = np.asarray(times, np.float64)[..., None]
    way, part = np.zeros(1), np.ones(1)
    for k, derivative in enumerate(np.atleast_2d(motion), 1):
        part = part * t / k
        way = way + part * derivative
    return se3.exp(way)


def beyond(time: float, half: float, motion: Array) -> Array:
    """As `poses` at one time (4, 4), of a motion that is known from -half to half s: before and after that steady.

    Away from where it was found a polynomial is of no use: half a sweep farther one of third degree is degrees off.
    """
    end = float(np.clip(time, -half, half))
    twist = np.sum([end**k / factorial(k) * derivative for k, derivative in enumerate(np.atleast_2d(motion))], 0)
    return np.asarray(poses(end, motion) @ se3.exp((time - end) * twist))


def fitted(turn: Callable[[Array], Array | None], half: float) -> Array | None:
    """The derivatives at 0 (3, 3) of the rotation of a motion, as rotation vectors [rad/s, rad/s2, rad/s3], that is
    nearest to a `turn`, rotations (M, 3, 3) at times (M,), from -half to half s; None where it says nothing."""
    times = np.linspace(-half, half, _FITTED)
    R = turn(times)
    if R is None:
        return None
    powers = np.stack([times, times**2 / 2, times**3 / 6], 1)
    return np.asarray(np.linalg.lstsq(powers, se3.rotation_vector(R), rcond=None)[0])


def moved(points: Cloud, times: NDArray[np.floating], along: Callable[[Array], Array]) -> Cloud:
    """Points (N, 3+), each seen by the sensor at its time (N,), s, as seen from where it was at 0.

    Args:
        along: gives the poses (M, 4, 4) at times (M,).
    """
    if len(points) == 0:
        return points
    start, end = float(times.min()), float(times.max())
    step = (times.astype(np.float64) - start) * (_STEPS / max(end - start, 1e-9))
    return _moved(points, step, np.ascontiguousarray(along(np.linspace(start, end, _STEPS + 1))))


@compiled(
    [
        float32[:, ::1](READ_F4, float64[::1], float64[:, :, ::1]),
        float64[:, ::1](READ_F8, float64[::1], float64[:, :, ::1]),
    ]
)
def _moved(points: Cloud, step: Array, T: Array) -> Cloud:
    """`step` (N,): how many of the poses T (M, 4, 4) were passed when a point was seen, with fractions."""
    out = points.copy()
    for n in range(len(points)):
        i = min(int(step[n]), len(T) - 2)
        after = step[n] - i
        for row in range(3):
            value = 0.0
            for column in range(4):
                weight = (1 - after) * T[i, row, column] + after * T[i + 1, row, column]
                value += weight * points[n, column] if column < 3 else weight
            out[n, row] = value
    return out
