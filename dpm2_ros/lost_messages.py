# SPDX-License-Identifier: Apache-2.0
"""How many messages of a topic were sent and never arrived. Pure logic: no ROS, no clock, no thread."""

from __future__ import annotations

from collections import deque
from statistics import median

_LEAST = 5
"""Steps of the stamps after which their period is known."""
_PAUSE = 20
"""Periods from which on nothing is known to be lost: the sensor, or whoever recorded it, has paused."""
_OFF = 0.25
"""Periods by which a gap may differ from a whole number of them."""


class Losses:
    """Counts the gaps: of the publisher's own numbers, or, where the middleware has none, of the stamps' rhythm.

    The numbers are exact, whatever the recording's pauses. Nothing is lost before the first message that arrives; of a
    publisher that takes the place of another all that it has sent was to arrive.

    Attributes:
        count: messages lost so far.
    """

    def __init__(self) -> None:
        self.count = 0
        self._number: int | None = None
        self._stamp: int | None = None
        self._steps: deque[int] = deque(maxlen=50)  # ns

    def add(self, stamp: int, number: int | None) -> int:
        """Take note of a message that arrived; returns how many were lost between the one before and this one.

        Args:
            stamp: ns.
            number: that its publisher gave it, by one more each time; None if it gave none, or if there are several.
        """
        before, self._number = self._number, number
        lost = self._step(stamp)
        if number is not None:
            lost = _between(before, number)
        self.count += lost
        return lost

    def skip(self, number: int | None) -> None:
        """A message with that number arrived, and is not used; so it is not lost."""
        if number is not None:
            self.count += _between(self._number, number)
            self._number = number

    def _step(self, stamp: int) -> int:
        """By the stamps alone."""
        before, self._stamp = self._stamp, stamp
        step = 0 if before is None else stamp - before
        if step <= 0:  # the first, a repeated one, or a looped bag
            return 0
        periods = step / median(self._steps) if len(self._steps) >= _LEAST else 1.0
        self._steps.append(step)
        whole = round(periods)
        return whole - 1 if 1 < whole < _PAUSE and abs(periods - whole) <= _OFF else 0


def _between(before: int | None, number: int) -> int:
    """How many messages are missing between two; another publisher begins at 1 again."""
    if before is None:
        return 0
    return number - 1 - (before if number > before else 0)
