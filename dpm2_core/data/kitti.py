# SPDX-License-Identifier: Apache-2.0
"""The KITTI odometry layout: sequences/NN/{velodyne,image_2,calib.txt,times.txt} and poses/NN.txt. With an IMU also
imu.txt (one line per sample: s, then rad/s and m/s2 along its axes) and Tr_imu_to_velo in calib.txt. With GNSS fixes
also gnss.txt (s, latitude and longitude, deg, altitude, m, standard deviations to the east, north, up, m) and
Tr_gnss_to_velo, of the antenna.

A. Geiger, P. Lenz, R. Urtasun, "Are we ready for autonomous driving?", CVPR 2012.
"""

from __future__ import annotations

import json
from collections import deque
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dpm2_core.data.cloud_folder import name_times
from dpm2_core.data.imu import KEPT
from dpm2_core.data.scan_file import KITTI, chosen, drives_below
from dpm2_core.data.settings import InputSettings
from dpm2_core.data.source import ROUNDED
from dpm2_core.data.text import parse_row, read_lines, read_numbers
from dpm2_core.data.time_order import out_of_order
from dpm2_core.data.velodyne import VelodyneDrive
from dpm2_core.data.vertical_angle import checked_correction
from dpm2_core.errors import UsageError
from dpm2_core.frame import Array, Camera, Fix, Frame, Inertial
from dpm2_core.geometry import se3


