# SPDX-License-Identifier: Apache-2.0
"""Which messages are associated with which cloud, for recordings and live topics. Pure rules: no ROS, clock or thread.

The cloud leads: every cloud is released once. It is released with the image, and the cloud of a second LiDAR, that is
nearest in time among the messages received before the release.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from dpm2_core.data.messages import serialized_stamp

JUMP = 1_000_000_000
"""ns. A stamp that goes back, or ahead of the elapsed time, by more than this is wrong, or time itself has jumped: a
looped bag, a clock that was set, a recording with a gap."""
AHEAD = 3
"""LiDAR periods by which a stamp may exceed the last stamp plus the time elapsed since then; `JUMP` at most. If the
stamp of one cloud is wrong by less than that, the next ones may have to catch up with it."""
FEW = 3
"""Largest number of consecutive stamps that may be wrong; more mean that the clock was set."""
LATE = 500_000_000
"""Longest time that a cloud of a recording is held back for other messages, ns of log time."""
SWEEP = 250_000_000
"""Longest time from a cloud's stamp to its last point, ns. IMU samples are needed up to that time."""
BUFFER = 32
"""Messages kept in addition to those that waiting clouds need. Bounds memory if no cloud arrives, or if stamps are
unusable."""

RawMessage = tuple[str, int, bytes]
"""Topic, log time (ns) and serialized message of a recording."""


class Beside:
    """Messages of one sensor other than the LiDAR that may be associated with a cloud, in the order received.

    Args:
        tolerance: largest difference of associated stamps, s.

    Attributes:
        last: stamp of the last message, ns.
    """

    def __init__(self, tolerance: float) -> None:
        self.tolerance = round(tolerance * 1e9)
        self.last = -float("inf")
        self._messages: deque[tuple[int, Any]] = deque()

    def add(self, stamp: int, message: Any, waiting: Sequence[int] = ()) -> None:
        """Add a message with its stamp (ns); `waiting`: stamps (ns) of clouds that are not released yet."""
        self.last = stamp
        self._messages.append((stamp, message))
        if len(self._messages) > BUFFER:
            stamps = np.array([stamp for stamp, _ in self._messages])
            needed = np.abs(stamps[:, None] - np.array(waiting, np.int64)).argmin(0)
            others = np.setdiff1d(np.arange(len(stamps)), needed)
            if len(others) > BUFFER:
                del self._messages[int(others[0])]

    def nearest(self, stamp: int) -> tuple[int, Any] | None:
        """Stamp (ns) and message nearest to a cloud's stamp (ns); None if none is within the tolerance."""
        found = min(self._messages, key=lambda message: abs(message[0] - stamp), default=None)
        return found if found is not None and abs(found[0] - stamp) <= self.tolerance else None

    def forget(self, stamp: int) -> None:
        """Drop messages too old for the clouds after the released one (stamp in ns), or from before a jump back."""
        while self._messages and not -self.tolerance <= self._messages[0][0] - stamp < JUMP:
            self._messages.popleft()


class SetBack:
    """Items with an earlier stamp than the item before, kept until they show that the clock was set back. That is so
    after more than `FEW` in a row, each stamped later than the one before."""

    def __init__(self) -> None:
        self._kept: list[tuple[int, Any]] = []

    def add(self, stamp: int, item: Any) -> list[Any]:
        """Add an item with its stamp (ns); returns all kept items once the clock is known to be set back, else none."""
        if self._kept and stamp <= self._kept[-1][0]:
            self._kept.clear()
        self._kept.append((stamp, item))
        if len(self._kept) <= FEW:
            return []
        return self.end()

    def end(self) -> list[Any]:
        """Called when an item arrives in order; returns the late items received before it."""
        items, self._kept = [item for _, item in self._kept], []
        return items


def is_due(passed: float, period: float) -> bool:
    """Whether the time passed since the last cloud (ns) is about one period, whatever the cloud's stamp is."""
    return 0.5 * period < passed < 1.5 * period


def passed(last: float, cloud: int) -> bool:
    """Whether a sensor with that last stamp (ns) will send no message closer to the cloud's stamp (ns)."""
    return cloud <= last < cloud + JUMP


def clouds_after_others(
    messages: Iterable[RawMessage],
    clouds: Collection[str],
    others: Mapping[str, int],
    waiting: deque[tuple[int, RawMessage]] | None = None,
) -> Iterator[RawMessage]:
    """The messages of a recording; each cloud is held back until all other sensors have passed its stamp, or for `LATE`
    at most.

    Args:
        messages: in recorded order.
        clouds: topics. others: topics of the other sensors, and the offset added to their stamps, ns.
        waiting: filled with the clouds that are held back, and their stamps (ns).
    """
    latest = dict.fromkeys(others, -float("inf"))
    waiting = deque() if waiting is None else waiting
    for message in messages:
        topic, time, data = message
        if topic in clouds:
            waiting.append((serialized_stamp(data, time), message))
        else:
            yield message
        if topic in latest:
            latest[topic] = serialized_stamp(data, time) + others[topic]
        while waiting and (
            time - waiting[0][1][1] >= LATE or all(passed(last, waiting[0][0]) for last in latest.values())
        ):
            yield waiting.popleft()[1]
    yield from (message for _, message in waiting)
