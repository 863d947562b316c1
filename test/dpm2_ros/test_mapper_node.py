# SPDX-License-Identifier: Apache-2.0
"""The mapper apart builds the same map as the embedded one, from messages alone."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from nav_msgs.msg import Odometry
from sensor_msgs.msg import PointCloud2
from std_msgs.msg import UInt8MultiArray
from std_srvs.srv import Trigger

from dpm2_core.data.trajectory import read_trajectory
from dpm2_core.data.transforms import transform_matrix
from dpm2_core.frame import Keyframe
from dpm2_core.geometry import se3
from dpm2_core.slam.map.data import load_map
from dpm2_core.slam.map.store import MapStore
from dpm2_ros.conversions import edge_to_msg, keyframe_name
from dpm2_ros.keyframes import payload_to_msgs
from dpm2_ros.mapper_node import MapperNode, keyframe_from
from dpm2_ros.mapping import KEEP_ALL
from dpm2_ros.tf import TFMessage


@pytest.fixture
def mapper(ros: Callable[..., Any], tmp_path: Path) -> Any:
    """Harness with a mapper_node that saves to tmp_path/map, and `send(name, T, cloud)` for keyframes."""
    harness = ros(f"ros.map_directory:={tmp_path / 'map'}")
    harness.mapper = harness.add(MapperNode())
    kinds = ((Odometry, "odom"), (PointCloud2, ""), (UInt8MultiArray, "cloud"))
    wires = [harness.node.create_publisher(kind, f"/dpm2/keyframe_{end}".rstrip("_"), KEEP_ALL) for kind, end in kinds]
    harness.wait(lambda: all(wire.get_subscription_count() for wire in wires), "the mapper's ears")

    def send(id: int, T: np.ndarray, points: np.ndarray, cloud_first: bool = False, name: str = "") -> None:
        name = name or keyframe_name("", id)
        pose = edge_to_msg(T, np.eye(6) * 1e-4, 1000 + id, "odom", name)
        keyframe = Keyframe(id, 1000 + id, id, T, points.astype(np.float32))
        messages = list(zip(wires, (pose, *payload_to_msgs(keyframe, name)), strict=True))
        for publisher, message in reversed(messages) if cloud_first else messages:
            publisher.publish(message)

    harness.send = send
    return harness


def points(seed: int) -> np.ndarray:
    return np.random.default_rng(seed).uniform(0, 1, (500, 4)).astype(np.float32) * [20, 20, 5, 1]


@pytest.mark.parametrize("cloud_first", [False, True])
def test_keyframes_become_a_map_in_either_order_of_messages(mapper: Any, tmp_path: Path, cloud_first: bool) -> None:
    T = [se3.exp([0, 0, 0.1 * n, 5.0 * n, 0, 0]) for n in range(4)]
    for n in range(4):
        mapper.send(n, T[n], points(n).astype(np.float32), cloud_first)
    mapper.wait(lambda: mapper.mapper._mapper.keyframes == 4, "four keyframes")
    mapper.mapper.close()
    mapper._closing.remove(mapper.mapper)
    saved = read_trajectory(tmp_path / "map" / "drive" / "trajectory.tum")
    assert saved.keys.tolist() == [1000, 1001, 1002, 1003]
    np.testing.assert_allclose(saved.poses, T, atol=1e-6)
    header = (tmp_path / "map" / "drive" / "map.ply").read_bytes()[:300].decode("ascii", "replace")
    assert int(header.split("element vertex ")[1].split()[0]) > 1000


def test_a_map_file_is_written_as_the_drive_goes_on(mapper: Any, tmp_path: Path) -> None:
    """By default; all keyframes are in it before the node ends. A reset saves it, and a new map gets its own files."""
    thread = mapper.mapper._mapper

    def stored(name: str) -> int:
        with MapStore.open(tmp_path / "map" / name) as store:
            return len(load_map(store))

    for id in (0, 1, 2):
        mapper.send(id, se3.exp([0, 0, 0, 5.0 * id, 0, 0]), points(id))
        mapper.wait(lambda expected=id + 1: thread.keyframes == expected, "the keyframe")
    mapper.wait(lambda: stored("drive.dpm2map") == 3, "all of them in the file")
    client = mapper.node.create_client(Trigger, "/mapper_node/reset")
    assert client.wait_for_service(10)
    answer = client.call_async(Trigger.Request())
    mapper.wait(answer.done, "the reset")
    assert answer.result().success
    mapper.wait(lambda: thread.keyframes == 0, "the empty map")  # which comes after the save
    assert read_trajectory(tmp_path / "map" / "drive" / "trajectory.tum").keys.tolist() == [1000, 1001, 1002]
    mapper.send(0, np.eye(4), points(0))
    mapper.wait(lambda: thread.keyframes == 1 and stored("drive-2.dpm2map") == 1, "the keyframe in the new file")
    assert stored("drive.dpm2map") == 3
    assert thread.store_problem == ""


def test_a_keyframe_of_another_name_is_refused_and_the_rest_goes_on(mapper: Any) -> None:
    mapper.send(0, np.eye(4), points(0).astype(np.float32))
    mapper.send(1, np.eye(4), points(0).astype(np.float32), name="not a keyframe")
    mapper.send(1, se3.exp([0, 0, 0, 5, 0, 0]), points(1).astype(np.float32))
    mapper.wait(lambda: mapper.mapper._mapper.keyframes == 2, "two keyframes")


def test_a_restarted_odometry_goes_on_in_the_same_map(mapper: Any) -> None:
    """As a trajectory of its own, which nothing ties to the first; ids count on."""
    for id in (0, 1, 2, 0):
        mapper.send(id, se3.exp([0, 0, 0, 5.0 * id, 0, 0]), points(id))
    mapper.wait(lambda: mapper.mapper._mapper.keyframes == 4, "all four")
    core = mapper.mapper._mapper._active.mapper
    assert [keyframe.id for keyframe in core.keyframes] == [0, 1, 2, 3]
    assert [(a, b) for a, b, _, _ in core.edges] == [(0, 1), (1, 2)]
    assert core.T_map_odom_of("") is None


def test_map_to_odom_goes_out_with_every_odometry(mapper: Any) -> None:
    odometry = mapper.publisher(Odometry, "/dpm2/odom")
    heard = mapper.hear(TFMessage, "/tf")
    mapper.wait(lambda: odometry.get_subscription_count() and mapper.mapper.count_subscribers("/tf"), "connections")
    odometry.publish(edge_to_msg(np.eye(4), np.eye(6), 77, "odom", "base"))
    mapper.wait(lambda: heard, "/tf")
    transform = heard[0].transforms[0]
    assert (transform.header.frame_id, transform.child_frame_id) == ("map", "odom")
    assert transform.header.stamp.nanosec == 77 + 500_000_000  # valid until the next one
    np.testing.assert_array_equal(transform_matrix(transform.transform), np.eye(4))


def test_the_edge_leads_to_the_last_keyframe_that_arrived() -> None:
    before = Keyframe(3, 0, 0, se3.exp([0, 0, 0, 5, 0, 0]), np.zeros((0, 4), np.float32))
    T, covariance = se3.exp([0, 0, 0.5, 12, 1, 0]), np.diag([1.0, 2, 3, 4, 5, 6])
    pose = edge_to_msg(T, covariance, 9, "odom", "kf_5")
    keyframe = keyframe_from(pose, np.zeros((0, 4), np.float32), "", 5, before)
    assert keyframe.edge is not None
    np.testing.assert_allclose(before.T_odom_kf @ keyframe.edge.T_target_source, T, atol=1e-9)
    np.testing.assert_allclose(keyframe.edge.covariance, covariance, atol=1e-9)


@pytest.mark.parametrize("before", [None, 5, 7])
def test_the_first_keyframe_and_one_that_goes_back_have_no_edge(before: int | None) -> None:
    last = None if before is None else Keyframe(before, 0, 0, np.eye(4), np.zeros((0, 4), np.float32))
    pose = edge_to_msg(np.eye(4), np.eye(6), 9, "odom", "kf_5")
    assert keyframe_from(pose, np.zeros((0, 4), np.float32), "", 5, last).edge is None
