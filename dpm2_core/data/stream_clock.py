# SPDX-License-Identifier: Apache-2.0
"""The time of a stream of frames, by their stamps: how long ago the last one was, and which silence is a pause."""

from __future__ import annotations

from collections import deque

from dpm2_core.data.pairing import JUMP

NOMINAL = 0.1
"""Period of a stream of which none is known, s."""
_FASTEST = 0.005  # s: no stream has a shorter period; frames that arrived together and were stamped then have
SLOWEST = 2.0
"""No stream has a longer period, s."""
DOUBTED = 0.8, 1.25
"""Of the usual period: one beyond may be due to stamps of arrival."""
_RHYTHM = 9  # periods: the rhythm of the stream, most of it between their quartiles


class StreamClock:
    """Goes on with every frame.

    Attributes:
        stamp: of the last frame, ns; None before the first. now: s since the first frame.
        went_back: whether a stamp was more than a second before the last one: a clock that was set, or another drive,
            as where a bag was looped. It stays so until whoever has looked at it takes it back.
    """

    def __init__(self) -> None:
        self.stamp: int | None = None
        self.now = 0.0
        self.went_back = False
        self._jumped_from: int | None = None
        self._counted = NOMINAL  # s, for the jump
        self._periods: deque[float] = deque(maxlen=_RHYTHM)

    def advance(self, stamp: int) -> float:
        """Seconds since the frame before; stamps that repeat or jump back count as one usual period.

        Where only one stamp jumped back, the next is later than the one before it, from which it is then measured.
        """
        dt = 0.0 if self.stamp is None else (stamp - self.stamp) * 1e-9
        if self._jumped_from is not None and stamp > self._jumped_from:
            dt = (stamp - self._jumped_from) * 1e-9 - self._counted
        self._jumped_from = self.stamp if self.stamp is not None and stamp < self.stamp else None
        self.went_back |= dt < -JUMP * 1e-9
        if dt < _FASTEST:
            dt = self._counted = self.usual or NOMINAL
        if self.stamp is not None:
            self.now += dt
            self._periods.append(dt)
        self.stamp = stamp
        return dt

    def correct(self, dt: float) -> None:
        """The last period was so long, s, whatever its stamps say."""
        if self._periods:
            self._periods[-1] = dt

    @property
    def usual(self) -> float:
        """Period of the stream, s; 0 before it is known."""
        return self._quartile(2) if len(self._periods) > 4 else 0.0

    def pause(self, least: float) -> float:
        """Seconds without a registration that are a pause: `least`, or 1.5 periods where the stream is slow.

        One or two long ones of nine are gaps; more are the rhythm of the stream, as where two frames come at a time.
        """
        if len(self._periods) > 1:
            return max(least, 1.5 * self._quartile(3))
        return SLOWEST  # whether that is a pause or the rhythm of the stream is not known yet

    def _quartile(self, which: int) -> float:
        return sorted(self._periods)[(len(self._periods) - 1) * which // 4]
