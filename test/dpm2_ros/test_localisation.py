# SPDX-License-Identifier: Apache-2.0
"""A slam_node process localizes, over real DDS, in a map that `dpm2 run --map` made; the map does not change."""

from __future__ import annotations

import hashlib
import shutil
import signal
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from geometry_msgs.msg import PoseWithCovarianceStamped
from nav_msgs.msg import Odometry
from rcl_interfaces.msg import Parameter, ParameterType, ParameterValue
from rcl_interfaces.srv import SetParameters
from sensor_msgs.msg import PointCloud2
from std_srvs.srv import SetBool, Trigger

from dpm2_core.data import naming
from dpm2_core.data.open import open_source
from dpm2_core.data.settings import InputSettings
from dpm2_core.data.transforms import transform_matrix
from dpm2_core.errors import UsageError
from dpm2_core.frame import Array
from dpm2_core.geometry import se3
from dpm2_core.slam.store.check import check_map
from dpm2_ros.conversions import cloud_to_msg, header, pose_to_msg
from dpm2_ros.slam_node import SlamNode
from dpm2_ros.tf_message import TFMessage

from ..helpers.command import dpm2

pytestmark = pytest.mark.weights
ODOMETRY = "slam.registration=geometric"
"""Odometry from one scan to the next; place recognition uses the network nevertheless."""


