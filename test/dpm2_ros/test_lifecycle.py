# SPDX-License-Identifier: Apache-2.0
"""slam_node and mapper_node as managed nodes, over their lifecycle services: in repeated cycles every map and every
keyframe is kept, and nothing is left over."""

from __future__ import annotations

import gc
import os
import signal
import threading
import time
import weakref
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest
from builtin_interfaces.msg import Time
from lifecycle_msgs.msg import Transition
from nav_msgs.msg import Odometry
from rcl_interfaces.msg import Parameter, ParameterType, ParameterValue
from rcl_interfaces.srv import SetParameters
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import PointCloud2
from std_srvs.srv import Trigger

from dpm2_core.data.naming import POINTS
from dpm2_core.estimates import Keyframe
from dpm2_core.geometry import se3
from dpm2_core.slam.store.check import check_map
from dpm2_core.slam.store.map_data import load_map
from dpm2_core.slam.store.map_store import MapStore
from dpm2_ros.active_map import ActiveMap
from dpm2_ros.conversions import keyframe_name
from dpm2_ros.mapper_node import MapperNode
from dpm2_ros.slam_node import SlamNode

from ..helpers.diagnostics import having
from ..helpers.lifecycle import Manager
from ..helpers.mapping import Wires, points

CONFIGURE, CLEANUP = Transition.TRANSITION_CONFIGURE, Transition.TRANSITION_CLEANUP
ACTIVATE, DEACTIVATE = Transition.TRANSITION_ACTIVATE, Transition.TRANSITION_DEACTIVATE
FAST = ("input.images:=false",)
ACKS = "/dpm2/keyframes_received"
ROUNDS = 4


class Managed:
    """A node and its manager."""

    def __init__(self, harness: Any, kind: type[SlamNode] | type[MapperNode]) -> None:
        self.harness, self.node = harness, harness.add(kind(managed=True))
        self.manager = Manager(harness, f"/{self.node.get_name()}")
        self.change = self.manager.change

    @property
    def state(self) -> str:
        return self.manager.state

    @property
    def entities(self) -> int:
        return len([*self.node.publishers, *self.node.subscriptions, *self.node.services, *self.node.timers])

    @property
    def keyframes(self) -> int:
        """Number of keyframes in the map."""
        return len(self.node.slam.mapper.keyframes)


class Lidar:
    """The LiDAR of a robot."""

    def __init__(self, harness: Any, drive: Any) -> None:
        self.harness, self.drive = harness, drive
        self.clouds, self.odom = harness.publisher(PointCloud2, POINTS), harness.hear(Odometry, "/dpm2/odom")

    def send(self, *numbers: int) -> None:
        self.harness.wait(self.clouds.get_subscription_count, "the subscription to the clouds")
        for n in numbers:
            before = len(self.odom)
            self.clouds.publish(self.drive.cloud(n))
            self.harness.wait(lambda before=before: len(self.odom) > before, f"the odometry of cloud {n}")


class Robot:
    """A robot's keyframes as messages."""

    def __init__(self, harness: Any) -> None:
        self._wires = Wires(harness)

    def send(self, *ids: int) -> None:
        self._wires.wait()
        for id in ids:
            keyframe = Keyframe(id, 1000 + id, id, se3.exp([0, 0, 0, 5.0 * id, 0, 0]), points(id))
            self._wires.send(keyframe, keyframe_name("", id))


def held() -> tuple[int, int]:
    """Number of Python's threads, and of open files, of this process."""
    gc.collect()
    return threading.active_count(), len(os.listdir("/proc/self/fd"))


def ids(path: Path) -> list[int]:
    """The ids of the keyframes in a map file."""
    with MapStore.open(path) as store:
        return [keyframe.id for keyframe in load_map(store).keyframes]


@pytest.mark.slow
@pytest.mark.parametrize("kind", [SlamNode, MapperNode])
def test_rounds_keep_every_map_and_leave_nothing(
    ros: Callable[..., Any], drive: Any, tmp_path: Path, kind: type[SlamNode] | type[MapperNode]
) -> None:
    m = Managed(ros(*FAST, f"ros.map_directory:={tmp_path}"), kind)
    source: Any = Lidar(m.harness, drive) if kind is SlamNode else Robot(m.harness)
    after, maps = [], weakref.WeakSet[Any]()
    for round in range(ROUNDS):
        assert m.change(CONFIGURE, ACTIVATE)
        maps.add(m.node.slam)
        source.send(0, 1, 2)
        m.harness.wait(lambda: m.keyframes, "a keyframe")
        assert m.change(DEACTIVATE, CLEANUP)
        after.append((*held(), m.entities))
        m.harness.wait(lambda: (gc.collect(), not maps)[1], "their memory to be free")
        name = "drive" if not round else f"drive-{round + 1}"
        result = check_map(tmp_path / f"{name}.dpm2map")
        assert (result.problems, result.keyframes >= 1) == ([], True)
        assert (tmp_path / name / "map.ply").is_file()
    assert m.state == "unconfigured"
    # The counted round may include something of the harness that was ending.
    no_more = lambda: all(now <= then for now, then in zip((*held(), m.entities), after[2], strict=True))  # noqa: E731
    m.harness.wait(no_more, f"no more than {after[2]}, as of {after}")


