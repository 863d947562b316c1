# SPDX-License-Identifier: Apache-2.0
"""Start poses for the next scan, while no motion is known or where the predicted pose does not fit."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from dpm2_core.frame import Array
from dpm2_core.geometry import se3

# Motions [m along x, deg of yaw]: up to 110 km/h and 100 deg/s at 10 Hz.
_STRAIGHT = ((0.0, 0), (1.0, 0), (2.0, 0), (3.0, 0), (-1.0, 0))
_CURVES = tuple((x, yaw) for yaw in (4, -4, 8, -8) for x in (0.5, 1.5, 2.5))
_HEADINGS_PER_SIDE = 3  # to each side


def starts_from_rest(T: Array, turns: float) -> Iterator[list[Array]]:
    """Poses (4, 4) from which the scan after the one at `T` is searched: straight ahead; then, only if none of these
    fits well, also in curves and with rotations.

    Args:
        turns: see `OdometrySettings.turns`.
    """
    turning = tuple((0.0, yaw) for yaw in _headings(turns))
    for motions in (_STRAIGHT, _STRAIGHT + _CURVES + turning):
        yield [T @ se3.exp([0, 0, np.radians(yaw), x, 0, 0]) for x, yaw in motions]


def turned_starts(T: Array, T_before: Array, turns: float) -> Sequence[Array]:
    """Poses (4, 4) at the position of `T`: with the attitude of `T_before`, in case a swing has reversed, and with
    other headings, in case the robot turned on the spot."""
    T_back = se3.make(T_before[:3, :3], T[:3, 3])
    return [T_back, *(T @ se3.exp([0, 0, np.radians(yaw), 0, 0, 0]) for yaw in _headings(turns))]


def _headings(most: float) -> list[float]:
    """Rotations on the spot that are tried, deg."""
    return (
        [side * most * (i + 1) / _HEADINGS_PER_SIDE for i in range(_HEADINGS_PER_SIDE) for side in (1, -1)]
        if most
        else []
    )
