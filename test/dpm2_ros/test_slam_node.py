# SPDX-License-Identifier: Apache-2.0
"""slam_node over real DDS: a test publishes clouds and images and subscribes to what comes out."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import TransformStamped
from nav_msgs.msg import OccupancyGrid, Odometry
from nav_msgs.msg import Path as PathMsg
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import CameraInfo, Image, PointCloud2, PointField
from std_msgs.msg import String, UInt32MultiArray
from std_srvs.srv import Trigger
from visualization_msgs.msg import MarkerArray

from dpm2_core.data.messages import cloud_fields, decode_points, stamp_ns
from dpm2_core.data.topics import CAMERA_INFO, IMAGE, POINTS
from dpm2_core.data.transforms import transform_matrix
from dpm2_core.geometry import se3
from dpm2_ros.active_map import ActiveMap
from dpm2_ros.conversions import EARLIER, cloud_to_msg, header, stamp_to_msg, transform_to_msg
from dpm2_ros.keyframe_messages import BUDGET, received_to_msg
from dpm2_ros.slam_node import SlamNode
from dpm2_ros.tf import TFMessage
from dpm2_ros.unsent import KeyframeFile, left_behind

from ..helpers.diagnostics import figures, having, saying
from .conftest import pose, scan

LATCHED = QoSProfile(depth=10, durability=DurabilityPolicy.TRANSIENT_LOCAL, reliability=ReliabilityPolicy.RELIABLE)
ACCURATE = 0.05  # m: the scans are exact, sampled at 0.35 m, and averaged into voxels of 0.5 m


class Rig:
    """A slam_node, a LiDAR, and subscriptions."""

    def __init__(self, ros: Callable[..., Any], drive: Any, *parameters: str, reliable: bool = True, **options: Any):
        quiet = () if any(p.startswith("input.images") for p in parameters) else ("input.images:=false",)
        self.harness = ros(*quiet, *parameters, **options)
        self.drive = drive
        self.lidar = self.harness.publisher(PointCloud2, POINTS, reliable)
        self.odom = self.harness.hear(Odometry, f"{options.get('namespace', '')}/dpm2/odom")
        self.diagnostics = self.harness.diagnostics
        self.node: SlamNode = self.harness.add(SlamNode())
        self.wait = self.harness.wait
        self.wait(lambda: self.lidar.get_subscription_count(), "the subscription to the clouds")
        self.wait(lambda: self.node.count_subscribers(self.odom_topic), "the test's subscription")

    @property
    def odom_topic(self) -> str:
        return self.node.resolve_topic_name("dpm2/odom")

    def send(self, n: int, stamp: int | None = None, **changes: Any) -> None:
        message = self.drive.cloud(n, **changes)
        if stamp is not None:
            message.header.stamp = stamp_to_msg(stamp)
        self.lidar.publish(message)

    def send_and_wait(self, *numbers: int, **changes: Any) -> None:
        """One after the other, each when the one before has come out."""
        for n in numbers:
            before = len(self.odom)
            self.send(n, **changes)
            self.wait(lambda before=before: len(self.odom) > before, f"the odometry of cloud {n}")

    def status(
        self, part: str, condition: Callable[[DiagnosticStatus], Any], since: int | None = None
    ) -> DiagnosticStatus:
        """The first for which that holds."""
        found: DiagnosticStatus = self.harness.status(f"slam_node: {part}", condition, since)
        return found

    def processed(self, count: int) -> DiagnosticStatus:
        """The status of the odometry once so many clouds have been processed: what comes of a cloud may come before."""
        return self.status("odometry", having(processed=count), since=0)

    def mapped(self, count: int) -> None:
        """Until so many keyframes are in the map, and all that has to do with them is done."""
        self.status("mapper", having(keyframes=count, waiting=0))

    @property
    def keyframes(self) -> int:
        """In the map of the node."""
        return len(self.node.slam.mapper.keyframes)

    def stamps(self) -> list[int]:
        return [stamp_ns(message.header) for message in self.odom]


@pytest.fixture
def rig(ros: Callable[..., Any], drive: Any, monkeypatch: pytest.MonkeyPatch) -> Callable[..., Rig]:
    """Makes a Rig whose node sends diagnostics ten times a second."""
    monkeypatch.setattr("dpm2_ros.diagnostics.PERIOD", 0.1)
    return lambda *parameters, **options: Rig(ros, drive, *parameters, **options)


@pytest.mark.parametrize("reliable", [True, False], ids=["reliable", "best effort"])
def test_every_cloud_gives_its_pose(rig: Callable[..., Rig], drive: Any, reliable: bool) -> None:
    """Also from a best-effort publisher, which a reliable subscription would never hear."""
    r = rig("use_sim_time:=true", reliable=reliable)
    clock = r.harness.publisher(Clock, "/clock")
    r.wait(clock.get_subscription_count, "the subscription to /clock")
    for n in range(drive.frames):
        clock.publish(Clock(clock=stamp_to_msg(drive.stamp(n))))
        r.send_and_wait(n)
    assert r.stamps() == [drive.stamp(n) for n in range(drive.frames)]
    for n, message in enumerate(r.odom):
        T = transform_matrix(message.pose.pose)
        assert np.linalg.norm(T[:3, 3] - drive.pose(n)[:3, 3]) < ACCURATE
        assert (message.header.frame_id, message.child_frame_id) == ("odom", "lidar")
    covariance = np.array(r.odom[-1].pose.covariance).reshape(6, 6)
    assert (np.linalg.eigvalsh(covariance) > 0).all()
    assert np.trace(covariance) > np.trace(np.array(r.odom[5].pose.covariance).reshape(6, 6))  # uncertainty accumulates
    assert r.odom[-1].twist.twist.linear.x == pytest.approx(8.0, abs=0.6)  # 0.8 m in 0.1 s
    status = r.processed(16)
    values = figures(status)
    assert (values["received"], values["processed"], values["dropped (queue full)"]) == ("16", "16", "0")
    assert float(values["latency p95 (ms)"]) > 0
    assert status.level == DiagnosticStatus.OK


def test_keyframes_map_path_and_tf(rig: Callable[..., Rig], drive: Any) -> None:
    r = rig("ros.map_period:=0.1", "ros.path_period:=0.1", "slam.loops.descriptors:=true")
    hear = r.harness.hear
    keyframes, poses = hear(PointCloud2, "/dpm2/keyframe"), hear(Odometry, "/dpm2/keyframe_odom")
    maps, paths = hear(PointCloud2, "/dpm2/map", LATCHED), hear(PathMsg, "/dpm2/path", LATCHED)
    graphs, tf = hear(MarkerArray, "/dpm2/pose_graph", LATCHED), hear(TFMessage, "/tf")
    r.wait(lambda: r.node.count_subscribers("/tf") and r.node.count_subscribers("/dpm2/keyframe"), "subscriptions")
    r.send_and_wait(*range(drive.frames))
    r.wait(lambda: len(keyframes) == len(poses) >= 3, "three keyframes in 12 m")
    assert [k.header.frame_id for k in keyframes] == [f"kf_{n}" for n in range(len(keyframes))]
    assert [stamp_ns(k.header) for k in keyframes] == [stamp_ns(p.header) for p in poses]
    assert poses[1].child_frame_id == "kf_1"
    assert keyframes[1].width == 320  # all of a frame
    assert len(keyframes[1].data) <= BUDGET // 2  # the other half is the cloud's
    r.wait(lambda: maps and stamp_ns(maps[-1].header) == stamp_ns(poses[-1].header), "the map of the last keyframe")
    assert maps[-1].header.frame_id == "map"
    assert maps[-1].width > 1000
    r.wait(lambda: paths and len(paths[-1].poses) == len(poses), "the path")
    r.wait(lambda: graphs and len(graphs[-1].markers[0].points) == len(poses), "the pose graph")

    def links() -> dict[tuple[str, str], TransformStamped]:
        return {(t.header.frame_id, t.child_frame_id): t for message in tf for t in message.transforms}

    ahead = {("map", "odom"): 500_000_000, ("odom", "lidar"): 0}  # ns: map -> odom is valid until the next one
    last = {link: drive.stamp(drive.frames - 1) + ns for link, ns in ahead.items()}
    r.wait(lambda: {link: stamp_ns(t.header) for link, t in links().items()} == last, "the last transforms")
    pairs = links()
    moved = transform_matrix(pairs["odom", "lidar"].transform)
    np.testing.assert_allclose(moved, transform_matrix(r.odom[-1].pose.pose), atol=1e-9)


def test_the_map_is_bounded_and_built_only_for_listeners(rig: Callable[..., Rig], drive: Any) -> None:
    r = rig("ros.map_max_points:=1000", "ros.map_period:=0.1")
    r.send_and_wait(0, 1, 2)
    r.mapped(1)
    built, make = [], r.node.slam.mapper.cloud
    r.node.slam.mapper.cloud = lambda *sizes: (built.append(1), make(*sizes))[1]  # type: ignore[method-assign]
    time.sleep(0.3)
    assert not built  # there is no subscriber
    maps = r.harness.hear(PointCloud2, "/dpm2/map", LATCHED)
    r.wait(lambda: maps, "the map, once there is a subscriber")
    time.sleep(0.3)
    assert [m.width for m in maps] == [1000]  # and not again while nothing changes
    assert len(built) == 1


def test_the_grid_is_latched_bounded_and_soon_there(rig: Callable[..., Rig], drive: Any) -> None:
    """Built only for listeners; a late one gets it at once; house fronts occupied, the street free."""
    r = rig("ros.grid.resolution:=0.25", "ros.grid_max_cells:=200000")
    r.send_and_wait(0, 1)
    r.mapped(1)
    grids = r.harness.hear(OccupancyGrid, "/dpm2/grid", LATCHED)
    r.wait(lambda: grids, "the grid, once there is a subscriber")
    before = r.keyframes
    while r.keyframes == before:
        r.send_and_wait(len(r.odom))
    changed = time.monotonic()
    r.wait(lambda: stamp_ns(grids[-1].header) == r.node.slam.mapper.keyframes[-1].stamp, "the last keyframe's grid")
    assert time.monotonic() - changed < 30.0  # 0.5 s on a quiet machine
    latched: list[OccupancyGrid] = []
    late = r.harness.node.create_subscription(OccupancyGrid, "/dpm2/grid", latched.append, LATCHED)
    r.wait(lambda: latched, "the latched grid")
    r.harness.node.destroy_subscription(late)
    grid = latched[0]
    assert grid.header == grids[-1].header
    assert grid.header.frame_id == "map"
    assert grid.info.height * grid.info.width == len(grid.data) <= 200_000
    assert set(grid.data) == {-1, 0, 100}
    cells = np.array(grid.data).reshape(grid.info.height, grid.info.width)
    size, low = grid.info.resolution, grid.info.origin.position
    y = (np.argwhere(cells == 100)[:, 0] + 0.5) * size + low.y
    assert (np.abs(y) > 7.0).mean() > 0.95  # fronts are 8 to 12 m from the middle of the street
    on_the_way = cells[int((0.1 - low.y) // size), int((1.0 - low.x) // size)]
    assert on_the_way == 0


def test_it_is_silent_also_after_the_only_cloud(rig: Callable[..., Rig], monkeypatch: pytest.MonkeyPatch) -> None:
    """But not before it: a driver may take its time to start."""
    monkeypatch.setattr("dpm2_ros.state.SILENT", 0.5)
    r = rig()
    states = r.harness.hear(String, "/dpm2/state", LATCHED)
    r.wait(lambda: states, "the latched state")
    time.sleep(1.0)
    assert [s.data for s in states] == ["initialising"]
    r.send_and_wait(0)
    r.wait(lambda: [s.data for s in states] == ["initialising", "silent"], "the silence")


def test_the_state_is_latched_and_sent_at_each_change(rig: Callable[..., Rig], monkeypatch: pytest.MonkeyPatch) -> None:
    silent = lambda seconds: monkeypatch.setattr("dpm2_ros.state.SILENT", seconds)  # noqa: E731
    silent(300.0)  # clouds may take their time, but where it is the silence that is looked at
    r = rig()
    states = r.harness.hear(String, "/dpm2/state", LATCHED)
    r.wait(lambda: states, "the latched state")
    r.send_and_wait(0, 1, 2, 3)
    r.wait(lambda: [s.data for s in states] == ["initialising", "tracking"], "tracking, once")
    silent(1.0)
    r.wait(lambda: states[-1].data == "silent", "no more clouds")
    silent(300.0)
    r.send_and_wait(4)
    r.wait(lambda: states[-1].data == "tracking", "the next cloud")
    late = r.harness.node.create_subscription(String, "/dpm2/state", states.append, LATCHED)
    r.wait(lambda: len(states) >= 5, "the state, for who comes late")
    assert [s.data for s in states] == ["initialising", "tracking", "silent", "tracking", "tracking"]
    r.harness.node.destroy_subscription(late)


def test_tf_can_be_switched_off(rig: Callable[..., Rig]) -> None:
    r = rig("ros.publish_tf_odom:=false", "ros.publish_tf_map:=false")
    assert r.node.count_publishers("/tf") == 0


def test_a_namespace_holds_a_robot(rig: Callable[..., Rig]) -> None:
    r = rig("input.points_topic:=/kitti/velo/pointcloud", namespace="/robot_1")
    keyframes = r.harness.hear(PointCloud2, "/robot_1/dpm2/keyframe")
    r.wait(lambda: r.node.count_subscribers("/robot_1/dpm2/keyframe"), "the subscription")
    r.send_and_wait(0, 1)
    r.wait(lambda: keyframes, "a keyframe")
    assert keyframes[0].header.frame_id == "robot_1/kf_0"
    assert r.status("odometry", bool).name == "robot_1/slam_node: odometry"


def test_the_base_is_the_root_of_tf_static(rig: Callable[..., Rig], drive: Any) -> None:
    """The pose of base_link, which starts at the origin, although the LiDAR is mounted ahead, above and turned."""
    T_base_lidar = se3.exp([0.0, 0.05, 0.4, 1.0, 0.2, 1.5])
    r = rig()
    static = r.harness.publisher(TFMessage, "/tf_static", latched=True)
    static.publish(TFMessage(transforms=[transform_to_msg(T_base_lidar, 0, "base_link", "lidar")]))
    r.wait(lambda: "lidar" in r.node.calibration.transforms.frames, "/tf_static")
    r.send_and_wait(*range(8))
    for n, message in enumerate(r.odom):
        assert message.child_frame_id == "base_link"
        expected = T_base_lidar @ drive.pose(n) @ se3.inverse(T_base_lidar)
        assert np.linalg.norm(transform_matrix(message.pose.pose)[:3, 3] - expected[:3, 3]) < ACCURATE


T_BASE_SENSOR, T_SENSOR_LIDAR = se3.exp([0.0, 0.05, 0.4, 1.0, 0.2, 1.5]), se3.exp([0.1, 0.0, 0.0, 0.0, 0.0, 0.04])


def publish_static(r: Rig, parent: str, child: str, T: Any) -> None:
    """By a publisher of its own, as drivers and robot_state_publisher are."""
    publisher = r.harness.publisher(TFMessage, "/tf_static", latched=True)
    publisher.publish(TFMessage(transforms=[transform_to_msg(T, 0, parent, child)]))
    r.wait(lambda: child in r.node.calibration.transforms.frames, "/tf_static")


def test_nothing_is_published_before_the_base_is_reachable_and_nothing_is_lost(
    rig: Callable[..., Rig], drive: Any
) -> None:
    """The driver's part of /tf_static comes first, that of the robot with the base three clouds later."""
    r = rig("ros.base_frame:=base_link", "ros.tf_timeout:=0.1")
    keyframes, tf = r.harness.hear(Odometry, "/dpm2/keyframe_odom"), r.harness.hear(TFMessage, "/tf")
    r.wait(lambda: r.node.count_subscribers("/tf") and r.node.count_subscribers("/dpm2/keyframe_odom"), "subscriptions")
    publish_static(r, "os_sensor", "lidar", T_SENSOR_LIDAR)
    for n in range(3):
        r.send(n)
    note = "no transform from 'lidar' to 'base_link'; frames known: lidar, os_sensor"
    assert r.status("odometry", saying(note), since=0).level == DiagnosticStatus.ERROR
    r.processed(3)
    assert (r.odom, tf, keyframes) == ([], [], [])
    publish_static(r, "base_link", "os_sensor", T_BASE_SENSOR)
    r.send(3)
    r.wait(lambda: len(r.odom) == 4 and keyframes, "the poses that were held back")
    assert r.stamps() == [drive.stamp(n) for n in range(4)]
    T_base_lidar = T_BASE_SENSOR @ T_SENSOR_LIDAR
    for n, message in enumerate(r.odom):
        assert message.child_frame_id == "base_link"
        expected = T_base_lidar @ drive.pose(n) @ se3.inverse(T_base_lidar)
        assert np.linalg.norm(transform_matrix(message.pose.pose)[:3, 3] - expected[:3, 3]) < ACCURATE
    np.testing.assert_allclose(transform_matrix(keyframes[0].pose.pose), np.eye(4), atol=1e-9)
    children = lambda: {t.child_frame_id for message in tf for t in message.transforms}  # noqa: E731
    r.wait(lambda: children() == {"odom", "base_link"}, "/tf")


