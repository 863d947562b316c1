# SPDX-License-Identifier: Apache-2.0
"""What counts as time and as a pause, by the stamps alone."""

from __future__ import annotations

import pytest

from dpm2_core.data.stream_clock import StreamClock


def test_stamps_that_do_not_advance_count_as_a_period() -> None:
    clock = StreamClock()
    assert [clock.advance(stamp) for stamp in (5_000_000_000, 5_200_000_000, 5_200_000_000, 4_000_000_000)] == (
        pytest.approx([0.1, 0.2, 0.1, 0.1])
    )
    assert clock.now == pytest.approx(0.5)
    assert clock.stamp == 4_000_000_000


def test_a_pause_is_longer_than_the_rhythm_of_the_stream() -> None:
    """A stream of one frame per second does not pause each second; before two periods its rhythm is not known."""
    clock = StreamClock()
    for second in range(2):
        clock.advance(second * 10**9)
        assert clock.pause(0.65) == 2.0
    for second in range(2, 6):
        clock.advance(second * 10**9)
        assert clock.pause(0.65) == pytest.approx(1.5)
    for tenth in range(1, 12):
        clock.advance(5 * 10**9 + tenth * 10**8)
    assert clock.pause(0.65) == 0.65
