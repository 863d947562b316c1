# SPDX-License-Identifier: Apache-2.0
"""Two slam_node processes and a mapper_node over real DDS make one map, even if one starts late, dies or is cut off."""

from __future__ import annotations

import signal
import subprocess
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from nav_msgs.msg import Odometry
from rclpy.serialization import serialize_message
from sensor_msgs.msg import PointCloud2
from std_msgs.msg import UInt8MultiArray

from dpm2_core.data.open import open_source
from dpm2_core.data.settings import InputSettings
from dpm2_core.data.transforms import transform_matrix
from dpm2_core.errors import Dpm2Error
from dpm2_core.estimates import Keyframe
from dpm2_core.frame import Array, Frame
from dpm2_core.geometry import se3
from dpm2_core.slam.store.map_data import MapData, load_map
from dpm2_core.slam.store.map_store import MapStore
from dpm2_ros.conversions import cloud_to_msg
from dpm2_ros.keyframe_messages import descriptors_from_msg, descriptors_to_msg, payload_to_msgs
from dpm2_ros.tf_message import TFMessage

GEOMETRIC = ("-p", "slam.registration:=geometric", "-p", "slam.loops.descriptors:=false")
"""Without the network, for tests to which the content of keyframes does not matter: nodes start in half the time."""


class Fleet:
    """Processes of robots and of their mapper; scans for each robot."""

    def __init__(self, harness: Any, recording: Path, folder: Path, parameters: Sequence[str] = ()) -> None:
        """`parameters`: for all nodes."""
        self.harness, self.folder, self._parameters = harness, folder, parameters
        self.source = open_source(recording, InputSettings(images=False))
        self.tf = harness.hear(TFMessage, "/tf")
        self._lidars: dict[str, Any] = {}
        self._odom: dict[str, list[Any]] = {}
        self._stamp = 0

    def _start(self, name: str, log: str, *arguments: str) -> subprocess.Popen[bytes]:
        return self.harness.start(name, ["--ros-args", *arguments, *self._parameters], self.folder / log)

    def mapper(self, file: str = "map.dpm2map") -> subprocess.Popen[bytes]:
        """Start a mapper_node for all robots."""
        parameters = ("-p", "ros.map_directory:=''", "-p", f"ros.map_file:={self.folder / file}")
        return self._start("mapper_node", "mapper.log", *parameters)

    def robot(self, name: str) -> subprocess.Popen[bytes]:
        """Start a slam_node in a namespace."""
        pairs = ["input.points_topic:=points", "input.images:=false", "ros.embed_mapper:=false",
                 f"ros.odom_frame:={name}/odom", "slam.keyframes.distance:=2.0",
                 f"ros.map_directory:={self.folder / 'robots'}"]  # fmt: skip
        if name not in self._lidars:
            self._lidars[name] = self.harness.publisher(PointCloud2, f"/{name}/points")
            self._odom[name] = self.harness.hear(Odometry, f"/{name}/dpm2/odom")
        before = self._listeners(name)  # DDS still lists a killed one for a while
        process = self._start(
            "slam_node", f"{name}.log", "-r", f"__ns:=/{name}", *(x for p in pairs for x in ("-p", p))
        )
        message = self.folder / f"{name}.log"
        new = lambda: "waiting for clouds" in message.read_text() and self._listeners(name) - before  # noqa: E731
        self.harness.wait(new, name)
        self.harness.find(f"{name}/slam_node")
        return process

    def _listeners(self, name: str) -> set[bytes]:
        """The subscribers to the scans of a robot."""
        infos = self.harness.node.get_subscriptions_info_by_topic(f"/{name}/points")
        return {bytes(info.endpoint_gid) for info in infos}

    def drive(self, name: str, *frames: int) -> None:
        """Publish scans, each after the odometry of the one before."""
        for n in frames:
            frame = next(iter(self.source.frames(n, n + 1)))
            self._stamp += 100_000_000
            before = len(self._odom[name])
            self._lidars[name].publish(cloud_to_msg(frame.points, self._stamp, f"{name}/lidar"))
            self.harness.wait(lambda before=before: len(self._odom[name]) > before, f"{name}: scan {n}")

    def map(self, file: str = "map.dpm2map") -> MapData:
        """The map in the file, as it is now."""
        with MapStore.open(self.folder / file) as store:
            return load_map(store, descriptors=False)

    def ids(self, name: str, file: str = "map.dpm2map") -> list[int]:
        """The ids of a robot's keyframes in the map."""
        try:
            return [keyframe.id for keyframe in self.map(file).keyframes if keyframe.robot == name]
        except Dpm2Error:  # the file is being created
            return []

    def received(self, name: str, count: int, file: str = "map.dpm2map") -> None:
        """Wait until exactly the first `count` keyframes of a robot are in the map."""
        with suppress(AssertionError):
            # On a busy machine the network, in a thread of low priority, takes long to describe them.
            self.harness.wait(lambda: self.ids(name, file) == list(range(count)), f"{name}'s keyframes", timeout=240)
        assert self.ids(name, file) == list(range(count)), (self.folder / "mapper.log").read_text()[-2000:]

    def T_map_lidar(self, name: str) -> Array | None:
        """Pose of the LiDAR by the last transforms; None before map -> odom is known."""
        last = {t.child_frame_id: transform_matrix(t.transform) for m in list(self.tf) for t in m.transforms}
        if f"{name}/odom" not in last:
            return None
        return last[f"{name}/odom"] @ last[f"{name}/lidar"]


