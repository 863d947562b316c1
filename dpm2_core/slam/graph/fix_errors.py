# SPDX-License-Identifier: Apache-2.0
"""Errors of satellite fixes that stay about the same for a while, so that they do not average out.

A receiver states how far each fix may be off, but not that the error stays for a minute, as long as it sees the same
satellites and reflections. From one fix to the next the odometry is much better than both, so that it shows which part
of the errors changes.
"""

from __future__ import annotations

import numpy as np

from dpm2_core.frame import Array
from dpm2_core.slam.graph.graph_data import Index

_MIN_FIXES = 5
_MEMORY = 60 * 10**9  # ns for which an error stays about the same
_DRIFT = 0.01  # m per m: error of the odometry
_MARGIN = 3.0  # standard deviations by which the errors may seem to change less than they do


def inflation(here: Array, there: Array, sigmas: Array, stamps: Index) -> Array:
    """(K,) factors by which the covariances of consecutive fixes must be larger than stated, so that together they
    constrain a map as much as they should.

    If no error changed, n fixes within the memory of the receiver would constrain it as much as one: the factor is n.
    Fixes between which the odometry drifts by more than their errors do not average out anyway.

    Args:
        here, there: (K, 3) m, level: antenna positions by the odometry, and by the fixes, in east, north, up.
        sigmas: (K,) m, horizontal standard deviations of the fixes. stamps: (K,) ns.
    """
    if len(here) < _MIN_FIXES:
        return np.ones(len(here))
    changes, stated = np.diff(there - here, axis=0)[:, :2], sigmas[1:] ** 2 + sigmas[:-1] ** 2
    # 2 log 2: the median of the squared length of two standard normal numbers.
    ratio = float(np.median((changes**2).sum(1) / stated)) / (2 * np.log(2))
    changing = min(1.0, ratio * (1 + _MARGIN / np.sqrt(len(changes))))
    distance = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(here, axis=0), axis=1)))
    count = np.minimum(_count_within(stamps, _MEMORY), _count_within(distance, sigmas / _DRIFT))
    return np.asarray(changing + (1 - changing) * count)


def _count_within(values: Array | Index, reach: Array | int) -> Index:
    """(K,) number of values within a reach of each, to either side."""
    ordered = np.sort(values)
    return np.searchsorted(ordered, values + reach, "right") - np.searchsorted(ordered, values - reach, "left")
