# SPDX-License-Identifier: Apache-2.0
"""How late the fixes of satellites are stamped: many receivers stamp them when they are sent.

A late fix lies behind, by the way of that time. Where a vehicle turns or changes its speed, that is no shift of the
map. The odometry of a few fixes alone shows it: an optimized map has been bent to them.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from dpm2_core.frame import Array

STRETCH = 20
"""Fixes in a row that are compared with the odometry."""
_FEWEST = 3  # stretches
_UNKNOWN = 0.2  # s, standard deviation before the way tells
_SURE = 4.0  # standard deviations from which on a lag counts
_LONGEST = 2.0  # s: no receiver needs longer
_OFF = 9.0  # squared standard deviations, on average, beyond which a stretch shows other errors than a lag
_ROUNDS = 5  # in which turn and lag of a stretch are found
_SLACK, _DRIFT = 0.05, 0.01  # m, and m per m from the middle of a stretch: the odometry errs, too


class Stretch(NamedTuple):
    """Some fixes in a row.

    Attributes:
        here, there: (K, 3) m, level, where the odometry has the antenna at their stamps, and where they have it, east,
            north, up; there may be a shift and a turn between the two.
        velocities: (K, 3) m/s of the antenna. sigmas: (K,) m, horizontal standard deviations of the fixes.
    """

    here: Array
    there: Array
    velocities: Array
    sigmas: Array


class Lag(NamedTuple):
    """What fixes show.

    Attributes:
        seconds: how late they are. sigma: its standard deviation, s. known: whether it is beyond doubt.
    """

    seconds: float
    sigma: float
    known: bool


def lag_of(stretches: Sequence[Stretch]) -> Lag:
    """How late the fixes of some stretches of a way are."""
    found = np.array([_told(stretch) for stretch in stretches]).reshape(-1, 2)
    information, pull = found.sum(0)
    seconds = pull / (information + 1 / _UNKNOWN**2)
    scatter = ((found[:, 1] - found[:, 0] * seconds) ** 2).sum()
    told = information**2 / max(information + scatter, 1e-9)  # by what is stated, and by how they differ
    sigma = float(1 / np.sqrt(told + 1 / _UNKNOWN**2))
    known = len(found) >= _FEWEST and _SURE * sigma < abs(seconds) < _LONGEST
    return Lag(float(seconds), sigma, bool(known))


def moved_by(stretches: Sequence[Stretch]) -> Array:
    """(6,) rad, m by how much a lag of 1 s moves the local frame in the map, about and along east, north, up."""
    moves = np.zeros(6)
    if stretches:
        A = _level(np.concatenate([stretch.here for stretch in stretches])[:, :2] @ [1, 1j])
        v = np.concatenate([stretch.velocities for stretch in stretches])[:, :2] @ [1, 1j]
        moves[2:5] = np.linalg.lstsq(np.concatenate([A.real, A.imag]), np.concatenate([v.real, v.imag]), rcond=None)[0]
    return moves


def _told(stretch: Stretch) -> tuple[float, float]:
    """Information on the lag, 1/s2, and that times the lag, 1/s, whatever the shift and the turn of the stretch."""
    parts = stretch.here - stretch.here.mean(0), stretch.there - stretch.there.mean(0), stretch.velocities
    at, to, v = (part[:, :2] @ [1, 1j] for part in parts)
    turn = np.exp(1j * np.angle(np.vdot(at, to)))
    weights = np.tile(1 / np.hypot(stretch.sigmas, _SLACK + _DRIFT * np.abs(at)), 2)[:, None]
    for _ in range(_ROUNDS):
        columns = np.column_stack([_level(turn * at), -turn * v, to - turn * at])
        A = np.concatenate([columns.real, columns.imag]) * weights
        B = np.concatenate([A, [[0, 0, 0, 1 / _UNKNOWN, 0]]])
        turn *= np.exp(1j * np.linalg.lstsq(B[:, :4], B[:, 4], rcond=None)[0][0])
    rest = A[:, 3:] - A[:, :3] @ np.linalg.lstsq(A[:, :3], A[:, 3:], rcond=None)[0]
    (information, pull), (_, square) = rest.T @ rest
    off = (square - pull**2 / (information + 1 / _UNKNOWN**2)) / len(A)
    worse = max(off, 1.0)  # than stated, as many receivers are
    return (information / worse, pull / worse) if off < _OFF else (0.0, 0.0)


def _level(at: NDArray[Any]) -> NDArray[np.complex128]:
    """(K, 3) where places (K,) go by a turn of 1 rad, and by 1 m east and north."""
    return np.stack([1j * at, np.ones(len(at)), np.full(len(at), 1j)], 1)
