# SPDX-License-Identifier: Apache-2.0
"""KITTI raw from a small tree in its own layout: a missing scan, oxts, the calibration in the folder of the date."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from dpm2_core.data.kitti_raw import KittiRawSource
from dpm2_core.data.open import open_source, sequences_below
from dpm2_core.data.settings import InputSettings
from dpm2_core.data.vertical_angle import HDL64_CORRECTION_DEG, correct_vertical_angle
from dpm2_core.errors import UsageError
from dpm2_core.geometry import se3

DRIVE = "2011_09_26_drive_0009_sync"
NUMBERS = (0, 1, 3)
T_CAM_LIDAR = se3.make([[0, -1, 0], [0, 0, -1], [1, 0, 0]], [0.01, -0.07, -0.27])
T_LIDAR_IMU = se3.exp([0.001, -0.002, 0.015, -0.81, 0.32, -0.8])
R_RECT = se3.exp([0.01, -0.007, 0.003, 0, 0, 0])[:3, :3]


def text(*numbers: object) -> str:
    return " ".join(f"{x:.9e}" for part in numbers for x in np.ravel(part))


@pytest.fixture
def date(tmp_path: Path) -> Path:
    """A drive to the north at 49 degrees of latitude, 2 m per frame, and climbing. Its yaw is about 90 degrees."""
    date = tmp_path / "2011_09_26"
    drive = date / DRIVE
    for folder in ("velodyne_points/data", "image_02/data", "oxts/data"):
        (drive / folder).mkdir(parents=True)
    (date / "calib_velo_to_cam.txt").write_text(
        f"calib_time: 15-Mar-2012 11:37:16\nR: {text(T_CAM_LIDAR[:3, :3])}\nT: {text(T_CAM_LIDAR[:3, 3])}\n"
    )
    (date / "calib_imu_to_velo.txt").write_text(f"R: {text(T_LIDAR_IMU[:3, :3])}\nT: {text(T_LIDAR_IMU[:3, 3])}\n")
    (date / "calib_cam_to_cam.txt").write_text(
        f"corner_dist: 9.950000e-02\nR_rect_00: {text(R_RECT)}\nP_rect_02: 50 0 20 3 0 50 15 0.5 0 0 1 0.004\n"
    )
    rng = np.random.default_rng(0)
    for n in NUMBERS:
        rng.uniform(1, 9, (60, 4)).astype("<f4").tofile(drive / f"velodyne_points/data/{n:010d}.bin")
        cv2.imwrite(str(drive / f"image_02/data/{n:010d}.png"), np.full((30, 40, 3), 10 * n, np.uint8))
        latitude = 49 + np.degrees(2.0 * n / 6378137)
        row = [latitude, 8.4, 110 + 0.1 * n, 0.02, -0.05, np.pi / 2 + 0.01 * n, *[0] * 24]
        (drive / f"oxts/data/{n:010d}.txt").write_text(" ".join(repr(float(x)) for x in row) + "\n")
    times = "".join(f"2011-09-26 13:02:25.{n}51199337\n" for n in range(1, 5))
    (drive / "velodyne_points/timestamps.txt").write_text(times)
    return date


def test_frames(date: Path) -> None:
    """Frames by number, also after a missing one. Points are as measured, except for the known error of the sensor's
    angles."""
    source = open_source(date / DRIVE)
    assert isinstance(source, KittiRawSource)
    assert (len(source), source.name, source.notes) == (3, DRIVE, [])
    frames = list(source.frames(1))
    assert [frame.index for frame in frames] == [1, 3]
    assert frames[1].stamp - frames[0].stamp == 2 * 10**8
    assert frames[0].stamp % 10**9 == 251199337
    raw = np.fromfile(date / DRIVE / "velodyne_points/data/0000000001.bin", "<f4").reshape(-1, 4)
    points = frames[0].points
    np.testing.assert_allclose(points[:, 3], raw[:, 3] / 255)  # intensities above 1 mean a range of 0..255
    np.testing.assert_allclose(points[:, :3], correct_vertical_angle(raw, HDL64_CORRECTION_DEG)[:, :3])
    left, right = points[:, 1] > 0, points[:, 1] < 0
    assert (frames[0].time_offset[left] < 0).all()  # it rotates clockwise, and faces forward at the stamp
    assert (frames[0].time_offset[right] > 0).all()


def test_the_left_color_camera(date: Path) -> None:
    """A point in front of it projects to where P_rect_02 R_rect_00 T_cam_lidar puts it."""
    (image,) = next(open_source(date / DRIVE).frames(2)).images
    assert (image.pixels == 30).all()
    P = np.array([[50, 0, 20, 3], [0, 50, 15, 0.5], [0, 0, 1, 0.004]])
    point = np.array([12.0, 1, 0.5, 1])
    wanted = P @ se3.make(R_RECT, np.zeros(3)) @ T_CAM_LIDAR @ point
    in_camera = se3.inverse(image.camera.T_lidar_cam) @ point
    found = image.camera.K @ in_camera[:3]
    np.testing.assert_allclose(found[:2] / found[2], wanted[:2] / wanted[2], atol=1e-5)
    assert next(open_source(date / DRIVE, InputSettings(images=False)).frames()).images == ()


def test_truth_is_what_the_oxts_measured(date: Path) -> None:
    source = open_source(date / DRIVE)
    T_world_imu = source.poses @ T_LIDAR_IMU
    np.testing.assert_allclose(T_world_imu[:, :3, 3], [[0, 2 * n, 0.1 * n] for n in NUMBERS], atol=1e-4)
    forward, left = T_world_imu[0, :3, 0], T_world_imu[0, :3, 1]
    np.testing.assert_allclose(forward, [0, np.cos(0.05), np.sin(0.05)], atol=1e-6)  # to the north, its front up
    assert left[2] == pytest.approx(np.sin(0.02) * np.cos(0.05), abs=1e-6)  # its left side is up
    (date / DRIVE / "oxts/data/0000000001.txt").unlink()
    source = open_source(date / DRIVE)
    assert np.isnan(source.poses[:, 0, 0]).tolist() == [False, True, False]
    assert source.notes == [f"{date / DRIVE / 'oxts/data'}: 1 of 3 frames have no pose"]


def test_a_drive_is_named_in_the_folder_of_its_date(date: Path) -> None:
    assert open_source(date).name == DRIVE
    (date / DRIVE.replace("0009", "0001") / "velodyne_points" / "data").mkdir(parents=True)
    with pytest.raises(UsageError, match=r"several sequences; choose one with input.sequence: .*0001_sync, .*0009"):
        open_source(date)
    assert open_source(date, InputSettings(sequence="0009")).name == DRIVE
    assert len(sequences_below(date)) == 2


@pytest.mark.parametrize(
    ("file", "content", "said"),
    [
        ("calib_imu_to_velo.txt", None, "calib_imu_to_velo.txt: no such file"),
        ("calib_velo_to_cam.txt", "R: 1 0 0", "calib_velo_to_cam.txt: want R of 9 and T of 3 numbers"),
        ("calib_velo_to_cam.txt", "R: 1 0 0 0 1 0 0 0 2\nT: 0 0 0", "calib_velo_to_cam.txt: R is no rotation"),
        ("calib_cam_to_cam.txt", "R_rect_00: 1", "calib_cam_to_cam.txt: no R_rect_00 of 9 numbers"),
        (f"{DRIVE}/oxts/data/0000000001.txt", "1 2 3", "0000000001.txt:1: 3 numbers, want 30"),
    ],
)
def test_what_cannot_be_read_is_named(date: Path, file: str, content: str | None, said: str) -> None:
    (date / file).unlink()
    if content is not None:
        (date / file).write_text(content)
    with pytest.raises(UsageError, match=said):
        open_source(date / DRIVE)


def test_a_drive_without_scans_is_said_to_be_none(date: Path) -> None:
    for scan in (date / DRIVE / "velodyne_points/data").iterdir():
        scan.rename(scan.with_suffix(".txt"))  # as in an unsynchronized drive
    with pytest.raises(UsageError, match=r"no scans .*want a drive that is `_sync`"):
        open_source(date / DRIVE)


def test_without_calibration_the_points_count(date: Path) -> None:
    (date / "calib_velo_to_cam.txt").unlink()
    source = open_source(date / DRIVE)
    assert "calib_velo_to_cam.txt: no such file; without calibration only the points are used" in source.notes[0]
    assert (source.poses, next(source.frames()).images) == (None, ())


def test_a_drive_on_another_disk_with_smaller_images(date: Path, tmp_path: Path) -> None:
    """A link next to the calibration, and JPEG images as in many copies."""
    (tmp_path / "disk").mkdir()
    (date / DRIVE).rename(tmp_path / "disk" / "drive")
    (date / DRIVE).symlink_to(tmp_path / "disk" / "drive")
    for image in (date / DRIVE / "image_02/data").iterdir():
        cv2.imwrite(str(image.with_suffix(".jpg")), cv2.imread(str(image)))
        image.unlink()
    source = open_source(date / DRIVE)
    assert (source.name, source.notes) == (DRIVE, [])
    assert all(len(frame.images) == 1 for frame in source.frames())
    assert source.poses is not None
