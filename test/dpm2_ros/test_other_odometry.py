# SPDX-License-Identifier: Apache-2.0
"""slam_node with another odometry on the robot, over real DDS: one tree, whatever that odometry does."""

from __future__ import annotations

import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticStatus
from nav_msgs.msg import Odometry
from sensor_msgs.msg import PointCloud2, PointField

from dpm2_core.data.messages import cloud_fields, stamp_ns
from dpm2_core.data.transforms import TransformTree, transform_matrix
from dpm2_core.errors import UsageError
from dpm2_core.frame import Array
from dpm2_core.geometry import se3
from dpm2_ros.conversions import edge_to_msg, header, transform_to_msg
from dpm2_ros.other_odometry import WAIT, OtherOdometry
from dpm2_ros.settings import RosSettings
from dpm2_ros.slam_node import SlamNode
from dpm2_ros.tf_message import TFMessage
from test.helpers.rig import ACCURATE, Rig, publish_static

from ..helpers.diagnostics import figures, having, saying
from .conftest import pose, scan

T_BASE_LIDAR = se3.exp([0.0, 0.0, 0.2, 0.8, 0.0, 1.2])
JUMP, SLIP = 9, 0.02  # cloud before which the wheels jump by 0.5 m; fraction by which their distances are too long
STEPS = 5  # samples of the wheels per cloud
NONE = "ros.publish_tf_odom:=false"


class Robot(Rig):
    """Its wheels, its LiDAR 0.8 m ahead of the base and 1.2 m above it, and slam_node."""

    def __init__(self, ros: Callable[..., Any], drive: Any, source: str, *parameters: str) -> None:
        super().__init__(ros, drive, f"ros.odom_source:={source}", *parameters)
        self.tf, self.heard = self.harness.publisher(TFMessage, "/tf"), self.harness.hear(TFMessage, "/tf")
        self.topic = self.harness.publisher(Odometry, "/odom") if source == "topic" else None
        publish_static(self, "base_link", "lidar", T_BASE_LIDAR)
        self.wait((self.topic or self.tf).get_subscription_count, "the subscription to the wheels")
        self.covariance = lambda n: 1e-4 * np.eye(6)  # stated on the topic at cloud n
        self._T, self.wheels = se3.exp([0.0, 0.0, 1.0, 5.0, 0.0, 0.0]), {}  # an origin of its own

    def base(self, t: float) -> Array:
        """Ground truth T_start_base at the (fractional) number of a cloud."""
        begin, end = self.drive.pose(int(t)), self.drive.pose(int(t) + 1)
        T = begin @ se3.exp((t - int(t)) * se3.way(begin, end))
        return T_BASE_LIDAR @ T @ se3.inverse(T_BASE_LIDAR)

    def turn_wheels(self, n: int) -> None:
        """Publish the samples from the previous cloud to this one, and one more."""
        for step in range(1 if n else 0, STEPS + 1):
            t = n - 1 + step / STEPS if n else 0.0
            if n:
                way = se3.way(self.base(t - 1 / STEPS), self.base(t))
                way[3:] *= 1 + SLIP
                way[3] += 0.5 * (n == JUMP and step == 3)
                self._T = self._T @ se3.exp(way)
            stamp = round(self.drive.start + t * self.drive.period)
            self.wheels[stamp] = self._T
            if self.topic:
                self.topic.publish(edge_to_msg(self._T, self.covariance(n), stamp, "odom", "base_link"))
            self.tf.publish(TFMessage(transforms=[transform_to_msg(self._T, stamp, "odom", "base_link")]))
            if not n:
                break

    def go(self, *numbers: int, wheels: bool = True) -> None:
        for n in numbers:
            if wheels:
                self.turn_wheels(n)
            self.send_and_wait(n)

    def links(self) -> dict[tuple[str, str], dict[int, Array]]:
        """The transforms on /tf by parent and child, at each stamp."""
        out: dict[tuple[str, str], dict[int, Array]] = {}
        for message in self.heard:
            for t in message.transforms:
                link = out.setdefault((t.header.frame_id, t.child_frame_id), {})
                link[stamp_ns(t.header)] = transform_matrix(t.transform)
        return out


