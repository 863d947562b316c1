# SPDX-License-Identifier: Apache-2.0
"""A cloud receives the image nearest in time, whatever arrives in between, and waits for it no longer than
necessary."""

from __future__ import annotations

import gc
import struct
from collections import deque
from collections.abc import Iterator
from weakref import WeakSet

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dpm2_core.data.pairing import BUFFER, JUMP, LATE, Beside, RawMessage, clouds_after_others

MS = 1_000_000
START = 1_700_000_000_000


def serialized(stamp: int) -> bytes:
    """The start of any message that begins with a header; `stamp` in ms."""
    return b"\0\1\0\0" + struct.pack("<iI", stamp // 1000, stamp % 1000 * MS)


def record(clouds: list[tuple[int, int]], images: list[tuple[int, int]]) -> list[RawMessage]:
    """Clouds and images, both as (stamp, delay until recording), ms after START. Messages of the same recording time
    are in this order."""
    messages = [(topic, (START + stamp + delay) * MS, serialized(START + stamp))
                for topic, sent in (("/cloud", clouds), ("/image", images)) for stamp, delay in sent]  # fmt: skip
    return sorted(messages, key=lambda message: message[1])


def paired(
    messages: list[RawMessage], tolerance: float = 0.05, offset: int = 0, silent: tuple[str, ...] = ()
) -> dict[int, int | None]:
    """Stamp of each cloud -> stamp of its image, ms after START; `silent`: other topics that clouds wait for."""
    images, out, waiting = Beside(tolerance), {}, deque[tuple[int, RawMessage]]()
    others = {"/image": offset * MS, **dict.fromkeys(silent, 0)}
    for topic, _, data in clouds_after_others(messages, ["/cloud"], others, waiting):
        second, ns = struct.unpack_from("<iI", data, 4)
        stamp = second * 1000 + ns // MS - START
        if topic == "/image":
            images.add((stamp + offset) * MS, stamp, [cloud - START * MS for cloud, _ in waiting])
        else:
            _, out[stamp] = images.nearest(stamp * MS) or (0, None)
            images.forget(stamp * MS)
    return out


@given(
    shots=st.lists(st.integers(5, 150), min_size=1, max_size=60).map(np.cumsum),
    delays=st.lists(st.integers(0, 200), min_size=60, max_size=60).map(sorted),
    offset=st.integers(-40, 40),
)
def test_each_cloud_has_the_nearest_image_of_the_recording(shots: list[int], delays: list[int], offset: int) -> None:
    """For a camera with gaps and any frame rate, ahead of the clouds or behind them, as long as its images arrive in
    order."""
    times = [int(shot) for shot in shots]
    images = list(zip(times, delays, strict=False))
    found = paired(record([(100 * n, 30) for n in range(20)], images), offset=offset)
    assert list(found) == [100 * n for n in range(20)]
    for cloud, image in found.items():
        best = min(abs(time + offset - cloud) for time in times)
        assert image is None if best > 50 else image is not None and abs(image + offset - cloud) == best


@pytest.mark.parametrize(("delay", "joins"), [(400, True), (600, False)])
def test_an_image_joins_the_cloud_that_was_recorded_before_it_for_a_while(delay: int, joins: bool) -> None:
    messages = record([(100 * n, 0) for n in range(10)], [(0, delay)])
    assert paired(messages)[0] == (0 if joins else None)


def test_a_cloud_that_waits_keeps_its_image() -> None:
    """However many images arrive meanwhile, here from a camera at 200 Hz while an IMU is silent."""
    messages = record([(100 * n, 0) for n in range(20)], [(5 * n, 10) for n in range(400)])
    assert paired(messages, silent=("/imu",)) == {100 * n: 100 * n for n in range(20)}


def test_one_image_serves_two_clouds() -> None:
    assert paired(record([(0, 0), (60, 0)], [(30, 100)])) == {0: 30, 60: 30}


@pytest.mark.parametrize("stray", [-60_000, 60_000])
def test_one_stamp_far_off_costs_its_image_alone(stray: int) -> None:
    """Ahead or behind: clouds are not released because of it, and the images around it are kept."""
    messages = record([(100 * n, 0) for n in range(10)], [(100 * n, 40) for n in range(10)])
    messages.insert(7, ("/image", messages[6][1], serialized(START + stray)))
    assert paired(messages) == {100 * n: 100 * n for n in range(10)}


def test_when_time_goes_back_the_images_of_before_are_not_used() -> None:
    images = Beside(0.05)
    for turn in range(2):
        for n in range(20):
            images.add(n * 100 * MS, (turn, n))
            assert images.nearest(n * 100 * MS) == (n * 100 * MS, (turn, n))
            images.forget(n * 100 * MS)


def test_without_a_camera_nothing_is_held_back() -> None:
    messages = record([(100 * n, 0) for n in range(3)], [])
    assert list(clouds_after_others(messages, ["/cloud"], {})) == messages


def test_memory_is_bounded() -> None:
    """Whatever the stamps of images are. Clouds wait no longer than half a second for a silent camera."""
    images = Beside(0.05)
    for n in range(10 * BUFFER):
        images.add(n * JUMP, n)
    assert images.nearest(0) is None
    kept, clouds = WeakSet[Beside](), [100 * n * MS for n in range(2 * BUFFER)]
    for n in range(1000):
        message = Beside(0.05)  # any object that a WeakSet accepts
        kept.add(message)
        images.add(10 * n * MS, message, clouds)
    del message
    gc.collect()
    assert BUFFER < len(kept) <= BUFFER + len(clouds)
    assert [images.nearest(cloud) is not None for cloud in clouds] == [True] * len(clouds)
    held, most = 0, 0
    messages = record([(100 * n, 0) for n in range(100)], [])

    def counted() -> Iterator[RawMessage]:
        nonlocal held
        for message in messages:
            held += 1
            yield message

    for _ in clouds_after_others(counted(), ["/cloud"], {"/image": 0}):
        most, held = max(most, held), held - 1
    assert most <= LATE // (100 * MS) + 1
