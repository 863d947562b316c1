# SPDX-License-Identifier: Apache-2.0
"""KITTI-360 from a small tree in its own layout: sparse poses, rectified camera, raw sweeps."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from dpm2_core.data.kitti360 import Kitti360Source
from dpm2_core.data.open import open_source
from dpm2_core.data.settings import InputSettings
from dpm2_core.data.trajectory import read_trajectory
from dpm2_core.data.velodyne import azimuth_time
from dpm2_core.errors import UsageError
from dpm2_core.frame import R_AHEAD
from dpm2_core.geometry import se3
from dpm2_core.geometry.deskew import deskew

DRIVE = "2013_05_28_drive_0009_sync"
T_LIDAR_CAM = se3.make(R_AHEAD, [0.8, 0.3, -0.2])
T_IMU_CAM = se3.exp([0.02, -0.01, 0.03, 1.5, 0.1, 0.4]) @ T_LIDAR_CAM
T_RECT_CAM = se3.exp([0.01, -0.02, 0.005, 0, 0, 0])


def text(*numbers: object) -> str:
    return " ".join(str(x) for part in numbers for x in np.ravel(part))


def truth(number: int) -> np.ndarray:
    """T_world_lidar of a frame."""
    return se3.exp([0, 0, 0.1 * number, number, 0.5, 2])


@pytest.fixture
def root(tmp_path: Path) -> Path:
    """Frames 0..4, poses only for 1 and 3, images of 40 x 30."""
    calibration = tmp_path / "calibration"
    calibration.mkdir()
    (calibration / "calib_cam_to_velo.txt").write_text(text(T_LIDAR_CAM[:3]))
    (calibration / "calib_cam_to_pose.txt").write_text(
        f"image_00: {text(T_IMU_CAM[:3])}\nimage_01: {text(np.eye(4)[:3])}"
    )
    (calibration / "perspective.txt").write_text(
        "calib_time: 09-Jan-2014 14:00:15\ncorner_dist: 1.0\nS_rect_00: 40 30\n"
        f"R_rect_00: {text(T_RECT_CAM[:3, :3])}\nP_rect_00: 50 0 20 0 0 50 15 0 0 0 1 0\n"
    )
    velodyne = tmp_path / "data_3d_raw" / DRIVE / "velodyne_points"
    (velodyne / "data").mkdir(parents=True)
    images = tmp_path / "data_2d_raw" / DRIVE / "image_00" / "data_rect"
    images.mkdir(parents=True)
    rng = np.random.default_rng(0)
    for n in range(5):
        rng.uniform(0, 1, (60, 4)).astype("<f4").tofile(velodyne / "data" / f"{n:010d}.bin")
        cv2.imwrite(str(images / f"{n:010d}.png"), np.full((30, 40, 3), 10 * n, np.uint8))
    (velodyne / "timestamps.txt").write_text("".join(f"2013-05-28 08:46:02.{9 - n}04300001\n" for n in range(5, 0, -1)))
    poses = tmp_path / "data_poses" / DRIVE
    poses.mkdir(parents=True)
    T_imu_lidar = T_IMU_CAM @ se3.inverse(T_LIDAR_CAM)
    T_rect_lidar = T_RECT_CAM @ se3.inverse(T_LIDAR_CAM)
    (poses / "poses.txt").write_text(
        "".join(f"{n} {text((truth(n) @ se3.inverse(T_imu_lidar))[:3])}\n" for n in (1, 3))
    )
    (poses / "cam0_to_world.txt").write_text(
        "".join(f"{n} {text(truth(n) @ se3.inverse(T_rect_lidar))} \n" for n in (1, 3))
    )
    return tmp_path


@pytest.mark.parametrize("missing", [None, "poses.txt"])
def test_poses_are_of_the_lidar_and_unknown_between(root: Path, missing: str | None) -> None:
    """They are read from poses.txt or cam0_to_world.txt, whose camera is the rectified one. Frames without a pose are
    NaN."""
    if missing:
        (root / "data_poses" / DRIVE / missing).unlink()
    source = open_source(root)
    assert isinstance(source, Kitti360Source)
    assert np.isfinite(source.poses[:, 0, 0]).tolist() == [False, True, False, True, False]
    for n in (1, 3):
        np.testing.assert_allclose(source.poses[n], truth(n), atol=1e-9)
    assert any("3 of 5 frames have no pose" in note for note in source.notes)


def test_frames(root: Path) -> None:
    """Numbers, stamps to the nanosecond, the image of the same number, and the rectified camera's calibration."""
    frames = list(open_source(root / "data_3d_raw" / DRIVE).frames(1, 3))
    assert [frame.index for frame in frames] == [1, 2]
    assert [frame.stamp % 10**9 for frame in frames] == [504300001, 604300001]
    assert frames[1].stamp - frames[0].stamp == 10**8
    (image,) = frames[1].images
    assert (image.pixels == 20).all()
    assert image.camera.K[0, 0] == 50
    np.testing.assert_allclose(image.camera.T_lidar_cam, T_LIDAR_CAM @ se3.inverse(T_RECT_CAM), atol=1e-12)
    assert frames[0].time_offset is not None
    assert next(open_source(root, InputSettings(images=False)).frames()).images == ()


