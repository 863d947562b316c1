# SPDX-License-Identifier: Apache-2.0
"""slam_node with an IMU on the topic `imu`, over real DDS: level, in use, gone, hostile; the drive continues."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticStatus
from sensor_msgs.msg import Imu

from dpm2_core.data.transforms import transform_matrix
from dpm2_core.geometry import se3
from dpm2_ros.conversions import header, vector
from test.helpers.rig import Rig, publish_static

from ..helpers.diagnostics import saying

PITCH = np.radians(10.0)  # the slope on which the robot stands, nose up
T_BASE_LIDAR = se3.exp([0.0, 0.1, 0.3, 0.8, 0.0, 1.2])
T_BASE_IMU = se3.exp([0.0, 0.0, 1.0, 0.1, 0.0, 0.2])
BIAS = np.array([0.01, -0.02, 0.015])
NAN = float("nan")

pytestmark = pytest.mark.slow


class Robot(Rig):
    """A robot that stands on a slope: clouds of one position at 10 Hz, samples at 100 Hz."""

    def __init__(
        self, ros: Callable[..., Any], drive: Any, *parameters: str, place: bool = True, topic: str = "/imu"
    ) -> None:
        super().__init__(ros, drive, "ros.base_frame:=base_link", *parameters)
        self.gravity = 9.81  # m/s2
        self.imu = self.harness.publisher(Imu, topic, reliable=False)
        publish_static(self, "base_link", "lidar", T_BASE_LIDAR)
        if place:
            publish_static(self, "base_link", "imu_link", T_BASE_IMU)
        self.wait(lambda: topic != "/imu" or self.imu.get_subscription_count(), "the subscription to the IMU")

    def sample(self, stamp: int, rates: Any = BIAS, frame: str = "imu_link") -> None:
        """A sample of a robot at rest."""
        up = T_BASE_IMU[:3, :3].T @ [np.sin(PITCH), 0, np.cos(PITCH)]
        message = Imu(header=header(stamp, frame), linear_acceleration=vector(self.gravity * up))
        message.angular_velocity = vector(np.asarray(rates))
        self.imu.publish(message)

    def stand(self, *numbers: int, samples: bool = True) -> None:
        for stamp in map(self.drive.stamp, numbers):
            for k in range(10 * samples):
                self.sample(stamp - self.drive.period + (k + 1) * self.drive.period // 10)
            self.send_and_wait(0, stamp=stamp)


@pytest.fixture
def robot(ros: Callable[..., Any], drive: Any, monkeypatch: pytest.MonkeyPatch) -> Callable[..., Robot]:
    monkeypatch.setattr("dpm2_ros.diagnostics.PERIOD", 0.1)
    monkeypatch.setattr("dpm2_ros.slam_diagnostics.SILENT", 300.0)  # a busy machine may be slow
    return lambda *parameters, **other: Robot(ros, drive, *parameters, **other)


def test_a_start_on_a_slope_is_level_and_one_that_stops_is_missed(robot: Callable[..., Robot]) -> None:
    """On a slope, the base's pose has the pitch of the slope. Hostile samples are counted and change nothing; missing
    samples are reported."""
    r = robot()
    r.stand(0, 1, 2)
    assert r.status("imu", lambda s: s.message == "in use").level == DiagnosticStatus.OK
    first = transform_matrix(r.odom[0].pose.pose)
    np.testing.assert_allclose(first[2, :3], [np.sin(PITCH), 0, np.cos(PITCH)], atol=0.01)  # base's axes, heights
    assert abs(np.degrees(np.arctan2(first[1, 0], first[0, 0]))) < 1  # and the heading is unchanged
    late = r.drive.stamp(2)
    r.sample(late + 10**7, (NAN, 0.0, 0.0))
    r.sample(late + 10**7, (0.0, 1e9, 0.0))
    r.sample(late - 10**8)  # stamped before the last one
    for k in range(20):  # a flood
        r.sample(late + 10**6 * (k == 19) + k)
    r.wait(lambda: sum(r.node.rejections.values()) >= 22, "rejections")
    r.stand(3, 4)
    assert r.status("imu", saying("in use"))
    r.stand(5, 6, samples=False)
    assert r.status("imu", saying("no samples at the time of the scan; going on")).level == DiagnosticStatus.WARN
    r.stand(7)
    assert r.status("imu", lambda s: s.message == "in use")
    for message in r.odom:
        T = se3.inverse(first) @ transform_matrix(message.pose.pose)
        assert se3.magnitude(T)[0] < 0.02


def test_one_that_stops_together_with_the_clouds_is_missed(
    robot: Callable[..., Robot], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Previously, nothing reported this without clouds: the status stayed "in use"."""
    r = robot()
    r.stand(0, 1)
    assert r.status("imu", saying("in use"))
    monkeypatch.setattr("dpm2_ros.slam_diagnostics.SILENT", 1.0)
    assert r.status("imu", saying("no sample on /imu for")).level == DiagnosticStatus.WARN


def test_without_its_place_it_is_left_out_and_said(robot: Callable[..., Robot]) -> None:
    r = robot(place=False)
    r.stand(0, 1)
    said = r.status("imu", saying("set input.q_lidar_imu"))
    assert said.message.startswith("no transform from 'imu_link' to 'lidar'")
    assert said.level == DiagnosticStatus.WARN
    np.testing.assert_allclose(transform_matrix(r.odom[0].pose.pose)[:3, :3], np.eye(3), atol=0.01)


def test_another_imu_on_the_topic_changes_nothing(robot: Callable[..., Robot]) -> None:
    """The other IMU is upside down, and not level: its samples are rejected and counted, and do not affect the pose."""
    r = robot()
    publish_static(r, "base_link", "other", se3.exp([np.pi, 0, 0, 0, 0, 0]))
    r.sample(r.drive.stamp(0) - r.drive.period)
    r.wait(lambda: r.node.calibration.heard, "a sample")
    for k in range(20):
        r.sample(r.drive.stamp(0) - r.drive.period + k * r.drive.period // 20, frame="other")
    r.stand(0, 1)
    first = transform_matrix(r.odom[0].pose.pose)
    np.testing.assert_allclose(first[2, :3], [np.sin(PITCH), 0, np.cos(PITCH)], atol=0.01)  # base's axes, heights
    assert sum(r.node.rejections.values()) == 20


def test_forces_of_the_other_sign_are_said_at_the_start(
    robot: Callable[..., Robot], monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("dpm2_ros.diagnostics.PERIOD", 60.0)  # these messages miss the first cloud
    r = robot()
    r.gravity = -r.gravity
    r.stand(0, 1, 2)
    assert capfd.readouterr().err.count("/imu: its acceleration at rest is 170 deg away from up") == 1


def test_one_that_is_named_and_never_comes_is_said(robot: Callable[..., Robot]) -> None:
    """A warning is given if the IMU's topic is misspelled; an IMU whose topic is not set may be absent."""
    r = robot("input.imu_topic:=/imu/dta", topic="/imu/data")
    r.stand(0, 1)
    said = r.status("imu", saying("no usable message on /imu/dta yet; going on without"))
    assert said.level == DiagnosticStatus.WARN


def test_none_is_said_where_none_is_named(robot: Callable[..., Robot]) -> None:
    r = robot(topic="/another")
    r.stand(0, 1)
    r.harness.status(": odometry")
    assert not any(status.name.endswith(": imu") for message in r.diagnostics for status in message.status)
