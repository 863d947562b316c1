# SPDX-License-Identifier: Apache-2.0
"""Times of a recording that cannot be, by those around them."""

from __future__ import annotations

from bisect import bisect_left
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from dpm2_core.data.messages import STAMP_END, restamped, serialized_stamp
from dpm2_core.data.pairing import RawMessage
from dpm2_core.frame import Array

_FEW = 3  # in a row; more are a clock that was set
_AROUND = 2 * _FEW + 1  # clouds on either side that show which of the stamps between them are off: more than may be


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


def in_order(messages: Iterable[RawMessage], topic: str, corrected: Callable[[int, int], None]) -> Iterator[RawMessage]:
    """The messages of a recording, those clouds of a topic whose stamps are off with stamps between their neighbors'.

    A stamp that is repeated stays: it may be the same cloud twice.

    Args:
        messages: in recorded order; up to seven clouds, and what came between them, are held back.
        corrected: is told the number of each such cloud, and the stamp that it had, ns.
    """
    held, stamps, decided, number = deque[RawMessage](), deque[int](), 0, 0

    def decide() -> Iterator[RawMessage]:
        """All up to the first cloud that is held."""
        nonlocal decided, number
        while held[0][0] != topic:
            yield held.popleft()
        _, time, data = held.popleft()
        stamp = _in_place(stamps, decided)
        if stamp != stamps[decided]:
            corrected(number, stamps[decided])
            stamps[decided], data = stamp, restamped(data, stamp)
        yield topic, time, data
        decided, number = decided + 1, number + 1
        if decided > _AROUND:
            stamps.popleft()
            decided -= 1

    for message in messages:
        if not held and message[0] != topic:
            yield message
            continue
        held.append(message)
        if message[0] == topic:
            stamps.append(serialized_stamp(message[2], message[1]))
            if len(stamps) - decided > _AROUND:
                yield from decide()
    while decided < len(stamps):
        yield from decide()
    yield from held


def _in_place(stamps: Sequence[int], which: int) -> int:
    """The stamp (ns) of one of some clouds in a row, put between its neighbors where it is off."""
    near = list(stamps)
    increase = [before < after for before, after in pairwise(near)]
    repeated = near[which] in near[max(which - 1, 0) : which] + near[which + 1 : which + 2]
    if all(increase) or repeated:
        return near[which]
    since = np.array([stamp - near[0] for stamp in near], np.float64)  # whose differences may have more than 64 bits
    off = out_of_order(since)
    known = np.flatnonzero(~off)
    stamp = near[0] + round(np.interp(which, known, since[known]))
    return stamp if off[which] and stamp < STAMP_END else near[which]


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