@pytest.fixture
def fleet(request: pytest.FixtureRequest, ros: Callable[..., Any], recording: Path, tmp_path: Path) -> Fleet:
    return Fleet(ros(), recording, tmp_path, getattr(request, "param", GEOMETRIC))


@pytest.mark.long
@pytest.mark.weights
@pytest.mark.timeout(900)  # two of those waits, and others
@pytest.mark.parametrize("fleet", [GEOMETRIC[:2]], ids=["descriptors"], indirect=True)
def test_two_robots_one_map_each_with_its_own_correction(fleet: Fleet) -> None:
    """The second robot joins late, in the middle of the area that the first has mapped, and is localized in the map."""
    fleet.mapper()
    fleet.robot("red")
    fleet.drive("red", *range(19))
    wait = fleet.harness.wait
    fleet.received("red", 7)
    for scan in range(19, 24):  # keyframes are sent again, odometry is not: the mapper may subscribe late
        fleet.drive("red", scan)
        with suppress(AssertionError):
            wait(lambda: fleet.T_map_lidar("red") is not None, "map -> red/odom", timeout=5)
            break
    wait(lambda: fleet.T_map_lidar("red") is not None, "map -> red/odom")
    fleet.robot("blue")
    fleet.drive("blue", *range(6, 24))
    fleet.received("blue", 6)
    wait(lambda: "blue: its place" in (fleet.folder / "mapper.log").read_text(), "blue in red's map")
    fleet.drive("blue", 24, 25)
    poses = fleet.source.poses
    assert poses is not None
    truth = se3.inverse(poses[0]) @ poses[25]
    wait(lambda: fleet.T_map_lidar("blue") is not None, "map -> blue/odom")
    wait(lambda: np.linalg.norm(fleet.T_map_lidar("blue")[:3, 3] - truth[:3, 3]) < 0.3, "blue's place")

    def joined() -> bool:
        data = fleet.map()
        return any(data.keyframes[e.from_node].robot != data.keyframes[e.to_node].robot for e in data.constraints)

    wait(joined, "what joins them in the map file")
    data = fleet.map()
    robots = [keyframe.robot for keyframe in data.keyframes]
    assert all(robots[e.from_node] == robots[e.to_node] for e in data.constraints if e.kind == "odometry")
    parents = {t.child_frame_id: t.header.frame_id for m in fleet.tf for t in m.transforms}
    assert parents == {"red/odom": "map", "blue/odom": "map", "red/lidar": "red/odom", "blue/lidar": "blue/odom"}


