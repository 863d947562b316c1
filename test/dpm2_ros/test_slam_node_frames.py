# SPDX-License-Identifier: Apache-2.0
"""How slam_node gets its base from /tf_static, early, late or never; and clocks that do not match."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticStatus
from nav_msgs.msg import Odometry
from rcl_interfaces.msg import Log
from sensor_msgs.msg import PointCloud2

from dpm2_core.data.messages import stamp_ns
from dpm2_core.data.transforms import transform_matrix
from dpm2_core.frame import Frame
from dpm2_core.geometry import se3
from dpm2_core.network.pretrained import load_network
from dpm2_ros.conversions import cloud_to_msg
from dpm2_ros.tf_message import TFMessage
from test.helpers.rig import ACCURATE, Rig, publish_static

from ..helpers.diagnostics import figures, saying
from .conftest import pose, scan

T_BASE_SENSOR, T_SENSOR_LIDAR = se3.exp([0.0, 0.05, 0.4, 1.0, 0.2, 1.5]), se3.exp([0.1, 0.0, 0.0, 0.0, 0.0, 0.04])


def test_tf_can_be_switched_off(rig: Callable[..., Rig]) -> None:
    r = rig("ros.publish_tf_odom:=false", "ros.publish_tf_map:=false")
    assert r.node.count_publishers("/tf") == 0


@pytest.mark.usefixtures("no_earlier_nodes")
def test_two_publishers_that_place_the_lidar_otherwise_are_told(rig: Callable[..., Rig]) -> None:
    """A warning is given if, for example, a robot description and a calibration differ. Previously, the extrinsics
    received last before the first cloud were used without a message, and the pose of the base depended on them."""
    r = rig("ros.base_frame:=base_link")
    log = r.harness.hear(Log, "/rosout")
    r.wait(lambda: r.harness.found_by(r.node, "/rosout"), "the subscription to the log")
    publish_static(r, "base_link", "lidar", se3.exp([0.0, 0.0, 0.0, 1.0, 0.0, 0.0]))
    publish_static(r, "base_link", "lidar", se3.exp([0.0, 0.0, 0.2, 1.3, 0.0, 0.0]))
    said = "/tf_static: lidar has moved by 0.32 m and 11.5 deg in base_link"
    r.wait(lambda: any(line.msg.startswith(said) for line in log), "the warning")


def test_a_namespace_holds_a_robot(rig: Callable[..., Rig]) -> None:
    r = rig("input.points_topic:=/kitti/velo/pointcloud", namespace="/robot_1")
    keyframes = r.harness.hear(PointCloud2, "/robot_1/dpm2/keyframe")
    r.wait(lambda: r.node.count_subscribers("/robot_1/dpm2/keyframe"), "the subscription")
    r.send_and_wait(0, 1)
    r.wait(lambda: keyframes, "a keyframe")
    assert keyframes[0].header.frame_id == "robot_1/kf_0"
    assert r.status("odometry", bool).name == "robot_1/slam_node: odometry"


def test_the_base_is_the_root_of_tf_static(rig: Callable[..., Rig], drive: Any) -> None:
    """The pose of base_link starts at the origin, although the LiDAR is mounted ahead, above and rotated."""
    T_base_lidar = se3.exp([0.0, 0.05, 0.4, 1.0, 0.2, 1.5])
    r = rig()
    publish_static(r, "base_link", "lidar", T_base_lidar)
    r.send_and_wait(*range(8))
    assert {message.child_frame_id for message in r.odom} == {"base_link"}
    assert r.off(lambda n: T_base_lidar @ drive.pose(n) @ se3.inverse(T_base_lidar)) < ACCURATE


@pytest.mark.weights
def test_a_lidar_that_hangs_sees_what_one_that_stands_does(rig: Callable[..., Rig], drive: Any) -> None:
    """A LiDAR that is mounted upside down gets the descriptors of an upright one, on which the network was trained.
    Thus a robot can be localized in the map of another one."""
    T_base_lidar, network = se3.exp([np.pi, 0.0, 0.0, 0.3, 0.0, 1.5]), load_network("small", 1)
    r = rig("slam.loops.descriptors:=true")
    publish_static(r, "base_link", "lidar", T_base_lidar)
    standing = scan(pose(0))
    hanging = se3.transform(se3.exp([-np.pi, 0, 0, 0, 0, 0]), standing)
    r.lidar.publish(cloud_to_msg(hanging.astype(np.float32), drive.stamp(0), "lidar"))
    r.mapped(1)
    seen = r.node.slam.mapper.keyframes[0].descriptors
    assert seen is not None
    found = network.register(seen, network.describe(Frame(0, standing)))  # T_standing_base: lever arm, no rotation
    assert found.ok
    np.testing.assert_allclose(found.T_target_source, se3.make(np.eye(3), -T_base_lidar[:3, 3]), atol=0.1)


@pytest.mark.weights
def test_the_network_is_told_how_a_lidar_hangs(rig: Callable[..., Rig], drive: Any) -> None:
    """With the network's odometry alone, whose poses are level, the base still starts at the origin."""
    T_base_lidar = se3.exp([np.pi, 0.0, 0.0, 0.3, 0.0, 1.5])
    r = rig("slam.registration:=neural")
    publish_static(r, "base_link", "lidar", T_base_lidar)
    for n in range(6):
        hanging = se3.transform(se3.exp([-np.pi, 0, 0, 0, 0, 0]), scan(drive.pose(n)))
        r.lidar.publish(cloud_to_msg(hanging.astype(np.float32), drive.stamp(n), "lidar"))
        r.processed(n + 1)
    np.testing.assert_allclose(r.node.slam.odometry.T_start[2, :3], T_base_lidar[2, :3], atol=1e-9)
    T_base_standing = se3.make(np.eye(3), T_base_lidar[:3, 3])
    assert r.off(lambda n: T_base_standing @ drive.pose(n) @ se3.inverse(T_base_standing)) < ACCURATE