@pytest.mark.slow
def test_inactive_it_takes_no_cloud_and_keeps_the_map(ros: Callable[..., Any], drive: Any, tmp_path: Path) -> None:
    """While inactive, the node accepts no cloud and keeps the map; after activation, it continues where it was."""
    m = Managed(ros(*FAST, f"ros.map_directory:={tmp_path}"), SlamNode)
    lidar = Lidar(m.harness, drive)
    assert m.state == "unconfigured"
    assert not m.change(ACTIVATE)
    assert m.change(CONFIGURE)
    assert not lidar.clouds.get_subscription_count()
    assert m.change(ACTIVATE)
    lidar.send(*range(4))
    m.harness.wait(lambda: m.keyframes, "the first keyframe")
    keyframes = m.keyframes
    assert m.change(DEACTIVATE)
    m.harness.wait(lambda: not lidar.clouds.get_subscription_count(), "the end of the subscription")
    assert m.state == "inactive"
    assert m.change(ACTIVATE)
    lidar.send(*range(4, 10))
    m.harness.wait(lambda: m.keyframes > keyframes, "a keyframe more")
    m.harness.status("slam_node: odometry", having(received=6, processed=6))
    last = lidar.odom[-1].pose.pose.position.x
    assert last == pytest.approx(drive.pose(9)[0, 3], abs=0.1)
    assert m.change(Transition.TRANSITION_ACTIVE_SHUTDOWN)
    assert m.state == "finalized"
    assert check_map(tmp_path / "drive.dpm2map").problems == []


def test_time_that_goes_back_while_it_is_inactive_is_noticed(
    ros: Callable[..., Any], drive: Any, tmp_path: Path
) -> None:
    """If a simulation or a bag starts again while the node is inactive, the odometry starts again, too."""
    m = Managed(ros(*FAST, f"ros.map_directory:={tmp_path}"), SlamNode)
    lidar = Lidar(m.harness, drive)
    assert m.change(CONFIGURE, ACTIVATE)
    lidar.send(*range(12))  # 8.8 m
    assert m.change(DEACTIVATE)
    m.harness.wait(lambda: not lidar.clouds.get_subscription_count(), "the end of the subscription")
    assert m.change(ACTIVATE)
    lidar.send(0, 1)
    assert lidar.odom[-1].pose.pose.position.x == pytest.approx(drive.pose(1)[0, 3], abs=0.1)  # m, as for any scan


def test_a_clock_that_is_asked_for_while_it_is_active_goes_on(ros: Callable[..., Any]) -> None:
    """After `ros2 param set use_sim_time true`, the clock follows /clock after a deactivation, too. Previously it
    stopped, and clouds without a stamp, which are stamped with its time, were rejected as repeated."""
    managed = Managed(ros(*FAST), SlamNode)
    harness, clock = managed.harness, managed.harness.publisher(Clock, "/clock")
    value = ParameterValue(type=ParameterType.PARAMETER_BOOL, bool_value=True)
    assert managed.change(CONFIGURE)
    assert managed.change(ACTIVATE)
    given = [Parameter(name="use_sim_time", value=value)]
    assert harness.call(SetParameters, "/slam_node/set_parameters", parameters=given).results[0].successful

    def follows(seconds: int) -> bool:
        clock.publish(Clock(clock=Time(sec=seconds)))
        return bool(managed.node.get_clock().now().nanoseconds == seconds * 10**9)

    harness.wait(lambda: follows(100), "/clock")
    assert managed.change(DEACTIVATE)
    assert managed.change(ACTIVATE)
    harness.wait(lambda: follows(200), "/clock again", timeout=10)


