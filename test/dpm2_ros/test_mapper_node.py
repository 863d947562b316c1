# SPDX-License-Identifier: Apache-2.0
"""The separate mapper builds the same map as the embedded one, from messages only."""

from __future__ import annotations

import copy
import re
import struct
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rclpy
from nav_msgs.msg import OccupancyGrid, Odometry
from sensor_msgs.msg import PointCloud2
from std_msgs.msg import MultiArrayDimension, MultiArrayLayout, UInt8MultiArray
from std_srvs.srv import Trigger

from dpm2_core.data.trajectory import read_trajectory
from dpm2_core.data.transforms import transform_matrix
from dpm2_core.descriptors import Descriptors
from dpm2_core.errors import Dpm2Error
from dpm2_core.estimates import Keyframe
from dpm2_core.frame import Fix
from dpm2_core.geometry import se3
from dpm2_core.slam.store.map_data import load_map
from dpm2_core.slam.store.map_store import MapStore
from dpm2_ros import mapper_node
from dpm2_ros.conversions import edge_to_msg, keyframe_name
from dpm2_ros.keyframe_messages import descriptors_to_msg, payload_to_msgs
from dpm2_ros.mapper_node import MapperNode
from dpm2_ros.subscriptions import LAST_ONE

from ..helpers.mapping import S, Wires, core, keyframes, mapped, placed, points, rejections, send_all


def test_a_fix_travels_with_its_keyframe_and_a_forged_one_does_not(mapper: Any) -> None:
    fix = Fix(7, np.array([49.0, 8.4, 110.0]), np.diag([4.0, 4, 16]), np.array([0.1, -0.2, 1.5]))
    keyframe = Keyframe(0, 1000, 0, np.eye(4), points(0), fix=fix)
    name = keyframe_name("", 0)
    _, cloud = payload_to_msgs(keyframe, name)
    forged, cut = copy.deepcopy(cloud), copy.deepcopy(cloud)
    forged.data[-8:] = type(cloud.data)("B", struct.pack("<d", float("nan")))
    cut.data = cloud.data[:20]
    for wrong in (forged, cut):
        mapper.wires.cloud.publish(wrong)
    for why in ("fix", "size"):
        mapper.wait(lambda of=why: mapper.mapper.rejections.get(f"/dpm2/keyframe_cloud: {of}", 0), f"rejected: {why}")
    mapper.wires.send(keyframe, name)
    mapper.wait(lambda: keyframes(mapper) == 1, "the keyframe")
    found = core(mapper).keyframes[0].fix
    assert found is not None
    assert found.stamp == fix.stamp
    for part in ("geodetic", "covariance", "antenna"):
        np.testing.assert_array_equal(getattr(found, part), getattr(fix, part))


@pytest.mark.parametrize("cloud_first", [False, True])
def test_keyframes_become_a_map_in_either_order_of_messages(mapper: Any, tmp_path: Path, cloud_first: bool) -> None:
    T = [se3.exp([0, 0, 0.1 * n, 5.0 * n, 0, 0]) for n in range(4)]
    for n in range(4):
        mapper.send(n, T[n], points(n), cloud_first)
    mapper.wait(lambda: keyframes(mapper) == 4, "four keyframes")
    mapper.remove(mapper.mapper)
    saved = read_trajectory(tmp_path / "map" / "drive" / "trajectory.tum")
    assert saved.keys.tolist() == [1000, 1001, 1002, 1003]
    np.testing.assert_allclose(saved.poses, T, atol=1e-6)
    header = (tmp_path / "map" / "drive" / "map.ply").read_bytes()[:300].decode("ascii", "replace")
    assert int(header.split("element vertex ")[1].split()[0]) > 1000


def test_a_map_file_is_written_as_the_drive_goes_on(mapper: Any, tmp_path: Path) -> None:
    """By default, all keyframes are in the file before the node ends. A reset saves it; a new map gets new files."""

    def stored(name: str) -> int:
        with MapStore.open(tmp_path / "map" / name) as store:
            return len(load_map(store))

    for id in (0, 1, 2):
        mapper.send(id, se3.exp([0, 0, 0, 5.0 * id, 0, 0]), points(id))
        mapper.wait(lambda expected=id + 1: keyframes(mapper) == expected, "the keyframe")
    mapper.wait(lambda: stored("drive.dpm2map") == 3, "all of them in the file")
    assert mapper.call(Trigger, "/mapper_node/reset").success
    mapper.wait(lambda: keyframes(mapper) == 0, "the empty map")  # this follows the save
    assert read_trajectory(tmp_path / "map" / "drive" / "trajectory.tum").keys.tolist() == [1000, 1001, 1002]
    mapper.send(0, np.eye(4), points(0))
    mapper.wait(lambda: keyframes(mapper) == 1 and stored("drive-2.dpm2map") == 1, "the keyframe in the new file")
    assert stored("drive.dpm2map") == 3
    assert core(mapper).store_problem == ""


