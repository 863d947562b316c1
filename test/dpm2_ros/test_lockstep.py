# SPDX-License-Identifier: Apache-2.0
"""In lockstep a replay is exact: slam_node receives what `dpm2 run` reads, with cameras and with two LiDARs."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from nav_msgs.msg import Odometry
from rcl_interfaces.srv import GetParameters
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.task import Future
from rosbags.typesys import Stores, get_typestore
from sensor_msgs.msg import PointCloud2

from dpm2_core.commands.run import run
from dpm2_core.config import load_settings
from dpm2_core.data import bag_messages, naming
from dpm2_core.data.bag_file import open_bag
from dpm2_core.data.bags import BagSource
from dpm2_core.data.message_kinds import IMU
from dpm2_core.data.messages import restamped, serialized_stamp, stamp_ns
from dpm2_core.data.settings import InputSettings
from dpm2_core.data.trajectory import read_trajectory
from dpm2_core.data.transforms import transform_matrix
from dpm2_core.errors import Dpm2Error
from dpm2_core.slam.build import make_slam
from dpm2_core.slam.settings import Config
from dpm2_ros import lockstep
from dpm2_ros.conversions import pose_to_msg
from test.helpers.lockstep import Listener, contents, play
from test.helpers.recordings import write_bag

MS = 1_000_000


Shots = list[tuple[int, int]]
"""Stamps of images, and the log times at which they were recorded, ns."""


def with_shots(bag: Path, folder: Path, shots: Shots, later: int) -> Path:
    """The drive with images at these times, all different, and with its calibration recorded `later` (ns)."""
    types = get_typestore(Stores.ROS2_JAZZY)
    source, rng = open_bag(bag), np.random.default_rng(2)
    out: list[tuple[int, str, bytes]] = []
    for topic, log_time, data in source.messages(list(source.types)):
        if topic != naming.IMAGE:
            out.append((log_time + later * (topic == f"{naming.KITTI.camera}/camera_info"), topic, data))
    image = source.first(naming.IMAGE)
    assert image is not None
    for stamp, log_time in shots:
        image.header.stamp.sec, image.header.stamp.nanosec = stamp // 10**9, stamp % 10**9
        gray = cv2.GaussianBlur(rng.integers(0, 255, (40, 120), np.uint8), (0, 0), 2)
        pixels = np.repeat(cv2.normalize(gray, None, 0, 255, cv2.NORM_MINMAX)[..., None], 3, 2)
        message = replace(image, data=pixels.reshape(-1))
        out.append((log_time, naming.IMAGE, bytes(types.serialize_cdr(message, source.types[naming.IMAGE]))))
    return write_bag(folder, source.types, out)


@pytest.fixture(scope="module")
def fast_camera(bag: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The drive with three images per cloud, recorded 30 ms after their stamps: the nearest is the second, recorded
    after the cloud. The calibration is recorded only after the first cloud."""
    stamps = BagSource(bag).stamps.tolist()
    shots = [(stamp + shift * MS, stamp + (shift + 30) * MS) for stamp in stamps for shift in (-20, 12, 45)]
    return with_shots(bag, tmp_path_factory.mktemp("fast") / "camera", shots, 45 * MS)


def test_lockstep_gives_the_trajectory_of_dpm2_run(
    ros: Callable[..., Any], fast_camera: Path, drive: Any, tmp_path: Path
) -> None:
    """The trajectories are identical bit for bit, with images: here every pose depends on its cloud's image."""
    settings = ["slam.odometry.degraded_sigma=0.0001", "slam.visual.min_correlation=0.0", "slam.visual.distinct=0.0"]
    settings += ["slam.registration=geometric", "slam.loops.descriptors=false"]  # otherwise the network would be loaded
    harness = ros()
    odometry = harness.hear(Odometry, "/dpm2/odom")
    given = [*(text.replace("=", ":=") for text in settings), "ros.base_frame:=velo_link", "ros.map_directory:=''"]
    arguments = ["--ros-args", *(part for one in given for part in ("-p", one))]
    harness.start("slam_node", arguments, tmp_path / "node")
    harness.find("slam_node")  # otherwise its odometry of the first clouds would be lost
    player = harness.start("bag_player", [str(fast_camera), "--lockstep"], tmp_path / "player")
    assert player.wait(180) == 0, (tmp_path / "player").read_text()
    assert f"each of {drive.frames} clouds had its odometry" in (tmp_path / "player").read_text()
    harness.wait(lambda: len(odometry) == drive.frames, "the odometry")

    def expected(*more: str) -> list[Any]:
        config = load_settings(Config, None, [*settings, *more])
        slam = make_slam(config.slam)
        tracked = [slam.process(frame).odometry for frame in BagSource(fast_camera, config.input).frames()]
        return [pose_to_msg(one.T_odom_lidar) for one in tracked]

    assert [message.pose.pose for message in odometry] == expected()
    assert [message.pose.pose for message in odometry] != expected("input.image_time_offset=-0.03")  # with other images
    run(fast_camera, tmp_path / "out", settings=settings)
    written = read_trajectory(tmp_path / "out" / "trajectory.tum")
    assert written.keys.tolist() == [stamp_ns(message.header) for message in odometry]
    poses = [transform_matrix(message.pose.pose) for message in odometry]
    np.testing.assert_allclose(written.poses, poses, rtol=0, atol=1e-10)  # the file has 12 digits


