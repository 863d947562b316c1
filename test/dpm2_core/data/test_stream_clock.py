# SPDX-License-Identifier: Apache-2.0
"""Time and pauses, determined from the stamps alone."""

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


def test_two_stamps_of_a_fast_stream_that_come_close_count_as_one_of_its_periods() -> None:
    """At 100 Hz, stamped on arrival. Previously, two stamps that were 4 ms apart counted as 0.1 s."""
    clock = StreamClock()
    for stamp in range(0, 100, 10):
        clock.advance(stamp * 10**6)
    assert [clock.advance(stamp * 10**6) for stamp in (106, 110, 120)] == pytest.approx([0.016, 0.01, 0.01])


def test_of_a_fast_stream_a_stamp_that_jumps_back_counts_as_one_of_its_periods() -> None:
    clock = StreamClock()
    stamps = [*range(0, 500, 50), 100, 550, 600]
    assert [clock.advance(stamp * 10**6) for stamp in stamps][-3:] == pytest.approx([0.05] * 3)


@pytest.mark.parametrize("back", [150, 300, 1000, 5000, 3_600_000])
def test_one_stamp_that_jumps_back_makes_no_pause(back: int) -> None:
    """Back by `back` ms. A clock that is set back continues from there."""
    clock = StreamClock()
    stamps = [1000, 1100, 1200 - back, 1300, 1400, 1500 - back, 1600 - back, 1700 - back]
    assert [clock.advance(stamp * 10**6) for stamp in stamps] == pytest.approx([0.1] * 8)
    assert clock.now == pytest.approx(0.7)


def test_one_stamp_of_a_fast_stream_that_jumps_back_makes_no_pause() -> None:
    clock = StreamClock()
    stamps = [1000, 1050, 100, 1150, 1200, 1250]
    assert max(clock.advance(stamp * 10**6) for stamp in stamps) == pytest.approx(0.1)


def test_a_pause_after_a_stamp_that_jumped_back_is_one() -> None:
    clock = StreamClock()
    for stamp in (1000, 1100, 200, 3200):
        dt = clock.advance(stamp * 10**6)
    assert dt == pytest.approx(2.0)
    assert clock.now == pytest.approx(2.2)


def test_time_that_goes_back_by_more_than_a_second_is_told_until_somebody_has_looked() -> None:
    clock = StreamClock()
    told = []
    for stamp in (9000, 9100, 8100, 8200, 9200, 8100, 8200):
        clock.advance(stamp * 10**6)
        told.append(clock.went_back)
    assert told == [False] * 5 + [True] * 2


def test_lost_frames_and_two_of_a_burst_do_not_change_the_usual_period() -> None:
    """Before five periods there is no usual period."""
    clock = StreamClock()
    for stamp in (0, 100, 200, 300, 400):
        clock.advance(stamp * 10**6)
        assert clock.usual == 0
    for stamp in (500, 900, 1000, 1100, 1400, 1410, 1420):
        clock.advance(stamp * 10**6)
        assert clock.usual == pytest.approx(0.1)


def test_a_period_that_was_corrected_counts_as_it_was() -> None:
    clock = StreamClock()
    clock.correct(5.0)  # no effect before the first frame
    for stamp in range(0, 1000, 10):
        clock.advance(stamp * 10**6)
        clock.correct(0.1)
    assert clock.usual == pytest.approx(0.1)
    assert clock.now == pytest.approx(0.99)


def test_two_frames_at_a_time_are_a_rhythm() -> None:
    """There is no pause between pairs of frames, but a gap or two in a regular stream still are pauses."""
    clock = StreamClock()
    for stamp in (800 * i + j for i in range(6) for j in (0, 100)):
        clock.advance(stamp * 10**6)
    assert clock.pause(0.65) == pytest.approx(1.05)
    regular = StreamClock()
    for tenth in (*range(8), 18, 19, 29):
        regular.advance(tenth * 10**8)
    assert regular.pause(0.65) == 0.65


def test_a_pause_is_longer_than_the_rhythm_of_the_stream() -> None:
    """A stream of one frame per second does not pause each second. Before two periods its rate is not known."""
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
