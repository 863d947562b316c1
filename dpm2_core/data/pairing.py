# SPDX-License-Identifier: Apache-2.0
"""What goes with which cloud, of a recording as of topics. Pure rules: no ROS, no clock, no thread.

The cloud leads: every cloud leaves once, with that image, and that cloud of a second LiDAR, which is nearest in time of
those that came before it left.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from dpm2_core.data.messages import serialized_stamp

JUMP = 1_000_000_000
"""ns by which a stamp goes back, or ahead beyond the time that has passed, only if it is wrong or time itself has
jumped: a looped bag, a clock that was set, a recording with a gap."""
AHEAD = 3
"""Periods of the LiDAR by which a stamp may exceed the last one and the time that has passed since; `JUMP` at most. If
the stamp of one cloud is wrong by less than that, the next ones may have to catch up with it."""
FEW = 3
"""Stamps in a row that may be off; more are of a clock that was set."""
LATE = 500_000_000
"""ns of log time that a cloud of a recording waits for what goes with it."""
SWEEP = 250_000_000
"""ns: so far beyond its stamp may the last point of a cloud be, up to which the IMU is wanted."""
BUFFER = 32
"""Messages kept beside those that waiting clouds need; bounds memory where no cloud comes, or the stamps are of no use.
"""

RawMessage = tuple[str, int, bytes]
"""Topic, log time (ns) and serialized message of a recording."""


class Beside:
    """Messages of one sensor beside the LiDAR that may belong to a cloud, in the order in which they came.

    Args:
        tolerance: greatest difference of stamps that belong together, s.

    Attributes:
        last: stamp of the last one, ns.
    """

    def __init__(self, tolerance: float) -> None:
        self.tolerance = round(tolerance * 1e9)
        self.last = -float("inf")
        self._messages: deque[tuple[int, Any]] = deque()

    def add(self, stamp: int, message: Any, waiting: Sequence[int] = ()) -> None:
        """Take one with its stamp (ns); `waiting`: stamps (ns) of the clouds that have come, and not left."""
        self.last = stamp
        self._messages.append((stamp, message))
        if len(self._messages) > BUFFER:
            stamps = np.array([stamp for stamp, _ in self._messages])
            needed = np.abs(stamps[:, None] - np.array(waiting, np.int64)).argmin(0)
            others = np.setdiff1d(np.arange(len(stamps)), needed)
            if len(others) > BUFFER:
                del self._messages[int(others[0])]

    def nearest(self, stamp: int) -> tuple[int, Any] | None:
        """Stamp (ns) and message for a cloud with that stamp (ns); None if none is within the tolerance."""
        found = min(self._messages, key=lambda message: abs(message[0] - stamp), default=None)
        return found if found is not None and abs(found[0] - stamp) <= self.tolerance else None

    def forget(self, stamp: int) -> None:
        """A cloud with that stamp (ns) has left: drop what is too old for the next, or from before time went back."""
        while self._messages and not -self.tolerance <= self._messages[0][0] - stamp < JUMP:
            self._messages.popleft()


class SetBack:
    """What has come with an earlier stamp than what came before, until it shows that the clock was set back: more than
    `FEW` in a row, each stamped later than the one before."""

    def __init__(self) -> None:
        self._late: list[tuple[int, Any]] = []

    def add(self, stamp: int, item: Any) -> list[Any]:
        """Take one with its stamp (ns); returns all of them once they show that, else none."""
        if self._late and stamp <= self._late[-1][0]:
            self._late.clear()
        self._late.append((stamp, item))
        if len(self._late) <= FEW:
            return []
        return self.end()

    def end(self) -> list[Any]:
        """One has come in order; returns what has come late before it."""
        items, self._late = [item for _, item in self._late], []
        return items


def is_due(passed: float, period: float) -> bool:
    """Whether a cloud comes about one period after the last, when so much has passed (ns), whatever its stamp says."""
    return 0.5 * period < passed < 1.5 * period


def passed(last: float, cloud: int) -> bool:
    """Whether a sensor whose last message has that stamp (ns) has none to come that is nearer to the cloud's (ns)."""
    return cloud <= last < cloud + JUMP


def clouds_after_others(
    messages: Iterable[RawMessage],
    clouds: Collection[str],
    others: Mapping[str, int],
    waiting: deque[tuple[int, RawMessage]] | None = None,
) -> Iterator[RawMessage]:
    """The messages of a recording, each cloud held back until every other sensor has passed it, or it has waited too
    long.

    Args:
        messages: in recorded order.
        clouds: topics. others: topics of the other sensors, with what is added to their stamps, ns.
        waiting: where the clouds that are held back are kept, with their stamps (ns).
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