@pytest.mark.parametrize("seed", range(4))
def test_lockstep_builds_the_frames_of_dpm2_run(ros: Callable[..., Any], bag: Path, tmp_path: Path, seed: int) -> None:
    """The camera has up to three images per cloud, with stamps that jitter by more than their distance, and sometimes
    one midway between two clouds. Images are recorded up to 0.7 s late, the calibration after the last cloud."""
    rng, shots = np.random.default_rng(seed), []
    for n, cloud in enumerate(BagSource(bag).stamps.tolist()):
        if n % 6 == 0:
            shots.append((cloud + 50 * MS, cloud + 150 * MS))
        elif n % 6 > 1:
            for jitter in rng.integers(-49, 50, rng.integers(0, 4)).tolist():
                stamp = cloud + jitter * MS
                shots.append((stamp, stamp + int(rng.choice([5, 60, 150, 400, 700])) * MS))
    recording = with_shots(bag, tmp_path / "camera", shots, 10_000 * MS)
    expected = list(BagSource(recording).frames())
    shown = [frame.images[0].pixels.tobytes() if frame.images else None for frame in expected]
    assert None in shown
    assert any(a == b and a is not None for a, b in pairwise(shown))
    harness = ros()
    node = harness.add(Listener())
    play(recording)
    assert [contents(frame) for frame in node.frames] == [contents(frame) for frame in expected]


@pytest.mark.parametrize(("ahead", "gap"), [(3000, 3000), (3000, 0), (700, 0)])
def test_a_gap_is_no_clock_that_was_set(
    ros: Callable[..., Any], bag: Path, tmp_path: Path, ahead: int, gap: int
) -> None:
    """A gap in a recording is not taken for a clock that was set, since /clock shows its duration. If only the stamps
    jump by so many ms, a clock was set."""
    types, source = get_typestore(Stores.ROS2_JAZZY), open_bag(bag)
    kinds = {topic: source.types[topic] for topic in (naming.POINTS, f"{naming.KITTI.truth}/odom")} | {naming.IMU: IMU}
    set_at = BagSource(bag).stamps.tolist()[8]
    messages = [(time, topic, bytes(data)) for topic, time, data in source.messages(list(kinds))]
    for time in BagSource(bag).stamps.tolist():  # none in the gap either: the last cloud before it waits to its end
        sample = bag_messages.imu(time, np.full(3, 0.01), np.array([0, 0, 9.8]))
        messages.append((time + MS, naming.IMU, bytes(types.serialize_cdr(sample, IMU))))
    for n, (time, topic, data) in enumerate(messages):
        later = time >= set_at
        moved = restamped(data, serialized_stamp(data, time) + later * ahead * MS)
        messages[n] = time + later * gap * MS, topic, moved
    recording = write_bag(tmp_path / "gap", kinds, messages)
    expected = [frame.stepped for frame in BagSource(recording).frames()]
    assert sum(expected) == (gap == 0)
    node = ros("use_sim_time:=true").add(Listener(busy=0.05))
    play(recording, clock=True)
    assert node.stepped == expected


SECOND = "/second/points"