@pytest.fixture(scope="module")
def made(recording: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The map of the recording, as the command makes it."""
    folder = tmp_path_factory.mktemp("map")
    done = dpm2("run", recording, "--out", folder / "out", "--map", folder / "drive.dpm2map", "--set", ODOMETRY)
    assert done.returncode == 0, done.stderr
    return folder / "drive.dpm2map"


def digest(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


class Robot:
    """A slam_node process, its LiDAR, and subscriptions."""

    def __init__(self, harness: Any, recording: Path, log: Path, *parameters: str) -> None:
        self.harness, self.log, self._stamp = harness, log, 100_000_000_000
        self._source = open_source(recording, InputSettings(images=False))
        self.lidar = harness.publisher(PointCloud2, naming.POINTS)
        self.odom = harness.hear(Odometry, "/dpm2/odom")
        self.tf = harness.hear(TFMessage, "/tf")
        self.diagnostics = harness.diagnostics
        pairs = ["input.images:=false", "ros.map_directory:=''", ODOMETRY.replace("=", ":="), *parameters]
        arguments = ["--ros-args", *(part for pair in pairs for part in ("-p", pair))]
        self.process = harness.start("slam_node", arguments, log)
        harness.wait(self._ready, "slam_node")
        harness.find("slam_node")

    def _ready(self) -> bool:
        assert self.process.poll() is None, self.log.read_text()
        return bool(self.lidar.get_subscription_count() and self.message(""))

    def send(self, *frames: int) -> None:
        """Publish scans 0.1 s apart, whatever their position in the drive, each after the odometry of the one before.
        No two scans are identical, even if repeated, as with a real LiDAR."""
        for n in frames:
            frame = next(iter(self._source.frames(n, n + 1)))
            self._stamp += 100_000_000
            frame.points[:, 3] += self._stamp % 1_000_000_007 * 1e-12
            before = len(self.odom)
            self.lidar.publish(cloud_to_msg(frame.points, self._stamp, "lidar"))
            self.harness.wait(lambda before=before: len(self.odom) > before, f"the odometry of scan {n}")

    def go_back(self, seconds: float) -> None:
        """Set the LiDAR's clock back."""
        self._stamp -= round(seconds * 1e9)

    def stand(self, frame: int, condition: Callable[[], Any], what: str) -> None:
        """Publish the same scan repeatedly, until the condition is true."""

        def again() -> Any:
            self.send(frame)
            return condition()

        self.harness.wait(again, what, timeout=120)

    def message(self, part: str) -> str:
        """The last status of a part."""
        statuses = [s for m in self.diagnostics for s in m.status if s.name.endswith(part)]
        return f"{statuses[-1].message} " if statuses else ""

    def off(self, T_map_lidar: Array) -> float:
        """Distance between a pose and the robot's by the last transforms, m; infinite before map -> odom is known."""
        last = {t.child_frame_id: transform_matrix(t.transform) for m in self.tf for t in m.transforms}
        if "odom" not in last:
            return np.inf
        return float(np.linalg.norm((last["odom"] @ last["lidar"] - T_map_lidar)[:3, 3]))

    def point(self, T_map_lidar: Array, frame: str) -> None:
        """Publish an initial pose, as RViz does."""
        message = PoseWithCovarianceStamped(header=header(0, frame))
        message.pose.pose = pose_to_msg(T_map_lidar)
        publisher = self.harness.publisher(PoseWithCovarianceStamped, "/initialpose")
        self.harness.wait(publisher.get_subscription_count, "slam_node's subscription")
        publisher.publish(message)

    def close(self) -> int:
        self.process.send_signal(signal.SIGINT)
        return self.process.wait(180)


@pytest.fixture
def robot(ros: Callable[..., Any], recording: Path, tmp_path: Path) -> Callable[..., Robot]:
    return lambda *parameters: Robot(ros(), recording, tmp_path / "log", *parameters)


def place(recording: Path, n: int) -> Array:
    """T_map_lidar of a scan, (4, 4): the map's frame is that of the first one."""
    poses = open_source(recording, InputSettings(images=False)).poses
    assert poses is not None
    return np.asarray(se3.inverse(poses[0]) @ poses[n])


def test_finds_itself_tracks_and_notices_being_carried_off(
    robot: Callable[..., Robot], recording: Path, made: Path, tmp_path: Path
) -> None:
    """It starts in the middle of the map, and is carried back while it runs; the file never changes."""
    before = digest(made)
    r = robot(f"ros.map_file:={made}", "ros.localization_mode:=true", "slam.keyframes.distance:=2.0")
    assert "relocalising" in r.message("slam_node: localisation")
    r.send(*range(8, 17))
    r.harness.wait(lambda: r.message("slam_node: localisation").startswith(("relocalised", "tracking")), "a result")
    r.send(17, 18)
    r.harness.wait(lambda: r.off(place(recording, 18)) < 0.1, "its place in the map")
    r.harness.wait(lambda: r.message("slam_node: localisation").startswith("tracking"), "the second result")
    seen = len(r.diagnostics)
    r.send(19)  # the published state is that at the last cloud
    info = lambda: [s.message for d in r.diagnostics[seen:] for s in d.status if s.name.endswith("odometry")]  # noqa: E731
    r.harness.wait(lambda: any(text.startswith("track") for text in info()), "the state")
    # carried off: scans from 15 m behind, which the odometry cannot follow
    r.stand(3, lambda: r.off(place(recording, 3)) < 0.2, "the robot where it was put")
    assert r.close() == 0
    log = r.log.read_text()
    assert "found at" in log
    assert "Traceback" not in log
    assert digest(made) == before
    assert sorted(path.name for path in made.parent.iterdir()) == ["drive.dpm2map", "out"]


def test_hints_and_services_give_reasons(
    robot: Callable[..., Robot], recording: Path, made: Path, tmp_path: Path
) -> None:
    """A hint in another frame, a save of a map that does not change, a file that is gone: each is rejected, and the
    drive continues."""
    r = robot(f"ros.map_file:={made}", "ros.localization_mode:=true")
    r.stand(0, lambda: r.off(np.eye(4)) < 0.2, "map -> odom")
    r.point(np.eye(4), "odom")
    r.harness.wait(lambda: "want it in frame map, not in 'odom'" in r.log.read_text(), "the warning")
    saved = r.harness.call(Trigger, "/slam_node/save_map")
    assert not saved.success
    reset = r.harness.call(Trigger, "/slam_node/reset")
    assert (reset.success, "and the search" in reset.message) == (True, True)  # the map is kept
    # without its file the map cannot be loaded again, and the robot keeps what it has loaded
    made_elsewhere = made.rename(made.with_name("gone.dpm2map"))
    try:
        result = r.harness.call(Trigger, "/slam_node/load_map")
        assert not result.success
        assert "no such map file" in result.message
    finally:
        made_elsewhere.rename(made)
    loaded = r.harness.call(Trigger, "/slam_node/load_map")
    assert loaded.success, loaded.message
    r.harness.wait(lambda: "relocalising" in r.message("slam_node: localisation"), "the new search")
    r.point(np.eye(4), "map")
    seen = len(r.tf)
    again = lambda: any(t.header.frame_id == "map" for m in r.tf[seen:] for t in m.transforms)  # noqa: E731
    r.stand(1, again, "the robot in the map again")
    r.go_back(20.0)  # its clock is set back: odom starts again, so the robot must be relocalized in the map
    r.stand(3, lambda: "time went back" in r.log.read_text(), "the restart")
    seen = len(r.tf)
    r.stand(3, lambda: again() and r.off(place(recording, 3)) < 0.2, "the robot in the map after the jump")


@pytest.mark.long
def test_from_mapping_to_localizing_and_back(robot: Callable[..., Robot], tmp_path: Path) -> None:
    """One node makes a map, localizes in it, and extends it by a session; each response has a message."""
    path = tmp_path / "own.dpm2map"
    r = robot(f"ros.map_file:={path}", "slam.keyframes.distance:=2.0")
    assert not r.harness.call(Trigger, "/slam_node/load_map").success
    growing = r.harness.call(SetBool, "/slam_node/localization_mode", data=False)
    assert growing.success
    assert "already" in growing.message
    r.send(*range(8))
    localizing = r.harness.call(SetBool, "/slam_node/localization_mode", data=True)
    assert localizing.success, localizing.message
    before = digest(path)
    early = r.harness.call(SetBool, "/slam_node/localization_mode", data=False)
    assert not early.success
    assert "relocalising" in early.message

    def extended() -> bool:
        r.send(8, 9)
        assert digest(path) == before
        return r.harness.call(SetBool, "/slam_node/localization_mode", data=False).success

    r.harness.wait(extended, "the robot in its map")
    r.send(*range(10, 20))
    assert r.close() == 0
    from dpm2_core.slam.store.map_data import load_map
    from dpm2_core.slam.store.map_store import MapStore

    with MapStore.open(path) as store:
        data = load_map(store)
    assert {k.session for k in data.keyframes} == {1, 2}
    assert len({(k.robot, k.id) for k in data.keyframes}) == len(data)


@pytest.mark.long
def test_another_map_by_its_name_while_the_node_runs(
    robot: Callable[..., Robot], recording: Path, made: Path, tmp_path: Path
) -> None:
    """It switches from a map that is being made to a saved one; a map that cannot be loaded changes nothing."""
    maps = tmp_path / "maps"
    maps.mkdir()
    shutil.copy(made, maps / "town.dpm2map")
    r = robot(f"ros.map_directory:={maps}", "slam.keyframes.distance:=2.0")
    r.send(*range(6))

    def named(name: str) -> Any:
        value = ParameterValue(type=ParameterType.PARAMETER_STRING, string_value=name)
        request = [Parameter(name="ros.map_name", value=value)]
        return r.harness.call(SetParameters, "/slam_node/set_parameters", parameters=request).results[0]

    refused = named("../town")
    assert not refused.successful
    assert "map_name" in refused.reason
    assert not r.harness.call(Trigger, "/slam_node/load_map").success  # no map is named
    assert named("nowhere").successful
    lost = r.harness.call(Trigger, "/slam_node/load_map")
    assert (lost.success, "no such map file" in lost.message) == (False, True)
    assert named("start").successful
    assert "start.dpm2map" in r.harness.call(Trigger, "/slam_node/save_map").message
    assert named("town").successful
    before = digest(maps / "town.dpm2map")
    loaded = r.harness.call(Trigger, "/slam_node/load_map")
    assert loaded.success, loaded.message
    r.stand(12, lambda: r.off(place(recording, 12)) < 0.2, "the robot in the other map")
    assert r.close() == 0
    assert digest(maps / "town.dpm2map") == before
    for name in ("drive", "start"):
        assert check_map(maps / f"{name}.dpm2map").problems == []


def test_a_map_that_is_not_there_is_an_error_of_use(ros: Callable[..., Any], tmp_path: Path) -> None:
    ros(f"ros.map_file:={tmp_path / 'none'}", "ros.localization_mode:=true")
    with pytest.raises(UsageError, match="no such map file"):
        SlamNode()