def test_without_timestamps_scans_are_as_far_apart_as_of_every_folder(root: Path) -> None:
    """Previously, `input.period` had no effect here."""
    (root / "data_3d_raw" / DRIVE / "velodyne_points" / "timestamps.txt").unlink()
    for settings, period in ((InputSettings(), 100_000_000), (InputSettings(period=0.5), 500_000_000)):
        source = open_source(root, settings)
        assert list(source.stamps) == [number * period for number in source.numbers]
        assert any(f"{period * 1e-9:g} s apart (input.period)" in note for note in source.notes)


def test_the_lidar_turns_clockwise_from_behind() -> None:
    """Forward is at the stamp, and left was a quarter of a rotation earlier. Previously, it was later, which doubled
    the distortion of a scan."""
    points = np.array([[1, 0, 0, 0], [0, 1, 0, 0], [0, -1, 0, 0]], np.float32)
    np.testing.assert_allclose(azimuth_time(points), [0, -0.025, 0.025], atol=1e-7)


def test_points_are_moved_as_by_the_devkit() -> None:
    """kitti360Scripts moves a point by the fraction azimuth / 2 pi of the motion from this pose to the previous one."""
    points = np.array([[3, 9, 0, 1], [-8, 2, 1, 1], [4, -7, 2, 1], [20, 0, 0, 1]], np.float32)
    T_previous_now = se3.exp([0, 0, 0.02, 1.4, 0, 0])  # 14 m/s, a curve
    part = np.arctan2(points[:, 1], points[:, 0]) / (2 * np.pi)
    back = se3.log(se3.inverse(T_previous_now))
    want = [se3.transform(se3.exp(a * back), p[None, :3].astype(float))[0] for a, p in zip(part, points, strict=True)]
    got = deskew(points, azimuth_time(points), se3.log(T_previous_now) / 0.1)
    np.testing.assert_allclose(got[:, :3], want, atol=0.012)  # half of one of the 63 steps of a sweep


def test_pose_files_are_read_by_themselves(root: Path) -> None:
    """13 or 17 numbers per line, as input for `dpm2 eval`."""
    for name in ("poses.txt", "cam0_to_world.txt"):
        trajectory = read_trajectory(root / "data_poses" / DRIVE / name)
        assert trajectory.keys.tolist() == [1, 3]
        assert trajectory.kind == "kitti-indexed"


def test_what_is_missing_is_named(root: Path) -> None:
    """A missing drive, a damaged scan, a damaged pose file, a missing calibration."""
    with pytest.raises(UsageError, match=rf"no sequence 0003.*{DRIVE}"):
        open_source(root, InputSettings(sequence="0003"))
    assert open_source(root, InputSettings(sequence="0009")).name == DRIVE
    scan = root / "data_3d_raw" / DRIVE / "velodyne_points" / "data" / "0000000000.bin"
    scan.write_bytes(b"123")
    assert "no whole number of points" in (next(open_source(root).frames()).problem or "")
    (root / "data_poses" / DRIVE / "poses.txt").write_text("1 2 3\n")
    with pytest.raises(UsageError, match=r"poses.txt:1: 3 numbers, want 13"):
        open_source(root)
    (root / "calibration" / "perspective.txt").unlink()
    with pytest.raises(UsageError, match=r"perspective.txt: no such file"):
        open_source(root)
