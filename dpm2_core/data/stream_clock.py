# SPDX-License-Identifier: Apache-2.0
"""The time of a stream of frames, by their stamps: how long ago the last one was, and which silence is a pause."""

from __future__ import annotations

from collections import deque

_PERIOD = 0.1  # s, assumed between two stamps that do not advance
_FASTEST = 0.005  # s: no stream has a shorter period; frames that arrived together and were stamped then have
SLOWEST = 2.0
"""No stream has a longer period, s."""
_RHYTHM = 9  # periods: the rhythm of the stream, most of it between their quartiles


class StreamClock:
    """Goes on with every frame.

    Attributes:
        stamp: of the last frame, ns; None before the first. now: s since the first frame.
        late: s by which the frame before the last one was late, as the last one shows.
    """

    def __init__(self) -> None:
        self.stamp: int | None = None
        self.now = self.late = 0.0
        self._periods: deque[float] = deque(maxlen=_RHYTHM)
        self._behind, self._in_burst = 0.0, False

    def advance(self, stamp: int) -> float:
        """Seconds since the frame before; stamps that repeat or jump back count as one nominal period.

        A driver or network that holds frames back, stamped on arrival, makes the periods after it short: what moves as
        far as in a period is not to count as so much faster. So do periods below 0.6 of the usual count as usual, until
        they have made up for the time before them; without such a time they are believed after three.
        """
        dt = 0.0 if self.stamp is None else (stamp - self.stamp) * 1e-9
        if dt < _FASTEST:
            dt = _PERIOD
        if self.stamp is not None:
            dt = self._without_bursts(dt)
            self.now += dt - self.late
        self.stamp = stamp
        return dt

    def _without_bursts(self, dt: float) -> float:
        usual = self._quartile(1) if len(self._periods) > 3 else dt  # fewer are no rhythm
        if dt >= 0.6 * usual:
            self._periods.append(dt)
            self._behind, self._in_burst, self.late = min(dt - usual, _RHYTHM * usual), False, 0.0
            return dt
        self.late = 0.0 if self._in_burst else max(self._behind, 0.0)
        self._in_burst = True
        if self._behind < 0.5 * (usual - dt):
            self._periods.append(dt)
        self._behind -= usual - dt
        return usual

    def pause(self, least: float) -> float:
        """Seconds without a registration that are a pause: `least`, or 1.5 periods where the stream is slow.

        One or two long ones of nine are gaps; more are the rhythm of the stream, as where two frames come at a time.
        """
        if len(self._periods) > 1:
            return max(least, 1.5 * self._quartile(3))
        return SLOWEST  # whether that is a pause or the rhythm of the stream is not known yet

    def _quartile(self, which: int) -> float:
        return sorted(self._periods)[(len(self._periods) - 1) * which // 4]
