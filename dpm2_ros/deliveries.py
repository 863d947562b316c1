# SPDX-License-Identifier: Apache-2.0
"""Which keyframes of a drive a robot still has to send, by the mapper's acknowledgments."""

from __future__ import annotations

import functools
from collections.abc import Set
from dataclasses import dataclass

from dpm2_ros.unsent import KeyframeFile

_SLOT_DURATION, _MAX_ACK_AGE = 0.3, 0.8  # s; the mapper acknowledges twice per second
_RESEND_PERIOD, _ANNOUNCE_PERIOD = 1.5, 2.0  # s until a keyframe is sent again, and between two announcements
_CONFIRMATION_TIME = 2.0  # s for which every acknowledgment must confirm all keyframes, before a file is deleted


class Delivery:
    """The keyframes of a drive, and which of them the mapper has.

    Attributes:
        earlier: whether the drive is over, as after a restart.
    """

    def __init__(self, session: str, file: KeyframeFile, earlier: bool, now: float) -> None:
        self.session, self.file, self.earlier = session, file, earlier
        self._sent_at = [now] * len(file)  # when each was sent last; those of an earlier drive may have arrived already
        self._acks = Acks()
        self._announced_at = 0.0
        self._complete_since: float | None = None

    def append(self, parts: list[bytes], sent: float | None) -> None:
        """Add a new keyframe that was sent at that time, s; None: not sent yet."""
        self.file.append(parts)
        self._sent_at.append(-float("inf") if sent is None else sent)
        self._announced_at = sent or self._announced_at

    @property
    def arrived(self) -> int:
        """Number of keyframes that the mapper has, in its map file or still in memory."""
        below, above = self._acks.agreed
        return below + len(above)

    @property
    def late(self) -> int:
        """Number of keyframes from the first one on that is not in the mapper's map file."""
        return len(self.file) - self._acks.agreed[0]

    def acknowledge(self, below: int, above: Set[int], now: float) -> None:
        """Process an acknowledgment: all ids below a number are in the map file, some above have arrived, too."""
        count = len(self.file)
        self._acks.add(min(below, count), {id for id in above if below <= id < count}, now)
        self._complete_since = None if self.late else self._complete_since or now

    def certain(self, now: float) -> bool:
        """Whether all keyframes are delivered, by more than one acknowledgment. True of a drive without keyframes."""
        if not len(self.file):
            return True
        return not self.late and self._complete_since is not None and now - self._complete_since > _CONFIRMATION_TIME

    def due(self, now: float, max_count: int) -> list[int]:
        """Ids of keyframes to be sent now, at most `max_count`."""
        below, above = self._acks.agreed
        late = [
            id for id in range(below, len(self.file)) if id not in above and now - self._sent_at[id] > _RESEND_PERIOD
        ]
        for id in late[:max_count]:
            self._sent_at[id] = now
        return late[:max_count]

    def announces(self, now: float) -> bool:
        """Whether the pose of the last keyframe is due, by which the mapper knows how many there are."""
        if not len(self.file) or now - self._announced_at <= _ANNOUNCE_PERIOD:
            return False
        self._announced_at = now
        return True


class Acks:
    """The keyframes that the mapper has: those on which all its acknowledgments of the last second agree.

    Any process can send an acknowledgment. If it claims too little, a keyframe is sent twice; if it claims too much, a
    keyframe would be lost. So no single one is trusted.
    """

    def __init__(self) -> None:
        self._slots: list[_Slot] = []  # the oldest first

    @property
    def agreed(self) -> tuple[int, frozenset[int]]:
        """All ids below the number, and some above."""
        results = [(slot.below, slot.above) for slot in self._slots]
        return functools.reduce(_intersection, results) if results else (0, frozenset())

    def add(self, below: int, above: Set[int], now: float) -> None:
        """Add an acknowledgment that arrived at that time, s."""
        if not self._slots or now - self._slots[-1].begin > _SLOT_DURATION:
            self._slots.append(_Slot(now, now, below, frozenset(above)))
        else:
            last = self._slots[-1]
            last.end = now
            last.below, last.above = _intersection((last.below, last.above), (below, frozenset(above)))
        self._slots = [slot for slot in self._slots if now - slot.end <= _MAX_ACK_AGE]


@dataclass(eq=False)
class _Slot:
    """The acknowledgments that arrived between two times, s, and the ids on which they agree."""

    begin: float
    end: float
    below: int
    above: frozenset[int]


def _intersection(a: tuple[int, frozenset[int]], b: tuple[int, frozenset[int]]) -> tuple[int, frozenset[int]]:
    smaller, larger = sorted((a, b), key=lambda result: result[0])
    return smaller[0], frozenset(id for id in smaller[1] if id < larger[0] or id in larger[1])
