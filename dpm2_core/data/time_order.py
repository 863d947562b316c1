# SPDX-License-Identifier: Apache-2.0
"""Times of a recording that cannot be, by those around them."""

from __future__ import annotations

from bisect import bisect_left
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from dpm2_core.frame import Array

_FEW = 3  # in a row; more are a clock that was set


def out_of_order(times: Array) -> NDArray[np.bool_]:
    """Which of the times (N,) increase with the others only if they are changed: at most three in a row, between two
    that are in order. One that is 1 s off at 10 Hz comes after some later ones, or before some earlier ones."""
    ordered = np.zeros(len(times), bool)
    ordered[_longest_increasing(times)] = True
    ends = np.flatnonzero(ordered)
    off = np.zeros(len(times), bool)
    for before, after in pairwise(ends):
        off[before + 1 : after] = after - before <= _FEW + 1
    return off


def _longest_increasing(times: Array) -> list[int]:
    """Where the longest increasing subsequence of the times (N,) is, by patience sorting."""
    smallest, places, before = list[float](), list[int](), list[int]()
    for i, time in enumerate(times.tolist()):
        length = bisect_left(smallest, time)
        before.append(places[length - 1] if length else -1)
        smallest[length : length + 1], places[length : length + 1] = [time], [i]
    found, i = list[int](), places[-1] if places else -1
    while i >= 0:
        found.append(i)
        i = before[i]
    return found[::-1]
