# SPDX-License-Identifier: Apache-2.0
"""Single wrong times are detected, whatever they are; clocks that were set are not changed."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dpm2_core.data.messages import restamped, serialized_stamp
from dpm2_core.data.time_order import in_order, out_of_order

TIMES = 0.1 * np.arange(40)


@given(st.integers(2, 38), st.floats(0.15, 1e6), st.booleans())
def test_one_that_is_off_by_more_than_a_period_is_found(which: int, off: float, before: bool) -> None:
    times = TIMES.copy()
    times[which] += -off if before else off
    if not times[which - 1] < times[which] < times[which + 1]:
        found = np.flatnonzero(out_of_order(times))
        assert len(found) == 1
        assert abs(found[0] - which) <= (off < 0.3)  # if two have changed places, either may be the wrong one


@pytest.mark.parametrize("times", [TIMES, TIMES[:1], TIMES[:0], np.r_[TIMES, TIMES + 1.05], np.r_[TIMES, TIMES + 60]])
def test_times_in_order_and_clocks_that_were_set_stay(times: np.ndarray) -> None:
    assert not out_of_order(times).any()


def test_at_most_three_in_a_row() -> None:
    for count in (3, 4):
        times = TIMES.copy()
        times[10 : 10 + count] += 100
        assert out_of_order(times).sum() == (count if count <= 3 else 0)


def test_the_ends_have_one_neighbor() -> None:
    """Nothing shows whether they are right."""
    for which in (0, -1):
        times = TIMES.copy()
        times[which] += 50 if which == 0 else -50
        assert not out_of_order(times).any()
    times = TIMES.copy()
    times[1] -= 50  # or the first was 50 s late
    assert not out_of_order(times).any()


@given(
    st.lists(
        st.tuples(st.sampled_from("ci"), st.one_of(st.just(0), st.integers(0, 2 * 10**18)), st.integers(0, 2**63 - 1)),
        max_size=60,
    )
)
def test_whatever_the_stamps_each_message_comes_once_and_in_the_order_of_recording(
    sent: list[tuple[str, int, int]],
) -> None:
    """A stamp of 0 is replaced by the recording time, which may be later than any stamp."""
    messages = [
        (topic, time, restamped(b"\0\1\0\0" + bytes(8) + number.to_bytes(4), stamp))
        for number, (topic, stamp, time) in enumerate(sent)
    ]
    corrected = dict[int, int]()
    out = list(in_order(messages, "c", corrected.__setitem__))
    assert [(topic, number, data[12:]) for topic, number, data in out] == [
        (topic, number, data[12:]) for topic, number, data in messages
    ]
    clouds = [(a[2], b[2]) for a, b in zip(messages, out, strict=True) if a[0] == "c"]
    times = [time for topic, time, _ in messages if topic == "c"]
    changed = {i: serialized_stamp(b, times[i]) for i, (b, after) in enumerate(clouds) if b != after}
    assert changed == corrected
    assert all(a[2] == b[2] for a, b in zip(messages, out, strict=True) if a[0] == "i")


def test_no_more_than_seven_clouds_are_held_back() -> None:
    taken = 0

    def messages() -> Iterator[tuple[str, int, bytes]]:
        nonlocal taken
        for taken in range(1, 101):
            yield "c", taken, restamped(b"\0\1\0\0" + bytes(8), taken * 10**8)

    for given_out, _ in enumerate(in_order(messages(), "c", lambda *_: None)):
        assert taken <= given_out + 8
