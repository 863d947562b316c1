# SPDX-License-Identifier: Apache-2.0
"""Mapping runs in parallel to the odometry, and has lower priority."""

from __future__ import annotations

import os
import sqlite3
import sys
import threading
import time
from collections.abc import Callable, Generator, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from nav_msgs.msg import Path as PathMsg
from sensor_msgs.msg import PointCloud2
from std_srvs.srv import Trigger

from dpm2_core.data.trajectory import read_trajectory
from dpm2_core.data.transforms import transform_matrix
from dpm2_core.estimates import Edge, Registration
from dpm2_core.geometry import se3
from dpm2_core.slam.loops.closure import LoopCloser
from dpm2_core.slam.store.map_cloud import map_cloud_in_steps
from dpm2_core.slam.store.map_store import MapStore
from dpm2_ros.display import Display, path_to_msg
from dpm2_ros.guard import GuardedNode, respond, slow_service
from dpm2_ros.mapping import KEEP_ALL
from dpm2_ros.runtime import lower_priority

from ..helpers.mapping import core, mapped, placed, send_all


def niceness() -> int:
    return os.getpriority(os.PRIO_PROCESS, threading.get_native_id())


@pytest.mark.skipif(sys.platform != "linux", reason="threads have a priority of their own on Linux alone")
def test_only_the_thread_of_the_map_gives_way() -> None:
    before = niceness()
    with ThreadPoolExecutor(1, initializer=lower_priority) as pool:
        assert pool.submit(niceness).result() == min(before + 10, 19)
    assert niceness() == before


def test_the_path_of_a_long_drive_is_soon_made() -> None:
    """The path of 2,000 keyframes, made once per second, holds Python's lock only briefly, and all poses and stamps are
    correct."""
    poses, best = se3.exp(np.arange(2000)[:, None] * np.array([0.001, 0.0, 0.02, 0.5, 0.0, 0.01])), np.inf
    for _ in range(3):
        begin = time.thread_time()
        message = path_to_msg(poses, range(2000), "map")
        best = min(best, time.thread_time() - begin)
    assert best < 0.25  # 0.06 s; 0.5 to 0.7 s with a rotation for each pose
    np.testing.assert_allclose([transform_matrix(one.pose) for one in message.poses], poses, atol=1e-9)  # rounding
    assert [one.header.stamp.nanosec for one in message.poses] == list(range(2000))
    assert path_to_msg(np.zeros((0, 4, 4)), [], "map").poses == []


@pytest.mark.parametrize("saved", [False, True])
def test_a_loop_after_which_the_robot_stands_still_counts(
    mapper: Any, monkeypatch: pytest.MonkeyPatch, tmp_path: Path, saved: bool
) -> None:
    """The solution of another process for a large graph is applied without a further keyframe. Previously, if the robot
    had come home and stopped, its pose and the map of ~/save_map stayed without that loop."""
    monkeypatch.setattr("dpm2_core.slam.graph.pose_graph.SHORT", 1)  # otherwise small graphs are solved immediately
    move, transforms = placed(mapper)
    send_all(mapper, 0, 1, 2)
    mapped(mapper, 3)
    graph = core(mapper).graph  # its thread is idle now
    graph.add_loop(Edge("loop", 0, 2, Registration(se3.exp([0, 0, 0, 10.02, 0, 0]), np.eye(6) * 1e-8)))
    graph.optimize()  # as with the last keyframe
    if saved:
        assert mapper.call(Trigger, "/mapper_node/save_map").success
        poses = read_trajectory(tmp_path / "map" / "drive" / "trajectory.tum").poses
    else:
        path = mapper.hear(PathMsg, "/dpm2/path", 10)
        mapper.wait(lambda: path and path[-1].poses[-1].pose.position.x > 10.01, "the path with that loop")
        poses = np.array([transform_matrix(one.pose) for one in path[-1].poses])
    np.testing.assert_allclose(poses[:, 0, 3], [0, 5.01, 10.02], atol=1e-3)  # with a sigma of 0.1 mm, that of the loop
    move(1)
    mapper.wait(lambda: transforms, "a transform")
    assert transforms[-1].transforms[0].transform.translation.x == pytest.approx(0.02, abs=1e-3)


