# SPDX-License-Identifier: Apache-2.0
"""Detects and corrects wrong times in a recording from the times around them."""

from __future__ import annotations

from bisect import bisect_left
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from itertools import islice, pairwise
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from dpm2_core.data.messages import STAMP_END, restamped, serialized_stamp
from dpm2_core.data.pairing import FEW, RawMessage
from dpm2_core.data.source import Source, note_once
from dpm2_core.frame import Array, Frame

Item = TypeVar("Item")

_HALF_WINDOW = 2 * FEW + 1  # clouds on either side that show which stamps are wrong: more than can be wrong


def out_of_order(times: Array) -> NDArray[np.bool_]:
    """Which of the times (N,) must be changed to make all times increase: at most three in a row, between two times in
    order. For example, a stamp that is 1 s off at 10 Hz is after some later stamps, or before some earlier ones."""
    ordered = np.zeros(len(times), bool)
    ordered[_longest_increasing(times)] = True
    kept = np.flatnonzero(ordered)
    wrong = np.zeros(len(times), bool)
    for before, after in pairwise(kept):
        wrong[before + 1 : after] = after - before <= FEW + 1
    return wrong


def in_order(messages: Iterable[RawMessage], topic: str, corrected: Callable[[int, int], None]) -> Iterator[RawMessage]:
    """The messages of a recording; wrong stamps of clouds on a topic are replaced by stamps between their neighbors'.

    A stamp that is repeated stays: it may be the same cloud twice.

    Args:
        messages: in recorded order; up to seven clouds, and the messages between them, are held back.
        corrected: called with the number of each such cloud, and its original stamp, ns.
    """

    def stamp_of(message: RawMessage) -> int | None:
        return serialized_stamp(message[2], message[1]) if message[0] == topic else None

    return _items_in_order(messages, stamp_of, lambda m, stamp: (m[0], m[1], restamped(m[2], stamp)), corrected)


def frames_in_order(source: Source, start: int, stop: int, corrected: Callable[[int, int], None]) -> Iterator[Frame]:
    """The same for frames start..stop-1 of a drive, also using the frames around them; a bag is corrected already."""
    if getattr(source, "in_order", False):
        return source.frames(start, stop)
    first = max(start - _HALF_WINDOW, 0)
    frames = _items_in_order(
        source.frames(first, stop + _HALF_WINDOW),
        lambda frame: frame.stamp,
        lambda frame, stamp: replace(frame, stamp=stamp),
        lambda number, stamp: corrected(first + number, stamp) if first + number >= start else None,
    )
    return islice(frames, start - first, stop - first if stop < len(source) else None)


def note_corrected(notes: list[str], number: int, stamp: int, whose: str = "") -> None:
    """Add a note, once, that stamps (ns) were corrected, with the first one and the number of its frame."""
    what = f"{whose}stamps that are not between their neighbors are interpolated"
    note_once(notes, what, f"the first at frame {number}: {stamp * 1e-9:.3f} s")


def _items_in_order(
    items: Iterable[Item],
    stamp_of: Callable[[Item], int | None],
    restamp: Callable[[Item, int], Item],
    corrected: Callable[[int, int], None],
) -> Iterator[Item]:
    """`stamp_of`: ns, or None for items that are not clouds."""
    held, stamps, decided, number = deque[tuple[Item, int | None]](), deque[int](), 0, 0

    def release_next() -> Iterator[Item]:
        """Release all items up to the first cloud that is held."""
        nonlocal decided, number
        while held[0][1] is None:
            yield held.popleft()[0]
        item, stamp = held.popleft()[0], _corrected_stamp(stamps, decided)
        if stamp != stamps[decided]:
            corrected(number, stamps[decided])
            stamps[decided], item = stamp, restamp(item, stamp)
        yield item
        decided, number = decided + 1, number + 1
        if decided > _HALF_WINDOW:
            stamps.popleft()
            decided -= 1

    for item in items:
        if (new_stamp := stamp_of(item)) is None and not held:
            yield item
            continue
        held.append((item, new_stamp))
        if new_stamp is not None:
            stamps.append(new_stamp)
            if len(stamps) - decided > _HALF_WINDOW:
                yield from release_next()
    while decided < len(stamps):
        yield from release_next()
    yield from (item for item, _ in held)


def _corrected_stamp(stamps: Sequence[int], index: int) -> int:
    """The stamp (ns) of one of several consecutive clouds, interpolated from its neighbors if it is wrong."""
    window = list(stamps)
    increase = [before < after for before, after in pairwise(window)]
    repeated = window[index] in window[max(index - 1, 0) : index] + window[index + 1 : index + 2]
    if all(increase) or repeated:
        return window[index]
    relative = np.array([stamp - window[0] for stamp in window], np.float64)  # differences may exceed 64 bits
    wrong = out_of_order(relative)
    known = np.flatnonzero(~wrong)
    stamp = window[0] + round(np.interp(index, known, relative[known]))
    return stamp if wrong[index] and stamp < STAMP_END else window[index]


def _longest_increasing(times: Array) -> list[int]:
    """Indices of the longest increasing subsequence of the times (N,), by patience sorting."""
    tails, tail_indices, predecessors = list[float](), list[int](), list[int]()
    for i, time in enumerate(times.tolist()):
        length = bisect_left(tails, time)
        predecessors.append(tail_indices[length - 1] if length else -1)
        tails[length : length + 1], tail_indices[length : length + 1] = [time], [i]
    found, i = list[int](), tail_indices[-1] if tail_indices else -1
    while i >= 0:
        found.append(i)
        i = predecessors[i]
    return found[::-1]
