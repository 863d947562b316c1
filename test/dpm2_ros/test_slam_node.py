# SPDX-License-Identifier: Apache-2.0
"""slam_node over real DDS: a test publishes clouds and images and subscribes to the results."""

from __future__ import annotations

import re
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
from sensor_msgs.msg import PointCloud2
from std_msgs.msg import String, UInt32MultiArray
from std_srvs.srv import Trigger
from visualization_msgs.msg import MarkerArray

from dpm2_core.data.messages import stamp_ns
from dpm2_core.data.transforms import transform_matrix
from dpm2_core.slam.store.map_cloud import map_cloud_in_steps
from dpm2_ros.active_map import ActiveMap
from dpm2_ros.conversions import EARLIER
from dpm2_ros.keyframe_messages import BUDGET, received_to_msg
from dpm2_ros.stamps import stamp_to_msg
from dpm2_ros.tf_message import TFMessage
from dpm2_ros.unsent import KeyframeFile, left_behind
from test.helpers.rig import ACCURATE, Rig

from ..helpers.diagnostics import figures, saying

LATCHED = QoSProfile(depth=10, durability=DurabilityPolicy.TRANSIENT_LOCAL, reliability=ReliabilityPolicy.RELIABLE)


@pytest.mark.parametrize("reliable", [True, False], ids=["reliable", "best effort"])
def test_every_cloud_gives_its_pose(rig: Callable[..., Rig], drive: Any, reliable: bool) -> None:
    """Clouds of a best-effort publisher are received, too, which a reliable subscription would never receive."""
    r = rig("use_sim_time:=true", reliable=reliable)
    clock = r.harness.publisher(Clock, "/clock")
    r.wait(clock.get_subscription_count, "the subscription to /clock")
    for n in range(drive.frames):
        clock.publish(Clock(clock=stamp_to_msg(drive.stamp(n))))
        r.send_and_wait(n)
    assert r.stamps() == [drive.stamp(n) for n in range(drive.frames)]
    assert r.off(drive.pose) < ACCURATE
    assert {(message.header.frame_id, message.child_frame_id) for message in r.odom} == {("odom", "lidar")}
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
    r.wait(lambda: r.harness.found_by(r.node, "/tf") and r.node.count_subscribers("/dpm2/keyframe"), "subscriptions")
    r.send_and_wait(*range(drive.frames))
    r.wait(lambda: len(keyframes) == len(poses) >= 3, "three keyframes in 12 m")
    assert [k.header.frame_id for k in keyframes] == [f"kf_{n}" for n in range(len(keyframes))]
    assert [stamp_ns(k.header) for k in keyframes] == [stamp_ns(p.header) for p in poses]
    assert poses[1].child_frame_id == "kf_1"
    assert keyframes[1].width == 320  # all descriptors of a frame
    assert len(keyframes[1].data) <= BUDGET // 2  # the other half is for the cloud
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


