# SPDX-License-Identifier: Apache-2.0
"""Small folders in the layouts of published data sets, made from a simulated drive."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from dpm2_core.data.kitti import KittiSource, read_calib
from dpm2_core.frame import R_AHEAD
from dpm2_core.geometry import se3

from .drives import first_scans

DRIVE_360 = "2013_05_28_drive_{}_sync"


def kitti_odometry(recording: Path, root: Path, names: tuple[str, ...], count: int, images: bool = False) -> Path:
    """KITTI odometry: the first scans of a simulated recording under each of these names; images are noise."""
    one = first_scans(recording, count, root / "one")
    (root / "sequences").mkdir()
    (root / "poses").mkdir()
    noise = np.random.default_rng(0)
    for name in names:
        folder = root / "sequences" / name
        folder.mkdir()
        for path in (one / "sequences" / "00").iterdir():
            if path.name != "poses.txt":
                (folder / path.name).symlink_to(path)
        (root / "poses" / f"{name}.txt").write_text((one / "poses" / "00.txt").read_text())
        if images:
            (folder / "image_2").mkdir()
            K = read_calib(folder / "calib.txt")["P2"]
            size = round(2 * K[0, 2] + 1), round(2 * K[1, 2] + 1)  # the principal point is in the middle
            for number in range(count):
                pixels = cv2.resize(noise.integers(0, 255, (47, 155, 3), np.uint8), size)
                cv2.imwrite(str(folder / "image_2" / f"{number:06d}.png"), pixels)
    return root


def kitti_360(recording: Path, root: Path, names: tuple[str, ...], count: int) -> Path:
    """KITTI-360 without images: drives with these numbers. The first frame has no pose, as in the original."""
    source = KittiSource(recording)
    assert source.poses is not None
    T_lidar_cam = se3.make(R_AHEAD, [0.8, 0.3, -0.2])
    calibration = root / "calibration"
    calibration.mkdir(parents=True)
    (calibration / "calib_cam_to_velo.txt").write_text(_text(T_lidar_cam[:3]))
    (calibration / "calib_cam_to_pose.txt").write_text(f"image_00: {_text(T_lidar_cam[:3])}\n")
    (calibration / "perspective.txt").write_text(
        f"R_rect_00: {_text(np.eye(3))}\nP_rect_00: 50 0 20 0 0 50 15 0 0 0 1 0\n"
    )
    for name in names:
        velodyne = root / "data_3d_raw" / DRIVE_360.format(name) / "velodyne_points"
        poses = root / "data_poses" / DRIVE_360.format(name)
        (velodyne / "data").mkdir(parents=True)
        poses.mkdir(parents=True)
        stamps = "".join(f"2013-05-28 08:46:{k // 10:02d}.{k % 10}00000000\n" for k in range(count))
        (velodyne / "timestamps.txt").write_text(stamps)
        for k, frame in enumerate(source.frames(0, count)):
            frame.points.astype("<f4").tofile(velodyne / "data" / f"{k:010d}.bin")
        rows = (f"{k} {_text(source.poses[k][:3])}\n" for k in range(1, count))
        (poses / "poses.txt").write_text("".join(rows))
    return root


def _text(numbers: np.ndarray) -> str:
    return " ".join(f"{x:.9g}" for x in np.ravel(numbers))
