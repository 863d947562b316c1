# SPDX-License-Identifier: Apache-2.0
"""The KITTI-360 layout: data_3d_raw, data_2d_raw, data_poses and calibration below one root.

Y. Liao, J. Xie, A. Geiger, "KITTI-360: A Novel Dataset and Benchmarks for Urban Scene Understanding in 2D and 3D",
TPAMI 2022; https://www.cvlibs.net/datasets/kitti-360/documentation.php
"""

from __future__ import annotations

from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dpm2_core.data.messages import scale_intensity
from dpm2_core.data.scan_file import chosen, image_of, image_size, images_of, numbered_scans, read_scan
from dpm2_core.data.settings import InputSettings
from dpm2_core.data.text import parse_row, read_lines, read_numbers
from dpm2_core.data.vertical_angle import correct_vertical_angle
from dpm2_core.errors import UsageError
from dpm2_core.frame import Array, Camera, Frame, Points
from dpm2_core.geometry import se3

_PERIOD = 0.1  # s, a turn of the LiDAR


class SweptDrive:
    """Scans of KITTI's LiDAR as measured: each point has a time offset by its azimuth, see `azimuth_time`.

    What KITTI-360 and KITTI raw have in common. Those who derive from it set the camera.
    """

    def __init__(self, scans: Path, images: Path, settings: InputSettings, correction_deg: float) -> None:
        """`correction_deg` is added to the elevation of the points where the settings say nothing else.

        Raises:
            UsageError: there are no scans.
        """
        self._settings, self._images, self._correction_deg = settings, images, correction_deg
        self.notes: list[str] = []
        self.camera: Camera | None = None
        self._scans = numbered_scans(scans / "data")
        if not self._scans:
            raise UsageError(f"{scans}: no scans (data/NNNNNNNNNN.bin) in this folder: want a drive that is `_sync`")
        self.numbers = np.array([int(scan.stem) for scan in self._scans])
        self.stamps = self._stamps(scans / "timestamps.txt")

    def __len__(self) -> int:
        return len(self._scans)

    def frames(self, start: int = 0, stop: int | None = None) -> Iterator[Frame]:
        """Frames start..stop-1 by position; `Frame.index` is the number in the file name."""
        degrees = self._settings.angle_correction(self._correction_deg)
        for scan, stamp in list(zip(self._scans, self.stamps, strict=True))[start:stop]:
            points, problem = read_scan(scan)
            points = correct_vertical_angle(scale_intensity(points, self._settings.intensity_max), degrees)
            images = images_of(image_of(scan, self._images), self.camera, self.notes)
            yield Frame(int(stamp), points, azimuth_time(points), images, index=int(scan.stem), problem=problem)

    def _stamps(self, path: Path) -> NDArray[np.int64]:
        """(len,) ns; line k of timestamps.txt is of scan k."""
        lines = read_lines(path)
        if len(lines) <= self.numbers[-1]:
            return self._settings.steady_stamps(self.numbers, f"{path}: missing or too short", self.notes)
        return np.array([_stamp(lines[number], f"{path}:{number + 1}") for number in self.numbers], np.int64)

    def _image_size(self) -> tuple[int, int] | None:
        """None without images, or where none are wanted."""
        if not self._settings.images:
            return None
        return image_size(path for scan in self._scans if (path := image_of(scan, self._images)))


class Kitti360Source(SweptDrive):
    """One drive, by the root and `input.sequence` (such as 0009), or by its folder in data_3d_raw.

    Poses were published for a part of the frames only, those where the car had moved; the others are NaN. They are of
    the moment when the LiDAR faces forward. Scans are as measured: each point has a time offset by its azimuth, see
    `azimuth_time`. Images are those of the rectified left camera, image_00.

    Raises:
        UsageError: no scans or no calibration, or a text file is damaged; the message names file and line.
    """

    def __init__(self, path: Path | str, settings: InputSettings | None = None) -> None:
        settings = settings or InputSettings()
        self.root, self.drive = _find(Path(path), settings.sequence)
        self.name, self.truth = self.drive, ""
        scans = self.root / "data_3d_raw" / self.drive / "velodyne_points"
        super().__init__(scans, self.root / "data_2d_raw" / self.drive / "image_00" / "data_rect", settings, 0.0)
        calibration = self.root / "calibration"
        T_lidar_cam = se3.from_rows(_only_row(calibration / "calib_cam_to_velo.txt"))
        self._intrinsics = read_keyed(calibration / "perspective.txt")
        R_rect = required(self._intrinsics, "R_rect_00", 9, calibration / "perspective.txt")
        self._T_rect_cam = se3.orthonormalized(se3.make(R_rect.reshape(3, 3), np.zeros(3)))
        self._T_cam_lidar = se3.inverse(T_lidar_cam)
        self.T_cam_lidar: Array | None = self._T_rect_cam @ self._T_cam_lidar
        self.poses: Array | None = self._poses()
        self.camera = self._camera()

    def _poses(self) -> Array | None:
        """(len, 4, 4) T_world_lidar, from poses.txt (of the IMU) or else cam0_to_world.txt; None without either."""
        folder = self.root / "data_poses" / self.drive
        of_imu, of_camera = folder / "poses.txt", folder / "cam0_to_world.txt"
        if of_imu.is_file():
            file, rows = of_imu, read_numbers(of_imu, 13)
            mounting = self.root / "calibration" / "calib_cam_to_pose.txt"
            row = read_keyed(mounting).get("image_00")
            if row is None:
                raise UsageError(f"{mounting}: no image_00, which {of_imu} needs")
            T_sensor_lidar = se3.from_rows(row) @ self._T_cam_lidar
        elif of_camera.is_file():
            file, rows = of_camera, read_numbers(of_camera, 17)
            T_sensor_lidar = self._T_rect_cam @ self._T_cam_lidar
        else:
            return None
        self.truth = "/".join(file.parts[-3:])
        poses = np.full((len(self), 4, 4), np.nan)
        at = {int(number): k for k, number in enumerate(self.numbers)}
        for row in rows:
            if (k := at.get(int(row[0]))) is not None:
                poses[k] = se3.from_rows(row[1:13]) @ T_sensor_lidar
        known = int(np.isfinite(poses[:, 0, 0]).sum())
        if known < len(self):
            self.notes.append(f"{file}: {len(self) - known} of {len(self)} frames have no pose")
        return poses

    def _camera(self) -> Camera | None:
        size = self._image_size()
        if size is None:
            return None
        P = required(self._intrinsics, "P_rect_00", 12, self.root / "calibration" / "perspective.txt")
        assert self.T_cam_lidar is not None
        return Camera(P.reshape(3, 4)[:, :3], se3.inverse(self.T_cam_lidar), size, name="image_00")


