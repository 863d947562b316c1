# SPDX-License-Identifier: Apache-2.0
"""Counts messages of a topic that were sent and never arrived. Pure logic: no ROS, no clock, no thread."""

from __future__ import annotations

from collections import deque
from statistics import median

_MIN_STEPS = 5
"""Number of steps of the stamps after which their period is known."""
_MIN_PAUSE = 20
"""Periods from which on a gap counts as a pause of the sensor or of the recorder, not as a loss."""
_PERIOD_TOLERANCE = 0.25
"""Periods by which a gap may differ from a whole number of periods."""


class Losses:
    """Counts the gaps in the publisher's sequence numbers, or, if the middleware has none, in the period of the stamps.

    The numbers are exact, also if the recording has pauses. Messages before the first one that arrives do not count as
    lost. If another publisher takes over, all messages that it has sent count.

    Attributes:
        count: messages lost so far.
    """

    def __init__(self) -> None:
        self.count = 0
        self._last_number: int | None = None
        self._last_stamp: int | None = None
        self._steps: deque[int] = deque(maxlen=50)  # ns

    def add(self, stamp: int, number: int | None) -> int:
        """Add a message that arrived; returns how many were lost between the previous one and this one.

        Args:
            stamp: ns.
            number: its publisher's sequence number; None if there is none, or if there are several publishers.
        """
        before, self._last_number = self._last_number, number
        lost = self._lost_by_stamp(stamp)
        if number is not None:
            lost = _missing_between(before, number)
        self.count += lost
        return lost

    def skip(self, number: int | None) -> None:
        """Note that a message with that number arrived but is not used: it is not lost."""
        if number is not None:
            self.count += _missing_between(self._last_number, number)
            self._last_number = number

    def _lost_by_stamp(self, stamp: int) -> int:
        """Number of lost messages, by the stamps only."""
        before, self._last_stamp = self._last_stamp, stamp
        step = 0 if before is None else stamp - before
        if step <= 0:  # the first, a repeated one, or a looped bag
            return 0
        periods = step / median(self._steps) if len(self._steps) >= _MIN_STEPS else 1.0
        self._steps.append(step)
        whole = round(periods)
        return whole - 1 if 1 < whole < _MIN_PAUSE and abs(periods - whole) <= _PERIOD_TOLERANCE else 0


def _missing_between(before: int | None, number: int) -> int:
    """Number of messages missing between two sequence numbers; another publisher begins at 1 again."""
    if before is None:
        return 0
    return number - 1 - (before if number > before else 0)
