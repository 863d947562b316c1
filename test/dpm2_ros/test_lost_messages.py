# SPDX-License-Identifier: Apache-2.0
"""Lost messages are counted: exactly by the publisher's numbers, otherwise by the period of the stamps."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dpm2_ros.lost_messages import Losses

PERIOD = 103_600_000  # ns: KITTI's LiDAR


def count(stamps: list[int], numbers: list[int] | None = None) -> int:
    losses = Losses()
    each = [losses.add(stamp, number) for stamp, number in zip(stamps, numbers or [None] * len(stamps), strict=True)]
    assert sum(each) == losses.count
    return losses.count


@given(arrived=st.sets(st.integers(0, 300), min_size=1), first=st.integers(1, 10**6), seed=st.integers(0, 9))
def test_numbers_are_exact_whatever_the_stamps_say(arrived: set[int], first: int, seed: int) -> None:
    """Losses are counted from the first received message to the last; earlier numbers do not count."""
    kept = sorted(arrived)
    stamps = np.cumsum(np.random.default_rng(seed).integers(0, 10**10, kept[-1] + 1))[kept]
    assert count(stamps.tolist(), [first + n for n in kept]) == kept[-1] - kept[0] + 1 - len(kept)


def test_another_publisher_begins_anew() -> None:
    """A new publisher restarts the count. The first one had sent messages before the subscription; the second is
    received from its first message on."""
    stamps = [n * PERIOD for n in range(6)]
    assert count(stamps, [7, 8, 10, 1, 2, 3]) == 1
    assert count(stamps, [7, 8, 10, 4, 5, 6]) == 1 + 3
    losses = Losses()
    losses.add(0, 10)
    losses.skip(3)
    assert losses.count == 2


def test_several_publishers_have_no_common_numbers() -> None:
    """After a message without a number, nothing is known about the numbers around it."""
    losses = Losses()
    for n, number in enumerate([1, 2, None, 40, 41]):
        losses.add(n * PERIOD, number)
    assert losses.count == 0


@pytest.mark.parametrize("missing", [{10}, {10, 11, 12}, {9, 15, 16, 40}, set(range(20, 35)), set(range(8, 60, 3))])
def test_the_rhythm_of_the_stamps_tells_what_is_missing(missing: set[int]) -> None:
    """Losses are detected although the stamps jitter as those of a spinning LiDAR: by a twentieth of a period."""
    jitter = np.random.default_rng(0).integers(-PERIOD // 20, PERIOD // 20, 60)
    stamps = [n * PERIOD + int(jitter[n]) for n in range(60) if n not in missing]
    assert count(stamps) == len(missing - {59})


@pytest.mark.parametrize(
    "periods",
    [
        pytest.param(3.5, id="no whole number of periods"),
        pytest.param(100.0, id="a real pause"),
        pytest.param(0.0, id="repeated"),
        pytest.param(-30.0, id="a looped bag"),
    ],
)
def test_other_gaps_of_the_stamps_are_no_losses(periods: float) -> None:
    before = [n * PERIOD for n in range(20)]
    after = [before[-1] + round((periods + n) * PERIOD) for n in range(20)]
    assert count(before + after) == 0


def test_nothing_is_said_before_the_rhythm_is_known() -> None:
    assert count([0, PERIOD, 5 * PERIOD]) == 0


def test_what_is_rejected_is_not_lost() -> None:
    """A rejected message's number is known, so it is not lost; messages that are missing before it are."""
    losses = Losses()
    losses.add(0, 1)
    losses.skip(2)
    assert losses.add(10**8, 3) == 0
    losses.skip(5)
    assert losses.add(2 * 10**8, 6) == 0
    assert losses.count == 1
