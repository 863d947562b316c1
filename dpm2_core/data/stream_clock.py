# SPDX-License-Identifier: Apache-2.0
"""The time of a stream of frames from their stamps: time since the last frame, and which silence is a pause."""

from __future__ import annotations

from collections import deque

from dpm2_core.data.pairing import JUMP

NOMINAL = 0.1
"""Period assumed for a stream of unknown period, s."""
_MIN_PERIOD = 0.005  # s: shortest period of any stream; frames that were stamped on arrival, together, can be closer
SLOWEST = 2.0
"""Longest period of any stream, s."""
DOUBTED = 0.8, 1.25
"""Bounds, in usual periods: a period outside may be due to stamps taken on arrival."""
_N_PERIODS = 9  # periods that show the usual intervals of the stream, of which quartiles are taken


class StreamClock:
    """Advances with every frame.

    Attributes:
        stamp: stamp of the last frame, ns; None before the first. now: s since the first frame.
        went_back: whether a stamp was more than a second before the last one: a clock that was set, or another drive,
            as in a looped bag. It stays set until the caller resets it.
    """

    def __init__(self) -> None:
        self.stamp: int | None = None
        self.now = 0.0
        self.went_back = False
        self._jumped_from: int | None = None
        self._assumed_period = NOMINAL  # s, period counted for the jump
        self._periods: deque[float] = deque(maxlen=_N_PERIODS)

    def advance(self, stamp: int) -> float:
        """Seconds since the frame before; stamps that repeat or jump back count as one usual period.

        If only one stamp jumped back, the next one is later than the stamp before the jump, and is measured from that.
        """
        dt = 0.0 if self.stamp is None else (stamp - self.stamp) * 1e-9
        if self._jumped_from is not None and stamp > self._jumped_from:
            dt = (stamp - self._jumped_from) * 1e-9 - self._assumed_period
        self._jumped_from = self.stamp if self.stamp is not None and stamp < self.stamp else None
        self.went_back |= dt < -JUMP * 1e-9
        if dt < _MIN_PERIOD:
            dt = self._assumed_period = self.usual or NOMINAL
        if self.stamp is not None:
            self.now += dt
            self._periods.append(dt)
        self.stamp = stamp
        return dt

    def correct(self, dt: float) -> None:
        """Set the last period to `dt`, s, whatever the stamps are."""
        if self._periods:
            self._periods[-1] = dt

    @property
    def usual(self) -> float:
        """Period of the stream, s; 0 before it is known."""
        return self._quartile(2) if len(self._periods) > 4 else 0.0

    def pause(self, least: float) -> float:
        """Seconds without a registration that count as a pause: `least`, or 1.5 periods if the stream is slow.

        One or two long periods of nine are gaps; more are normal for the stream, for example if frames come in pairs.
        """
        if len(self._periods) > 1:
            return max(least, 1.5 * self._quartile(3))
        return SLOWEST  # it is not known yet whether that is a pause or normal for the stream

    def _quartile(self, number: int) -> float:
        return sorted(self._periods)[(len(self._periods) - 1) * number // 4]
