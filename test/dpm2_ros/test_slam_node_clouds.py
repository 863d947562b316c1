# SPDX-License-Identifier: Apache-2.0
"""Bad clouds, of another LiDAR, repeated, late, ahead, too many or none: slam_node continues and reports them."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticStatus
from nav_msgs.msg import Odometry
from sensor_msgs.msg import Image, Imu, NavSatFix, PointCloud2, PointField
from std_srvs.srv import Trigger

from dpm2_core.data.messages import cloud_fields, decode_points
from dpm2_core.data.naming import POINTS
from dpm2_core.data.transforms import transform_matrix
from dpm2_core.estimates import OdometryResult
from dpm2_core.frame import Frame
from dpm2_core.geometry import se3
from dpm2_ros.conversions import cloud_to_msg, header
from dpm2_ros.slam_node import SlamNode
from dpm2_ros.stamps import stamp_to_msg
from dpm2_ros.tf_message import TFMessage
from test.helpers.rig import ACCURATE, Rig, publish_static

from ..helpers.diagnostics import figures, having, saying
from .conftest import pose, scan


def test_times_that_the_motion_contradicts_are_said(rig: Callable[..., Rig], drive: Any) -> None:
    """A driver de-skews its clouds but still sends the times of the points, on a robot whose heading oscillates: a
    warning names the setting."""
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


def test_each_part_of_a_sweep_has_a_pose_and_none_has_failed(rig: Callable[..., Rig], drive: Any) -> None:
    """A driver sends a sweep in ten parts, before a reset and after it."""
    r = rig("input.images:=false")
    for n in range(4):
        if n == 2:
            assert r.harness.call(Trigger, "/slam_node/reset").success
        r.send_in_parts(n)
    assert r.stamps() == [drive.stamp(n) + 10_000_000 * k for n in range(4) for k in range(10)]
    assert figures(r.processed(40))["failed registrations"] == "0"


def test_bad_clouds_among_good_ones(rig: Callable[..., Rig], drive: Any) -> None:
    """Clouds that are empty, of 50 points, all NaN, all zero, without x, or truncated get a pose each, and the drive
    continues."""
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
    assert figures(r.status("messages", bool))["internal errors"] == "0"


def test_a_bug_costs_its_cloud_and_is_a_warning(
    rig: Callable[..., Rig], drive: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A bug costs one cloud's pose and gives a warning. Previously, bugs were counted, but nothing warned of them, and
    each filled a page of the log."""
    r = rig()
    r.send_and_wait(0)
    good = r.node.slam.odometry_step

    def step(frame: Frame) -> OdometryResult:
        if frame.stamp == drive.stamp(1):
            raise RuntimeError("a bug")
        return good(frame)

    monkeypatch.setattr(r.node.slam, "odometry_step", step)
    r.lidar.publish(drive.cloud(1))
    assert r.status("messages", lambda s: "1 internal errors" in s.message).level == DiagnosticStatus.WARN
    r.send_and_wait(2)
    assert r.stamps() == [drive.stamp(0), drive.stamp(2)]


def test_clouds_without_a_point_in_range_are_a_warning_from_the_first(rig: Callable[..., Rig], drive: Any) -> None:
    """If a driver sends millimeters, the odometry cannot start: this is a warning from the first cloud on."""
    r = rig()
    for n in range(3):
        points = decode_points(drive.cloud(n))[0] * np.float32(1000)
        r.lidar.publish(cloud_to_msg(points, time.time_ns(), "lidar"))  # the node's own clock: others are a warning
        r.wait(lambda n=n: len(r.odom) > n, "the pose of a cloud")
    assert r.processed(3).level == DiagnosticStatus.WARN