def test_the_map_is_bounded_and_built_only_for_listeners(
    rig: Callable[..., Rig], drive: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    r = rig("ros.map_max_points:=1000", "ros.map_period:=0.1")
    r.send_and_wait(0, 1, 2)
    r.mapped(1)
    built, make = [], map_cloud_in_steps
    monkeypatch.setattr("dpm2_ros.mapping.map_cloud_in_steps", lambda *given: (built.append(1), make(*given))[1])
    time.sleep(0.3)
    assert not built  # there is no subscriber
    maps = r.harness.hear(PointCloud2, "/dpm2/map", LATCHED)
    r.wait(lambda: maps, "the map, once there is a subscriber")
    time.sleep(0.3)
    assert [m.width for m in maps] == [1000]  # and it is not sent again while nothing changes
    assert len(built) == 1


def test_the_grid_is_latched_bounded_and_soon_there(rig: Callable[..., Rig], drive: Any) -> None:
    """The grid is built only for subscribers; a late one receives it immediately. House fronts are occupied, the street
    is free."""
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
    r.harness.destroy(late)
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
    """Before the first cloud, the node is not silent: a driver may need long to start."""
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
    silent(300.0)  # clouds may be slow, unless the silence itself is tested
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
    r.harness.destroy(late)


def mapped_elsewhere(rig: Callable[..., Rig], *parameters: str) -> tuple[Rig, Any, list[Odometry]]:
    """A node without a mapper of its own, a publisher of acknowledgments, and the received poses of its keyframes."""
    r = rig("ros.embed_mapper:=false", "slam.keyframes.distance:=0.5", *parameters)
    received = r.harness.publisher(UInt32MultiArray, "/dpm2/keyframes_received")
    r.wait(received.get_subscription_count, "the node")
    poses = r.harness.hear(Odometry, "/dpm2/keyframe_odom")
    r.wait(lambda: r.node.count_subscribers("/dpm2/keyframe_odom"), "the subscription")
    return r, received, poses


def test_keyframes_that_no_mapper_has_received_are_counted(rig: Callable[..., Rig], drive: Any) -> None:
    """Without a mapper all count as missing, which is a warning; once one acknowledges some, the warning ends."""
    r, received, poses = mapped_elsewhere(rig)
    r.send_and_wait(*range(drive.frames))
    none = r.status("mapper", saying(f"0 of {drive.frames} keyframes"))
    assert none.level == DiagnosticStatus.WARN
    r.wait(lambda: poses, "a keyframe")
    received.publish(received_to_msg(poses[0].child_frame_id.rpartition(".")[2], 5, [7]))
    some = r.status("mapper", saying(f"6 of {drive.frames} keyframes"))
    assert some.level == DiagnosticStatus.OK


def test_keyframes_stay_on_the_disk_whoever_else_has_heard_them(rig: Callable[..., Rig], tmp_path: Path) -> None:
    """A recorder or RViz receives the keyframes, but no mapper does: they are kept on the disk."""
    r, _, poses = mapped_elsewhere(rig, f"ros.map_directory:={tmp_path}")
    r.send_and_wait(*range(6))
    r.wait(lambda: len({pose.child_frame_id for pose in poses}) >= 6, "every keyframe, however often")
    r.harness.remove(r.node)
    ((_, path),) = left_behind(tmp_path, "")
    file = KeyframeFile(path)
    assert len(file) == 6
    file.close(keep=False)


@pytest.mark.parametrize("folder", ["", "file/map"])
def test_keyframes_that_end_with_the_node_are_named(
    rig: Callable[..., Rig], tmp_path: Path, capfd: pytest.CaptureFixture[str], folder: str
) -> None:
    """Keyframes that are lost when the node ends, without a mapper and without a usable folder, are reported;
    previously they were lost silently."""
    (tmp_path / "file").touch()
    directory = tmp_path / folder if folder else "''"
    r = rig("ros.embed_mapper:=false", "slam.keyframes.distance:=0.5", f"ros.map_directory:={directory}")
    r.send_and_wait(*range(6))
    expected = f"of 6 keyframes have arrived at the mapper{'; 6 keyframes in memory only' if folder else ''}"
    assert r.status("mapper", saying(expected)).level == (DiagnosticStatus.ERROR if folder else DiagnosticStatus.OK)
    r.harness.remove(r.node)
    why = "Not a directory" if folder else "ros.map_directory is empty"
    said = re.search("6 keyframes neither delivered nor on the disk: (.*)", capfd.readouterr().err)
    assert said is not None
    assert why in said[1]


def test_a_mapper_is_told_that_a_drive_is_over_that_it_has(rig: Callable[..., Rig]) -> None:
    """Even if all keyframes have arrived, the mapper is informed of a drive's end. Otherwise it would place the
    odometry of the next drive by that of the previous one."""
    r, received, poses = mapped_elsewhere(rig)
    r.send_and_wait(*range(6))
    r.wait(lambda: len({pose.child_frame_id for pose in poses}) >= 6, "every keyframe, however often")
    last = max(pose.child_frame_id for pose in poses)
    received.publish(received_to_msg(last.rpartition(".")[2], 6, []))
    r.status("mapper", saying("6 of 6 keyframes"))
    time.sleep(2.5)  # until delivery is confirmed, and nothing of this drive is sent again
    assert r.harness.call(Trigger, "/slam_node/reset").success
    r.wait(lambda: any(pose.child_frame_id == last + EARLIER for pose in poses), "the end of the drive")


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
    """Saving a large map takes seconds; clouds are processed meanwhile."""
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
    """A file in place of the map's folder has the effect of a full disk. A reset that cannot save the map changes
    neither the odometry nor the robot's pose; the response gives the reason."""
    r = rig(f"ros.map_directory:={tmp_path / 'map'}", f"ros.map_file:={tmp_path / 'a.dpm2map'}")
    tf = r.harness.hear(TFMessage, "/tf")
    r.send_and_wait(*range(6))
    r.mapped(1)
    (tmp_path / "map").write_text("in the way")
    for service, says in (("save_map", ""), ("reset", "no reset: ")):
        result = r.harness.call(Trigger, f"/slam_node/{service}")
        assert not result.success
        assert says in result.message
        assert str(tmp_path / "map") in result.message
    placed = lambda: [t for m in tf for t in m.transforms if t.child_frame_id == "odom"]  # noqa: E731
    before = len(placed())
    r.send_and_wait(6)
    assert transform_matrix(r.odom[-1].pose.pose)[0, 3] == pytest.approx(drive.pose(6)[0, 3], abs=0.1)
    r.wait(lambda: len(placed()) > before, "map -> odom")
    assert r.keyframes
    (tmp_path / "map").unlink()  # so that the node can save when it ends


def test_reset_starts_again(rig: Callable[..., Rig], drive: Any) -> None:
    r = rig()
    r.send_and_wait(*range(6))
    r.mapped(1)
    assert r.harness.call(Trigger, "/slam_node/reset").success
    r.wait(lambda: r.keyframes == 0, "the empty map")
    r.send_and_wait(6)
    assert transform_matrix(r.odom[-1].pose.pose)[:3, 3] == pytest.approx([0, 0, 0], abs=1e-9)