def test_a_map_that_ends_with_neither_file_nor_folder_is_an_error(ros: Callable[..., Any], tmp_path: Path) -> None:
    """The node must report this error. Previously, it ended as if no file had been requested."""
    (tmp_path / "full").write_text("no folder")
    harness = ros(f"ros.map_file:={tmp_path / 'full' / 'town.dpm2map'}")
    harness.mapper = harness.add(MapperNode())
    wires = Wires(harness)
    wires.wait()
    wires.send(Keyframe(0, 1000, 0, np.eye(4), points(0)), keyframe_name("", 0))
    harness.wait(lambda: keyframes(harness) == 1, "the keyframe")
    with pytest.raises(Dpm2Error, match=r"no map file: .*full"):
        harness.remove(harness.mapper)


def test_a_grid_of_storeys_that_lie_over_each_other_is_said_to_be_of_no_use(
    mapper: Any, capfd: pytest.CaptureFixture[str]
) -> None:
    """The node warns once, as the export does: the grid contains the walls of both floors."""
    grids, log = mapper.hear(OccupancyGrid, "/dpm2/grid", LAST_ONE), list[str]()

    def said() -> list[str]:
        log.append(capfd.readouterr().err)
        return re.findall(r"\[WARN\] .*: (dpm2/grid: .*)", "".join(log))

    for n, height in enumerate((0.0, 0.0, 2.8, 2.8)):
        before = len(grids)
        mapper.send(n, se3.exp([0, 0, 0, 5.0 * (n % 2), 0, height]), points(n))
        mapper.wait(lambda expected=n + 1: keyframes(mapper) == expected, "the keyframe")
        mapper.wait(lambda than=before: len(grids) > than, "its grid")
        assert n >= 2 or not said()
    mapper.wait(said, "the warning")
    (words,) = said()
    assert words.startswith(
        "dpm2/grid: do not use it: parts of the map lie up to 2.8 m above each other, because of storeys"
    )


def test_a_restarted_odometry_goes_on_in_the_same_map(mapper: Any) -> None:
    """A restarted odometry begins a trajectory without an edge to the first one; the ids continue."""
    for id in (0, 1, 2, 0):
        mapper.send(id, se3.exp([0, 0, 0, 5.0 * id, 0, 0]), points(id))
    mapped(mapper, 4)
    assert [keyframe.id for keyframe in core(mapper).keyframes] == [0, 1, 2, 3]
    assert [(e.from_node, e.to_node) for e in core(mapper).edges] == [(0, 1), (1, 2)]
    assert core(mapper).T_map_odom_of("") is None


def test_map_to_odom_goes_out_with_every_odometry(mapper: Any) -> None:
    """map -> odom is sent only once a keyframe of the robot is in the map. Before that, the mapper may have been
    restarted, and the drive may be any; previously it then sent the identity."""
    move, heard = placed(mapper)
    move(33)
    move(34, frame="no name")
    mapper.wait(lambda: mapper.mapper.rejections, "the rejection: the odometry before it has been taken in")
    mapper.send(0, np.eye(4), points(0).astype(np.float32))
    mapped(mapper, 1)
    move(77)
    mapper.wait(lambda: heard, "/tf")
    transform = heard[0].transforms[0]
    assert (transform.header.frame_id, transform.child_frame_id) == ("map", "odom")
    assert transform.header.stamp.nanosec == 77 + 500_000_000  # valid until the next one
    np.testing.assert_array_equal(transform_matrix(transform.transform), np.eye(4))


def test_robots_whose_odometry_frames_have_one_name_are_reported(mapper: Any) -> None:
    """Otherwise map -> odom would alternate between the transforms of the two robots."""
    told, keyframe = mapper.diagnostics, Keyframe(0, 1000, 0, np.eye(4), points(0))
    wires = {robot: Wires(mapper, f"/{robot}") for robot in ("red", "blue")}
    for count, (robot, its) in enumerate(wires.items()):
        its.wait()
        its.send(keyframe, keyframe_name(robot, 0))
        mapper.wait(lambda before=count: keyframes(mapper) > before, "its keyframe")
    for robot, its in wires.items():  # drives end after 5 s of silence, and this machine may be busy
        its.pose.publish(edge_to_msg(np.eye(4), np.eye(6) * 1e-4, 1000, "odom", keyframe_name(robot, 0)))

    def said() -> bool:
        return any("robots share an odom_frame: odom" in s.message for m in told for s in m.status)

    mapper.wait(said, "the report")


