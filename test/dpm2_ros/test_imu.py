# SPDX-License-Identifier: Apache-2.0
"""slam_node with an IMU on the topic `imu`, over real DDS: level, in use, gone, hostile; and the drive goes on."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticStatus
from nav_msgs.msg import Odometry
from sensor_msgs.msg import Imu, PointCloud2

from dpm2_core.data.topics import POINTS
from dpm2_core.data.transforms import transform_matrix
from dpm2_core.geometry import se3
from dpm2_ros.conversions import header, transform_to_msg, vector
from dpm2_ros.slam_node import SlamNode
from dpm2_ros.tf_message import TFMessage

from ..helpers.diagnostics import saying

PITCH = np.radians(10.0)  # the slope that the robot stands on, nose up
T_BASE_LIDAR = se3.exp([0.0, 0.1, 0.3, 0.8, 0.0, 1.2])
T_BASE_IMU = se3.exp([0.0, 0.0, 1.0, 0.1, 0.0, 0.2])
BIAS = np.array([0.01, -0.02, 0.015])
NAN = float("nan")

pytestmark = pytest.mark.slow


class Robot:
    """Stands on a slope: clouds of one place at 10 Hz, samples at 100 Hz."""

    def __init__(
        self, ros: Callable[..., Any], drive: Any, *parameters: str, place: bool = True, topic: str = "/imu"
    ) -> None:
        self.harness, self.drive = ros("input.images:=false", "ros.base_frame:=base_link", *parameters), drive
        self.gravity = 9.81  # m/s2
        self.wait, publisher = self.harness.wait, self.harness.publisher
        self.lidar, self.imu = publisher(PointCloud2, POINTS), publisher(Imu, topic, reliable=False)
        frames = {"lidar": T_BASE_LIDAR} | ({"imu_link": T_BASE_IMU} if place else {})
        static = publisher(TFMessage, "/tf_static", latched=True)
        static.publish(TFMessage(transforms=[transform_to_msg(T, 0, "base_link", n) for n, T in frames.items()]))
        self.odom = self.harness.hear(Odometry, "/dpm2/odom")
        self.diagnostics = self.harness.diagnostics
        self.node: SlamNode = self.harness.add(SlamNode())
        self.wait(lambda: self.lidar.get_subscription_count(), "the subscription to the clouds")
        self.wait(lambda: topic != "/imu" or self.imu.get_subscription_count(), "the subscription to the IMU")
        self.wait(lambda: "lidar" in self.node.calibration.transforms.frames, "/tf_static")

    def sample(self, stamp: int, rates: Any = BIAS) -> None:
        """One of a robot at rest."""
        up = T_BASE_IMU[:3, :3].T @ [np.sin(PITCH), 0, np.cos(PITCH)]
        message = Imu(header=header(stamp, "imu_link"), linear_acceleration=vector(self.gravity * up))
        message.angular_velocity = vector(np.asarray(rates))
        self.imu.publish(message)

    def send(self, *numbers: int, samples: bool = True) -> None:
        for n in numbers:
            before, stamp = len(self.odom), self.drive.stamp(n)
            for k in range(10 * samples):
                self.sample(stamp - self.drive.period + (k + 1) * self.drive.period // 10)
            cloud = self.drive.cloud(0)
            cloud.header = header(stamp, "lidar")
            self.lidar.publish(cloud)
            self.wait(lambda before=before: len(self.odom) > before, f"the odometry of cloud {n}")

    def status(self, condition: Callable[[DiagnosticStatus], Any]) -> DiagnosticStatus:
        """Of the IMU, once it is so."""
        found: DiagnosticStatus = self.harness.status(": imu", condition)
        return found


@pytest.fixture
def robot(ros: Callable[..., Any], drive: Any, monkeypatch: pytest.MonkeyPatch) -> Callable[..., Robot]:
    monkeypatch.setattr("dpm2_ros.diagnostics.PERIOD", 0.1)
    return lambda *parameters, **other: Robot(ros, drive, *parameters, **other)


def test_a_start_on_a_slope_is_level_and_one_that_stops_is_missed(robot: Callable[..., Robot]) -> None:
    """The pose of the base has the pitch of the slope; hostile samples are counted and change nothing."""
    r = robot()
    r.send(0, 1, 2)
    assert r.status(lambda s: s.message == "in use").level == DiagnosticStatus.OK
    first = transform_matrix(r.odom[0].pose.pose)
    np.testing.assert_allclose(first[2, :3], [np.sin(PITCH), 0, np.cos(PITCH)], atol=0.01)  # base's axes, heights
    assert abs(np.degrees(np.arctan2(first[1, 0], first[0, 0]))) < 1  # and no other heading
    late = r.drive.stamp(2)
    r.sample(late + 10**7, (NAN, 0.0, 0.0))
    r.sample(late + 10**7, (0.0, 1e9, 0.0))
    r.sample(late - 10**8)  # back
    for k in range(20):  # a flood
        r.sample(late + 10**6 * (k == 19) + k)
    r.wait(lambda: sum(r.node.rejections.values()) >= 22, "rejections")
    r.send(3, 4)
    assert r.status(saying("in use"))
    r.send(5, 6, samples=False)
    assert r.status(saying("no samples at the time of the scan; going on")).level == DiagnosticStatus.WARN
    r.send(7)
    assert r.status(lambda s: s.message == "in use")
    for message in r.odom:
        T = se3.inverse(first) @ transform_matrix(message.pose.pose)
        assert se3.magnitude(T)[0] < 0.02


def test_without_its_place_it_is_left_out_and_said(robot: Callable[..., Robot]) -> None:
    r = robot(place=False)
    r.send(0, 1)
    said = r.status(saying("set input.q_lidar_imu"))
    assert said.message.startswith("no transform from 'imu_link' to 'lidar'")
    assert said.level == DiagnosticStatus.WARN
    np.testing.assert_allclose(transform_matrix(r.odom[0].pose.pose)[:3, :3], np.eye(3), atol=0.01)


def test_forces_of_the_other_sign_are_said_at_the_start(
    robot: Callable[..., Robot], monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("dpm2_ros.diagnostics.PERIOD", 60.0)  # they miss the first cloud
    r = robot()
    r.gravity = -r.gravity
    r.send(0, 1, 2)
    assert capfd.readouterr().err.count("/imu: its forces at rest point 170 deg away from up") == 1


def test_one_that_is_named_and_never_comes_is_said(robot: Callable[..., Robot]) -> None:
    """As where its topic is misspelled; one that is not named need not be there."""
    r = robot("input.imu_topic:=/imu/dta", topic="/imu/data")
    r.send(0, 1)
    said = r.status(saying("nothing of use on /imu/dta yet; going on without"))
    assert said.level == DiagnosticStatus.WARN


def test_none_is_said_where_none_is_named(robot: Callable[..., Robot]) -> None:
    r = robot(topic="/another")
    r.send(0, 1)
    r.harness.status(": odometry")
    assert not any(status.name.endswith(": imu") for message in r.diagnostics for status in message.status)
