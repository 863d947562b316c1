# SPDX-License-Identifier: Apache-2.0
"""Recordings of sensors together with results of dpm2, played to nodes of dpm2 and to other nodes."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from nav_msgs.msg import Odometry
from nav_msgs.msg import Path as Way
from rclpy.serialization import serialize_message
from sensor_msgs.msg import PointCloud2

from dpm2_core.data.naming import POINTS
from dpm2_ros.conversions import cloud_to_msg, edge_to_msg, transform_to_msg
from dpm2_ros.tf_message import TFMessage
from test.helpers.lockstep import play
from test.helpers.recordings import write_bag

KINDS = {POINTS: PointCloud2, "/dpm2/odom": Odometry, "/dpm2/path": Way, "/tf": TFMessage}
LINKS = (("map", "odom"), ("odom", "base"), ("base", "wheel"))
EYE = np.eye(4)


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    """Five clouds, each with a pose, a path, and /tf."""
    kinds = {topic: f"{kind.__module__.partition('.')[0]}/msg/{kind.__name__}" for topic, kind in KINDS.items()}
    out = list[tuple[int, str, bytes]]()
    for at in range(1_000_000_000, 1_050_000_000, 10_000_000):
        sent = {
            POINTS: cloud_to_msg(np.ones((3, 4), np.float32), at, "lidar"),
            "/dpm2/odom": edge_to_msg(EYE, np.eye(6), at, "odom", "base"),
            "/dpm2/path": Way(),
            "/tf": TFMessage(transforms=[transform_to_msg(EYE, at, *link) for link in LINKS]),
        }
        out += [(at, topic, bytes(serialize_message(message))) for topic, message in sent.items()]
    return write_bag(tmp_path / "bag", kinds, out)


@pytest.mark.parametrize("asked", [False, True], ids=["all", "by name"])
@pytest.mark.parametrize("runs", [False, True], ids=["without a node", "with a node"])
def test_what_a_node_publishes_now_is_not_played_beside_it(
    ros: Callable[..., Any], recording: Path, capfd: pytest.CaptureFixture[str], runs: bool, asked: bool
) -> None:
    """Recorded topics that a node publishes now are left out, unless requested. Otherwise, two poses alternated, 16 m
    apart, and a mapper took them for two robots."""
    harness = ros()
    heard = {topic: harness.hear(kind, topic) for topic, kind in KINDS.items()}
    if runs:
        harness.publisher(Odometry, "/dpm2/odom")
    left = runs and not asked
    play(recording, lockstep=False, clock=True, topics=tuple(KINDS) * asked)
    harness.wait(lambda: all(len(heard[topic]) == 5 for topic in (POINTS, "/dpm2/path", "/tf")), "the recording")
    links = [(t.header.frame_id, t.child_frame_id) for message in heard["/tf"] for t in message.transforms]
    assert links == list(LINKS[2:] if left else LINKS) * 5
    harness.wait(lambda: len(heard["/dpm2/odom"]) == 5 * (not left), "the poses")
    said = "/dpm2/odom: left out, as nodes publish these now; so are transforms from and to odom"
    assert (said in capfd.readouterr().err) == left