def azimuth_time(points: Points) -> Points:
    """(N,) s from facing forward, -0.05..0.05, of points (N, 4) of a LiDAR that turns clockwise, seen from above.

    What is on the left was measured before what is on the right: so it is in the data set's devkit (kitti360Scripts,
    `curl_velodyne_data` moves a point on the left by a part of the way back to the previous pose) and in KISS-ICP's
    reader of KITTI raw. In real scans of KITTI odometry, the same sensor, the rings have been moved that way by what
    KITTI untwisted, and the world agrees best from scan to scan with it. Other converters call the rotation
    counter-clockwise. No scan of KITTI-360 itself was at hand.
    """
    return (-np.arctan2(points[:, 1], points[:, 0]) * (_PERIOD / (2 * np.pi))).astype(np.float32)


def read_keyed(path: Path) -> dict[str, Array]:
    """The `name: numbers` lines of a calibration file, as float64 of any length; other lines are left out.

    Raises:
        UsageError: there is no such file.
    """
    found: dict[str, Array] = {}
    if not path.is_file():
        raise UsageError(f"{path}: no such file, and the calibration is needed")
    for number, line in enumerate(read_lines(path), 1):
        name, colon, text = line.partition(":")
        words = text.split()
        try:
            values = [float(word) for word in words]
        except ValueError:
            continue  # dates
        if colon and values:
            found[name.strip()] = parse_row(text, len(words), f"{path}:{number}: {name}")
    return found


def required(rows: dict[str, Array], name: str, count: int, path: Path) -> Array:
    """(count,) numbers of a name in a file that `read_keyed` has read.

    Raises:
        UsageError: they are missing.
    """
    row = rows.get(name)
    if row is None or len(row) != count:
        raise UsageError(f"{path}: no {name} of {count} numbers")
    return row


def _only_row(path: Path) -> Array:
    rows = read_numbers(path, 12)
    if len(rows) != 1:
        raise UsageError(f"{path}: want one line of 12 numbers, found {len(rows)}")
    return rows[0]


def _stamp(line: str, where: str) -> int:
    """`2013-05-28 08:46:02.904300000` in ns since 1970; a float would lose the last digits."""
    date, dot, fraction = line.strip().partition(".")
    try:
        seconds = int(datetime.strptime(date, "%Y-%m-%d %H:%M:%S").replace(tzinfo=UTC).timestamp())
        return seconds * 10**9 + (int(fraction[:9].ljust(9, "0")) if dot else 0)
    except ValueError:
        raise UsageError(f"{where}: {line.strip()!r} is no time") from None


def _find(path: Path, sequence: str) -> tuple[Path, str]:
    """Root of the dataset and name of the drive."""
    if (path / "velodyne_points").is_dir():
        drive = path.absolute()
        return drive.parents[1], drive.name
    found = sorted(p.name for p in (path / "data_3d_raw").glob("*") if (p / "velodyne_points").is_dir())
    if not found:
        raise UsageError(f"{path}: no drive (data_3d_raw/*/velodyne_points) below it")
    return path, chosen_drive(path, sequence, found)


def chosen_drive(path: Path, sequence: str, found: list[str]) -> str:
    """Of the drives below a folder the one that is meant, also by its four digits (0009).

    Raises:
        UsageError: none or several.
    """
    matching = [name for name in found if sequence in ("", name, name.removesuffix("_sync")[-4:])]
    return chosen(path, sequence, found, matching)