def test_a_map_file_catches_up_while_the_robot_stands(
    mapper: Any, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """What a full disk kept out of the file is written once there is room. Previously, it was written only with the
    next keyframe, and lost if a charging robot was switched off. Another program's lock acts as a full disk after 5
    s."""
    monkeypatch.setattr("dpm2_ros.mapping.RETRY", 0.2)
    send_all(mapper, 0)
    mapped(mapper, 1)
    path = tmp_path / "map" / "drive.dpm2map"
    with closing(sqlite3.connect(path, isolation_level=None, timeout=30)) as other:
        other.execute("BEGIN IMMEDIATE")
        send_all(mapper, 1)
        mapper.wait(lambda: core(mapper).store_problem, "a keyframe that is in memory only")
        other.execute("ROLLBACK")
    mapper.wait(lambda: not core(mapper).store_problem, "the file, without another keyframe")
    with MapStore.open(path) as store:
        assert store.size == 2


def test_who_listens_to_loops_and_hangs_holds_up_nothing(mapper: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """A hung subscriber delays nothing. Previously, with 10,000 loops waiting for it in DDS, each later keyframe with
    loops delayed the map by 0.1 s and was an internal error, and no path, map or grid was published for it."""
    hung = rclpy.create_node("hung", use_global_arguments=False)  # its callbacks are never called
    hung.create_subscription(DiagnosticArray, "/dpm2/loop_candidates", lambda message: None, KEEP_ALL)
    mapper.wait(lambda: mapper.mapper.count_subscribers("/dpm2/loop_candidates"), "the one that hangs")
    send_all(mapper, 0)
    mapped(mapper, 1)
    tried = Edge("loop", 0, 1, Registration(np.eye(4), np.eye(6)).rejected("does not fit"))
    monkeypatch.setattr(LoopCloser, "close", lambda *_: [tried] * 10_300)
    path = mapper.hear(PathMsg, "/dpm2/path", 10)
    send_all(mapper, 1)
    mapper.wait(lambda: path and len(path[-1].poses) == 2, "the path with both")
    mapped(mapper, 2)
    assert mapper.mapper.errors == 0
    hung.destroy_node()


def test_keyframes_come_to_their_turn_while_a_large_map_is_built(mapper: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """Keyframes are added while a large map is built. The map of 2,000 keyframes takes 6 s, during which none was added
    before."""
    end, begun = time.monotonic() + 30, threading.Event()

    def large(*given: Any) -> Iterator[None]:
        begun.set()
        while len(core(mapper).keyframes) < 2 and time.monotonic() < end:
            time.sleep(0.01)
            yield
        return (yield from map_cloud_in_steps(*given))

    monkeypatch.setattr("dpm2_ros.mapping.map_cloud_in_steps", large)
    shown = mapper.hear(PointCloud2, "/dpm2/map")
    mapper.wait(lambda: mapper.mapper.count_subscribers("/dpm2/map"), "the subscription")
    send_all(mapper, 0)
    mapper.wait(begun.is_set, "its begin")
    send_all(mapper, 1)
    mapper.wait(lambda: shown, "the map")
    assert time.monotonic() < end
    assert shown[0].width <= 500  # of the first keyframe, as at the start of the work


def test_what_takes_long_to_make_is_made_less_often(mapper: Any) -> None:
    publisher = mapper.publisher(PathMsg, "/shown")
    heard = mapper.hear(PathMsg, "/shown")
    mapper.wait(publisher.get_subscription_count, "the subscription")

    def make() -> Generator[None, None, PathMsg]:
        time.sleep(0.05)
        yield
        time.sleep(0.05)
        return PathMsg()

    display, begin = Display(publisher, lambda: 0.0, make), time.monotonic()
    for change in (1, 2):  # in two parts, the second whether or not anything has changed
        assert display.due(change)
        assert not display.due(change)
        display.publish()
    while not display.due(3):
        time.sleep(0.001)
    assert time.monotonic() - begin >= 4 * 2 * 0.05
    mapper.wait(lambda: len(heard) == 1, "the message")


def test_what_nobody_waits_for_any_more_is_not_built_on(mapper: Any) -> None:
    """If the last subscriber leaves, a partly built map is dropped, and built anew for the next one, even if nothing
    has changed. Otherwise, the next subscriber would receive an old map, which would stay in memory until then."""
    publisher, begun = mapper.publisher(PathMsg, "/shown"), []

    def make() -> Generator[None, None, PathMsg]:
        begun.append(0)
        yield
        return PathMsg()

    display = Display(publisher, lambda: 0.0, make)
    for change in (1, 1, 2):
        listener = rclpy.create_node("listener", use_global_arguments=False)
        listener.create_subscription(PathMsg, "/shown", lambda message: None, 1)
        mapper.wait(publisher.get_subscription_count, "the subscription")
        assert display.due(change)
        display.publish()
        listener.destroy_node()
        mapper.wait(lambda: not publisher.get_subscription_count(), "its end")
        assert not display.due(change)
    assert len(begun) == 3


def test_a_map_that_is_replaced_while_it_is_built_is_not_shown(mapper: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    maps, begun = [core(mapper)], threading.Event()

    def large(*given: Any) -> Iterator[None]:
        begun.set()
        while core(mapper) is maps[0]:
            time.sleep(0.01)
            yield
        return (yield from map_cloud_in_steps(*given))

    monkeypatch.setattr("dpm2_ros.mapping.map_cloud_in_steps", large)
    send_all(mapper, 0, 1)
    mapped(mapper, 2)
    shown = mapper.hear(PointCloud2, "/dpm2/map")
    mapper.wait(begun.is_set, "its begin")
    assert mapper.call(Trigger, "/mapper_node/reset").success
    send_all(mapper, 0, session="5f3a9c02")
    mapper.wait(lambda: shown, "the new map")
    assert shown[0].width <= 500  # of one keyframe
    assert mapper.mapper.errors == 0


def test_what_is_made_of_as_much_as_its_time_allows_goes_on_after_its_period(mapper: Any) -> None:
    """A part that used up its time is followed by the next after the period. Previously, the grid of a loaded map had a
    part of 0.3 s every 1.2 s instead of 0.5 s: Nav2 waited twice as long."""
    publisher = mapper.publisher(PathMsg, "/shown")
    mapper.hear(PathMsg, "/shown")
    mapper.wait(publisher.get_subscription_count, "the subscription")

    def make() -> PathMsg:
        time.sleep(0.3)
        display.again()
        return PathMsg()

    display = Display(publisher, lambda: 0.5, make)
    assert display.due(1)
    display.publish()
    assert not display.due(1)
    time.sleep(0.3)
    assert display.due(1)


class Failing(GuardedNode):
    """A service whose work has a bug."""

    def __init__(self) -> None:
        super().__init__("failing")
        self._pool = ThreadPoolExecutor(1)
        slow_service(self, Trigger, "~/work", self._on_work)

    async def _on_work(self, _request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        await respond(self, self._pool.submit(lambda: str(1 / 0)), response)
        return response

    def close(self) -> None:
        self._pool.shutdown()


def test_work_that_fails_by_a_bug_is_answered(ros: Callable[..., Any]) -> None:
    """The client gets an answer, and the node counts the failure and reports it in /diagnostics. Previously, the client
    waited forever."""
    harness = ros()
    node = harness.add(Failing())
    answer = harness.call(Trigger, "/failing/work")
    assert (answer.success, answer.message) == (False, "ZeroDivisionError: division by zero")
    assert node.errors == 1
