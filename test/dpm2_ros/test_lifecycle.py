# SPDX-License-Identifier: Apache-2.0
"""slam_node as a managed node, over its lifecycle services: round and round, every map kept and nothing left over."""

from __future__ import annotations

import gc
import os
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState, GetState
from nav_msgs.msg import Odometry
from sensor_msgs.msg import PointCloud2

from dpm2_core.data.topics import POINTS
from dpm2_core.slam.store.check import check_map
from dpm2_ros.lifecycle import ManagedSlamNode

CONFIGURE, CLEANUP = Transition.TRANSITION_CONFIGURE, Transition.TRANSITION_CLEANUP
ACTIVATE, DEACTIVATE = Transition.TRANSITION_ACTIVATE, Transition.TRANSITION_DEACTIVATE


class Managed:
    """The node, its manager and its LiDAR."""

    def __init__(self, ros: Callable[..., Any], drive: Any, *parameters: str) -> None:
        fast = ("input.images:=false", "slam.loops.descriptors:=false", "slam.registration:=geometric")
        self.harness, self.drive = ros(*fast, *parameters), drive
        self.lidar = self.harness.publisher(PointCloud2, POINTS)
        self.odom = self.harness.hear(Odometry, "/dpm2/odom")
        self.node: ManagedSlamNode = self.harness.add(ManagedSlamNode())
        self._change = self.harness.node.create_client(ChangeState, "/slam_node/change_state")
        self._state = self.harness.node.create_client(GetState, "/slam_node/get_state")

    def _call(self, client: Any, request: Any) -> Any:
        assert client.wait_for_service(timeout_sec=10)
        future = client.call_async(request)
        self.harness.wait(future.done, client.srv_name)
        return future.result()

    def change(self, transition: int) -> bool:
        return bool(self._call(self._change, ChangeState.Request(transition=Transition(id=transition))).success)

    @property
    def state(self) -> str:
        return str(self._call(self._state, GetState.Request()).current_state.label)

    def send(self, *numbers: int) -> None:
        self.harness.wait(self.lidar.get_subscription_count, "the subscription to the clouds")
        for n in numbers:
            before = len(self.odom)
            self.lidar.publish(self.drive.cloud(n))
            self.harness.wait(lambda before=before: len(self.odom) > before, f"the odometry of cloud {n}")


def held() -> tuple[int, int]:
    """Threads of Python and open files of this process."""
    gc.collect()
    return threading.active_count(), len(os.listdir("/proc/self/fd"))


@pytest.mark.slow
def test_rounds_keep_every_map_and_leave_nothing(ros: Callable[..., Any], drive: Any, tmp_path: Path) -> None:
    """Six of them; DPM2_ROUNDS=20 for more."""
    m = Managed(ros, drive, f"ros.map_directory:={tmp_path}")
    after = []
    for round in range(int(os.environ.get("DPM2_ROUNDS", "6"))):
        assert all(m.change(transition) for transition in (CONFIGURE, ACTIVATE))
        m.send(0, 1, 2)
        assert m.change(DEACTIVATE)
        assert m.change(CLEANUP)
        entities = [*m.node.publishers, *m.node.subscriptions, *m.node.services, *m.node.timers]
        after.append((*held(), len(entities)))
        name = "drive" if not round else f"drive-{round + 1}"
        result = check_map(tmp_path / f"{name}.dpm2map")
        assert (result.problems, result.keyframes >= 1) == ([], True)
        assert (tmp_path / name / "map.ply").is_file()
    assert m.state == "unconfigured"
    assert after[-1] == after[2]  # not the first: what is loaded once stays


@pytest.mark.slow
def test_inactive_it_takes_no_cloud_and_keeps_the_map(ros: Callable[..., Any], drive: Any, tmp_path: Path) -> None:
    """And goes on where it was."""
    m = Managed(ros, drive, f"ros.map_directory:={tmp_path}")
    assert m.state == "unconfigured"
    assert not m.change(ACTIVATE)
    assert m.change(CONFIGURE)
    assert not m.lidar.get_subscription_count()
    assert m.change(ACTIVATE)
    m.send(*range(4))
    m.harness.wait(lambda: m.node.slam.mapper.keyframes, "the first keyframe")
    keyframes = len(m.node.slam.mapper.keyframes)
    assert m.change(DEACTIVATE)
    m.harness.wait(lambda: not m.lidar.get_subscription_count(), "the end of the subscription")
    assert m.state == "inactive"
    assert m.change(ACTIVATE)
    m.send(*range(4, 10))
    m.harness.wait(lambda: len(m.node.slam.mapper.keyframes) > keyframes, "a keyframe more")
    last = m.odom[-1].pose.pose.position.x
    assert last == pytest.approx(drive.pose(9)[0, 3], abs=0.1)
    assert m.change(Transition.TRANSITION_ACTIVE_SHUTDOWN)
    assert m.state == "finalized"
    assert check_map(tmp_path / "drive.dpm2map").problems == []


def test_what_cannot_be_configured_stays_unconfigured(ros: Callable[..., Any], drive: Any, tmp_path: Path) -> None:
    m = Managed(ros, drive, "ros.localization_mode:=true", f"ros.map_file:={tmp_path / 'none.dpm2map'}")
    before = held()[0]
    assert not m.change(CONFIGURE)
    assert m.state == "unconfigured"
    assert held()[0] == before
