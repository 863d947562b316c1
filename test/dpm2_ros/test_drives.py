# SPDX-License-Identifier: Apache-2.0
"""The drives of one namespace in mapper_node: one after the other, at the same time, and resumed."""

from __future__ import annotations

import time
from typing import Any

import numpy as np
import pytest

from dpm2_ros import feed
from dpm2_ros.conversions import EARLIER, edge_to_msg, keyframe_name

from ..helpers.mapping import OTHER, S, core, keyframes, mapped, placed, send_all, taken_in


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    """Drives count as finished after a second of silence."""
    monkeypatch.setattr(feed, "SILENT", 1.0)
    monkeypatch.setattr(feed, "BESIDE", 0.3)


def test_two_drives_in_one_namespace_are_kept_apart(mapper: Any) -> None:
    """A forged session or, by accident, a second robot is reported, and each drive continues as if it were alone."""
    diagnostics = mapper.diagnostics
    send_all(mapper, 0, 1)
    mapper.wait(lambda: keyframes(mapper) == 2, "the drive")
    send_all(mapper, 1)  # the first drive is still active, however long its mapping took
    send_all(mapper, 0, 1, session=OTHER, shift=100.0)

    def apart() -> bool:
        send_all(mapper, 2)  # repeatedly, as a robot does
        time.sleep(0.1)
        return keyframes(mapper) == 5

    mapper.wait(apart, "both drives")
    send_all(mapper, 2, session=OTHER, shift=100.0)
    send_all(mapper, 3)
    mapped(mapper, 7)
    drives = {name: [k.id for k in core(mapper).keyframes if k.robot == name] for name in core(mapper).robots}
    assert drives == {"": [0, 1, 2, 3], f".{OTHER}": [0, 1, 2]}
    assert len(core(mapper).edges) == 5  # none between the two

    def reported() -> bool:
        send_all(mapper, 2, session=OTHER)
        time.sleep(0.1)
        heard = [status for m in diagnostics for status in m.status]
        return any(f"several in one namespace: .{OTHER} kept separate" in status.message for status in heard)

    mapper.wait(reported, "the diagnostics")


def test_what_is_left_of_an_earlier_drive_comes_before_the_next_one(mapper: Any) -> None:
    """After a robot was killed, its remaining keyframes are added first. Until that drive is complete, its current
    odometry has no pose in the map."""
    move, heard = placed(mapper)
    send_all(mapper, 0, 1)
    mapper.wait(lambda: keyframes(mapper) == 2, "the drive")
    send_all(mapper, 2, 3, session=f"{S}{EARLIER}")
    mapper.wait(lambda: keyframes(mapper) == 4, "the rest of it")
    for stamp in range(5):
        move(stamp)
    time.sleep(1.0)
    send_all(mapper, 0, 1, session=OTHER, shift=100.0)  # immediately, without a silence
    mapped(mapper, 6)
    move(77)
    time.sleep(1.0)
    assert not heard  # the new drive has no pose in the map yet, either
    assert [k.robot for k in core(mapper).keyframes] == [""] * 6
    assert [k.id for k in core(mapper).keyframes] == [0, 1, 2, 3, 4, 5]
    assert [(e.from_node, e.to_node) for e in core(mapper).edges] == [(0, 1), (1, 2), (2, 3), (4, 5)]


def test_a_robot_that_starts_again_is_not_put_where_its_drive_before_was(mapper: Any) -> None:
    """Its odometry begins at zero: until the pose of its new drive is decided, that odometry has no known pose."""
    move, heard = placed(mapper)
    send_all(mapper, 0, 1)
    mapper.wait(lambda: keyframes(mapper) == 2, "the drive")
    move(5)
    mapper.wait(lambda: len(heard) == 1, "/tf")
    mapper.wires.pose.publish(edge_to_msg(np.eye(4), np.eye(6) * 1e-4, 1000, "odom", keyframe_name("", 0, OTHER)))
    taken_in(mapper)
    move(6)
    time.sleep(1.0)
    assert len(heard) == 1
    send_all(mapper, 2)  # the previous drive continues: the new one was another robot's
    taken_in(mapper)
    move(7)
    mapper.wait(lambda: len(heard) == 2, "/tf again")


@pytest.mark.usefixtures("quick")
def test_a_drive_that_another_one_has_replaced_comes_back(mapper: Any) -> None:
    """A robot was out of reach, and a session in its name began meanwhile. When it returns, nothing that it sends is
    lost."""
    for session, ids in ((S, (0, 1)), (OTHER, (0,)), (S, (2, 3))):
        time.sleep(1.2)
        expected = keyframes(mapper) + len(ids)
        send_all(mapper, *ids, session=session)
        mapped(mapper, expected)
    assert [k.robot for k in core(mapper).keyframes] == [""] * 5
    assert [(e.from_node, e.to_node) for e in core(mapper).edges] == [(0, 1), (3, 4)]