def hostile_parts(id: int) -> list[Any]:
    """Messages with the name of a keyframe that a robot is about to send, each invalid for a different reason."""
    name, T = keyframe_name("", id, S), np.eye(4)
    poses = [edge_to_msg(T, np.eye(6) * variance, 5, "odom", name) for variance in (-1.0, 1e300)]
    for value in (np.nan, np.inf):
        poses.append(copy.deepcopy(poses[0]))
        poses[-1].pose.covariance[7] = value
    for value in (np.nan, np.inf, 1e9):
        poses.append(edge_to_msg(T, np.eye(6), 5, "odom", name))
        poses[-1].pose.pose.position.x = value
    poses.append(edge_to_msg(T, np.eye(6), 5, "o" * 5000, name))
    clouds = [
        UInt8MultiArray(layout=MultiArrayLayout(dim=[MultiArrayDimension(label=name)]), data=data)
        for data in (
            b"",
            bytes(50),
            struct.pack("<If", 2**32 - 1, 0.01),
            struct.pack("<If", 1, np.inf) + zlib.compress(bytes(7)),
            struct.pack("<If", 1, np.nan) + zlib.compress(bytes(7)),
            struct.pack("<If", 10**7, 0.01) + zlib.compress(bytes(7 * 10**7), 9)[:90_000],
            bytes(200_000),
        )
    ]
    seen = descriptors_to_msg(Descriptors.of(np.zeros((9, 3), "f4"), np.zeros((9, 8))), 5, name, "weights")
    short, wide = copy.deepcopy(seen), copy.deepcopy(seen)
    short.width, wide.fields[-1].count = 2**32 - 1, 2**32 - 1
    return [*poses, *clouds, short, wide]


@pytest.mark.parametrize("mapper", [True], ids=["descriptors"], indirect=True)
def test_nothing_under_the_name_of_a_keyframe_displaces_it(mapper: Any) -> None:
    """Invalid messages are rejected one by one, and counted by reason; the robot's own messages then make its map."""
    wires = dict(zip((Odometry, PointCloud2, UInt8MultiArray), mapper.wires.all, strict=True))
    bad = hostile_parts(1)
    for message in bad:
        wires[type(message)].publish(message)
    mapper.wait(lambda: sum(rejections(mapper).values()) == len(bad), "all of them rejected")
    kinds = {kind.partition(": ")[2] for kind in rejections(mapper)}
    assert kinds == {"covariance", "pose", "frame", "cloud", "size", "descriptors"}
    send_all(mapper, 0, 1, 2)
    mapper.wait(lambda: keyframes(mapper) == 3, "the map")
    np.testing.assert_allclose(core(mapper).poses[:, 0, 3], [0, 5, 10], atol=1e-6)


@pytest.mark.parametrize(
    "name",
    [
        "not a keyframe", "kf_" + "9" * 5000, f"kf_5000000000.{S}", f"kf_{2**31}.{S}", f"kf_1.{'a' * 5000}",
        "../" * 50 + "kf_1", "kf_१",
    ],
)  # fmt: skip
def test_no_name_ends_the_mapper(mapper: Any, name: str) -> None:
    mapper.send(1, np.eye(4), points(1), name=name)
    mapper.wait(lambda: sum(mapper.mapper.rejections.values()) == 3, "three messages rejected")
    send_all(mapper, 0)
    mapper.wait(lambda: keyframes(mapper) == 1, "the keyframe after it")


@pytest.mark.parametrize("mapper", [True], ids=["descriptors"], indirect=True)
def test_descriptors_of_other_weights_are_made_anew(mapper: Any) -> None:
    """The keyframe is used; its descriptors are computed again with the mapper's own network."""
    name, cloud = keyframe_name("", 0, S), points(0)
    foreign = Descriptors.of(np.ones((256, 3), "f4"), np.ones((256, 128)))
    mapper.wires.send(Keyframe(0, 9, 0, np.eye(4), cloud, descriptors=foreign), name, "0123456789abcdef")
    mapper.wait(lambda: keyframes(mapper) == 1, "the keyframe")
    assert mapper.mapper.rejections == {"/dpm2/keyframe: descriptors of other weights": 1}
    own = core(mapper).keyframes[0].descriptors
    assert own is None or not np.array_equal(own.features, foreign.features)


def test_topics_that_bring_nothing_are_forgotten(mapper: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """Subscriptions are limited, and topics without a publisher are released: a robot that appears later is still
    received."""
    monkeypatch.setattr(mapper_node, "PATIENCE", 1.0)
    topics = [f"/x{n}/dpm2/keyframe_odom" for n in range(80)]
    many = rclpy.create_node("many", use_global_arguments=False)
    for topic in topics:
        many.create_publisher(Odometry, topic, 1)

    def heard() -> int:
        return sum(mapper.node.count_subscribers(topic) for topic in topics)

    mapper.wait(lambda: heard() == 63, "as many as there may be, with its own")
    many.destroy_node()
    mapper.wait(lambda: heard() == 0, "those without a publisher to go")
    send_all(mapper, 0)
    mapper.wait(lambda: keyframes(mapper) == 1, "a robot that is still heard")
