# SPDX-License-Identifier: Apache-2.0
"""The KITTI-360 layout: data_3d_raw, data_2d_raw, data_poses and calibration below one root.

Y. Liao, J. Xie, A. Geiger, "KITTI-360: A Novel Dataset and Benchmarks for Urban Scene Understanding in 2D and 3D",
TPAMI 2022; https://www.cvlibs.net/datasets/kitti-360/documentation.php
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from dpm2_core.data.scan_file import KITTI_360, chosen
from dpm2_core.data.settings import InputSettings
from dpm2_core.data.text import read_keyed, read_numbers, required
from dpm2_core.data.velodyne import VelodyneDrive
from dpm2_core.errors import UsageError
from dpm2_core.frame import Array, Camera
from dpm2_core.geometry import se3


class Kitti360Source(VelodyneDrive):
    """One drive, by the root and `input.sequence` (such as 0009), or by its folder in data_3d_raw.

    Poses are published only for frames in which the car had moved; the others are NaN. A pose is of the time when the
    LiDAR faces forward. Scans are not de-skewed: each point has a time offset from its azimuth, see `azimuth_time`.
    Images are from the rectified left camera, image_00.

    Raises:
        UsageError: no scans or no calibration, or a text file is damaged; the message names file and line.
    """

    def __init__(self, path: Path | str, settings: InputSettings | None = None) -> None:
        settings = settings or InputSettings()
        self.root, self.drive = _find_drive(Path(path), settings.sequence)
        scans = self.root / "data_3d_raw" / self.drive / "velodyne_points"
        images = self.root / "data_2d_raw" / self.drive / "image_00" / "data_rect"
        super().__init__(self.drive, scans / "data", images, settings)
        self.vertical_angle_correction_deg = settings.angle_correction(0.0)
        self.stamps = self._read_stamps(scans / "timestamps.txt")
        calibration = self.root / "calibration"
        T_lidar_cam = se3.from_rows(_only_row(calibration / "calib_cam_to_velo.txt"))
        self._intrinsics = read_keyed(calibration / "perspective.txt")
        R_rect = required(self._intrinsics, "R_rect_00", 9, calibration / "perspective.txt")
        self._T_rect_cam = se3.orthonormalized(se3.make(R_rect.reshape(3, 3), np.zeros(3)))
        self._T_cam_lidar = se3.inverse(T_lidar_cam)
        self.T_cam_lidar = self._T_rect_cam @ self._T_cam_lidar
        self.poses = self._poses()
        self.camera = self._camera()

    def _poses(self) -> Array | None:
        """(len, 4, 4) T_world_lidar, from poses.txt (of the IMU), else cam0_to_world.txt; None without either."""
        folder = self.root / "data_poses" / self.drive
        imu_poses, camera_poses = folder / "poses.txt", folder / "cam0_to_world.txt"
        if imu_poses.is_file():
            file, rows = imu_poses, read_numbers(imu_poses, 13)
            mounting = self.root / "calibration" / "calib_cam_to_pose.txt"
            row = read_keyed(mounting).get("image_00")
            if row is None:
                raise UsageError(f"{mounting}: no image_00, which {imu_poses} needs")
            T_sensor_lidar = se3.from_rows(row) @ self._T_cam_lidar
        elif camera_poses.is_file():
            file, rows = camera_poses, read_numbers(camera_poses, 17)
            T_sensor_lidar = self._T_rect_cam @ self._T_cam_lidar
        else:
            return None
        self.truth = "/".join(file.parts[-3:])
        poses = np.full((len(self), 4, 4), np.nan)
        position_of = {int(number): k for k, number in enumerate(self.numbers)}
        for row in rows:
            if (k := position_of.get(int(row[0]))) is not None:
                poses[k] = se3.from_rows(row[1:13]) @ T_sensor_lidar
        self._note_unposed(file, np.isfinite(poses[:, 0, 0]))
        return poses

    def _camera(self) -> Camera | None:
        size = self._image_size()
        if size is None:
            return None
        P = required(self._intrinsics, "P_rect_00", 12, self.root / "calibration" / "perspective.txt")
        assert self.T_cam_lidar is not None
        return Camera(P.reshape(3, 4)[:, :3], se3.inverse(self.T_cam_lidar), size, name="image_00")


def _only_row(path: Path) -> Array:
    rows = read_numbers(path, 12)
    if len(rows) != 1:
        raise UsageError(f"{path}: want one line of 12 numbers, found {len(rows)}")
    return rows[0]


def _find_drive(path: Path, sequence: str) -> tuple[Path, str]:
    """Root of the dataset and name of the drive."""
    if (path / "velodyne_points").is_dir():
        drive = path.absolute()
        return drive.parents[1], drive.name
    return path, chosen(path, sequence, KITTI_360)