def test_poses_kept_for_a_base_are_bounded(
    rig: Callable[..., Rig], drive: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Then the drive begins anew: what is published at last is a whole drive from its first pose on."""
    monkeypatch.setattr("dpm2_ros.slam_node.HELD", 3)
    r = rig("ros.base_frame:=base_link", "ros.tf_timeout:=0.0")
    for n in range(5):
        r.send(n)
    r.processed(5)
    publish_static(r, "base_link", "lidar", np.eye(4))
    r.send(5)
    r.wait(lambda: len(r.odom) == 2, "the poses")
    assert r.stamps() == [drive.stamp(4), drive.stamp(5)]
    np.testing.assert_allclose(transform_matrix(r.odom[0].pose.pose), np.eye(4), atol=1e-9)


def test_a_parent_that_comes_late_becomes_the_base(rig: Callable[..., Rig], drive: Any) -> None:
    """No base is asked for, and the driver's part of /tf_static comes first. odom and map go on as they are."""
    r = rig()
    tf = r.harness.hear(TFMessage, "/tf")
    publish_static(r, "os_sensor", "lidar", T_SENSOR_LIDAR)
    r.send_and_wait(*range(4))
    publish_static(r, "base_link", "os_sensor", T_BASE_SENSOR)
    r.send_and_wait(*range(4, 8))
    for n, message in enumerate(r.odom):
        T_odom_sensor = T_SENSOR_LIDAR @ drive.pose(n) @ se3.inverse(T_SENSOR_LIDAR)
        expected = T_odom_sensor if n < 4 else T_odom_sensor @ se3.inverse(T_BASE_SENSOR)
        assert message.child_frame_id == ("os_sensor" if n < 4 else "base_link")
        np.testing.assert_allclose(transform_matrix(message.pose.pose), expected, atol=ACCURATE)

    def since() -> set[str]:
        return {t.child_frame_id for m in tf for t in m.transforms if stamp_ns(t.header) >= drive.stamp(4)}

    r.wait(lambda: "base_link" in since(), "/tf")
    assert "os_sensor" not in since()  # it has a parent


def test_the_lidars_own_frame_is_the_base_where_tf_static_does_not_name_it(rig: Callable[..., Rig]) -> None:
    r = rig("ros.tf_timeout:=0.2")
    publish_static(r, "base_link", "camera", np.eye(4))
    r.send_and_wait(0, 1)
    assert [message.child_frame_id for message in r.odom] == ["lidar", "lidar"]


def test_stamps_of_another_clock_are_reported(rig: Callable[..., Rig]) -> None:
    """A recording without /clock, or a sensor whose clock is not set: a warning with both values."""
    r = rig()
    r.send_and_wait(0, 1, 2)
    status = r.status("odometry", saying("tracking; clouds are stamped"), since=0)
    assert status.level == DiagnosticStatus.WARN
    stamp, _, message = status.message.partition(" s (2023-11-14 22:13:20 UTC), the clock of this machine says")
    assert stamp.startswith("tracking; clouds are stamped 1700000000.")
    assert message.endswith("a recording wants use_sim_time and /clock")
    values = figures(status)
    assert stamp.endswith(values["cloud stamp (s)"])
    assert abs(float(values["clock (s)"]) - time.time()) < 60


def test_sim_time_without_a_clock_is_reported(rig: Callable[..., Rig]) -> None:
    r = rig("use_sim_time:=true")
    r.send_and_wait(0, 1, 2)
    status = r.status("odometry", lambda s: s.message.endswith("use_sim_time is on, and /clock has no publisher"), 0)
    assert status.level == DiagnosticStatus.WARN


class Camera:
    """A camera of black images, 8 by 6 pixels."""

    def __init__(self, r: Rig, image: str = IMAGE, info: str = CAMERA_INFO, frame: str = "camera") -> None:
        self._rig, self._frame = r, frame
        self._image, self._info = r.harness.publisher(Image, image), r.harness.publisher(CameraInfo, info)
        r.wait(
            lambda: self._image.get_subscription_count() and self._info.get_subscription_count(),
            "subscribers",
        )

    def send(self, n: int, offset: float = 0.0) -> None:
        stamp = self._rig.drive.stamp(n) + round(offset * 1e9)
        info = CameraInfo(height=6, width=8, distortion_model="plumb_bob", k=[5.0, 0, 4, 0, 5, 3, 0, 0, 1])
        info.p = [5.0, 0, 4, 0, 0, 5, 3, 0, 0, 0, 1, 0]
        image = Image(height=6, width=8, encoding="rgb8", step=24, data=bytes(144))
        for message in (info, image):
            message.header.stamp, message.header.frame_id = stamp_to_msg(stamp), self._frame
        self._info.publish(info)
        self._image.publish(image)


def with_camera(rig: Callable[..., Rig], *parameters: str) -> tuple[Rig, Camera]:
    r = rig("input.images:=true", *parameters)
    return r, Camera(r)


PLACE = "input.T_lidar_cam:=[0.0, 0.0, 0.0, 0.5, -0.5, 0.5, -0.5]"
AHEAD = np.array([[0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1.0]])
"""As a matrix."""


def test_an_image_joins_its_cloud(rig: Callable[..., Rig]) -> None:
    r, camera = with_camera(rig, PLACE, "ros.sync_timeout:=2.0")
    frames = record_frames(r)
    for n in range(4):
        camera.send(n, offset=0.01)
        r.send_and_wait(n)
    assert [len(frame.images) for frame in frames] == [1] * 4
    assert frames[0].images[0].pixels.shape == (6, 8, 3)
    np.testing.assert_allclose(frames[0].images[0].camera.T_lidar_cam[:3, 2], [1, 0, 0], atol=1e-9)  # looks ahead
    assert r.status("camera", saying("in use"), since=0).level == DiagnosticStatus.OK


def test_the_cloud_is_painted_into_its_image_for_who_looks(rig: Callable[..., Rig]) -> None:
    r, camera = with_camera(rig, PLACE, "ros.sync_timeout:=2.0")
    camera.send(0)
    r.send_and_wait(0)
    painted = r.harness.hear(Image, "/dpm2/projection", 1)
    r.wait(lambda: r.node.count_subscribers("/dpm2/projection"), "the subscription")
    camera.send(1)
    r.send_and_wait(1)
    r.wait(lambda: painted, "the projection")
    assert (painted[0].height, painted[0].width, painted[0].encoding) == (6, 8, "rgb8")
    assert (painted[0].header.frame_id, stamp_ns(painted[0].header)) == ("camera", r.drive.stamp(1))
    assert any(painted[0].data)  # the image itself is black
    r.send_and_wait(2)  # without an image
    assert len(painted) == 1


SECOND = "input.second_image_topic:=/rear/image"


def test_two_cameras_and_what_each_loss_costs(rig: Callable[..., Rig]) -> None:
    """The second looks back. Without a place it is left out, said; late and silent it costs its image alone."""
    r, camera = with_camera(rig, PLACE, SECOND, "ros.sync_timeout:=1.0")
    rear = Camera(r, "/rear/image", "/rear/camera_info", "rear")
    frames, T = record_frames(r), se3.exp([0, 0, np.pi, 0, 0, 0]) @ AHEAD
    shown = [r.harness.hear(Image, f"/dpm2/{name}", 5) for name in ("projection", "second_projection")]
    r.wait(lambda: r.node.count_subscribers("/dpm2/second_projection"), "the subscription")
    camera.send(0)
    rear.send(0)
    r.send_and_wait(0)
    missing = "no transform from 'rear' to 'lidar'; frames known: none; publish it on /tf_static; going on without"
    r.status("second camera", saying(missing), since=0)
    publish_static(r, "lidar", "rear", T)
    for n in (1, 2):
        camera.send(n)
        rear.send(n, offset=-0.03)
        r.send_and_wait(n)
    for part in ("camera", "second camera"):
        r.status(part, saying("in use"), since=0)
    rear.send(3)  # the first one has none
    r.send_and_wait(3)
    camera.send(4)
    r.send_and_wait(4)
    rear.send(4)  # too late
    r.status("second camera", having(received=5, used=4, late=1))
    topics = [[image.camera.name for image in frame.images] for frame in frames]
    assert topics == [[IMAGE], [IMAGE, "/rear/image"], [IMAGE, "/rear/image"], ["/rear/image"], [IMAGE]]
    np.testing.assert_allclose(frames[1].images[1].camera.T_lidar_cam, T, atol=1e-9)
    np.testing.assert_allclose(frames[1].images[1].camera.T_lidar_cam[:3, 2], [-1, 0, 0], atol=1e-9)
    r.wait(lambda: len(shown[0]) == 4 and len(shown[1]) == 3, "every image with its cloud")
    assert {message.header.frame_id for message in shown[1]} == {"rear"}
    r.status("second camera", saying("no image on /rear/image for"))
    assert figures(r.processed(5))["failed registrations"] == "0"


def test_two_cameras_of_one_frame_are_one_too_many(rig: Callable[..., Rig]) -> None:
    """As drivers of stereo cameras may send them: the second one's place is not known then."""
    r, camera = with_camera(rig, PLACE, SECOND, "ros.sync_timeout:=1.0")
    rear = Camera(r, "/rear/image", "/rear/camera_info")
    frames = record_frames(r)
    for n in range(2):
        camera.send(n)
        rear.send(n)
        r.send_and_wait(n)
    assert [len(frame.images) for frame in frames] == [1, 1]
    r.status("second camera", saying(f"its frame 'camera' is that of {IMAGE}: two cameras"), since=0)


def test_extrinsics_come_from_tf_static(rig: Callable[..., Rig]) -> None:
    r, camera = with_camera(rig, "ros.sync_timeout:=2.0")
    T = se3.exp([0.1, -1.2, 1.2, 0.3, 0.0, -0.1])
    publish_static(r, "lidar", "camera", T)
    frames = record_frames(r)
    for n in range(3):
        camera.send(n)
        r.send_and_wait(n)
    np.testing.assert_allclose(frames[-1].images[0].camera.T_lidar_cam, T, atol=1e-9)


def test_a_missing_extrinsic_rejects_the_images_and_says_so(rig: Callable[..., Rig]) -> None:
    r, camera = with_camera(rig, "ros.sync_timeout:=2.0")
    frames = record_frames(r)
    for n in range(3):
        camera.send(n)
        r.send_and_wait(n)
    assert [len(frame.images) for frame in frames] == [0] * 3
    status = r.status("camera", saying("no transform from 'camera' to 'lidar'"), since=0)
    assert status.level == DiagnosticStatus.ERROR
    assert "input.T_lidar_cam" in status.message


def test_times_that_the_motion_contradicts_are_said(rig: Callable[..., Rig], drive: Any) -> None:
    """Of a driver that de-skews its clouds and sends the times of their points all the same, on a robot that swings."""
    r = rig("input.images:=false")
    for n in range(14):
        points = scan(se3.exp([0, 0, 0.12 * np.sin(max(n - 3, 0) * np.pi / 6), 0, 0, 0]))
        columns = {name: points[:, i] for i, name in enumerate(("x", "y", "z"))}
        around = np.arctan2(points[:, 1], points[:, 0]) / (2 * np.pi) + 0.5
        columns["t"] = (around * drive.period).astype(np.uint32)
        message = PointCloud2(header=header(drive.stamp(n), "lidar"), **cloud_fields(columns, PointField))
        before = len(r.odom)
        r.lidar.publish(message)
        r.wait(lambda before=before: len(r.odom) > before, f"the odometry of cloud {n}")
    status = r.status("odometry", saying("slam.preprocess.deskew"))
    assert status.level == DiagnosticStatus.WARN


def test_two_lidars_are_one_scan(rig: Callable[..., Rig], drive: Any) -> None:
    """Each sees one side of the street; the second is turned and stands to the right. Then it stops."""
    r = rig("input.second_points_topic:=/right", "ros.sync_timeout:=2.0", "input.vertical_angle_correction_deg:='0.0'")
    T = se3.exp([0, 0, -1.5, 0.3, -0.5, 0.1])
    publish_static(r, "lidar", "right", T)
    right = r.harness.publisher(PointCloud2, "/right")
    frames = record_frames(r)
    for n in range(5):
        points = scan(pose(n))
        left = points[:, 1] > 0
        others = se3.transform(se3.inverse(T), points[~left])
        right.publish(cloud_to_msg(others, drive.stamp(n) - 20_000_000, "right"))
        before = len(r.odom)
        r.lidar.publish(cloud_to_msg(points[left], drive.stamp(n), "lidar"))
        r.wait(lambda before=before: len(r.odom) > before, f"the odometry of cloud {n}")
        np.testing.assert_allclose(frames[n].points, np.concatenate([points[left], points[~left]]), atol=1e-4)
    assert frames[-1].time_offset is not None
    assert set(np.round(frames[-1].time_offset, 6)) == {0.0, np.float32(-0.02)}
    r.status("second lidar", lambda s: s.message == "in use", since=0)
    r.send_and_wait(5)  # alone
    assert len(frames[5].points) == len(scan(pose(5)))
    r.processed(6)
    r.status("second lidar", having(received=5, used=5, late=0))


def test_a_camera_that_never_comes_comes_late_and_stops(rig: Callable[..., Rig], drive: Any) -> None:
    """Every cloud gets its pose all the while, and /diagnostics shows it."""
    r, camera = with_camera(rig, PLACE, "ros.sync_timeout:=0.05")
    frames = record_frames(r)
    r.send_and_wait(0, 1, 2)
    r.status("camera", saying("no image on /kitti/camera_color_left/image_raw yet"))
    seen = len(r.diagnostics)
    for n in range(3, 10):
        camera.send(n)
        r.status("camera", having(received=n - 2), since=seen)  # in time, however busy the machine is
        r.send_and_wait(n)
    assert r.status("camera", saying("in use"), since=seen).level == DiagnosticStatus.OK
    r.send_and_wait(*range(10, drive.frames))
    assert [bool(frame.images) for frame in frames] == [3 <= n < 10 for n in range(drive.frames)]
    assert r.status("camera", saying("no image")).level == DiagnosticStatus.WARN


def test_without_a_camera_no_cloud_waits_for_one(rig: Callable[..., Rig], drive: Any) -> None:
    """Images are wanted by default; a drive without any is as fast from its first cloud on as one that wants none."""
    r = rig("input.images:=true", "input.second_image_topic:=/rear/image", "ros.sync_timeout:=5.0")
    assert r.node.slam.odometry.uses_images
    began = time.monotonic()
    r.send_and_wait(*range(drive.frames))
    assert time.monotonic() - began < 20.0  # the first five would wait 5 s each; without it is under a second


def test_images_that_nothing_looks_at_are_not_received(rig: Callable[..., Rig]) -> None:
    r = rig("input.images:=true", "slam.visual.enabled:=false")
    assert r.node.count_subscribers(IMAGE) == 0
    r.send_and_wait(0)


def test_keyframes_that_no_mapper_has_received_are_counted(rig: Callable[..., Rig], drive: Any) -> None:
    """Without a mapper all are missing, a warning; once one acknowledges some, they are not."""
    r = rig("ros.embed_mapper:=false", "slam.keyframes.distance:=0.5")
    received = r.harness.publisher(UInt32MultiArray, "/dpm2/keyframes_received")
    r.wait(received.get_subscription_count, "the node")
    poses = r.harness.hear(Odometry, "/dpm2/keyframe_odom")
    r.wait(lambda: r.node.count_subscribers("/dpm2/keyframe_odom"), "the subscription")
    r.send_and_wait(*range(drive.frames))
    none = r.status("mapper", saying(f"0 of {drive.frames} keyframes"))
    assert none.level == DiagnosticStatus.WARN
    r.wait(lambda: poses, "a keyframe")
    received.publish(received_to_msg(poses[0].child_frame_id.rpartition(".")[2], 5, [7]))
    some = r.status("mapper", saying(f"6 of {drive.frames} keyframes"))
    assert some.level == DiagnosticStatus.OK


def test_keyframes_stay_on_the_disk_whoever_else_has_heard_them(rig: Callable[..., Rig], tmp_path: Path) -> None:
    """A recorder or RViz receives them, and no mapper."""
    r = rig("ros.embed_mapper:=false", "slam.keyframes.distance:=0.5", f"ros.map_directory:={tmp_path}")
    poses = r.harness.hear(Odometry, "/dpm2/keyframe_odom")
    r.wait(lambda: r.node.count_subscribers("/dpm2/keyframe_odom"), "the subscription")
    r.send_and_wait(*range(6))
    r.wait(lambda: len({pose.child_frame_id for pose in poses}) >= 6, "every keyframe, however often")
    r.harness.remove(r.node)
    ((_, path),) = left_behind(tmp_path, "")
    file = KeyframeFile(path)
    assert len(file) == 6
    file.close(keep=False)


def test_a_mapper_is_told_that_a_drive_is_over_that_it_has(rig: Callable[..., Rig]) -> None:
    """Else it goes on to place the odometry of the next one by the one before."""
    r = rig("ros.embed_mapper:=false", "slam.keyframes.distance:=0.5")
    received = r.harness.publisher(UInt32MultiArray, "/dpm2/keyframes_received")
    r.wait(received.get_subscription_count, "the node")
    poses = r.harness.hear(Odometry, "/dpm2/keyframe_odom")
    r.wait(lambda: r.node.count_subscribers("/dpm2/keyframe_odom"), "the subscription")
    r.send_and_wait(*range(6))
    r.wait(lambda: len({pose.child_frame_id for pose in poses}) >= 6, "every keyframe, however often")
    last = max(pose.child_frame_id for pose in poses)
    received.publish(received_to_msg(last.rpartition(".")[2], 6, []))
    r.status("mapper", saying("6 of 6 keyframes"))
    time.sleep(2.5)  # until it is certain, and nothing of this drive is sent again
    assert r.harness.call(Trigger, "/slam_node/reset").success
    r.wait(lambda: any(pose.child_frame_id == last + EARLIER for pose in poses), "the end of the drive", timeout=20)


def record_frames(r: Rig) -> list[Any]:
    """What the odometry is given."""
    frames: list[Any] = []
    process = r.node.slam.odometry.process

    def recording(frame: Any) -> Any:
        frames.append(frame)
        return process(frame)

    r.node.slam.odometry.process = recording  # type: ignore[method-assign]
    return frames


def test_bad_clouds_among_good_ones(rig: Callable[..., Rig], drive: Any) -> None:
    """Empty, of 50 points, all NaN, all zero, without x, cut short: each gets a pose, and the drive goes on."""
    r = rig()
    r.send_and_wait(*range(5))
    good = decode_points(drive.cloud(5))[0]
    bad = [good[:0], good[:50], np.full_like(good, np.nan), np.zeros_like(good), np.full_like(good, np.inf)]
    messages = [cloud_to_msg(points, drive.stamp(5 + n), "lidar") for n, points in enumerate(bad)]
    without_x = drive.cloud(10)
    without_x.fields = without_x.fields[1:]
    cut = drive.cloud(11)
    cut.data = cut.data[:1000]
    for message in (*messages, without_x, cut):
        before = len(r.odom)
        r.lidar.publish(message)
        r.wait(lambda before=before: len(r.odom) > before, "the pose of a bad cloud")
    assert np.isfinite(transform_matrix(r.odom[-1].pose.pose)).all()
    assert r.processed(12).level in (DiagnosticStatus.WARN, DiagnosticStatus.ERROR)
    r.send_and_wait(*range(12, drive.frames))
    assert len(r.odom) == drive.frames
    end = transform_matrix(r.odom[-1].pose.pose)[:3, 3]
    assert np.linalg.norm(end - drive.pose(drive.frames - 1)[:3, 3]) < 0.3
    assert figures(r.processed(drive.frames))["internal errors"] == "0"


def test_clouds_without_a_point_in_range_are_a_warning_from_the_first(rig: Callable[..., Rig], drive: Any) -> None:
    """As of a driver that sends millimeters: nothing has begun, and that is no good news."""
    r = rig()
    for n in range(3):
        points = decode_points(drive.cloud(n))[0] * np.float32(1000)
        r.lidar.publish(cloud_to_msg(points, time.time_ns(), "lidar"))  # the node's own clock: else that is a warning
        r.wait(lambda n=n: len(r.odom) > n, "the pose of a cloud")
    assert r.processed(3).level == DiagnosticStatus.WARN


def test_clouds_that_are_not_of_this_drive_leave_it_alone(rig: Callable[..., Rig], drive: Any) -> None:
    """In another frame, or unreadable with a stamp from anywhere: rejected, counted by their reason, no restart."""
    r = rig()
    r.send_and_wait(*range(3))
    others = [drive.cloud(3) for _ in range(3)]
    for broken, stamp in zip(others, (drive.stamp(0) - 10**12, drive.stamp(3) + 10**12), strict=False):
        broken.header.stamp, broken.fields = stamp_to_msg(stamp), broken.fields[1:]
    others[2].header.stamp = stamp_to_msg(-(10**9))
    others.append(drive.cloud(4, frame_id="another"))
    r.send_and_wait(3)
    for message in others:  # at once: two seconds after a cloud one in another frame begins another drive
        r.lidar.publish(message)
    r.wait(lambda: sum(r.node.rejections.values()) == 4, "the rejections")
    r.send_and_wait(*range(4, 8))
    assert r.stamps() == [drive.stamp(n) for n in range(8)]
    status = r.status("messages", lambda s: s.message.startswith("4 messages rejected"))
    counts = {key.rpartition(": ")[2]: value for key, value in figures(status).items()}
    assert counts == {"unreadable": "2", "stamp": "1", "another frame": "1", "internal errors": "0"}
    assert figures(r.processed(8))["lost on the way"] == "0"


def test_two_publishers_of_clouds_are_a_warning(rig: Callable[..., Rig]) -> None:
    """As of two robots without namespaces: 0.5 m off, tracking and degraded in turn, and nothing said why."""
    r = rig()
    r.send_and_wait(0)
    assert "publishers" not in r.processed(1).message
    other = r.harness.publisher(PointCloud2, POINTS)
    said = r.status("odometry", saying(f"2 publishers on {POINTS}: a drive has one LiDAR"))
    assert said.level == DiagnosticStatus.WARN
    r.harness.node.destroy_publisher(other)
    r.status("odometry", lambda s: "publishers" not in s.message)


def test_another_lidar_on_the_topic_begins_another_drive(
    rig: Callable[..., Rig], drive: Any, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    """Turned about and elsewhere on the robot, which goes on: its points were taken for those of the first one."""
    monkeypatch.setattr("dpm2_ros.subscriptions.OTHER_FRAME", 0.0)
    T_base_rear = se3.exp([0.0, 0.0, np.pi, -1.5, 0.0, 0.0])
    r = rig("ros.base_frame:=base_link")
    publish_static(r, "base_link", "lidar", np.eye(4))
    publish_static(r, "base_link", "rear", T_base_rear)
    r.send_and_wait(*range(4))
    for n in range(4, 8):
        r.lidar.publish(cloud_to_msg(scan(pose(n) @ T_base_rear), drive.stamp(n), "rear"))
        r.wait(lambda n=n: len(r.odom) > n, f"the odometry of cloud {n}")
    for n, message in enumerate(r.odom):
        expected = se3.inverse(drive.pose(0 if n < 4 else 4)) @ drive.pose(n)
        assert message.child_frame_id == "base_link"
        assert np.linalg.norm(transform_matrix(message.pose.pose)[:3, 3] - expected[:3, 3]) < ACCURATE
    assert "clouds come in frame rear, no longer in lidar: the odometry starts again" in capfd.readouterr().err


def test_stamps_that_repeat_or_go_back(rig: Callable[..., Rig], drive: Any) -> None:
    r = rig()
    r.send_and_wait(0, 1, 2)
    r.send(2)
    r.send(1)
    r.send_and_wait(3)
    assert r.stamps() == [drive.stamp(n) for n in range(4)]
    values = figures(r.processed(4))
    assert (values["rejected (stamp repeated)"], values["rejected (stamp out of order)"]) == ("1", "1")


@pytest.mark.parametrize("back", [1.5, 20.0], ids=["looped bag", "clock that was set"])
def test_time_that_goes_back_restarts_the_odometry_and_keeps_the_map(
    rig: Callable[..., Rig], drive: Any, back: float
) -> None:
    """Where the robot is in the map is not known then before a loop is found, and not published."""
    r = rig("slam.loops.enabled:=false")
    tf = r.harness.hear(TFMessage, "/tf")
    r.send_and_wait(*range(drive.frames))
    r.wait(lambda: r.keyframes == 3, "the keyframes at 0, 5.6 and 11.2 m")
    before = 3

    def map_to_odom() -> int:
        return sum(t.header.frame_id == "map" for message in tf for t in message.transforms)

    r.wait(lambda: map_to_odom() == drive.frames, "map -> odom of each cloud")
    for n in range(2):  # together: the second confirms the first
        r.send(n, stamp=drive.stamp(n + drive.frames) - round(back * 1e9) - drive.period)
    r.wait(lambda: len(r.odom) == drive.frames + 2, "the clouds after the jump")
    assert transform_matrix(r.odom[-2].pose.pose)[:3, 3] == pytest.approx([0, 0, 0], abs=1e-9)
    r.wait(lambda: r.keyframes == before + 1, "the keyframe after the jump")
    r.send_and_wait(2, stamp=drive.stamp(2 + drive.frames) - round(back * 1e9) - drive.period)
    assert figures(r.processed(drive.frames + 3))["restarts"] == "1"
    assert map_to_odom() == drive.frames  # none since


def test_one_cloud_stamped_far_ahead_costs_that_cloud_alone(rig: Callable[..., Rig], drive: Any) -> None:
    r = rig()
    r.send_and_wait(*range(5))
    stray, next_one = drive.cloud(5), drive.cloud(6)
    stray.header.stamp = stamp_to_msg(drive.stamp(5) + 86_400 * 10**9)
    for message in (stray, next_one):  # at once: half a second later it would be believed
        r.lidar.publish(message)
    r.wait(lambda: len(r.odom) == 6, "the cloud after it")
    r.send_and_wait(*range(7, drive.frames))
    assert r.stamps() == [drive.stamp(n) for n in range(drive.frames) if n != 5]
    values = figures(r.processed(drive.frames - 1))
    assert (values["rejected (stray stamp)"], values["restarts"]) == ("1", "0")
    end = transform_matrix(r.odom[-1].pose.pose)[:3, 3]
    assert np.linalg.norm(end - drive.pose(drive.frames - 1)[:3, 3]) < ACCURATE


def test_clouds_that_stop_are_noticed(rig: Callable[..., Rig]) -> None:
    r = rig()
    assert r.status("odometry", saying("no cloud on /kitti/velo/pointcloud yet")).level == DiagnosticStatus.STALE
    r.send_and_wait(0)
    assert r.status("odometry", saying("no cloud on /kitti/velo/pointcloud for")).level == DiagnosticStatus.STALE


def test_a_lidar_whose_clouds_are_less_reliable_than_asked_for_is_reported(ros: Callable[..., Any]) -> None:
    """It named the very topic as the one to listen to."""
    harness = ros("input.points_topic:=/points", "input.images:=false", "ros.reliability:=reliable")
    harness.publisher(PointCloud2, "/points", reliable=False)
    harness.add(SlamNode())
    status = harness.status("slam_node: odometry", saying("is best effort"))
    assert (status.level, status.message) == (
        DiagnosticStatus.ERROR,
        "/points is best effort, ros.reliability asks for reliable",
    )


def test_a_wrong_topic_is_reported_with_the_right_one(ros: Callable[..., Any], drive: Any) -> None:
    r = Rig.__new__(Rig)
    r.harness = ros("input.points_topic:=/points", "input.images:=false")
    r.harness.publisher(PointCloud2, "/os_cloud/points")
    r.harness.add(SlamNode())
    r.status("odometry", saying("are published on /os_cloud/points"))


def test_an_overloaded_node_drops_the_oldest_and_counts(rig: Callable[..., Rig], drive: Any) -> None:
    r = rig("ros.queue_depth:=2")
    process, going_on = r.node.slam.odometry.process, threading.Event()
    r.node.slam.odometry.process = lambda frame: (going_on.wait(), process(frame))[1]  # type: ignore[method-assign]
    try:
        for n in range(8):
            r.send(n)
            r.status("odometry", having(received=n + 1))
    finally:
        going_on.set()  # the node ends after the cloud that it is at
    r.wait(lambda: r.stamps() and r.stamps()[-1] == drive.stamp(7), "the last cloud")
    values = figures(r.processed(len(r.odom)))
    assert int(values["dropped (queue full)"]) == 8 - len(r.odom) > 0
    assert values["received"] == "8"


def test_save_map_says_what_it_did(rig: Callable[..., Rig], drive: Any, tmp_path: Path) -> None:
    r = rig(f"ros.map_directory:={tmp_path / 'map'}")
    result = r.harness.call(Trigger, "/slam_node/save_map")
    assert (result.success, result.message) == (False, "no map is saved: there is no keyframe yet")
    r.send_and_wait(0, 1)
    result = r.harness.call(Trigger, "/slam_node/save_map")
    assert result.success
    assert result.message == (
        f"map of 1 keyframes saved in {tmp_path / 'map' / 'drive'}, and as {tmp_path / 'map' / 'drive.dpm2map'}"
    )
    assert sorted(path.name for path in (tmp_path / "map" / "drive").iterdir()) == [
        "map.ply",
        "pose_graph.g2o",
        "trajectory.tum",
    ]


def test_clouds_are_processed_while_a_map_is_saved(
    rig: Callable[..., Rig], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A large map takes seconds."""
    begun, may_end, save = threading.Event(), threading.Event(), ActiveMap.save

    def slow(self: ActiveMap, name: str = "") -> str:
        begun.set()
        assert may_end.wait(60)
        return save(self, name)

    monkeypatch.setattr(ActiveMap, "save", slow)
    r = rig(f"ros.map_directory:={tmp_path / 'map'}")
    r.send_and_wait(0)
    results: list[Any] = []
    caller = threading.Thread(target=lambda: results.append(r.harness.call(Trigger, "/slam_node/save_map")))
    caller.start()
    try:
        assert begun.wait(60)
        r.send_and_wait(1, 2, 3)
        assert not results
    finally:
        may_end.set()
        caller.join()
    assert results[0].success


def test_a_map_that_cannot_be_saved_is_a_response(rig: Callable[..., Rig], drive: Any, tmp_path: Path) -> None:
    """The disk is full as far as the file system goes: the map's folder is a file."""
    r = rig(f"ros.map_directory:={tmp_path / 'map'}", f"ros.map_file:={tmp_path / 'a.dpm2map'}")
    r.send_and_wait(0)
    r.mapped(1)
    (tmp_path / "map").write_text("in the way")
    result = r.harness.call(Trigger, "/slam_node/save_map")
    assert not result.success
    assert str(tmp_path / "map") in result.message
    (tmp_path / "map").unlink()  # so that the end of the node can save


def test_a_reset_that_cannot_save_the_map_changes_nothing(rig: Callable[..., Rig], drive: Any, tmp_path: Path) -> None:
    """Neither the odometry nor the robot's place; the response says why."""
    r = rig(f"ros.map_directory:={tmp_path / 'map'}", f"ros.map_file:={tmp_path / 'a.dpm2map'}")
    tf = r.harness.hear(TFMessage, "/tf")
    r.send_and_wait(*range(6))
    r.mapped(1)
    (tmp_path / "map").write_text("in the way")
    result = r.harness.call(Trigger, "/slam_node/reset")
    assert not result.success
    assert "no reset: " in result.message
    assert str(tmp_path / "map") in result.message
    placed = lambda: [t for m in tf for t in m.transforms if t.child_frame_id == "odom"]  # noqa: E731
    before = len(placed())
    r.send_and_wait(6)
    assert transform_matrix(r.odom[-1].pose.pose)[0, 3] == pytest.approx(drive.pose(6)[0, 3], abs=0.1)
    r.wait(lambda: len(placed()) > before, "map -> odom")
    assert r.keyframes
    (tmp_path / "map").unlink()  # so that the end of the node can save


def test_reset_starts_again(rig: Callable[..., Rig], drive: Any) -> None:
    r = rig()
    r.send_and_wait(*range(6))
    r.mapped(1)
    assert r.harness.call(Trigger, "/slam_node/reset").success
    r.wait(lambda: r.keyframes == 0, "the empty map")
    r.send_and_wait(6)
    assert transform_matrix(r.odom[-1].pose.pose)[:3, 3] == pytest.approx([0, 0, 0], abs=1e-9)