class KittiSource(VelodyneDrive):
    """A sequence folder, or the root above it with `sequences/NN`. See `Source` for its attributes and methods.

    Scan numbers need not start at 0 nor be consecutive. Images and poses are optional. A scan or image that cannot be
    read affects only its own frame.

    Raises:
        UsageError: there are no scans, or a text file is damaged; the message names file and line.
    """

    swept = False

    def __init__(self, path: Path | str, settings: InputSettings | None = None) -> None:
        settings = settings or InputSettings()
        self.path = _sequence_folder(Path(path), settings.sequence)
        super().__init__(self.path.resolve().name, self.path / "velodyne", self.path / "image_2", settings)
        self.vertical_angle_correction_deg = self._correction()
        calib = read_calib(self.path / "calib.txt")
        self.T_cam_lidar = calib.get("Tr")
        if self.T_cam_lidar is None:
            problem = "has no Tr" if (self.path / "calib.txt").is_file() else "is missing"
            self.notes.append(f"{self.path / 'calib.txt'} {problem}: poses are of the LiDAR, not of the left camera")
        self.stamps = self._scan_stamps()
        self.poses = self._poses()
        self.camera = self._camera(calib)
        self.imu, self.R_lidar_imu = self._read_imu(calib)
        self.fixes = self._read_fixes(calib)

    def frames(self, start: int = 0, stop: int | None = None) -> Iterator[Frame]:
        """Frames start..stop-1 by position, with the IMU samples and the fix measured since the frame before."""
        last_stamp, fixes = None, deque(self.fixes)
        for frame in super().frames(start, stop):
            imu, fix = self._imu_since(last_stamp, frame.stamp), None
            while fixes and fixes[0].stamp <= frame.stamp:
                fix = fixes.popleft()
            last_stamp = frame.stamp
            yield replace(frame, imu=imu, fix=fix)

    def _read_imu(self, calib: dict[str, Array]) -> tuple[Inertial | None, Array]:
        """All samples along the IMU's axes (None if there are none to use), and R_lidar_imu (3, 3)."""
        path, R = self.path / "imu.txt", self._settings.imu_rotation()
        rows = read_numbers(path, 7) if self._settings.imu else np.zeros((0, 7))
        if R is None and "Tr_imu_to_velo" in calib:
            R = calib["Tr_imu_to_velo"][:3, :3]
        if len(rows) and R is None:
            self.notes.append(f"{path} is left out: no Tr_imu_to_velo in calib.txt; set input.q_lidar_imu")
        if not len(rows) or R is None:
            return None, np.eye(3)
        if (np.diff(rows[:, 0]) <= 0).any():
            raise UsageError(f"{path}:{int(np.argmax(np.diff(rows[:, 0]) <= 0)) + 2}: times do not increase")
        return Inertial(np.round(rows[:, 0] * 1e9).astype(np.int64), rows[:, 1:4], rows[:, 4:]), R

    def _imu_since(self, last_stamp: int | None, stamp: int) -> Inertial | None:
        """Samples since the scan before (ns), at most those of the last `KEPT`, rotated into the LiDAR frame."""
        imu, R = self.imu, self.R_lidar_imu
        if imu is None:
            return None
        start = stamp - KEPT if last_stamp is None else max(last_stamp, stamp - KEPT)
        first, last = np.searchsorted(imu.stamps, [start, stamp], "right")
        return Inertial(imu.stamps[first:last], imu.rates[first:last] @ R.T, imu.forces[first:last] @ R.T)

    def _read_fixes(self, calib: dict[str, Array]) -> list[Fix]:
        path, antenna = self.path / "gnss.txt", calib.get("Tr_gnss_to_velo", np.eye(4))[:3, 3]
        rows, fixes = read_numbers(path, 7), []
        for line, (time, *numbers) in enumerate(rows.tolist(), 1):
            try:
                covariance = np.diag(np.square(numbers[3:]))
                fixes.append(Fix(round(time * 1e9), np.array(numbers[:3]), covariance, antenna))
            except ValueError as error:
                raise UsageError(f"{path}:{line}: {error}") from None
        if rows.size and "Tr_gnss_to_velo" not in calib:
            self.notes.append(f"{path}: the antenna is assumed to be at the LiDAR: no Tr_gnss_to_velo in calib.txt")
        return sorted(fixes, key=lambda fix: fix.stamp)

    def _known_correction(self) -> float:
        path = self.path / "dpm2_sim.json"  # the simulated sensor has no such error; this file states it
        try:
            correction = float(json.loads(path.read_text(encoding="utf-8"))["vertical_angle_correction_deg"])
        except FileNotFoundError:
            return super()._known_correction()
        except (OSError, ValueError, TypeError, KeyError, RecursionError) as error:
            raise UsageError(f"{path}: no number vertical_angle_correction_deg ({error})") from None
        return checked_correction(correction, str(path))

    def _scan_stamps(self) -> NDArray[np.int64]:
        """(len,) ns from times.txt, continued at a constant rate if it ends early; else from the names of the scans if
        those are times since 1970."""
        path, n = self.path / "times.txt", len(self)
        times = read_numbers(path, 1)
        seconds = self._rows_of_scans(times)[:, 0]
        known = np.isfinite(seconds)
        if not known.any():
            if named := name_times(self._scans):
                return np.array(named, np.int64)
            scan_count = self.numbers - self.numbers[0]
            return self._settings.steady_stamps(scan_count, f"{path}: missing or too short", self.notes)
        if not known.all():
            last = int(np.flatnonzero(known)[-1])
            step = float(np.median(np.diff(times[:, 0]))) if len(times) > 1 else self._settings.period
            self.notes.append(f"{path}: {len(times)} times for {n} scans; the rest continue every {step:.3f} s")
            seconds = np.where(known, seconds, seconds[last] + (self.numbers - self.numbers[last]) * step)
        if (wrong := out_of_order(seconds)).any():
            first = int(np.argmax(wrong))
            self.notes.append(
                f"{path}: {wrong.sum()} times are not between their neighbors and are interpolated, the first"
                f" {seconds[first]:g} s of scan {self.numbers[first]}"
            )
            seconds[wrong] = np.interp(self.numbers[wrong], self.numbers[~wrong], seconds[~wrong])
        return np.round(seconds * 1e9).astype(np.int64)

    def _poses(self) -> Array | None:
        """(len, 4, 4) T_world_lidar from poses.txt here or poses/NN.txt of the root; None without either."""
        in_sequence, in_root = self.path / "poses.txt", self.path.resolve().parent.parent / "poses" / f"{self.name}.txt"
        requested = {"auto": (in_sequence, in_root), "kitti": (in_root,), "semantic_kitti": (in_sequence,)}[
            self._settings.kitti_poses
        ]
        path = next((file for file in requested if file.is_file()), None)
        if path is None:
            if self._settings.kitti_poses != "auto":
                raise UsageError(f"{requested[0]}: no such file (input.kitti_poses is {self._settings.kitti_poses})")
            return None
        if self.T_cam_lidar is None:
            self.notes.append(f"{path} has poses of the camera: without Tr they are no ground truth for the LiDAR")
            return None
        self.truth = "/".join(path.parts[-2:])  # poses/04.txt, or SemanticKITTI's 04/poses.txt
        rows = self._rows_of_scans(read_numbers(path, 12))
        known = np.isfinite(rows[:, 0])
        self._note_unposed(path, known)
        rigid = np.array([se3.is_rigid(se3.make(T[:, :3], T[:, 3]), ROUNDED) for T in rows.reshape(-1, 3, 4)], bool)
        if (wrong := np.logical_and(known, ~rigid)).any():
            first = self.numbers[int(np.argmax(wrong))]
            self.notes.append(
                f"{path}: {wrong.sum()} poses are not rigid transforms and left out, the first that of scan {first}"
            )
            known = np.logical_and(known, rigid)
        T_world_cam = np.full((len(self), 4, 4), np.nan)
        # Rounded to 7 digits in the files; a quaternion, as in a bag, would not keep the error of the rotation.
        T_world_cam[known] = se3.from_rows(rows[known])
        return se3.inverse(self.T_cam_lidar) @ T_world_cam @ self.T_cam_lidar

    def _rows_of_scans(self, rows: Array) -> Array:
        """The row of each scan, NaN where there is none.

        In order if there are as many rows as scans, but not as many as the frame numbers require. Else by frame number
        if there are enough rows or the scans begin at 0. Else nothing shows which row is of which scan.
        """
        out = np.full((len(self), rows.shape[1]), np.nan)
        if len(rows) == len(self) <= self.numbers[-1]:
            indices = np.arange(len(self))
        elif len(rows) > self.numbers[-1] or self.numbers[0] == 0:
            indices = self.numbers
        else:
            return out
        out[indices < len(rows)] = rows[indices[indices < len(rows)]]
        return out

    def _camera(self, calib: dict[str, Array]) -> Camera | None:
        """The left color camera, with the size of the first readable image; None without images."""
        size = self._image_size()
        if size is None:
            return None
        if self.T_cam_lidar is None:
            self.notes.append("images are left out: without Tr the camera's pose is not known")
            return None
        if "P2" not in calib:
            raise UsageError(f"{self.path / 'calib.txt'}: no P2, which image_2 needs; without images it is not needed")
        return left_color_camera(calib["P2"], self.T_cam_lidar, size)


