# SPDX-License-Identifier: Apache-2.0
"""Livox' CustomMsg on a topic: it is subscribed to if its package is installed, and reported otherwise."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import rclpy
from nav_msgs.msg import Odometry
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions
from sensor_msgs.msg import PointCloud2

from dpm2_core.data.frames import FrameBuilder
from dpm2_core.data.livox import cloud_of_custom
from dpm2_core.data.settings import InputSettings
from dpm2_core.errors import UsageError
from dpm2_ros import bag_player
from dpm2_ros.conversions import cloud_to_msg
from dpm2_ros.matched_subscription import MatchedSubscription
from dpm2_ros.message_types import message_type
from dpm2_ros.settings import RosSettings
from dpm2_ros.subscriptions import Inputs
from test.dpm2_ros.test_subscriptions import node  # noqa: F401
from test.helpers.livox import custom_message, livox_store
from test.helpers.lockstep import play
from test.helpers.recordings import write_bag

CUSTOM = "livox_ros_driver2/msg/CustomMsg"
POINTS = np.random.default_rng(0).uniform(-20, 20, (50, 3)).astype(np.float32)
SECONDS = np.linspace(0, 0.1, 50)


def offering(node: Node, kind: str) -> Node:  # noqa: F811
    """The node, with a graph that reports publishers of that type on its topics."""
    info = SimpleNamespace(topic_type=kind, qos_profile=SimpleNamespace(reliability=None))
    node.get_publishers_info_by_topic = lambda topic: [info]  # type: ignore[assignment,return-value]
    return node


def test_a_missing_package_is_named(node: Callable[..., Node]) -> None:  # noqa: F811
    """The driver cannot run without the package either, so the graph's answer is made up here."""
    if message_type(CUSTOM) is not None:
        pytest.skip("the package is installed")
    made = MatchedSubscription(offering(node(), CUSTOM), PointCloud2, "/livox/lidar", print, RosSettings())
    assert made.problem.startswith(f"/livox/lidar is a {CUSTOM}, whose package is not installed here")
    assert "xfer_format: 0" in made.problem


def test_other_types_are_left_alone(node: Callable[..., Node]) -> None:  # noqa: F811
    made = MatchedSubscription(offering(node(), "my_msgs/msg/Cloud"), PointCloud2, "/points", print, RosSettings())
    assert made.problem == ""


def test_points_of_a_custom_message_arrive(node: Callable[..., Node]) -> None:  # noqa: F811
    """The driver's message is received over DDS and becomes a frame with the time of each point; a PointCloud2 may
    follow."""
    kind: Any = message_type(CUSTOM)
    if kind is None:
        pytest.skip("livox_ros_driver2 is not installed")
    n, other = node(), rclpy.Context()
    rclpy.init(context=other, domain_id=n.context.get_domain_id(), signal_handler_options=SignalHandlerOptions.NO)
    driver = rclpy.create_node("driver", context=other)
    inputs = Inputs(n, InputSettings(points_topic="/livox/lidar", images=False), RosSettings())
    publisher = driver.create_publisher(kind, "/livox/lidar", 10)
    bundle, end, i = None, time.monotonic() + 30, 0
    while bundle is None and time.monotonic() < end:
        i += 1
        publisher.publish(custom_message(10**9 + i * 10**8, POINTS, SECONDS))
        rclpy.spin_once(n, timeout_sec=0.1)
        bundle = inputs.take(0.0)
    driver.destroy_node()
    rclpy.shutdown(context=other)
    assert bundle is not None
    frame = FrameBuilder(InputSettings(), inputs.calibration, pytest.fail).frame(bundle.stamp, bundle.cloud, 0)
    np.testing.assert_array_equal(frame.points[:, :3], POINTS)
    np.testing.assert_allclose(frame.time_offset, SECONDS, atol=1e-8)
    assert cloud_to_msg(frame.points, 1, "lidar").width == 50


def recorded(folder: Path) -> Path:
    """A bag with five clouds as CustomMsg."""
    stamps = range(10**9, 15 * 10**8, 10**8)
    sent = [(stamp + 10**8, "/livox/lidar", custom_message(stamp, POINTS, SECONDS)) for stamp in stamps]
    return write_bag(folder, {"/livox/lidar": CUSTOM}, sent, livox_store())


def test_a_recording_is_played_in_lockstep(
    ros: Callable[..., Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A recording of CustomMsg can be played in lockstep; previously it was rejected. If the package is not installed,
    the bytes are sent under another type."""
    monkeypatch.setattr(bag_player, "message_type", lambda kind: message_type(kind) or PointCloud2)
    kind, n, seen = message_type(CUSTOM) or PointCloud2, ros().node, list[int]()
    odometry = n.create_publisher(Odometry, "dpm2/odom", 10)

    def answer(data: bytes) -> None:
        cloud = cloud_of_custom(data)
        seen.append(cloud.header.stamp.nanosec)
        message = Odometry()
        message.header.stamp.sec, message.header.stamp.nanosec = cloud.header.stamp.sec, cloud.header.stamp.nanosec
        odometry.publish(message)

    n.create_subscription(kind, "/livox/lidar", answer, 10, raw=True)
    play(recorded(tmp_path / "bag"))  # raises an error if a cloud has no odometry
    assert seen == [0, 10**8, 2 * 10**8, 3 * 10**8, 4 * 10**8]


def test_the_player_says_what_to_do_without_the_package(
    ros: Callable[..., Any], tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    if message_type(CUSTOM) is not None:
        pytest.skip("the package is installed")
    ros()
    with pytest.raises(UsageError, match="nothing to publish"):
        play(recorded(tmp_path / "bag"))
    assert f"no message type {CUSTOM}; dpm2 convert makes a recording with PointCloud2" in capfd.readouterr().err
