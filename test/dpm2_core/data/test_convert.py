# SPDX-License-Identifier: Apache-2.0
"""KITTI and other sources to bags: nothing changes, and a failed or killed conversion leaves nothing that looks
complete."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

import dpm2_core
from dpm2_core.data import naming
from dpm2_core.data.bag_file import open_bag
from dpm2_core.data.bags import BagSource
from dpm2_core.data.convert import EPOCH_NS, convert
from dpm2_core.data.kitti import KittiSource
from dpm2_core.data.open import open_source
from dpm2_core.data.ply import write_ply
from dpm2_core.data.settings import InputSettings
from dpm2_core.data.source import IndexedSource, Span
from dpm2_core.errors import Dpm2Error, UsageError
from dpm2_core.frame import R_AHEAD, Camera, Fix, Frame, Image, Inertial
from dpm2_core.geometry import se3

from ...helpers.command import dpm2, succeeded
from ...helpers.full_disk import largest_file

MakeFolder = Callable[..., Path]
ROOT = Path(dpm2_core.__file__).resolve().parents[1]
STAMP = 1_700_000_000_000_000_000  # ns


def assert_same_drive(bag: BagSource, folder: KittiSource, count: int | None = None) -> None:
    """Compare a bag with the first `count` frames of the folder, or with all."""
    assert len(bag) == (len(folder) if count is None else count)
    assert bag.vertical_angle_correction_deg == folder.vertical_angle_correction_deg
    for ours, theirs in zip(bag.frames(), folder.frames(0, count), strict=True):
        assert ours.stamp == EPOCH_NS + theirs.stamp
        np.testing.assert_array_equal(ours.points, theirs.points)
        assert len(ours.images) == len(theirs.images)
        for a, b in zip(ours.images, theirs.images, strict=True):
            np.testing.assert_array_equal(a.pixels, b.pixels)
    for ours_T, theirs_T in (
        (bag.poses, None if folder.poses is None else folder.poses[:count]),
        (bag.T_cam_lidar, folder.T_cam_lidar),
    ):
        assert ours_T is not None
        np.testing.assert_allclose(ours_T, theirs_T, rtol=0, atol=1e-9)
    if folder.camera:
        np.testing.assert_array_equal(bag.camera.K, folder.camera.K)
        np.testing.assert_allclose(bag.camera.T_lidar_cam, folder.camera.T_lidar_cam, rtol=0, atol=1e-9)


@pytest.mark.parametrize("zstd", [False, True])
def test_round_trip(kitti_folder: MakeFolder, tmp_path: Path, zstd: bool) -> None:
    folder = kitti_folder(numbers=[3, 4, 6])
    steps: list[tuple[int, int]] = []
    notes = convert(KittiSource(folder), tmp_path / "bag", zstd=zstd, progress=lambda *step: steps.append(step))
    assert notes == []
    assert steps == [(1, 3), (2, 3), (3, 3)]
    assert_same_drive(BagSource(tmp_path / "bag"), KittiSource(folder))
    assert sorted(os.listdir(tmp_path)) == ["bag", "kitti"]


@pytest.mark.slow
def test_round_trip_of_the_real_excerpt(kitti_root: Path, tmp_path: Path) -> None:
    folder = KittiSource(kitti_root, InputSettings(sequence="04"))
    convert(folder, tmp_path / "bag", (0, 6))
    assert_same_drive(BagSource(tmp_path / "bag"), folder, 6)


def test_a_simulated_drive_stays_without_correction(kitti_folder: MakeFolder, tmp_path: Path) -> None:
    folder = kitti_folder()
    (folder / "dpm2_sim.json").write_text('{"vertical_angle_correction_deg": 0}')
    convert(KittiSource(folder), tmp_path / "bag")
    assert BagSource(tmp_path / "bag").vertical_angle_correction_deg == 0
    assert_same_drive(BagSource(tmp_path / "bag"), KittiSource(folder))


def test_topics_frames_and_qos_are_those_of_kitti2bag(kitti_folder: MakeFolder, tmp_path: Path) -> None:
    folder = kitti_folder()
    convert(KittiSource(folder), tmp_path / "bag")
    bag = open_bag(tmp_path / "bag")
    assert bag.types == {
        "/kitti/velo/pointcloud": "sensor_msgs/msg/PointCloud2",
        "/kitti/camera_color_left/image_raw": "sensor_msgs/msg/Image",
        "/kitti/camera_color_left/camera_info": "sensor_msgs/msg/CameraInfo",
        "/tf_static": "tf2_msgs/msg/TFMessage",
        "/kitti/ground_truth/odom": "nav_msgs/msg/Odometry",
        "/kitti/ground_truth/path": "nav_msgs/msg/Path",
        "/kitti/vertical_angle_correction_deg": "std_msgs/msg/Float64",
    }
    latched = {naming.TF_STATIC, f"{naming.KITTI.truth}/path", naming.VERTICAL_ANGLE_CORRECTION}
    assert bag.counts == {t: 1 if t in latched else 5 for t in bag.types}
    cloud = bag.first("/kitti/velo/pointcloud")
    assert [field.name for field in cloud.fields] == ["x", "y", "z", "intensity"]
    assert (cloud.header.frame_id, cloud.point_step, cloud.width) == ("velo_link", 16, 60)
    image = bag.first(naming.IMAGE)
    assert (image.encoding, image.header.frame_id, image.width) == ("rgb8", "camera_color_left", 40)
    links = {(t.header.frame_id, t.child_frame_id) for t in bag.first("/tf_static").transforms}
    assert links == {("base_link", "velo_link"), ("velo_link", "camera_gray_left"), ("velo_link", "camera_color_left")}
    path = bag.first("/kitti/ground_truth/path")
    assert len(path.poses) == 5
    assert bag.first("/kitti/ground_truth/odom").child_frame_id == "velo_link"

    from rosbags.highlevel import AnyReader

    with AnyReader([tmp_path / "bag"]) as reader:
        durability = {c.topic: c.ext.offered_qos_profiles[0].durability.name for c in reader.connections}
    assert {topic for topic, name in durability.items() if name == "TRANSIENT_LOCAL"} == latched
    order = [topic for topic, _, _ in bag.messages(list(bag.types))][2:6]
    camera, truth = naming.KITTI.camera, naming.KITTI.truth
    assert order == [f"{camera}/camera_info", naming.IMAGE, f"{truth}/odom", naming.POINTS]  # the image comes first


def test_part_of_a_drive_without_images(kitti_folder: MakeFolder, tmp_path: Path) -> None:
    folder = kitti_folder()
    drive = KittiSource(folder.parents[1], InputSettings(sequence="07", images=False))
    convert(drive, tmp_path / "bag", (1, 3))
    source = BagSource(tmp_path / "bag")
    assert [frame.stamp - EPOCH_NS for frame in source.frames()] == [100_000_000, 200_000_000]
    assert naming.IMAGE not in open_bag(tmp_path / "bag").types
    np.testing.assert_allclose(source.poses[:, 0, 3], [1, 2], atol=1e-12)


def test_a_bare_sequence_becomes_a_lidar_bag(kitti_folder: MakeFolder, tmp_path: Path) -> None:
    """No calibration, no poses: only points, and nothing is invented for the rest."""
    folder = kitti_folder(images=False)
    for path in (folder / "calib.txt", folder / "times.txt", folder.parents[1] / "poses" / "07.txt"):
        path.unlink()
    notes = convert(KittiSource(folder), tmp_path / "bag")
    assert len(notes) == 2
    source = BagSource(tmp_path / "bag")
    assert len(list(source.frames())) == 5
    assert source.poses is None
    assert source.T_cam_lidar is None
    np.testing.assert_allclose(source.transforms.lookup("base_link", "velo_link")[2, 3], 1.73)


def test_a_scan_that_cannot_be_read_stays_a_frame(kitti_folder: MakeFolder, tmp_path: Path) -> None:
    folder = kitti_folder()
    (folder / "velodyne" / "000002.bin").write_bytes(b"123")
    notes = convert(KittiSource(folder), tmp_path / "bag")
    assert "000002.bin: 3 bytes are no whole number of points (16 bytes each): written as an empty cloud" in notes[0]
    assert [len(frame.points) for frame in BagSource(tmp_path / "bag").frames()] == [60, 60, 0, 60, 60]


def test_what_is_there_is_rejected_or_replaced(kitti_folder: MakeFolder, tmp_path: Path) -> None:
    folder, out = kitti_folder(), tmp_path / "bag"
    convert(KittiSource(folder), out, (0, 2))
    with pytest.raises(UsageError, match="exists already; use --overwrite"):
        convert(KittiSource(folder), out)
    assert len(BagSource(out)) == 2
    convert(KittiSource(folder), out, overwrite=True)
    assert len(BagSource(out)) == 5
    other = tmp_path / "photos"
    other.mkdir()
    (other / "holiday.jpg").touch()
    with pytest.raises(UsageError, match="not a rosbag2 folder, so it is not overwritten"):
        convert(KittiSource(folder), other, overwrite=True)
    assert (other / "holiday.jpg").exists()


@pytest.mark.parametrize(
    ("out", "frames", "message"),
    [
        ("bag", (5, None), "no frames 5:; it has 5"),
        ("bag", (3, 3), "no frames 3:3; it has 5"),
        ("bag.mcap", (0, None), "a rosbag2 recording is a folder; leave out the .mcap"),
    ],
)
def test_requests_that_cannot_be_met(
    kitti_folder: MakeFolder, tmp_path: Path, out: str, frames: Span, message: str
) -> None:
    with pytest.raises(UsageError, match=message):
        convert(KittiSource(kitti_folder()), tmp_path / out, frames)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["kitti"]


@pytest.mark.slow
def test_a_killed_conversion_leaves_nothing_that_looks_whole(kitti_folder: MakeFolder, tmp_path: Path) -> None:
    folder, out = kitti_folder(), tmp_path / "bag"
    code = """
