# SPDX-License-Identifier: Apache-2.0
"""What a robot has still to send of a drive, by what the mapper acknowledges."""

from __future__ import annotations

import functools
from collections.abc import Set
from dataclasses import dataclass

from dpm2_ros.unsent import KeyframeFile

_SLOT, _MEMORY = 0.3, 0.8  # s; the mapper acknowledges twice a second
_PATIENCE, _ANNOUNCE = 1.5, 2.0  # s until a keyframe is sent again, and between two announcements
_CERTAIN = 2.0  # s for which every acknowledgment says that all have arrived, before a file is deleted


class Delivery:
    """The keyframes of a drive, and which of them the mapper has.

    Attributes:
        earlier: whether the drive is over, as after a new start.
    """

    def __init__(self, session: str, file: KeyframeFile, earlier: bool, now: float) -> None:
        self.session, self.file, self.earlier = session, file, earlier
        self._sent = [now] * len(file)  # when each was sent last; those of an earlier drive may have arrived already
        self._acks = Acks()
        self._announced = 0.0
        self._whole_since: float | None = None

    def append(self, parts: list[bytes], sent: float | None) -> None:
        """A new keyframe, sent at that time, s; None: not yet."""
        self.file.append(parts)
        self._sent.append(-float("inf") if sent is None else sent)
        self._announced = sent or self._announced

    @property
    def arrived(self) -> int:
        """How many the mapper has, in its map file or still in memory."""
        below, above = self._acks.agreed
        return below + len(above)

    @property
    def late(self) -> int:
        """How many are not in the mapper's map file, from the first gap on."""
        return len(self.file) - self._acks.agreed[0]

    def acknowledge(self, below: int, above: Set[int], now: float) -> None:
        """All ids below a number are in the map file; some above have arrived, too."""
        made = len(self.file)
        self._acks.add(min(below, made), {id for id in above if below <= id < made}, now)
        self._whole_since = None if self.late else self._whole_since or now

    def certain(self, now: float) -> bool:
        """Whether all are delivered, by more than one acknowledgment; of a drive without keyframes too."""
        if not len(self.file):
            return True
        return not self.late and self._whole_since is not None and now - self._whole_since > _CERTAIN

    def due(self, now: float, most: int) -> list[int]:
        """Ids to be sent now."""
        below, above = self._acks.agreed
        late = [id for id in range(below, len(self.file)) if id not in above and now - self._sent[id] > _PATIENCE]
        for id in late[:most]:
            self._sent[id] = now
        return late[:most]

    def announces(self, now: float) -> bool:
        """Whether the pose of the last one is due, so that the mapper knows how many there are."""
        if not len(self.file) or now - self._announced <= _ANNOUNCE:
            return False
        self._announced = now
        return True


class Acks:
    """What the mapper has: that on which all its acknowledgments of the last second agree.

    Anyone can send one. One that claims too little costs a keyframe sent twice; one that claims too much would
    cost the keyframe, so no single one is trusted.
    """

    def __init__(self) -> None:
        self._slots: list[_Slot] = []  # the oldest first

    @property
    def agreed(self) -> tuple[int, frozenset[int]]:
        """All ids below the number, and some above."""
        results = [(slot.below, slot.above) for slot in self._slots]
        return functools.reduce(_both, results) if results else (0, frozenset())

    def add(self, below: int, above: Set[int], now: float) -> None:
        """One that came at that time, s."""
        if not self._slots or now - self._slots[-1].begin > _SLOT:
            self._slots.append(_Slot(now, now, below, frozenset(above)))
        else:
            last = self._slots[-1]
            last.end = now
            last.below, last.above = _both((last.below, last.above), (below, frozenset(above)))
        self._slots = [slot for slot in self._slots if now - slot.end <= _MEMORY]


@dataclass(eq=False)
class _Slot:
    """Those that came between two times, s, and on what they agree."""

    begin: float
    end: float
    below: int
    above: frozenset[int]


def _both(a: tuple[int, frozenset[int]], b: tuple[int, frozenset[int]]) -> tuple[int, frozenset[int]]:
    less, more = sorted((a, b), key=lambda result: result[0])
    return less[0], frozenset(id for id in less[1] if id < more[0] or id in more[1])