@pytest.mark.weights
def test_the_network_is_not_told_amid_a_drive_how_a_lidar_hangs(rig: Callable[..., Rig], drive: Any) -> None:
    """If /tf_static arrives after the first cloud, the mounting is not applied during the drive. Otherwise level scans
    were compared with one upside down: 3.4 m off."""
    T_base_lidar = se3.exp([np.pi, 0.0, 0.0, 0.3, 0.0, 1.5])
    r = rig("slam.registration:=neural", "ros.base_frame:=base_link", "ros.tf_timeout:=0.1")
    for n in range(6):
        hanging = se3.transform(se3.exp([-np.pi, 0, 0, 0, 0, 0]), scan(drive.pose(n)))
        r.lidar.publish(cloud_to_msg(hanging.astype(np.float32), drive.stamp(n), "lidar"))
        r.processed(n + 1)
        if n == 0:
            publish_static(r, "base_link", "lidar", T_base_lidar)
            r.wait(lambda: "base_link" in r.node.calibration.transforms.frames, "the transform")
    T_base_standing = se3.make(np.eye(3), T_base_lidar[:3, 3])
    assert r.off(lambda n: T_base_standing @ drive.pose(n) @ se3.inverse(T_base_standing)) < ACCURATE


def test_nothing_is_published_before_the_base_is_reachable_and_nothing_is_lost(
    rig: Callable[..., Rig], drive: Any
) -> None:
    """The driver's part of /tf_static arrives first; the robot's part, with the base, three clouds later. Then all
    poses are published."""
    r = rig("ros.base_frame:=base_link", "ros.tf_timeout:=0.1")
    keyframes, tf = r.harness.hear(Odometry, "/dpm2/keyframe_odom"), r.harness.hear(TFMessage, "/tf")
    r.wait(
        lambda: r.harness.found_by(r.node, "/tf") and r.node.count_subscribers("/dpm2/keyframe_odom"), "subscriptions"
    )
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
    assert {message.child_frame_id for message in r.odom} == {"base_link"}
    assert r.off(lambda n: T_base_lidar @ drive.pose(n) @ se3.inverse(T_base_lidar)) < ACCURATE
    np.testing.assert_allclose(transform_matrix(keyframes[0].pose.pose), np.eye(4), atol=1e-9)
    children = lambda: {t.child_frame_id for message in tf for t in message.transforms}  # noqa: E731
    r.wait(lambda: children() == {"odom", "base_link"}, "/tf")


