# SPDX-License-Identifier: Apache-2.0
"""Keyframes that a feed acknowledges for good are in the map file; waiting ones reach it, or stay with their robot."""

from __future__ import annotations

import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticStatus
from std_msgs.msg import UInt32MultiArray

from dpm2_core.errors import Dpm2Error
from dpm2_core.estimates import Keyframe
from dpm2_core.geometry import se3
from dpm2_core.slam.settings import SlamSettings
from dpm2_core.slam.store.map_data import load_map
from dpm2_core.slam.store.map_store import MapStore
from dpm2_ros.conversions import edge_to_msg, keyframe_name
from dpm2_ros.deliveries import Delivery
from dpm2_ros.diagnostics import mapper_status
from dpm2_ros.feed import Feed, keyframe_from
from dpm2_ros.guard import GuardedNode
from dpm2_ros.mapping import MapperThread
from dpm2_ros.settings import NodeConfig, RosSettings
from dpm2_ros.unsent import KeyframeFile

from ..helpers.mapping import Wires

COUNT = 45  # more than may wait for the mapper
DRIVE, NEXT = "0123abcd", "89ab0123"  # sessions


def keyframe(id: int) -> Keyframe:
    points = np.random.default_rng(id).uniform(0, 20, (100, 4)).astype(np.float32)
    return Keyframe(id, 1000 + id, id, np.eye(4), points, origin=np.array([0.5, 0.0, 1.5]))


class Node(GuardedNode):
    """A node with a map, and with the feed of one robot's keyframes."""

    def __init__(self, folder: Path) -> None:
        super().__init__("mapper")
        slam = SlamSettings.model_validate({"registration": "geometric", "loops": {"descriptors": False}})
        ros = RosSettings(map_directory=str(folder))
        self.mapper = MapperThread(self, NodeConfig(slam=slam, ros=ros), "robot")
        self.feed = Feed(self, self.mapper, "/robot", "")
        self.feed.open()
        self.create_timer(0.1, self.feed.tick)
        self.busy = threading.Event()

    def wait(self) -> Keyframe:
        """A first keyframe that takes long to process."""
        self.busy.wait()
        return keyframe(0)

    def close(self) -> None:
        """Close the feed first, while the mapper is still busy."""
        self.feed.close()
        self.busy.set()
        self.mapper.close()


class Robot:
    """Sends the keyframes of its drives, and receives the mapper's acknowledgments."""

    def __init__(self, ros: Callable[..., Any], folder: Path) -> None:
        self.harness, self.folder = ros(), folder
        self.wires = Wires(self.harness, "/robot")
        self.heard = self.harness.hear(UInt32MultiArray, "/robot/dpm2/keyframes_received")
        self.node = self.harness.add(Node(folder))
        self.wires.wait()
        self.last: tuple[Keyframe, str] | None = None
        self.harness.node.create_timer(2.0, self.announce)

    def send(self, count: int, session: str) -> None:
        for id in range(count):
            self.last = keyframe(id), keyframe_name("robot", id, session)
            self.wires.send(*self.last)

    def announce(self) -> None:
        """Repeat the last message, as robots do: a mapper stops answering a robot that is silent for long."""
        if self.last is not None:
            self.wires.send(*self.last)

    def acknowledged(self, session: str) -> tuple[int, int]:
        """From the last answer: the number below which all have arrived, and how many above it have."""
        answers = [answer.data for answer in self.heard if answer.layout.dim[0].label == session]
        return (answers[-1][0], len(answers[-1]) - 1) if answers else (0, 0)

    def wait(self, session: str, arrived: int) -> None:
        self.harness.wait(lambda: sum(self.acknowledged(session)) == arrived, f"the answer for {arrived}")

    @property
    def stored(self) -> int:
        """Keyframes in the map file: what would remain if the mapper were killed now."""
        (path,) = self.folder.glob("*.dpm2map")
        with MapStore.open(path) as store:
            return len(load_map(store))


@pytest.fixture
def robot(ros: Callable[..., Any], tmp_path: Path) -> Robot:
    return Robot(ros, tmp_path)


def test_what_has_arrived_reaches_the_map(robot: Robot) -> None:
    """Keyframes reach the map even if the feed is closed while they arrive faster than they are mapped: their robot may
    be gone."""
    robot.node.mapper.add(robot.node.wait)
    robot.send(COUNT, DRIVE)
    robot.wait(DRIVE, COUNT)
    robot.harness.remove(robot.node)
    assert robot.stored == COUNT + 1
    (path,) = robot.folder.glob("*.dpm2map")
    with MapStore.open(path) as store:
        assert load_map(store).clouds.origin(COUNT).tolist() == [0.5, 0, 1.5]


