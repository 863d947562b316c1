# SPDX-License-Identifier: Apache-2.0
"""A frame on /tf must have one publisher; if another node publishes a frame of ours, our node reports it."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticStatus

from dpm2_core.geometry import se3
from dpm2_ros.conversions import transform_to_msg
from dpm2_ros.tf_message import TFMessage
from test.helpers.rig import Rig

from ..helpers.diagnostics import saying


@pytest.mark.parametrize(
    ("parent", "child", "part"),
    [("odom", "lidar", "odometry"), ("base_link", "lidar", "odometry"), ("map", "odom", "mapper")],
    ids=["wheels", "a joint", "another localization"],
)
def test_another_node_that_places_the_same_frame_is_named(
    rig: Callable[..., Rig], parent: str, child: str, part: str
) -> None:
    """With a robot's own odometry but without ros.odom_source, or with a recorded one, `odom` -> base jumped between
    the two with each message, and nothing reported it. Now a warning names the frames, even if both have the same
    stamps."""
    r = rig()
    other = r.harness.publisher(TFMessage, "/tf")
    r.wait(lambda: other.get_subscription_count() == 2, "slam_node's ears, of each transform that it sends")
    r.send_and_wait(0, 1)
    r.mapped(1)
    for stamp in (r.drive.stamp(0), r.drive.stamp(1)):
        other.publish(TFMessage(transforms=[transform_to_msg(se3.exp([0, 0, 0, 0.5, 0, 0]), stamp, parent, child)]))
    said = r.status(part, saying(f"another node also publishes {parent} -> {child} on /tf"))
    assert said.level == DiagnosticStatus.WARN


def test_frames_of_others_are_theirs(rig: Callable[..., Rig]) -> None:
    """A frame that only another node publishes is not reported, nor is a transform of ours that a relay repeats."""
    r = rig()
    tf, other = r.harness.hear(TFMessage, "/tf"), r.harness.publisher(TFMessage, "/tf")
    r.wait(lambda: other.get_subscription_count() == 3 and r.harness.found_by(r.node, "/tf"), "connections")
    r.send_and_wait(0, 1)
    r.mapped(1)
    r.wait(lambda: len(tf) >= 3, "transforms")  # at least two of odom -> lidar, and one of map -> odom
    for message in (*tf[:3], TFMessage(transforms=[transform_to_msg(np.eye(4), r.drive.stamp(1), "lidar", "wheel")])):
        other.publish(message)
    begin = len(r.diagnostics)
    r.wait(lambda: len(r.diagnostics) > begin + 5, "diagnostics")
    assert "another node" not in "".join(status.message for m in r.diagnostics[begin:] for status in m.status)
