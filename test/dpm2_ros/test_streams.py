# SPDX-License-Identifier: Apache-2.0
"""A mapper's memory per drive is bounded, nothing is lost by that, and no single answer makes a robot give up."""

from __future__ import annotations

import numpy as np
import pytest

from dpm2_ros.deliveries import Acks
from dpm2_ros.keyframe_messages import Payload
from dpm2_ros.streams import AHEAD, Stream

CLOUD = Payload(bytes(100_000))


def put(stream: Stream, id: int) -> None:
    if stream.wants(id, "pose"):
        stream.put(id, "pose", object())
        stream.put(id, "cloud", CLOUD)
        stream.put(id, "seen", None)


def taken(stream: Stream) -> list[int]:
    out = []
    while (found := stream.take()) is not None:
        out.append(found[0])
    return out


def test_any_order_comes_out_in_order() -> None:
    stream, out = Stream("5f3a9c01", 0.0), []
    for id in np.random.default_rng(0).permutation(AHEAD).tolist():
        put(stream, id)
        out += taken(stream)
    assert out == list(range(AHEAD))
    assert stream.holds == 0


def test_ids_far_ahead_cost_no_memory() -> None:
    stream = Stream("5f3a9c01", 0.0)
    for id in range(1, 2**31, 2**20):
        put(stream, id)
    for id in range(1, 5000):
        put(stream, id)
        stream.put(id % AHEAD, "cloud", CLOUD)
    assert stream.holds < 3 * AHEAD * len(CLOUD[0])
    below, waiting = stream.arrived(written=0)
    assert (below, len(waiting)) < (1, AHEAD)  # this is the robot's answer: it sends the rest again
    put(stream, 0)
    assert taken(stream) == list(range(AHEAD))


def test_what_is_not_in_the_map_file_counts_as_waiting() -> None:
    stream = Stream("5f3a9c01", 0.0)
    for id in (0, 1, 2, 4):
        put(stream, id)
    for number, id in zip((7, 9, 10), taken(stream), strict=True):  # the mapper's; 8 is another drive's
        stream.given(id, number)
    assert stream.arrived(written=0) == (0, [0, 1, 2, 4])
    assert stream.arrived(written=9) == (1, [1, 2, 4])
    assert stream.arrived(written=10) == (2, [2, 4])
    assert stream.arrived(written=11, missing=[10]) == (2, [2, 4])
    stream.replaced()
    assert stream.arrived(written=11) == (3, [])


def test_a_keyframe_that_is_never_sound_holds_up_the_others_for_seconds_only() -> None:
    """A keyframe that is merely late is awaited, however often other data is sent under its name at first."""
    stream = Stream("5f3a9c01", 0.0)
    put(stream, 1)
    assert stream.give_up(1000.0) is None
    for second in range(5):
        stream.reject(0, float(second))
    assert stream.give_up(5.0) is None
    assert stream.give_up(7.0) == 0
    assert taken(stream) == [1]


@pytest.mark.parametrize("claim", [(9, set()), (2, {5, 6, 7, 8})])
def test_an_answer_that_claims_too_much_is_outweighed(claim: tuple[int, set[int]]) -> None:
    """The mapper has 0, 1, 2 and 5. Another sender claims, hundreds of times per second, that it has more: this is
    ignored."""
    results = Acks()
    for tick in range(40):
        now = 0.1 * tick
        if tick % 5 == 0:
            results.add(3, {5}, now)
        results.add(*claim, now)
        below, above = results.agreed
        assert below <= 3
        assert above <= {5}


def test_acknowledgments_follow_the_mapper() -> None:
    results = Acks()
    assert results.agreed == (0, frozenset())
    for tick in range(10):
        results.add(tick, {tick + 2}, 0.5 * tick)
    assert results.agreed[0] >= 8  # up to the last two
    for tick in range(10, 14):
        results.add(0, set(), 0.5 * tick)  # another mapper has nothing
    assert results.agreed == (0, frozenset())