def left_color_camera(P2: Array, T_cam_lidar: Array, size: tuple[int, int]) -> Camera:
    """KITTI's camera 2, from its projection matrix (3, 4) and the transform (4, 4) to the rectified gray camera 0."""
    K, offset = P2[:, :3], P2[:, 3]
    # P2 = K [I | t] with t from the left gray camera 0, which the poses and Tr refer to.
    T_cam2_cam0 = se3.make(np.eye(3), np.linalg.solve(K, offset))
    return Camera(K, se3.inverse(T_cam2_cam0 @ T_cam_lidar), size, name="camera_color_left")


def read_calib(path: Path) -> dict[str, Array]:
    """The matrices in a calib.txt: P0..P3 (3, 4), Tr (4, 4, LiDAR to left gray camera), Tr_imu_to_velo and
    Tr_gnss_to_velo (4, 4); empty if there is no such file.

    Raises:
        UsageError: a line is damaged; the message names file and line.
    """
    calib: dict[str, Array] = {}
    for number, line in enumerate(read_lines(path), 1):
        key, colon, text = line.partition(":")
        if not colon or key.strip() not in ("P0", "P1", "P2", "P3", "Tr", "Tr_imu_to_velo", "Tr_gnss_to_velo"):
            continue  # calibrations of raw drives and of the object data set have many more
        row, name = parse_row(text, 12, f"{path}:{number}: {key}"), key.strip()
        matrix = row.reshape(3, 4)
        if name.startswith("Tr"):
            if not se3.is_rigid(se3.make(matrix[:, :3], matrix[:, 3]), ROUNDED):
                raise UsageError(f"{path}:{number}: {name} is no rigid transform")
            calib[name] = se3.from_rows(row)
        elif matrix[0, 0] <= 0 or matrix[1, 1] <= 0 or not np.allclose(matrix[2, :3], [0, 0, 1]):
            raise UsageError(f"{path}:{number}: {name} is no projection matrix of a rectified camera")
        else:
            calib[name] = matrix
    return calib


def _sequence_folder(path: Path, sequence: str) -> Path:
    if (path / "velodyne").is_dir():
        return path
    if not path.is_dir():
        raise UsageError(f"{path}: no such folder")
    root = path / "sequences" if (path / "sequences").is_dir() else path
    if not drives_below(root, KITTI):
        what = "no KITTI sequence (no velodyne folder in it or below sequences/)"
        raise UsageError(f"{path}: {what}, no bag, no scans: docs/recordings.md")
    return root / chosen(root, sequence, KITTI)
