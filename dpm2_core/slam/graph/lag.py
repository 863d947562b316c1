# SPDX-License-Identifier: Apache-2.0
"""Lag of satellite fixes: many receivers stamp a fix when they send it, not when they measure it.

A late fix lies behind the true position by the distance driven in that time. Where a vehicle turns or changes its
speed, this differs from a shift of the map. Only the odometry over a few fixes shows the lag: an optimized map was
already bent to fit the fixes.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from dpm2_core.frame import Array

STRETCH = 20
"""Number of consecutive fixes that are compared with the odometry."""
_MIN_STRETCHES = 3
_PRIOR_SIGMA = 0.2  # s, standard deviation of the lag without data
_MIN_SIGNIFICANCE = 4.0  # standard deviations from which on a lag is used
_MAX_LAG = 2.0  # s: no receiver needs longer
_MAX_MEAN_CHI2 = 9.0  # mean squared standard deviations above which a stretch shows errors other than a lag
_ITERATIONS = 5  # for rotation and lag of a stretch
_SLACK, _DRIFT = 0.05, 0.01  # m, and m per m from the middle of a stretch: error of the odometry


class Stretch(NamedTuple):
    """Some consecutive fixes.

    Attributes:
        here, there: (K, 3) m, level: antenna positions at their stamps by the odometry, and by the fixes, in east,
            north, up; there may be a shift and a rotation between the two.
        velocities: (K, 3) m/s of the antenna. sigmas: (K,) m, horizontal standard deviations of the fixes.
    """

    here: Array
    there: Array
    velocities: Array
    sigmas: Array


class Lag(NamedTuple):
    """The estimated lag of fixes.

    Attributes:
        seconds: the lag. sigma: its standard deviation, s. known: whether it is significant.
    """

    seconds: float
    sigma: float
    known: bool


def lag_of(stretches: Sequence[Stretch]) -> Lag:
    """The lag of the fixes of some stretches of a trajectory."""
    found = np.array([_lag_information(stretch) for stretch in stretches]).reshape(-1, 2)
    information, weighted_lag = found.sum(0)
    seconds = weighted_lag / (information + 1 / _PRIOR_SIGMA**2)
    scatter = ((found[:, 1] - found[:, 0] * seconds) ** 2).sum()
    # By the stated errors, and by the scatter of stretches.
    effective_information = information**2 / max(information + scatter, 1e-9)
    sigma = float(1 / np.sqrt(effective_information + 1 / _PRIOR_SIGMA**2))
    known = len(found) >= _MIN_STRETCHES and _MIN_SIGNIFICANCE * sigma < abs(seconds) < _MAX_LAG
    return Lag(float(seconds), sigma, bool(known))


def moved_by(stretches: Sequence[Stretch]) -> Array:
    """(6,) rad, m: motion of the local frame in the map by a lag of 1 s, about and along east, north, up."""
    moves = np.zeros(6)
    if stretches:
        A = _planar_jacobian(np.concatenate([stretch.here for stretch in stretches])[:, :2] @ [1, 1j])
        v = np.concatenate([stretch.velocities for stretch in stretches])[:, :2] @ [1, 1j]
        moves[2:5] = np.linalg.lstsq(np.concatenate([A.real, A.imag]), np.concatenate([v.real, v.imag]), rcond=None)[0]
    return moves


def _lag_information(stretch: Stretch) -> tuple[float, float]:
    """Information on the lag, 1/s2, and that times the lag, 1/s, for any shift and rotation of the stretch."""
    parts = stretch.here - stretch.here.mean(0), stretch.there - stretch.there.mean(0), stretch.velocities
    here, there, v = (part[:, :2] @ [1, 1j] for part in parts)
    rotation = np.exp(1j * np.angle(np.vdot(here, there)))
    weights = np.tile(1 / np.hypot(stretch.sigmas, _SLACK + _DRIFT * np.abs(here)), 2)[:, None]
    for _ in range(_ITERATIONS):
        columns = np.column_stack([_planar_jacobian(rotation * here), -rotation * v, there - rotation * here])
        A = np.concatenate([columns.real, columns.imag]) * weights
        B = np.concatenate([A, [[0, 0, 0, 1 / _PRIOR_SIGMA, 0]]])
        rotation *= np.exp(1j * np.linalg.lstsq(B[:, :4], B[:, 4], rcond=None)[0][0])
    residuals = A[:, 3:] - A[:, :3] @ np.linalg.lstsq(A[:, :3], A[:, 3:], rcond=None)[0]
    (information, weighted_lag), (_, square) = residuals.T @ residuals
    mean_chi2 = (square - weighted_lag**2 / (information + 1 / _PRIOR_SIGMA**2)) / len(A)
    inflation = max(mean_chi2, 1.0)  # errors larger than stated, as of many receivers
    return (information / inflation, weighted_lag / inflation) if mean_chi2 < _MAX_MEAN_CHI2 else (0.0, 0.0)


def _planar_jacobian(positions: NDArray[Any]) -> NDArray[np.complex128]:
    """(K, 3) displacement of positions (K,) by a rotation of 1 rad, and by 1 m east and north."""
    return np.stack([1j * positions, np.ones(len(positions)), np.full(len(positions), 1j)], 1)