@pytest.fixture
def robot(ros: Callable[..., Any], drive: Any, monkeypatch: pytest.MonkeyPatch) -> Callable[..., Robot]:
    monkeypatch.setattr("dpm2_ros.diagnostics.PERIOD", 0.1)
    monkeypatch.setattr("dpm2_ros.other_odometry.WAIT", 2.0)  # a busy machine may be slow
    return lambda *parameters: Robot(ros, drive, *parameters)


@pytest.mark.slow
@pytest.mark.parametrize("source", ["tf", "topic"])
def test_slip_and_a_jump_of_half_a_meter(robot: Callable[..., Robot], drive: Any, source: str) -> None:
    """At the stamp of every cloud, map -> odom and the wheels' odom -> base make our pose, accurate to centimeters."""
    r = robot(source)
    r.go(*range(drive.frames))
    r.wait(lambda: len(r.links().get(("map", "odom"), {})) == drive.frames, "map -> odom of every cloud")
    links = r.links()
    assert set(links) == {("map", "odom"), ("odom", "base_link")}  # one parent each
    for n, message in enumerate(r.odom):
        stamp = drive.stamp(n)
        assert (message.header.frame_id, message.child_frame_id) == ("odom_dpm2", "base_link")
        T_map_base = links["map", "odom"][stamp] @ r.wheels[stamp]
        np.testing.assert_allclose(T_map_base, transform_matrix(message.pose.pose), atol=1e-6)
        assert np.linalg.norm((T_map_base - r.base(n))[:3, 3]) < ACCURATE
    said = r.status("other odometry", saying("outweighed"), since=0)  # reported for a while after the jump
    assert said.level == DiagnosticStatus.WARN
    assert float(said.message.split()[1]) == pytest.approx(0.5, abs=0.05)
    values = figures(r.status("other odometry", having(**{"clouds with it": drive.frames, "without": 0})))
    assert float(values["its distances too long by (%)"]) == pytest.approx(100 * SLIP, abs=0.3)
    assert (values["clouds with it"], values["outweighed"]) == (str(drive.frames), "1")


@pytest.mark.slow
def test_late_stopping_and_coming_back(robot: Callable[..., Robot], drive: Any) -> None:
    """The drive continues without it, /diagnostics reports it, and map -> odom is sent only if it is known."""
    r = robot("tf")
    r.go(0, 1, 2, wheels=False)
    missing = "no transform from 'base_link' to 'odom'"
    assert "going on without" in r.status("other odometry", saying(missing)).message
    r.processed(3)
    for n in range(3):
        r.turn_wheels(n)  # too late
    r.go(*range(3, 7))
    assert r.status("other odometry", saying("in use")).level == DiagnosticStatus.OK  # as with the radius of a wheel
    r.go(7, 8, wheels=False)
    assert "going on without" in r.status("other odometry", saying("ends 0.")).message
    r.processed(9)
    for n in (7, 8):
        r.turn_wheels(n)
    r.go(*range(9, 12))
    r.wait(lambda: len(r.links().get(("map", "odom"), {})) >= 7, "map -> odom")
    assert sorted(r.links()["map", "odom"]) == [drive.stamp(n) for n in (3, 4, 5, 6, 9, 10, 11)]
    assert r.off(r.base) < ACCURATE