def test_an_outage_costs_nothing(fleet: Fleet) -> None:
    """The mapper is stopped while the robot drives, is killed, and is replaced: all keyframes are sent again."""
    first = fleet.mapper("first.dpm2map")
    fleet.robot("red")
    fleet.drive("red", *range(6))
    wait = fleet.harness.wait
    wait(lambda: fleet.ids("red", "first.dpm2map"), "the first keyframe")
    first.send_signal(signal.SIGSTOP)
    fleet.drive("red", *range(6, 18))
    first.send_signal(signal.SIGCONT)
    # 2 m between keyframes, 0.93 m between scans
    fleet.received("red", 6, "first.dpm2map")
    first.kill()
    first.wait()
    fleet.drive("red", *range(18, 24))
    fleet.mapper("second.dpm2map")
    fleet.received("red", 8, "second.dpm2map")


@pytest.mark.long
def test_a_robot_that_is_killed_and_comes_back(fleet: Fleet) -> None:
    """While the mapper is stopped, no keyframe is lost: after a restart the robot sends the old ones first, then those
    of the new drive. While the mapper runs, delivered keyframes are deleted from the robot's disk. Each start is a
    session of its own in the same map: ids continue, and no odometry edge connects the sessions."""
    mapper = fleet.mapper()
    red = fleet.robot("red")
    fleet.drive("red", *range(5))
    fleet.received("red", 2)
    mapper.send_signal(signal.SIGSTOP)
    fleet.drive("red", *range(5, 13))
    told = fleet.harness.diagnostics
    made = lambda: [status.message for m in told for status in m.status if "arrived at the mapper" in status.message]  # noqa: E731
    fleet.harness.wait(lambda: any(" of 5 keyframes" in message for message in made()), "five keyframes")
    red.kill()
    red.wait()
    left = fleet.folder / "robots"
    assert len(list(left.glob("drive_red.*.unsent"))) == 1
    red = fleet.robot("red")
    fleet.drive("red", *range(6, 13))
    mapper.send_signal(signal.SIGCONT)
    fleet.received("red", 8)
    fleet.harness.wait(lambda: len(list(left.glob("*.unsent"))) == 1, "the first drive's file deleted")
    red.kill()
    red.wait()
    red = fleet.robot("red")
    fleet.drive("red", *range(4, 9))
    fleet.received("red", 10)
    odometry = [(e.from_node, e.to_node) for e in fleet.map().constraints if e.kind == "odometry"]
    assert odometry == [(0, 1), (1, 2), (2, 3), (3, 4), (5, 6), (6, 7), (8, 9)]
    red.send_signal(signal.SIGINT)
    red.wait(180)
    assert not left.exists()


@pytest.mark.weights
def test_a_keyframe_is_at_most_100_kB_on_the_wire(recording: Path) -> None:
    """Descriptors are received as they were sent; a cloud that is too large is downsampled until it fits, a small
    one is not changed."""
    from dpm2_core.network.pretrained import load_network
    from dpm2_core.slam.store.cloud_codec import unpack_cloud

    points = next(iter(open_source(recording, InputSettings(images=False)).frames(0, 1))).points
    descriptors = load_network("small", 1).describe(Frame(0, points))
    tilted = replace(descriptors, up=np.array([0.6, 0, 0.8], np.float32))  # no base defines the level: not sent
    assert descriptors_from_msg(descriptors_to_msg(tilted, 5, "red/kf_1.00000000")) == (None, "")
    room = replace(descriptors, scale=5.0)
    assert descriptors_from_msg(descriptors_to_msg(room, 5, "red/kf_1.00000000")) == (None, "")
    for cloud in (points, points[::50]):
        keyframe = Keyframe(1, 2, 3, np.eye(4), cloud, None, "", descriptors)
        seen, packed = payload_to_msgs(keyframe, "red/kf_1.00000000", "0123456789abcdef")
        size = len(serialize_message(seen)) + len(serialize_message(packed))
        assert size < 99_500  # the pose adds 0.7 kB
        again, weights = descriptors_from_msg(seen)
        assert again is not None
        assert weights == "0123456789abcdef"
        np.testing.assert_array_equal(again.values, descriptors.values)
        np.testing.assert_array_equal(again.xyz, descriptors.xyz)
        assert isinstance(packed, UInt8MultiArray)
        count = len(unpack_cloud(bytes(packed.data)))
        assert count == len(cloud) if len(cloud) < 3000 else 4000 < count < len(cloud)
