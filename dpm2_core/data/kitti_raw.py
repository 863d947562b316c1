# SPDX-License-Identifier: Apache-2.0
"""The KITTI raw layout: DATE/calib_*.txt and DATE/DATE_drive_NNNN_sync/{velodyne_points,image_02,oxts}.

A. Geiger, P. Lenz, C. Stiller, R. Urtasun, "Vision meets Robotics: The KITTI Dataset", IJRR 2013, and the data set's
readme.txt and dataformat.txt.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from dpm2_core.data.kitti import left_color_camera
from dpm2_core.data.scan_file import KITTI_RAW, chosen
from dpm2_core.data.settings import InputSettings
from dpm2_core.data.source import ROUNDED
from dpm2_core.data.text import read_keyed, read_numbers, required
from dpm2_core.data.velodyne import VelodyneDrive
from dpm2_core.errors import UsageError
from dpm2_core.frame import Array
from dpm2_core.geometry import se3

_EARTH_RADIUS = 6378137.0  # m, the radius of the data set's projection
_EXTRINSICS = "calib_velo_to_cam.txt"
_OXTS_COLUMNS = 30  # numbers in a file of oxts


class KittiRawSource(VelodyneDrive):
    """A synchronized and rectified drive, by its folder, or by the folder of its date and `input.sequence` (0009).

    The stamp is the time when the LiDAR faced forward. Scan numbers may be missing. Images are from the left color
    camera, image_02; ground truth is measured by the car's OXTS.

    Raises:
        UsageError: no scans, or a text file is missing or damaged; the message names file and line.
    """

    def __init__(self, path: Path | str, settings: InputSettings | None = None) -> None:
        settings = settings or InputSettings()
        self.path = _drive_folder(Path(path), settings.sequence)
        scans = self.path / "velodyne_points"
        super().__init__(self.path.absolute().name, scans / "data", self.path / "image_02" / "data", settings)
        self.vertical_angle_correction_deg = self._correction()
        self.stamps = self._read_stamps(scans / "timestamps.txt")
        folders = (self.path.absolute().parent, self.path.resolve().parent)  # a drive may be a link to another disk
        date_folder = next((folder for folder in folders if (folder / _EXTRINSICS).is_file()), None)
        if date_folder is None:
            self.notes.append(f"{folders[0] / _EXTRINSICS}: no such file; without calibration only the points are used")
            return
        camera_file = date_folder / "calib_cam_to_cam.txt"
        intrinsics = read_keyed(camera_file)
        R_rect = se3.make(required(intrinsics, "R_rect_00", 9, camera_file).reshape(3, 3), np.zeros(3))
        self.T_cam_lidar = se3.orthonormalized(R_rect) @ _read_rigid(date_folder / _EXTRINSICS)
        if size := self._image_size():
            P2 = required(intrinsics, "P_rect_02", 12, camera_file).reshape(3, 4)
            self.camera = left_color_camera(P2, self.T_cam_lidar, size)
        self.poses = self._poses(date_folder / "calib_imu_to_velo.txt")

    def _poses(self, mounting: Path) -> Array | None:
        """(len, 4, 4) T_world_lidar, x to the east, z up, origin at the first scan; None without oxts."""
        folder = self.path / "oxts" / "data"
        rows = [read_numbers(folder / f"{scan.stem}.txt", _OXTS_COLUMNS)[:1] for scan in self._scans]
        known = np.array([len(row) == 1 for row in rows])
        if not known.any():
            return None
        self.truth = f"{self.name}/oxts"
        self._note_unposed(folder, known)
        poses = np.full((len(self), 4, 4), np.nan)
        poses[known] = _mercator_poses(np.concatenate(rows)) @ se3.inverse(_read_rigid(mounting))
        return poses


def _mercator_poses(oxts: Array) -> Array:
    """(N, 4, 4) T_world_imu from (N, 30) rows of oxts: a Mercator projection with true scale at the first row."""
    latitude, longitude = np.radians(oxts[:, 0]), np.radians(oxts[:, 1])
    scale = np.cos(latitude[0]) * _EARTH_RADIUS
    poses = np.tile(np.eye(4), (len(oxts), 1, 1))
    poses[:, :3, :3] = Rotation.from_euler("xyz", oxts[:, 3:6]).as_matrix()  # roll, then pitch, then yaw
    poses[:, :3, 3] = np.c_[scale * longitude, scale * np.log(np.tan(np.pi / 4 + latitude / 2)), oxts[:, 2]]
    poses[:, :3, 3] -= poses[0, :3, 3].copy()
    return poses


def _read_rigid(path: Path) -> Array:
    """(4, 4) transform from a file with the lines R and T.

    Raises:
        UsageError: there is no such file, or it contains something else.
    """
    rows = read_keyed(path)
    R, t = rows.get("R"), rows.get("T")
    if R is None or t is None or len(R) != 9 or len(t) != 3:
        raise UsageError(f"{path}: want R of 9 and T of 3 numbers")
    T = se3.make(R.reshape(3, 3), t)
    if not se3.is_rigid(T, ROUNDED):
        raise UsageError(f"{path}: R is no rotation")
    return se3.orthonormalized(T)


def _drive_folder(path: Path, sequence: str) -> Path:
    if (path / "velodyne_points").is_dir():
        return path
    return path / chosen(path, sequence, KITTI_RAW)