def test_one_that_begins_after_the_clouds_is_awaited_as_any_other(
    robot: Callable[..., Robot], drive: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """If samples always arrive right after the clouds, clouds still wait for them. Previously, if none had been there
    for the first clouds, clouds no longer waited, and none was ever used."""
    monkeypatch.setattr("dpm2_ros.other_odometry.PATIENCE", 1)
    r = robot("topic")
    r.go(0, wheels=False)
    r.turn_wheels(0)
    r.go(1, wheels=False)  # from now on clouds wait only if that would have helped
    r.turn_wheels(1)
    for n in (2, 3):
        time.sleep(0.3)  # for the wheels, which are on another topic than the cloud
        r.send(n)
        time.sleep(0.3)  # on a busy machine the cloud may arrive even later, and need not wait
        r.turn_wheels(n)
        r.wait(lambda n=n: len(r.odom) > n, "the odometry of the cloud")
    r.status("other odometry", having(**{"clouds with it": 2, "without": 2}))
    r.wait(lambda: set(r.links().get(("map", "odom"), {})) == {drive.stamp(2), drive.stamp(3)}, "map -> odom")


def test_map_to_odom_waits_for_what_it_tells_of_the_end_of_a_sweep(robot: Callable[..., Robot], drive: Any) -> None:
    """For clouds stamped at their end, an odometry at 10 Hz may have reached only their middle when the pose is ready:
    map -> odom then waits. Previously, it was never sent, and an odometry in use was reported as left out."""
    r = robot("topic")
    points = scan(pose(0))  # the robot stands still
    columns = {name: points[:, i] for i, name in enumerate(("x", "y", "z"))}
    columns["time"] = np.linspace(-0.1, 0, len(points)).astype(np.float32)

    def tell(stamp: int) -> None:
        r.topic.publish(edge_to_msg(np.eye(4), 1e-4 * np.eye(6), stamp, "odom", "base_link"))

    tell(drive.stamp(-1) - 20_000_000)
    for n in range(4):
        tell(drive.stamp(n) - 20_000_000)
        r.lidar.publish(PointCloud2(header=header(drive.stamp(n), "lidar"), **cloud_fields(columns, PointField)))
        r.wait(lambda n=n: len(r.odom) > n, "the odometry of the cloud")
    said = r.status("other odometry", having(**{"clouds with it": 4, "without": 0}))
    assert "going on without" not in said.message
    r.wait(lambda: len(r.links().get(("map", "odom"), {})) == 3, "map -> odom")
    assert sorted(r.links()["map", "odom"]) == [drive.stamp(n) for n in range(3)]  # the last follows later


def test_what_is_no_odometry_is_rejected(robot: Callable[..., Robot], drive: Any) -> None:
    """Messages with another frame or with values that are not finite are counted, and the drive continues."""
    r = robot("topic")
    r.go(0, 1)
    good, nan = np.eye(4), np.full((6, 6), np.nan)
    r.topic.publish(edge_to_msg(good, np.eye(6), drive.stamp(2), "elsewhere", "base_link"))
    r.topic.publish(edge_to_msg(good, np.eye(6), drive.stamp(2), "odom", ""))
    far = edge_to_msg(good, nan, drive.stamp(2), "odom", "base_link")
    far.pose.pose.position.x = float("inf")
    r.topic.publish(far)
    r.wait(lambda: sum(r.node.rejections.values()) == 3, "three rejections")
    stated = edge_to_msg(r.wheels[drive.stamp(1)], nan, drive.stamp(1) + 1, "odom", "base_link")
    r.topic.publish(stated)  # a valid pose; only its covariance is ignored
    r.go(2, 3)
    assert sum(r.node.rejections.values()) == 3
    assert r.off(r.base) < ACCURATE


@pytest.mark.parametrize(("frame", "child"), [("odom", ""), ("elsewhere", "base_link")])
def test_a_topic_without_odometry_of_use_is_named(
    robot: Callable[..., Robot], drive: Any, frame: str, child: str
) -> None:
    """The topic is named; no missing transform is reported, since TF is not involved."""
    r = robot("topic")
    r.topic.publish(edge_to_msg(np.eye(4), np.eye(6), drive.stamp(0), frame, child))
    r.wait(lambda: list(r.node.rejections.values()) == [1], "the rejection")
    r.go(0, wheels=False)
    assert r.status("other odometry", having(without=1)).message == "no usable message on /odom yet; going on without"


def test_one_that_is_unsure_by_its_own_covariance_is_not_called_outweighed(robot: Callable[..., Robot]) -> None:
    """With 1000 m2 per cloud it is reported as left out. Previously, "outweighed: 0.00 m, 0.0 deg from the motion of
    the scans" was reported of a correct odometry."""
    r = robot("topic")
    r.covariance = lambda n: (1e-4 + 1e3 * n) * np.eye(6)
    r.go(*range(5))
    said = r.status("other odometry", saying("left out: its own covariance"))
    assert "outweighed" not in said.message
    assert having(outweighed=0)(said)


def test_parts_of_a_sweep_do_not_clear_what_the_last_sweep_has_shown(robot: Callable[..., Robot], drive: Any) -> None:
    """Nine of ten clouds are not compared with it: /diagnostics alternated between "in use" and what is wrong."""
    r = robot("topic")
    r.covariance = lambda n: (1e-4 + 1e3 * n) * np.eye(6)
    r.turn_wheels(0)
    for n in range(4):
        r.turn_wheels(n + 1)
        r.send_in_parts(n)
    assert saying("left out: its own covariance")(r.status("other odometry", having(**{"clouds with it": 40})))
    r.turn_wheels(5)
    r.lidar.publish(r.parts(4)[0])
    assert saying("left out: its own covariance")(r.status("other odometry", having(**{"clouds with it": 41})))


def test_while_a_cloud_waits_for_it_nothing_is_wrong(robot: Callable[..., Robot], drive: Any) -> None:
    """Parts of a sweep wait for its next message nearly all the time: /diagnostics often said that it ends before the
    cloud, and that dpm2 goes on without, although each cloud had it."""
    r = robot("tf")
    other = OtherOdometry(r.node, RosSettings(odom_source="tf"), TransformTree)
    r.turn_wheels(0)
    with ThreadPoolExecutor(1) as worker:
        r.wait(lambda: other.T_odom_base(drive.stamp(0), "base_link") is not None, "the wheels")
        assert other.guess(drive.stamp(0), "base_link", np.eye(4)) is not None
        later = worker.submit(other.guess, drive.stamp(1), "base_link", np.eye(4))
        time.sleep(WAIT / 2)
        assert other.problem == ""
        assert later.result() is None
    assert other.problem == "/tf: odom -> base_link ends 0.10 s before the cloud"


def test_it_is_asked_for_the_middle_of_the_sweep(robot: Callable[..., Robot], drive: Any) -> None:
    """The scan is registered at that time. With the stamp, here of the first point, the distances of an accelerating
    robot were too short. In this test, the wheels begin between the two times."""
    r = robot("tf")
    for stamp in (drive.stamp(0) + 40_000_000, drive.stamp(0) + 60_000_000):
        r.tf.publish(TFMessage(transforms=[transform_to_msg(np.eye(4), stamp, "odom", "base_link")]))
    points = scan(pose(0))
    columns = {name: points[:, i] for i, name in enumerate(("x", "y", "z"))}
    columns["t"] = np.linspace(0, drive.period, len(points)).astype(np.uint32)
    r.lidar.publish(PointCloud2(header=header(drive.stamp(0), "lidar"), **cloud_fields(columns, PointField)))
    r.wait(lambda: r.odom, "the odometry of the cloud")
    r.status("other odometry", having(**{"clouds with it": 1, "without": 0}))


@pytest.mark.parametrize(
    ("parameters", "expected"),
    [
        (("own", "ros.invert_odom_tf:=true"), {("base_link", "odom"), ("odom", "map")}),
        (("tf", "ros.invert_odom_tf:=true"), {("map", "odom"), ("odom", "base_link"), ("base_link", "odom_dpm2")}),
        (("tf", "ros.embed_mapper:=false"), {("odom_dpm2", "odom"), ("odom", "base_link")}),
        (
            ("tf", "ros.invert_odom_tf:=true", NONE),
            {("map", "odom"), ("odom", "base_link"), ("base_link", "odom_dpm2")},
        ),
        (("tf", "ros.embed_mapper:=false", NONE), {("odom_dpm2", "odom"), ("odom", "base_link")}),
        (("tf", "ros.embed_mapper:=false", "ros.publish_tf_map:=false"), {("odom", "base_link")}),
    ],
    ids=["own, inverted", "another's, inverted", "mapper apart", "leaf, no odom", "apart, no odom", "apart, no map"],
)
def test_every_frame_has_one_parent(robot: Callable[..., Robot], parameters: tuple[str], expected: set) -> None:
    """`publish_tf_odom` controls odom -> base only; previously, with another odometry, it separated the tree between
    map and odom."""
    r = robot(*parameters)
    r.go(0, 1, 2, wheels=parameters[0] == "tf")
    r.wait(lambda: set(r.links()) == expected and min(map(len, r.links().values())) >= 2, f"{expected}")
    children = [child for _, child in r.links()]
    assert len(children) == len(set(children))
    links = r.links()
    if leaf := links.get(("base_link", "odom_dpm2")) or links.get(("base_link", "odom")):
        poses = {stamp_ns(message.header): transform_matrix(message.pose.pose) for message in r.odom}
        for stamp, T in leaf.items():
            np.testing.assert_allclose(T @ poses[stamp], np.eye(4), atol=1e-6)


def test_a_leaf_beside_a_mapper_elsewhere_is_refused(ros: Callable[..., Any]) -> None:
    ros("ros.odom_source:=tf", "ros.invert_odom_tf:=true", "ros.embed_mapper:=false")
    with pytest.raises(UsageError, match=r"ros\.invert_odom_tf: needs ros\.embed_mapper"):
        SlamNode()
