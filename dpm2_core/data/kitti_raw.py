# SPDX-License-Identifier: Apache-2.0
"""The KITTI raw layout: DATE/calib_*.txt and DATE/DATE_drive_NNNN_sync/{velodyne_points,image_02,oxts}.

A. Geiger, P. Lenz, C. Stiller, R. Urtasun, "Vision meets Robotics: The KITTI Dataset", IJRR 2013, and the data set's
readme.txt and dataformat.txt.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from dpm2_core.data.kitti360 import azimuth_time, read_keyed, read_stamps
from dpm2_core.data.messages import scale_intensity
from dpm2_core.data.scan_file import chosen, image_path, image_size, images_of, read_scan
from dpm2_core.data.settings import InputSettings
from dpm2_core.data.text import read_numbers
from dpm2_core.data.vertical_angle import HDL64_CORRECTION_DEG, correct_vertical_angle
from dpm2_core.errors import UsageError
from dpm2_core.frame import Array, Camera, Frame
from dpm2_core.geometry import se3

_EARTH = 6378137.0  # m, the radius of the data set's projection
_CALIBRATION = "calib_velo_to_cam.txt"
_OXTS = 30  # numbers in a file of oxts


class KittiRawSource:
    """A synchronized and rectified drive, by its folder, or by the folder of its date and `input.sequence` (0009).

    Scans are as measured: each point has a time offset by its azimuth (`azimuth_time`), and the stamp is when the
    LiDAR faced forward. Numbers may be missing. Images are those of the left color camera, image_02; ground truth is
    what the car's OXTS measured.

    Raises:
        UsageError: no scans or no calibration, or a text file is damaged; the message names file and line.
    """

    def __init__(self, path: Path | str, settings: InputSettings | None = None) -> None:
        self._settings = settings or InputSettings()
        self.path = _find(Path(path), self._settings.sequence)
        self.name, self.notes, self.truth = self.path.absolute().name, list[str](), ""
        velodyne = self.path / "velodyne_points"
        self._scans = [scan for scan in sorted((velodyne / "data").glob("*.bin")) if scan.stem.isdecimal()]
        if not self._scans:
            raise UsageError(f"{velodyne}: no scans (data/NNNNNNNNNN.bin) in this folder: want a drive that is `_sync`")
        numbers = np.array([int(scan.stem) for scan in self._scans])
        self.stamps = read_stamps(velodyne / "timestamps.txt", numbers, self.notes)
        self.T_cam_lidar: Array | None = None
        self.camera: Camera | None = None
        self.poses: Array | None = None
        folders = (self.path.absolute().parent, self.path.resolve().parent)  # a drive may be a link to another disk
        date = next((folder for folder in folders if (folder / _CALIBRATION).is_file()), None)
        if date is None:
            self.notes.append(f"{folders[0] / _CALIBRATION}: no such file; without calibration the points alone count")
            return
        self._cameras = date / "calib_cam_to_cam.txt"
        self._intrinsics = read_keyed(self._cameras)
        R_rect = se3.make(self._numbers("R_rect_00", 9).reshape(3, 3), np.zeros(3))
        self.T_cam_lidar = se3.orthonormalized(R_rect) @ _rigid(date / _CALIBRATION)
        self.camera = self._camera(self.T_cam_lidar)
        self.poses = self._poses(date / "calib_imu_to_velo.txt")

    def __len__(self) -> int:
        return len(self._scans)

    def frames(self, start: int = 0, stop: int | None = None) -> Iterator[Frame]:
        """Frames start..stop-1 by position; `Frame.index` is the number in the file name."""
        degrees = self._settings.angle_correction(HDL64_CORRECTION_DEG)
        for scan, stamp in list(zip(self._scans, self.stamps, strict=True))[start:stop]:
            points, problem = read_scan(scan)
            points = correct_vertical_angle(scale_intensity(points, self._settings.intensity_max), degrees)
            images = images_of(self._image_path(scan.stem), self.camera, self.notes)
            yield Frame(int(stamp), points, azimuth_time(points), images, index=int(scan.stem), problem=problem)

    def _numbers(self, name: str, count: int) -> Array:
        row = self._intrinsics.get(name)
        if row is None or len(row) != count:
            raise UsageError(f"{self._cameras}: no {name} of {count} numbers")
        return row

    def _camera(self, T_cam_lidar: Array) -> Camera | None:
        paths = (path for scan in self._scans if (path := self._image_path(scan.stem)))
        size = image_size(paths) if self._settings.images else None
        if size is None:
            return None
        P = self._numbers("P_rect_02", 12).reshape(3, 4)
        # P_rect_02 = K [I | t] with t from the left gray camera 0, which T_cam_lidar refers to.
        T_cam2_cam0 = se3.make(np.eye(3), np.linalg.solve(P[:, :3], P[:, 3]))
        return Camera(P[:, :3], se3.inverse(T_cam2_cam0 @ T_cam_lidar), size, name="camera_color_left")

    def _image_path(self, stem: str) -> Path | None:
        return image_path(self.path / "image_02" / "data", stem)

    def _poses(self, mounting: Path) -> Array | None:
        """(len, 4, 4) T_world_lidar, x to the east and z up, from the first scan's place; None without oxts."""
        folder = self.path / "oxts" / "data"
        rows = [read_numbers(folder / f"{scan.stem}.txt", _OXTS)[:1] for scan in self._scans]
        known = np.array([len(row) == 1 for row in rows])
        if not known.any():
            return None
        self.truth = f"{self.name}/oxts"
        if not known.all():
            self.notes.append(f"{folder}: {(~known).sum()} of {len(self)} frames have no pose")
        poses = np.full((len(self), 4, 4), np.nan)
        poses[known] = _poses_of(np.concatenate(rows)) @ se3.inverse(_rigid(mounting))
        return poses


def _poses_of(oxts: Array) -> Array:
    """(N, 4, 4) T_world_imu of (N, 30) rows of oxts: a Mercator projection that is true to scale at the first."""
    latitude, longitude = np.radians(oxts[:, 0]), np.radians(oxts[:, 1])
    scale = np.cos(latitude[0]) * _EARTH
    poses = np.tile(np.eye(4), (len(oxts), 1, 1))
    poses[:, :3, :3] = Rotation.from_euler("xyz", oxts[:, 3:6]).as_matrix()  # roll, then pitch, then yaw
    poses[:, :3, 3] = np.c_[scale * longitude, scale * np.log(np.tan(np.pi / 4 + latitude / 2)), oxts[:, 2]]
    poses[:, :3, 3] -= poses[0, :3, 3].copy()
    return poses


def _rigid(path: Path) -> Array:
    """(4, 4) of a file with the lines R and T.

    Raises:
        UsageError: there is no such file, or it holds something else.
    """
    rows = read_keyed(path)
    R, t = rows.get("R"), rows.get("T")
    if R is None or t is None or len(R) != 9 or len(t) != 3:
        raise UsageError(f"{path}: want R of 9 and T of 3 numbers")
    T = se3.make(R.reshape(3, 3), t)
    if np.abs(T[:3, :3] @ T[:3, :3].T - np.eye(3)).max() > 0.01 or np.linalg.det(T[:3, :3]) < 0:
        raise UsageError(f"{path}: R is no rotation")
    return se3.orthonormalized(T)


def _find(path: Path, sequence: str) -> Path:
    if (path / "velodyne_points").is_dir():
        return path
    found = sorted(folder.parent.name for folder in path.glob("*_drive_*/velodyne_points"))
    matching = [name for name in found if sequence in ("", name, name.removesuffix("_sync")[-4:])]
    return path / chosen(path, sequence, found, matching)
