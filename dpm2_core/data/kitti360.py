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
from dpm2_core.data.scan_file import chosen, image_path, image_size, images_of, read_scan
from dpm2_core.data.settings import InputSettings
from dpm2_core.data.text import parse_row, read_lines, read_numbers
from dpm2_core.data.vertical_angle import correct_vertical_angle
from dpm2_core.errors import UsageError
from dpm2_core.frame import Array, Camera, Frame, Points
from dpm2_core.geometry import se3

_PERIOD = 0.1  # s, a turn of the LiDAR


class Kitti360Source:
    """One drive, by the root and `input.sequence` (such as 0009), or by its folder in data_3d_raw.

    Poses were published for a part of the frames only, those where the car had moved; the others are NaN. They are of
    the moment when the LiDAR faces forward. Scans are as measured: each point has a time offset by its azimuth, see
    `azimuth_time`. Images are those of the rectified left camera, image_00.

    Raises:
        UsageError: no scans or no calibration, or a text file is damaged; the message names file and line.
    """

    def __init__(self, path: Path | str, settings: InputSettings | None = None) -> None:
        self._settings = settings or InputSettings()
        self.root, self.drive = _find(Path(path), self._settings.sequence)
        self.name = self.drive
        self.notes: list[str] = []
        self.truth = ""
        velodyne = self.root / "data_3d_raw" / self.drive / "velodyne_points"
        scans = sorted((velodyne / "data").glob("*.bin"))
        self._scans = [scan for scan in scans if scan.stem.isdecimal()]
        if not self._scans:
            raise UsageError(f"{velodyne}: no scans (data/NNNNNNNNNN.bin) in this folder")
        self.numbers = np.array([int(scan.stem) for scan in self._scans])
        calibration = self.root / "calibration"
        T_lidar_cam = se3.from_rows(_only_row(calibration / "calib_cam_to_velo.txt"))
        self._intrinsics = read_keyed(calibration / "perspective.txt")
        R_rect = self._intrinsics.get("R_rect_00")
        if R_rect is None or len(R_rect) != 9:
            raise UsageError(f"{calibration / 'perspective.txt'}: no R_rect_00 of 9 numbers")
        self._T_rect_cam = se3.orthonormalized(se3.make(R_rect.reshape(3, 3), np.zeros(3)))
        self._T_cam_lidar = se3.inverse(T_lidar_cam)
        self.T_cam_lidar: Array | None = self._T_rect_cam @ self._T_cam_lidar
        self.stamps = read_stamps(velodyne / "timestamps.txt", self.numbers, self.notes)
        self.poses: Array | None = self._poses()
        self.camera = self._camera()

    def __len__(self) -> int:
        return len(self._scans)

    def frames(self, start: int = 0, stop: int | None = None) -> Iterator[Frame]:
        """Frames start..stop-1 by position; `Frame.index` is the number in the file name."""
        degrees = self._settings.angle_correction(0.0)
        for scan, stamp in list(zip(self._scans, self.stamps, strict=True))[start:stop]:
            points, problem = read_scan(scan)
            points = correct_vertical_angle(scale_intensity(points, self._settings.intensity_max), degrees)
            images = images_of(self._image_path(scan.stem), self.camera, self.notes)
            yield Frame(int(stamp), points, azimuth_time(points), images, index=int(scan.stem), problem=problem)

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
        if not self._settings.images:
            return None
        paths = (path for scan in self._scans if (path := self._image_path(scan.stem)))
        size = image_size(paths)
        if size is None:
            return None
        P = self._intrinsics.get("P_rect_00")
        if P is None or len(P) != 12:
            raise UsageError(f"{self.root / 'calibration' / 'perspective.txt'}: no P_rect_00 of 12 numbers")
        assert self.T_cam_lidar is not None
        return Camera(P.reshape(3, 4)[:, :3], se3.inverse(self.T_cam_lidar), size, name="image_00")

    def _image_path(self, stem: str) -> Path | None:
        return image_path(self.root / "data_2d_raw" / self.drive / "image_00" / "data_rect", stem)


def azimuth_time(points: Points) -> Points:
    """(N,) s from facing forward, -0.05..0.05, of points (N, 4) of a LiDAR that turns clockwise, seen from above.

    What is on the left was measured before what is on the right: so it is in the data set's devkit (kitti360Scripts,
    `curl_velodyne_data` moves a point on the left by a part of the way back to the previous pose) and in KISS-ICP's
    reader of KITTI raw. In real scans of KITTI odometry, the same sensor, the rings have been moved that way by what
    KITTI untwisted, and the world agrees best from scan to scan with it. Other converters call the rotation
    counter-clockwise. No scan of KITTI-360 itself was at hand.
    """
    return (-np.arctan2(points[:, 1], points[:, 0]) * (_PERIOD / (2 * np.pi))).astype(np.float32)


def read_stamps(path: Path, numbers: NDArray[np.int64], notes: list[str]) -> NDArray[np.int64]:
    """(len(numbers),) ns: line k of timestamps.txt is of scan k; where it is too short a note says so."""
    lines = read_lines(path)
    if len(lines) <= numbers[-1]:
        notes.append(f"{path}: missing or too short; frames are taken to be {_PERIOD} s apart")
        return np.round(numbers * _PERIOD * 1e9).astype(np.int64)
    return np.array([_stamp(lines[number], f"{path}:{number + 1}") for number in numbers], np.int64)


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
    matching = [name for name in found if sequence in ("", name, name.removesuffix("_sync")[-4:])]
    return path, chosen(path, sequence, found, matching)