def test_clouds_that_are_not_of_this_drive_leave_it_alone(
    rig: Callable[..., Rig], drive: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Clouds in another frame, or unreadable with an arbitrary stamp, are rejected, counted by reason, and cause no
    restart."""
    monkeypatch.setattr("dpm2_ros.subscriptions.OTHER_FRAME", 300.0)  # s: longer than any pause of the machine
    r = rig()
    r.send_and_wait(*range(3))
    others = [drive.cloud(3) for _ in range(3)]
    for broken, stamp in zip(others, (drive.stamp(0) - 10**12, drive.stamp(3) + 10**12), strict=False):
        broken.header.stamp, broken.fields = stamp_to_msg(stamp), broken.fields[1:]
    others[2].header.stamp = stamp_to_msg(-(10**9))
    others.append(drive.cloud(4, frame_id="another"))
    r.send_and_wait(3)
    for message in others:
        r.lidar.publish(message)
    r.wait(lambda: sum(r.node.rejections.values()) == 4, "the rejections")
    r.send_and_wait(*range(4, 8))
    assert r.stamps() == [drive.stamp(n) for n in range(8)]
    status = r.status("messages", lambda s: s.message.startswith("4 messages rejected"))
    counts = {key.rpartition(": ")[2]: value for key, value in figures(status).items()}
    assert counts == {"unreadable": "2", "stamp": "1", "another frame": "1", "internal errors": "0"}
    assert figures(r.processed(8))["lost on the way"] == "0"


def test_two_publishers_of_clouds_are_a_warning(rig: Callable[..., Rig]) -> None:
    """Two robots without namespaces publish on one topic. Previously, poses were 0.5 m off, states alternated, and no
    message gave the reason."""
    r = rig()
    r.send_and_wait(0)
    assert "publishers" not in r.processed(1).message
    other = r.harness.publisher(PointCloud2, POINTS)
    said = r.status("odometry", saying(f"2 publishers on {POINTS}: a drive has one LiDAR"))
    assert said.level == DiagnosticStatus.WARN
    r.harness.destroy(other)
    r.status("odometry", lambda s: "publishers" not in s.message)


def test_another_lidar_on_the_topic_begins_another_drive(
    rig: Callable[..., Rig], drive: Any, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    """Another LiDAR, rotated and elsewhere on the moving robot, starts a new drive. Previously, its points were taken
    for the first one's."""
    monkeypatch.setattr("dpm2_ros.subscriptions.OTHER_FRAME", 0.0)
    T_base_rear = se3.exp([0.0, 0.0, np.pi, -1.5, 0.0, 0.0])
    r = rig("ros.base_frame:=base_link")
    publish_static(r, "base_link", "lidar", np.eye(4))
    publish_static(r, "base_link", "rear", T_base_rear)
    r.send_and_wait(*range(4))
    for n in range(4, 8):
        r.lidar.publish(cloud_to_msg(scan(pose(n) @ T_base_rear), drive.stamp(n), "rear"))
        r.wait(lambda n=n: len(r.odom) > n, f"the odometry of cloud {n}")
    assert {message.child_frame_id for message in r.odom} == {"base_link"}
    assert r.off(lambda n: se3.inverse(drive.pose(0 if n < 4 else 4)) @ drive.pose(n)) < ACCURATE
    assert "clouds come in frame rear, no longer in lidar: the odometry restarts" in capfd.readouterr().err


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
    """The robot's pose in the map is then unknown until a loop is found, and it is not published."""
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
    assert map_to_odom() == drive.frames  # none since the jump


def test_a_clock_that_is_set_back_by_less_than_a_second_costs_nothing(
    rig: Callable[..., Rig], drive: Any, capfd: pytest.CaptureFixture[str]
) -> None:
    """After a step of 0.5 s at 8 m/s, no cloud is lost. Previously, the clouds of that time were rejected, and the next
    was predicted 4 m too far back."""
    r, half = rig(), drive.frames // 2
    r.send_and_wait(*range(half))
    back = 500_000_000
    for n in range(half, drive.frames):
        r.send(n, stamp=drive.stamp(n) - back)
    r.wait(lambda: len(r.odom) == drive.frames, "the odometry of each cloud")
    assert r.stamps()[half:] == [drive.stamp(n) - back for n in range(half, drive.frames)]
    assert r.off(drive.pose) < ACCURATE
    assert "set back by less than a second; the drive continues" in capfd.readouterr().err


def test_one_cloud_stamped_far_ahead_costs_that_cloud_alone(
    rig: Callable[..., Rig], drive: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("dpm2_ros.synchronizer.HOLD", 300.0)  # on a busy machine half a second may pass between the two
    r = rig()
    r.send_and_wait(*range(5))
    stray, next_one = drive.cloud(5), drive.cloud(6)
    stray.header.stamp = stamp_to_msg(drive.stamp(5) + 86_400 * 10**9)
    for message in (stray, next_one):
        r.lidar.publish(message)
    r.wait(lambda: len(r.odom) == 6, "the cloud after it")
    r.send_and_wait(*range(7, drive.frames))
    assert r.stamps() == [drive.stamp(n) for n in range(drive.frames) if n != 5]
    values = figures(r.processed(drive.frames - 1))
    assert (values["rejected (stray stamp)"], values["restarts"]) == ("1", "0")
    end = transform_matrix(r.odom[-1].pose.pose)[:3, 3]
    assert np.linalg.norm(end - drive.pose(drive.frames - 1)[:3, 3]) < ACCURATE


def test_clouds_that_stop_are_noticed(rig: Callable[..., Rig], monkeypatch: pytest.MonkeyPatch) -> None:
    r = rig()
    before = r.status("odometry", saying("no cloud on /kitti/velo/pointcloud yet"))
    assert before.level == DiagnosticStatus.STALE
    assert "are published on" not in before.message  # the topic itself, whose publisher exists, was named
    r.send_and_wait(0)
    monkeypatch.setattr("dpm2_ros.slam_diagnostics.SILENT", 1.0)
    assert r.status("odometry", saying("no cloud on /kitti/velo/pointcloud for")).level == DiagnosticStatus.STALE


def test_a_lidar_whose_clouds_are_less_reliable_than_asked_for_is_reported(ros: Callable[..., Any]) -> None:
    """The error names the reliability. Previously, the message suggested to subscribe to the very same topic."""
    harness = ros("input.points_topic:=/points", "input.images:=false", "ros.reliability:=reliable")
    harness.publisher(PointCloud2, "/points", reliable=False)
    harness.add(SlamNode())
    status = harness.status("slam_node: odometry", saying("is best effort"))
    assert (status.level, status.message) == (
        DiagnosticStatus.ERROR,
        "/points is best effort, but ros.reliability is reliable: set it to auto",
    )


def test_other_sensors_that_are_less_reliable_than_asked_for_are_reported(ros: Callable[..., Any]) -> None:
    """The message names the reliability. Previously, it was "no image yet" and "no fix yet", and there was none for an
    IMU."""
    topics = ("input.image_topic:=/image", "input.imu_topic:=/imu", "input.gnss_topic:=/fix", "ros.odom_topic:=/wheels")
    harness = ros(*topics, "ros.odom_source:=topic", "ros.reliability:=reliable")
    sensors = {"camera": (Image, "/image"), "imu": (Imu, "/imu"), "gnss": (NavSatFix, "/fix")}
    sensors["other odometry"] = (Odometry, "/wheels")
    for kind, topic in sensors.values():
        harness.publisher(kind, topic, reliable=False)
    harness.add(SlamNode())
    for part, (_, topic) in sensors.items():
        says = f"{topic} is best effort, but ros.reliability is reliable: set it to auto"
        assert harness.status(f"slam_node: {part}", saying(says)).level != DiagnosticStatus.OK


def test_a_lidar_that_comes_back_less_reliable_than_asked_for_is_reported(
    rig: Callable[..., Rig], monkeypatch: pytest.MonkeyPatch
) -> None:
    r = rig("ros.reliability:=reliable")
    r.send_and_wait(0)
    monkeypatch.setattr("dpm2_ros.slam_diagnostics.SILENT", 1.0)
    r.harness.destroy(r.lidar)
    r.harness.publisher(PointCloud2, POINTS, reliable=False)
    assert r.status("odometry", saying(f"{POINTS} is best effort")).level == DiagnosticStatus.ERROR


def test_a_wrong_topic_is_reported_with_the_right_one(ros: Callable[..., Any]) -> None:
    harness = ros("input.points_topic:=/points", "input.images:=false")
    harness.publisher(PointCloud2, "/os_cloud/points")
    harness.add(SlamNode())
    harness.status("slam_node: odometry", saying("are published on /os_cloud/points"))


def test_an_overloaded_node_drops_the_oldest_and_counts(rig: Callable[..., Rig], drive: Any) -> None:
    r = rig("ros.queue_depth:=2")
    process, going_on = r.node.slam.odometry.process, threading.Event()
    r.node.slam.odometry.process = lambda frame: (going_on.wait(), process(frame))[1]  # type: ignore[method-assign]
    try:
        for n in range(8):
            r.send(n)
            r.status("odometry", having(received=n + 1))
    finally:
        going_on.set()  # the node ends after the current cloud
    r.wait(lambda: r.stamps() and r.stamps()[-1] == drive.stamp(7), "the last cloud")
    values = figures(r.processed(len(r.odom)))
    assert int(values["dropped (queue full)"]) == 8 - len(r.odom) > 0
    assert values["received"] == "8"