import sys, time
from pathlib import Path
from dpm2_core.data.convert import convert
from dpm2_core.data.kitti import KittiSource
def progress(done, total):
    print(done, flush=True)
    time.sleep(60 if done == 3 else 0)
convert(KittiSource(sys.argv[1]), Path(sys.argv[2]), progress=progress)
"""
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    command = [sys.executable, "-c", code, str(folder), str(out)]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=environment)
    while process.stdout.readline() != "3\n":
        assert process.poll() is None, process.communicate()
    process.send_signal(signal.SIGKILL)
    process.communicate()
    assert not out.exists()
    convert(KittiSource(folder), out)  # and the next attempt cleans up
    assert sorted(path.name for path in tmp_path.iterdir()) == ["bag", "kitti"]
    assert len(BagSource(out)) == 5


def test_a_full_disk_is_an_error_without_leftovers(kitti_folder: MakeFolder, tmp_path: Path) -> None:
    """A limit on the file size raises the same OSError as a full disk. The existing bag survives."""
    folder, out = kitti_folder(), tmp_path / "bag"
    convert(KittiSource(folder), out, (0, 1))
    np.zeros((200_000, 4), "<f4").tofile(folder / "velodyne" / "000004.bin")
    with largest_file(1_000_000), pytest.raises(Dpm2Error, match=f"^{out}: not written: File too large$"):
        convert(KittiSource(folder), out, overwrite=True)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["bag", "kitti"]
    assert len(BagSource(out)) == 1


def test_a_place_that_cannot_be_written_is_named(kitti_folder: MakeFolder, tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(Dpm2Error, match=r"file/bag: not written: Not a directory"):
        convert(KittiSource(kitti_folder()), tmp_path / "file" / "bag")


def test_command_line(kitti_folder: MakeFolder, tmp_path: Path) -> None:
    folder, out = kitti_folder(), tmp_path / "bag"
    succeeded("convert", folder, out, "--frames", "1:4", "--set", "input.images=false", "--zstd")
    assert len(BagSource(out)) == 3
    assert dpm2("convert", folder, out).returncode == 2
    assert dpm2("convert", folder, out, "--overwrite").returncode == 0
    assert len(BagSource(out)) == 5


def test_a_setting_of_the_slam_is_an_error(kitti_folder: MakeFolder, tmp_path: Path) -> None:
    """Previously, the help named one as its example, and it had no effect."""
    done = dpm2("convert", kitti_folder(), tmp_path / "bag", "--set", "slam.map.voxel=1")
    assert done.returncode == 2
    assert "allowed here: input" in done.stderr
    assert not (tmp_path / "bag").exists()


def test_ground_truth_starts_where_the_drive_does(kitti_folder: MakeFolder, tmp_path: Path) -> None:
    """Frames without a pose have none in the bag either: neither a zero pose nor a repeated one."""
    folder = kitti_folder()
    (folder / "poses.txt").write_text("1 0 0 0 0 1 0 0 0 0 1 0\n" * 3)
    convert(KittiSource(folder), tmp_path / "bag")
    poses = BagSource(tmp_path / "bag").poses
    np.testing.assert_allclose(poses[:3], se3.exp(np.zeros((3, 6))), atol=1e-12)
    assert np.isnan(poses[3:]).all()


class OtherDrive(IndexedSource):
    """A source with all kinds of data: two cameras with distortion, point times, an IMU, GNSS, stamps since 1970."""

    truth = "here"

    def __init__(self) -> None:
        super().__init__("other", 3)
        self.poses = np.tile(np.eye(4), (3, 1, 1))
        self.poses[:, 0, 3] = [0, 1, np.nan]
        self.cameras = [
            Camera(np.array([[50, 0, 20.5], [0, 51, 10], [0, 0, 1]]), se3.make(R_AHEAD, [0.1, y, 0]), (40, 20),
                   distortion, name)
            for y, distortion, name in ((0.3, (-0.2, 0.1, 1e-3, 0, 0), "left"), (-0.3, tuple(range(8)), "right"))
        ]  # fmt: skip

    def frame(self, position: int) -> Frame:
        """The second frame has no image of the left camera. Each frame repeats the last sample of the previous one."""
        rng, stamp = np.random.default_rng(position), STAMP + position * 10**8
        points = np.c_[rng.uniform(-20, 20, (30, 3)), rng.uniform(size=30)].astype(np.float32)
        pixels = rng.integers(0, 256, (2, 20, 40, 3)).astype(np.uint8)
        images = [Image(pixels[n], camera, 0.004 * n) for n, camera in enumerate(self.cameras)]
        samples = np.arange(-10, 1) * 10**7 + stamp
        imu = Inertial(samples, np.outer(samples - STAMP, [1, 2, 3]) * 1e-9, np.ones((11, 3)))
        fix = Fix(stamp, np.array([49.0 + position * 1e-5, 8.4, 120.0]), np.diag([1.0, 1, 4]), np.array([0, 0, 0.5]))
        offset = np.linspace(-0.1, 0, 30, dtype=np.float32)
        return Frame(stamp, points, offset, tuple(images[position == 1 :]), position, imu=imu, fix=fix)


def test_any_drive_becomes_a_bag_of_the_same_frames(tmp_path: Path) -> None:
    drive = OtherDrive()
    assert convert(drive, tmp_path / "bag") == []
    settings = InputSettings(
        image_topic="/camera/image_raw", second_image_topic="/camera_2/image_raw", gnss_topic="/fix"
    )
    bag = BagSource(tmp_path / "bag", settings)
    frames = list(bag.frames())
    assert bag.vertical_angle_correction_deg == 0
    for ours, theirs in zip(frames, drive.frames(), strict=True):
        assert ours.stamp == theirs.stamp
        np.testing.assert_array_equal(ours.points, theirs.points)
        np.testing.assert_allclose(ours.time_offset, theirs.time_offset, atol=1e-8)
        assert len(ours.images) == len(theirs.images)
        for a, b in zip(ours.images, theirs.images, strict=True):
            np.testing.assert_array_equal(a.pixels, b.pixels)
            assert a.time_offset == pytest.approx(b.time_offset, abs=1e-8)
            assert a.camera.distortion == b.camera.distortion
            np.testing.assert_array_equal(a.camera.K, b.camera.K)
            np.testing.assert_allclose(a.camera.T_lidar_cam, b.camera.T_lidar_cam, atol=1e-9)
        np.testing.assert_array_equal(ours.imu.stamps[-10:], theirs.imu.stamps[-10:])
        np.testing.assert_allclose(ours.imu.rates[-10:], theirs.imu.rates[-10:], atol=1e-12)
        np.testing.assert_array_equal(ours.fix.geodetic, theirs.fix.geodetic)
        np.testing.assert_allclose(ours.fix.antenna, theirs.fix.antenna, atol=1e-12)
    np.testing.assert_array_equal(bag.poses[:2], drive.poses[:2])
    assert np.isnan(bag.poses[2]).any()
    counts = open_bag(tmp_path / "bag").counts
    assert (counts["/imu"], counts["/tf_static"], counts["/fix"]) == (31, 1, 3)


def test_a_folder_of_clouds_by_command(tmp_path: Path) -> None:
    (tmp_path / "clouds").mkdir()
    for n in range(3):
        write_ply(tmp_path / "clouds" / f"{n}.ply", np.full((5, 4), n, np.float32))
    succeeded("convert", tmp_path / "clouds", tmp_path / "bag", "--frames", "1:")
    source = BagSource(tmp_path / "bag")
    assert [(frame.stamp - EPOCH_NS, frame.points[0, 0]) for frame in source.frames()] == [(10**8, 1), (2 * 10**8, 2)]
    assert set(open_bag(tmp_path / "bag").types) == {"/points"}


def test_the_first_camera_is_that_although_its_images_come_late(tmp_path: Path) -> None:
    """The source determines which camera is the first. And an image that is associated with two clouds is written
    once."""
    drive = OtherDrive()
    drive.camera = drive.cameras[1]  # type: ignore[attr-defined]
    convert(drive, tmp_path / "bag")
    counts = open_bag(tmp_path / "bag").counts
    assert (counts["/camera/image_raw"], counts["/camera_2/image_raw"]) == (3, 2)


def test_what_lies_beside_the_scans_does_not_hide_them(kitti_folder: MakeFolder, tmp_path: Path) -> None:
    folder = kitti_folder()
    write_ply(folder / "map.ply", np.zeros((5, 4), np.float32))
    (folder / "metadata.yaml").write_text("notes: mine")
    assert isinstance(open_source(folder), KittiSource)
    assert "no KITTI sequence" in dpm2("convert", tmp_path, tmp_path / "bag").stderr
