# SPDX-License-Identifier: Apache-2.0
"""Which keyframes are sent again, and when a drive counts as delivered; times in s."""

from __future__ import annotations

from dpm2_ros.deliveries import Delivery
from dpm2_ros.unsent import KeyframeFile

PARTS = [b"pose", b"descriptors", b"cloud"]


def delivery(count: int, earlier: bool = False, now: float = 0.0) -> Delivery:
    file = KeyframeFile()
    if earlier:
        for _ in range(count):
            file.append(PARTS)
    made = Delivery("00000001", file, earlier, now)
    for _ in range(0 if earlier else count):
        made.append(PARTS, now)
    return made


def test_what_is_not_acknowledged_is_sent_again_after_a_while() -> None:
    drive = delivery(20)
    assert drive.due(1.0, 8) == []
    assert drive.due(2.0, 8) == list(range(8))
    assert drive.due(2.1, 8) == list(range(8, 16))
    drive.acknowledge(12, {14}, 2.5)
    assert drive.due(4.0, 8) == [12, 13, 15, 16, 17, 18, 19]
    assert (drive.arrived, drive.late) == (13, 8)


def test_a_keyframe_that_had_to_wait_for_an_earlier_drive_is_due_at_once() -> None:
    drive = delivery(0)
    drive.append(PARTS, None)
    assert drive.due(0.1, 8) == [0]


def test_an_earlier_drive_is_announced_before_it_is_sent() -> None:
    """Most of the drive may have arrived already: the first acknowledgment shows it, before anything is sent twice."""
    drive = delivery(20, earlier=True, now=100.0)
    assert drive.announces(100.1)
    assert not drive.announces(100.2)
    assert drive.due(100.5, 8) == []
    drive.acknowledge(18, set(), 100.6)
    assert drive.due(101.0, 8) == []
    drive.acknowledge(18, set(), 101.6)
    assert drive.due(101.7, 8) == [18, 19]


def test_one_acknowledgment_does_not_end_a_drive() -> None:
    drive = delivery(3)
    drive.acknowledge(3, set(), 10.0)
    assert not drive.certain(10.1)
    drive.acknowledge(1, set(), 10.5)  # from this mapper; the one before came from another
    assert not drive.certain(12.5)
    for n in range(10):
        drive.acknowledge(3, set(), 13 + 0.5 * n)
    assert drive.certain(17.6)


def test_what_the_mapper_has_in_memory_alone_does_not_end_a_drive() -> None:
    """Keyframes that are only in the mapper's memory are not sent again, but the drive is not complete, either."""
    drive = delivery(3)
    for n in range(20):
        drive.acknowledge(1, {1, 2}, 0.5 * n)
    assert (drive.arrived, drive.late, drive.due(10.0, 8)) == (3, 2, [])
    assert not drive.certain(10.0)


def test_a_drive_without_keyframes_is_over_at_once() -> None:
    drive = delivery(0)
    assert drive.certain(0.0)
    assert not drive.announces(100.0)