@pytest.mark.slow
def test_a_robot_keeps_what_it_makes_while_its_mapper_is_inactive(
    ros: Callable[..., Any], drive: Any, tmp_path: Path
) -> None:
    """Keyframes made meanwhile are in the same map once the mapper is active again, each once; a new map gets the whole
    drive."""
    apart = ("ros.embed_mapper:=false", "slam.keyframes.distance:=1.0", f"ros.map_directory:={tmp_path}")
    harness = ros(*FAST, *apart)
    m, lidar = Managed(harness, MapperNode), Lidar(harness, drive)
    sent = harness.hear(Odometry, "/dpm2/keyframe_odom")
    made = lambda: len({pose.child_frame_id for pose in sent})  # noqa: E731
    harness.add(SlamNode())
    assert m.change(CONFIGURE, ACTIVATE)
    lidar.send(*range(5))  # 0.8 m apart: every second one is a keyframe
    harness.wait(lambda: m.keyframes == made() == 3, "the first keyframes")
    assert m.change(DEACTIVATE)
    others = lambda: (harness.node.count_subscribers("/dpm2/keyframe_odom"), harness.node.count_publishers(ACKS))  # noqa: E731
    harness.wait(lambda: others() == (1, 0), "the end of its subscriptions and acknowledgments")
    lidar.send(*range(5, 16))
    harness.wait(lambda: made() == 8, "keyframes of the robot")
    assert m.keyframes <= 3
    assert m.change(ACTIVATE)
    harness.wait(lambda: m.keyframes >= made(), "what was made meanwhile")
    assert m.change(DEACTIVATE, CLEANUP)
    assert ids(tmp_path / "drive.dpm2map") == list(range(made()))
    assert m.change(CONFIGURE, ACTIVATE)
    harness.wait(lambda: m.keyframes >= made(), "the whole drive")
    assert m.change(DEACTIVATE, CLEANUP)
    assert ids(tmp_path / "drive-2.dpm2map") == list(range(made()))


@pytest.mark.parametrize(
    ("kind", "wrong"),
    [
        (SlamNode, "slam.neural.weights:=none.safetensors"),
        (MapperNode, "slam.neural.weights:=none.safetensors"),
        (SlamNode, "ros.localization_mode:=true"),
    ],
)
def test_what_cannot_be_configured_stays_unconfigured(
    ros: Callable[..., Any], tmp_path: Path, kind: type[SlamNode] | type[MapperNode], wrong: str
) -> None:
    """A failed configuration leaves no thread, no topic and no empty map."""
    given = (wrong, "slam.loops.descriptors:=true", "input.images:=false")
    m = Managed(ros(*given, f"ros.map_directory:={tmp_path / 'maps'}"), kind)
    before, entities = held()[0], m.entities
    assert not m.change(CONFIGURE)
    assert m.state == "unconfigured"
    assert m.entities == entities
    m.harness.wait(lambda: held()[0] <= before, f"no more threads than {before}")  # some may still be ending
    assert not (tmp_path / "maps").exists()


def test_what_cannot_be_activated_stays_inactive(ros: Callable[..., Any], tmp_path: Path) -> None:
    m = Managed(ros(*FAST, f"input.second_points_topic:={POINTS}"), SlamNode)
    assert m.change(CONFIGURE)
    entities = m.entities
    assert not m.change(ACTIVATE)
    assert (m.state, m.entities) == ("inactive", entities)
    assert m.change(CLEANUP)
    assert m.state == "unconfigured"


@pytest.mark.parametrize("kind", [SlamNode, MapperNode])
@pytest.mark.parametrize("service", ["save_map", "reset"])
def test_who_has_asked_before_the_cleanup_is_answered(
    ros: Callable[..., Any],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    kind: type[SlamNode] | type[MapperNode],
    service: str,
) -> None:
    """`save_map` and `reset` may still be writing a large map when the node is cleaned up."""
    begun, work = threading.Event(), {"save_map": "save", "reset": "keep"}[service]
    answer = getattr(ActiveMap, work)

    def slow(*arguments: Any) -> Any:
        begun.set()
        time.sleep(1.0)
        return answer(*arguments)

    monkeypatch.setattr(ActiveMap, work, slow)
    m = Managed(ros(*FAST, f"ros.map_directory:={tmp_path}"), kind)
    assert m.change(CONFIGURE)
    with ThreadPoolExecutor(1) as thread:
        asked = thread.submit(m.harness.call, Trigger, f"/{m.node.get_name()}/{service}")
        assert begun.wait(90)
        assert m.change(CLEANUP)
        assert asked.result().message
    assert (m.state, m.node.errors) == ("unconfigured", 0)


@pytest.mark.slow
def test_the_executable_waits_and_a_signal_ends_it(ros: Callable[..., Any], tmp_path: Path) -> None:
    """A node that is stopped while unconfigured leaves no map. test_launch.py covers both executables with a map."""
    harness = ros()
    options = ["--lifecycle", "--ros-args", "-p", f"ros.map_directory:={tmp_path / 'maps'}"]
    process = harness.start("slam_node", options, tmp_path / "log")
    assert Manager(harness, "/slam_node").state == "unconfigured"
    process.send_signal(signal.SIGTERM)
    assert process.wait(180) == 0, (tmp_path / "log").read_text()
    assert not (tmp_path / "maps").exists()
