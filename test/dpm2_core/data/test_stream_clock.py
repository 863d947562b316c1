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
    assert clock.now == pytest.approx(0.4)
    assert clock.stamp == 4_000_000_000


def test_a_stamp_that_was_late_is_no_short_period() -> None:
    """Nor are those of a burst, also not of two frames. A stream that gets faster is believed after three frames."""
    late, burst, together, faster = StreamClock(), StreamClock(), StreamClock(), StreamClock()
    stamps = (*range(0, 900, 100), 985, 1000, 1100)  # ms
    assert [late.advance(stamp * 10**6) for stamp in stamps] == pytest.approx([0.1] * 9 + [0.185, 0.1, 0.1])
    assert late.now == pytest.approx(1.1)
    stamps = (*range(0, 900, 100), 1260, 1270, 1280, 1290, 1300, 1400, 1460)
    periods = [burst.advance(stamp * 10**6) for stamp in stamps]
    assert periods == pytest.approx([0.1] * 9 + [0.46] + [0.1] * 5 + [0.06])
    assert burst.now == pytest.approx(1.46)
    stamps = (0, 1, 200, 201, 400, 401, 600, 601)
    assert [together.advance(stamp * 10**6) for stamp in stamps] == pytest.approx([0.1, 0.1] + [0.199, 0.1] * 3)
    stamps = (*range(0, 1000, 100), *range(940, 1150, 40))
    assert [faster.advance(stamp * 10**6) for stamp in stamps] == pytest.approx([0.1] * 13 + [0.04] * 3)


def test_a_stream_that_goes_on_faster_after_a_gap_is_believed_at_once() -> None:
    """15 Hz before a gap and 24 Hz after it counted as 15 Hz: half as fast again, and the track was lost for good."""
    clock = StreamClock()
    stamps = (*range(0, 660, 66), *range(3600, 3900, 42))  # ms
    periods = [clock.advance(stamp * 10**6) for stamp in stamps]
    assert periods[1:] == pytest.approx([0.066] * 9 + [3.006] + [0.042] * 7)


def test_one_frame_after_each_of_another_rhythm_is_as_its_stamp_says() -> None:
    """Two frames at a time are no pause between, and a gap or two in a stream still are."""
    clock = StreamClock()
    periods = [clock.advance((800 * i + j) * 10**6) for i in range(6) for j in (0, 100)]
    assert periods[1:] == pytest.approx([0.1, 0.7] * 5 + [0.1])
    assert clock.pause(0.65) == pytest.approx(1.05)
    regular = StreamClock()
    for tenth in (*range(8), 18, 19, 29):
        regular.advance(tenth * 10**8)
    assert regular.pause(0.65) == 0.65


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