def test_poses_kept_for_a_base_are_bounded(
    rig: Callable[..., Rig], drive: Any, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    """If too many poses wait for the base, the drive begins anew: what is finally published is a whole drive from its
    first pose.

    The log names the preset of each of the two drives, and none before it is known.
    """
    monkeypatch.setattr("dpm2_ros.slam_node.HELD", 250_000_000)
    r = rig("ros.base_frame:=base_link", "ros.tf_timeout:=0.0")
    for n in range(5):
        r.send(n)
    r.processed(5)
    publish_static(r, "base_link", "lidar", np.eye(4))
    r.send(5)
    r.wait(lambda: len(r.odom) == 2, "the poses")
    assert r.stamps() == [drive.stamp(4), drive.stamp(5)]
    np.testing.assert_allclose(transform_matrix(r.odom[0].pose.pose), np.eye(4), atol=1e-9)
    lines = [line for line in capfd.readouterr().err.splitlines() if "slam.preset auto" in line]
    assert len(lines) == 2
    assert all("slam.preset auto: outdoor," in line for line in lines)


def test_poses_of_parts_are_kept_for_a_base_as_long_as_those_of_sweeps(rig: Callable[..., Rig], drive: Any) -> None:
    """At 100 Hz the drive began anew every 3 s, at 10 Hz every 30 s."""
    r = rig("ros.base_frame:=base_link", "ros.tf_timeout:=0.0", "ros.queue_depth:=1000")
    parts = [part for n in range(drive.frames) for part in r.parts(n, 20)]
    for sent, part in enumerate(parts[:-1], 1):
        r.lidar.publish(part)
        if sent % 20 == 0:
            r.processed(sent)
    r.processed(len(parts) - 1)
    publish_static(r, "base_link", "lidar", np.eye(4))
    r.lidar.publish(parts[-1])
    r.wait(lambda: len(r.odom) == len(parts) == 320, "the poses")


def test_a_parent_that_comes_late_becomes_the_base(rig: Callable[..., Rig], drive: Any) -> None:
    """No base is set, and the driver's part of /tf_static comes first. odom and map do not change."""
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
    """For a recording without /clock, or a sensor whose clock is not set, a warning shows both values."""
    r = rig()
    r.send_and_wait(0, 1, 2)
    status = r.status("odometry", saying("tracking; clouds are stamped"), since=0)
    assert status.level == DiagnosticStatus.WARN
    stamp, _, message = status.message.partition(" s (2023-11-14 22:13:20 UTC), the clock of this machine says")
    assert stamp.startswith("tracking; clouds are stamped 1700000000.")
    assert message.endswith("for a recording use_sim_time and /clock")
    values = figures(status)
    assert stamp.endswith(values["cloud stamp (s)"])
    assert abs(float(values["clock (s)"]) - time.time()) < 60


@pytest.mark.parametrize("stamp", [None, 0], ids=["with stamps", "without stamps"])
def test_sim_time_without_a_clock_is_reported(rig: Callable[..., Rig], stamp: int | None) -> None:
    """Clouds without a stamp are stamped by the clock, which stands still: all but the first are rejected as
    repeats."""
    r = rig("use_sim_time:=true")
    r.send_and_wait(0, stamp=stamp)
    for n in range(1, 4):
        r.send(n, stamp=stamp)
    status = r.status("odometry", lambda s: s.message.endswith("use_sim_time is on, and /clock has no publisher"), 0)
    assert status.level == DiagnosticStatus.WARN