def test_what_is_acknowledged_for_good_is_in_the_map_file(robot: Robot) -> None:
    """A mapper that is killed loses what waits in its memory; its robot still has it, and sends it to the next one."""
    robot.node.mapper.add(robot.node.wait)
    robot.send(COUNT, DRIVE)
    robot.wait(DRIVE, COUNT)
    assert robot.acknowledged(DRIVE) == (0, COUNT)
    assert robot.stored == 0
    robot.node.busy.set()
    robot.harness.wait(lambda: robot.acknowledged(DRIVE) == (COUNT, 0), "all of them in the file")
    assert robot.stored == COUNT + 1


@pytest.mark.parametrize("error", [Dpm2Error("the graph is full"), ZeroDivisionError("a bug")])
def test_a_keyframe_that_could_not_be_taken_in_stays_with_its_robot(
    robot: Robot, monkeypatch: pytest.MonkeyPatch, error: Exception
) -> None:
    """If adding a keyframe fails, it is not acknowledged as stored. Previously it was, so its robot deleted it, and
    /diagnostics reported OK."""
    mapper = robot.node.mapper.active.mapper
    add, errors = mapper.add, [error]

    def failing(keyframe: Keyframe) -> Any:
        if keyframe.id == 1 and errors:
            raise errors.pop()
        return add(keyframe)

    monkeypatch.setattr(mapper, "add", failing)
    robot.send(COUNT, DRIVE)
    robot.wait(DRIVE, COUNT)
    robot.harness.wait(lambda: robot.node.mapper.written == COUNT, "the mapper to be through with all of them")
    assert robot.node.mapper.keyframes == COUNT - 1
    robot.heard.clear()
    robot.wait(DRIVE, COUNT)
    found = mapper_status(robot.node, robot.node.mapper)
    assert (found.level, found.message) == (
        DiagnosticStatus.WARN,
        f"{COUNT - 1} keyframes, 0 loops; 1 keyframes could not be added to the map: {error}",
    )
    assert robot.acknowledged(DRIVE) == (1, COUNT - 1)
    robot.harness.wait(lambda: robot.stored == COUNT - 1, "the others in the file")


def test_a_drive_whose_place_is_not_decided_stays_with_its_robot(robot: Robot, monkeypatch: pytest.MonkeyPatch) -> None:
    """Keyframes of a drive without a decided pose are not acknowledged as stored, and not in the map when the mapper
    ends, even if the drive began directly after the previous one."""
    monkeypatch.setattr("dpm2_ros.feed.SILENT", 300.0)  # s without a message, after which its pose would be decided
    robot.node.busy.set()
    robot.send(1, DRIVE)
    robot.harness.wait(lambda: robot.acknowledged(DRIVE) == (1, 0), "the drive before")
    robot.send(3, NEXT)
    robot.wait(NEXT, 3)
    kept = Delivery(NEXT, KeyframeFile(), False, 0.0)
    for _ in range(3):
        kept.append([b"pose", b"descriptors", b"cloud"], 0.0)
    below, above = robot.acknowledged(NEXT)
    robot.harness.remove(robot.node)
    assert robot.stored == 1
    for tick in range(10):
        kept.acknowledge(below, set(range(below, below + above)), 0.5 * tick)
    assert not kept.certain(5.0)


def test_the_edge_leads_to_the_last_keyframe_that_arrived() -> None:
    before = Keyframe(3, 0, 0, se3.exp([0, 0, 0, 5, 0, 0]), np.zeros((0, 4), np.float32))
    T, covariance = se3.exp([0, 0, 0.5, 12, 1, 0]), np.diag([1.0, 2, 3, 4, 5, 6])
    pose = edge_to_msg(T, covariance, 9, "odom", "kf_5")
    keyframe = keyframe_from(pose, "", 5, before)
    assert keyframe.edge is not None
    np.testing.assert_allclose(before.T_odom_kf @ keyframe.edge.T_target_source, T, atol=1e-9)
    np.testing.assert_allclose(keyframe.edge.covariance, covariance, atol=1e-9)


@pytest.mark.parametrize("before", [None, 5, 7])
def test_the_first_keyframe_and_one_that_goes_back_have_no_edge(before: int | None) -> None:
    last = None if before is None else Keyframe(before, 0, 0, np.eye(4), np.zeros((0, 4), np.float32))
    pose = edge_to_msg(np.eye(4), np.eye(6), 9, "odom", "kf_5")
    assert keyframe_from(pose, "", 5, last).edge is None