def with_second(bag: Path, folder: Path, seed: int) -> Path:
    """The drive with a second LiDAR 1 m to the left. Its clouds are recorded up to 0.3 s after their stamps, which
    jitter by up to 45 ms; some clouds are missing, and some are repeated."""
    types, rng = get_typestore(Stores.ROS2_JAZZY), np.random.default_rng(seed)
    source = open_bag(bag)
    kinds = {topic: kind for topic, kind in source.types.items() if topic != naming.IMAGE}
    out = [(time, topic, bytes(data)) for topic, time, data in source.messages(list(kinds))]
    placed, cloud = source.first(naming.TF_STATIC), source.first(naming.POINTS)
    assert placed is not None
    assert cloud is not None
    transform = placed.transforms[0].transform
    left = replace(transform, translation=replace(transform.translation, x=0.0, y=1.0, z=0.0))
    place = replace(placed.transforms[0], header=cloud.header, child_frame_id="second", transform=left)
    placed = replace(placed, transforms=[*placed.transforms, place])
    out = [m for m in out if m[1] != naming.TF_STATIC]
    tf = bytes(types.serialize_cdr(placed, kinds[naming.TF_STATIC]))
    out.append((min(time for time, *_ in out), naming.TF_STATIC, tf))
    for n, stamp in enumerate(BagSource(bag).stamps.tolist()):
        for _ in range(n % 3):
            at = stamp + int(rng.integers(-45, 46)) * MS
            time = replace(cloud.header.stamp, sec=at // 10**9, nanosec=at % 10**9)
            row = cloud.data.reshape(-1, cloud.point_step)[n : n + 50 + n]
            header = replace(cloud.header, stamp=time, frame_id="second")
            message = replace(cloud, header=header, width=len(row), row_step=row.size, data=row.reshape(-1).copy())
            data = bytes(types.serialize_cdr(message, kinds[naming.POINTS]))
            out.append((at + int(rng.choice([1, 60, 300])) * MS, SECOND, data))
    return write_bag(folder, kinds | {SECOND: kinds[naming.POINTS]}, out)


@pytest.mark.parametrize("seed", range(2))
def test_lockstep_joins_the_clouds_of_two_lidars_as_dpm2_run_does(
    ros: Callable[..., Any], bag: Path, drive: Any, tmp_path: Path, seed: int
) -> None:
    recording = with_second(bag, tmp_path / "two", seed)
    settings = InputSettings(points_topic=naming.POINTS, second_points_topic=SECOND)
    expected = list(BagSource(recording, settings).frames())
    alone = [len(frame.points) for frame in BagSource(bag).frames()]
    joined = [len(frame.points) > size for frame, size in zip(expected, alone, strict=True)]
    assert 0 < sum(joined) < len(joined) == drive.frames
    harness = ros()
    node = harness.add(Listener(SECOND))
    play(recording)
    assert [contents(frame) for frame in node.frames] == [contents(frame) for frame in expected]


def test_a_node_whose_answer_is_lost_is_asked_again(ros: Callable[..., Any], bag: Path, tmp_path: Path) -> None:
    """If the node's answer about the topic of its second LiDAR is lost, the player asks again."""
    recording, asked, never = with_second(bag, tmp_path / "two", 0), [], Future()
    node = ros().add(Listener(SECOND, start_parameter_services=False))

    async def answer(request: GetParameters.Request, response: GetParameters.Response) -> GetParameters.Response:
        asked.append(request.names)
        if len(asked) == 1:
            await never
        response.values = [parameter.get_parameter_value() for parameter in node.get_parameters(request.names)]
        return response

    node.create_service(GetParameters, "~/get_parameters", answer, callback_group=ReentrantCallbackGroup())
    try:
        play(recording)
    finally:
        never.set_result(None)
    assert asked == [["input.second_points_topic"]] * 2
    assert [frame.stamp for frame in node.frames] == BagSource(bag).stamps.tolist()


def test_two_lidars_of_a_node_that_does_not_say_which_is_the_second_end_it(
    ros: Callable[..., Any], bag: Path, tmp_path: Path
) -> None:
    recording = with_second(bag, tmp_path / "two", 0)
    node = Responder(ros(), lambda n: True)
    node.harness.node.create_subscription(PointCloud2, SECOND, lambda _: None, 10)
    with pytest.raises(Dpm2Error, match=r"tester takes clouds of .* and its input.second_points_topic is neither"):
        play(recording)


class Responder:
    """Publishes an odometry for clouds, as slam_node does, but only for the selected ones."""

    def __init__(self, harness: Any, responds: Callable[[int], bool]) -> None:
        self.harness, self._responds = harness, responds
        self.stamps: list[int] = []
        self.publisher = harness.publisher(Odometry, "/dpm2/odom")
        harness.node.create_subscription(PointCloud2, naming.POINTS, self._on_cloud, 10)

    def _on_cloud(self, message: PointCloud2) -> None:
        self.stamps.append(stamp_ns(message.header))
        if self._responds(len(self.stamps)):
            self.publisher.publish(Odometry(header=message.header))


def test_a_cloud_without_odometry_is_reported_and_the_next_goes_out(
    ros: Callable[..., Any], bag: Path, drive: Any, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(lockstep, "TIMEOUT", 3.0)  # enough time for the odometry of the others, even on a busy machine
    node = Responder(ros(), lambda n: n != 5)
    with pytest.raises(Dpm2Error, match=f"1 of {drive.frames} clouds had no odometry"):
        play(bag)
    stamps = BagSource(bag).stamps.tolist()
    assert node.stamps == stamps
    assert f"no odometry within 3 s for the cloud at {stamps[4] * 1e-9:.3f} s" in capfd.readouterr().err


def test_a_node_that_goes_away_ends_it(ros: Callable[..., Any], bag: Path) -> None:
    harness = ros()

    def responds(n: int) -> bool:
        if n == 5:
            harness.node.destroy_publisher(node.publisher)
        return n < 5

    node = Responder(harness, responds)
    with pytest.raises(Dpm2Error, match="/dpm2/odom has no publisher any more"):
        play(bag)


def test_without_a_node_it_ends(run: Callable[..., Any], bag: Path) -> None:
    ended = run("bag_player", str(bag), "--lockstep", "--wait", "0.5")
    assert ended.returncode == 1
    assert f"error: lockstep: no node subscribes to {naming.POINTS} and publishes /dpm2/odom" in ended.stderr
