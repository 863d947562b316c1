# SPDX-License-Identifier: Apache-2.0
"""A drive through a world, written as a KITTI odometry data set with labels, static twins and a ground map."""

from __future__ import annotations

import io
import json
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from dpm2_core.console import Advance, untold
from dpm2_core.data.trajectory import FRAME_PERIOD
from dpm2_core.errors import UsageError
from dpm2_core.files import file_digest, new_folder
from dpm2_core.frame import Array
from dpm2_core.geometry import se3
from dpm2_core.sim.camera import calibration, render
from dpm2_core.sim.gnss import Receiver
from dpm2_core.sim.imu import Imu
from dpm2_core.sim.lidar import Lidar
from dpm2_core.sim.road import ROAD_KINDS, make_road, read_drive
from dpm2_core.sim.settings import DriveConfig
from dpm2_core.sim.world import World, build_world, own_preset, random_stream

NOTE = "dpm2_sim.json"
OVERLAP = 16.0
"""Distance that a closed drive continues beyond its start, m."""
LONGEST_LAP = 800.0
"""A longer drive goes around again, m."""
_SMOOTHING_WINDOW = 31
"""IMU samples over which the trajectory is smoothed: 0.3 s, a few samples of a road; it moves by 1 mm (RMS)."""
_OMITTED_IF_DEFAULT = {"pattern", "roll", "pitch", "real", "wet", "lens", "traffic", "imu", "gnss"}
_LIDAR_STREAM, _CAMERA_STREAM, _IMU_STREAM, _GNSS_STREAM = 10, 11, 14, 15


def simulate(
    out: Path,
    drive: DriveConfig,
    workers: int = 2,
    progress: Advance = untold,
) -> bool:
    """Write a drive to `out`, which appears only when it is complete.

    Args:
        out: root of the KITTI layout: sequences/00/{velodyne,image_2,labels,static,...}, poses/00.txt.
        workers: number of threads; the result does not depend on it.
        progress: called with the number of frames done and the total.

    Returns:
        False if the same drive exists already; it is not changed.

    Raises:
        UsageError: a setting is invalid, or `out` contains something else. Dpm2Error: it could not be written.
    """
    drive = drive.model_copy(update={"frames": _frame_count(drive)})
    recipe = _recipe(drive)
    if _already_exists(out, recipe):
        return False
    length = fitting_length(drive) if drive.road in ROAD_KINDS else 400.0
    world = build_world(drive.road, drive.preset, drive.seed, length, drive.traffic)
    plan, height = world.road.plan, drive.lidar.height
    if plan is not None and height >= plan.headroom:
        raise UsageError(
            f"--height {height:g}: the route passes under objects {plan.headroom:.2f} m high; set a lower height"
        )
    with new_folder(out) as part:  # `sequences`, which identifies a drive, is written last
        _Drive(world, drive).write(part, recipe, workers, progress)
    return True


def _frame_count(drive: DriveConfig) -> int:
    if drive.frames is not None and drive.frames < 1:
        raise UsageError(f"--frames {drive.frames}: want at least 1")
    if drive.road in ROAD_KINDS:
        return 150 if drive.frames is None else drive.frames
    available = len(read_drive(Path(drive.road)))
    if drive.frames is not None and drive.frames > available:
        raise UsageError(f"--frames {drive.frames}: {drive.road} has {available} poses")
    return available if drive.frames is None else drive.frames


def fitting_length(drive: DriveConfig) -> float:
    """Length of the road, m, that the frames of a drive just fill."""
    kind = own_preset(drive.preset, drive.seed, drive.traffic)
    end = (_frame_count(drive) - 1) * FRAME_PERIOD
    length = float(np.clip(end * kind.speed, 60, 20000))
    for _ in range(12):  # the driven distance depends on the curves, and these on the length
        streets = make_road(drive.road, kind, random_stream(drive.seed, drive.preset, 0), length)
        driven = float(streets.distance(end) - streets.distance(0.0))
        if streets.drive.closed:
            length = min(length + 0.8 * (driven - OVERLAP - streets.drive.length), LONGEST_LAP)
        else:
            length = driven
        length = float(np.clip(length, 60, 20000))
    return length


def _recipe(drive: DriveConfig) -> dict[str, Any]:
    """The drive's settings; a file of poses by name and checksum. Some settings are left out if they have their
    defaults: usual traffic, a level, clean and spinning LiDAR, and a dry lens."""
    recipe = {"generator": "dpm2 sim 1", "vertical_angle_correction_deg": 0, **drive.model_dump(mode="json")}
    if drive.road not in ROAD_KINDS:
        path = Path(drive.road)
        recipe["road"] = f"{path.name} sha256:{file_digest(path)}"
    defaults = DriveConfig().model_dump(mode="json")
    for part, default in (
        (recipe, defaults),
        (recipe["lidar"], defaults["lidar"]),
        (recipe["camera"], defaults["camera"]),
    ):
        for name in _OMITTED_IF_DEFAULT & part.keys():
            if part[name] == default[name]:
                del part[name]
    return recipe


def _already_exists(out: Path, recipe: dict[str, Any]) -> bool:
    """Whether `out` contains exactly this drive; UsageError if it contains anything else."""
    if not out.exists() or (out.is_dir() and not any(out.iterdir())):
        return False
    try:
        found = json.loads((out / "sequences" / "00" / NOTE).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        raise UsageError(f"{out}: exists already and is not a simulated drive; choose another folder") from None
    if found != recipe:
        different = [key for key in recipe if not isinstance(found, dict) or found.get(key) != recipe[key]]
        different += [key for key in found if key not in recipe] if isinstance(found, dict) else []
        what = f"a drive with other {', '.join(different) or 'settings'}, or of another version of dpm2"
        raise UsageError(f"{out}: contains {what}; remove it or choose another folder")
    return True


class _Drive:
    """One world, its sensors and the poses of the drive; writes frames in any order."""

    def __init__(self, world: World, drive: DriveConfig) -> None:
        self.world, self.lidar, self.camera = world, Lidar(drive.lidar), drive.camera if drive.images else None
        self.imu = None if drive.imu is None else Imu(drive.imu, np.random.default_rng([world.seed, _IMU_STREAM]))
        rng = np.random.default_rng([world.seed, _GNSS_STREAM])
        self.gnss = None if drive.gnss is None else Receiver(drive.gnss, rng)
        self.times = np.arange(_frame_count(drive), dtype=np.float64) * FRAME_PERIOD
        self.T_world_lidar = self._poses(self.times)
        color = calibration(drive.camera)
        # The poses and Tr of the layout are of the left gray camera 0; the color camera 2 is next to it.
        T_level_cam0 = color.T_lidar_cam.copy()
        T_level_cam0[1, 3] = 0.0
        T_lidar_level = se3.inverse(self.lidar.T_level_lidar)
        self.T_lidar_cam0, self.T_lidar_cam2 = T_lidar_level @ T_level_cam0, T_lidar_level @ color.T_lidar_cam
        self.K, self.baseline = color.K, color.T_lidar_cam[1, 3]

    def write(self, root: Path, recipe: dict[str, Any], workers: int, progress: Advance) -> None:
        sequence = root / "sequences" / "00"
        for name in ("velodyne", "labels", "static", *(["image_2"] if self.camera else [])):
            (sequence / name).mkdir(parents=True)
        self._write_texts(root, sequence)
        self._write_ground(sequence / "ground.npz")
        if self.imu is not None:
            self._write_imu(self.imu, sequence / "imu.txt")
        if self.gnss is not None:
            self._write_fixes(self.gnss, sequence / "gnss.txt")
        pool = ThreadPoolExecutor(max(1, workers))
        try:
            for done, _ in enumerate(pool.map(lambda i: self._write_frame(sequence, i), range(len(self.times))), 1):
                progress(done, len(self.times))
        finally:
            pool.shutdown(cancel_futures=True)
        (sequence / NOTE).write_text(json.dumps(recipe, indent=1) + "\n", encoding="utf-8")

    def _write_frame(self, sequence: Path, i: int) -> None:
        world, time, T = self.world, float(self.times[i]), self.T_world_lidar[i]
        rng = np.random.default_rng([world.seed, _LIDAR_STREAM, i])
        scan = self.lidar.drive_scan(world, T, time, rng)
        scan.points.tofile(sequence / "velodyne" / f"{i:06d}.bin")
        scan.label.tofile(sequence / "labels" / f"{i:06d}.label")
        scan.static.tofile(sequence / "static" / f"{i:06d}.bin")
        if self.camera:
            rng = np.random.default_rng([world.seed, _CAMERA_STREAM, i])
            pixels = render(world, self.camera, T @ self.T_lidar_cam2, time, rng)
            png = cv2.imencode(".png", cv2.cvtColor(pixels, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_PNG_COMPRESSION, 1])[1]
            (sequence / "image_2" / f"{i:06d}.png").write_bytes(png.tobytes())

    def _write_texts(self, root: Path, sequence: Path) -> None:
        T_world_cam = self.T_world_lidar @ self.T_lidar_cam0
        rows = (se3.inverse(T_world_cam[0]) @ T_world_cam)[:, :3].reshape(-1, 12)
        (root / "poses").mkdir()
        for path in (root / "poses" / "00.txt", sequence / "poses.txt"):
            np.savetxt(path, rows, "%.9e")
        np.savetxt(sequence / "times.txt", self.times, "%.6e")
        calib = io.StringIO()
        for k, x_offset in enumerate((0.0, -0.54, self.baseline, -0.48)):
            P = np.concatenate([self.K, self.K @ [[x_offset], [0], [0]]], 1)
            calib.write(f"P{k}: " + " ".join(f"{v:.12e}" for v in P.ravel()) + "\n")
        calib.write("Tr: " + " ".join(f"{v:.12e}" for v in se3.inverse(self.T_lidar_cam0)[:3].ravel()) + "\n")
        mounts = {}
        if self.imu is not None:
            mounts["imu"] = se3.make(self.imu.R_lidar_imu, np.zeros(3))
        if self.gnss is not None:
            mounts["gnss"] = se3.make(np.eye(3), self.gnss.antenna)
        for name, T_lidar_sensor in mounts.items():
            calib.write(f"Tr_{name}_to_velo: " + " ".join(f"{v:.12e}" for v in T_lidar_sensor[:3].ravel()) + "\n")
        (sequence / "calib.txt").write_text(calib.getvalue(), encoding="utf-8")

    def _write_imu(self, imu: Imu, path: Path) -> None:
        """One line per sample, from before the first scan to after the last: s, then rad/s and m/s2 along its axes."""
        times = imu.times(-FRAME_PERIOD, self.times[-1] + FRAME_PERIOD)
        np.savetxt(path, np.column_stack([times, *imu.measure(times, self._smooth_poses)]), "%.9e")

    def _write_fixes(self, gnss: Receiver, path: Path) -> None:
        """One line per fix: s, latitude and longitude, deg, altitude, m, standard deviations east, north, up, m."""
        times = gnss.times(self.times[-1])
        sigmas = np.tile(gnss.sigmas, (len(times), 1))
        np.savetxt(path, np.column_stack([times, gnss.measure(self._poses(times)), sigmas]), "%.12e")

    def _poses(self, times: Array) -> Array:
        """T_world_lidar (K, 4, 4) at times (K,) s."""
        return np.reshape([self.lidar.pose(self.world, float(t)) for t in times], (-1, 4, 4))

    def _smooth_poses(self, times: Array) -> Array:
        """Like `_poses`, 0.01 s apart, for a car that moves before 0 s, on a trajectory without corners. Roads are
        straight between samples, so that an IMU would measure peaks of some g at each sample."""
        from scipy.signal import savgol_filter  # takes longer to import than everything else here

        T, early = self._poses(np.maximum(times, 0.0)), times < 0
        first, second = self._poses(np.array([0.0, 0.02]))
        T[early] = first @ np.array([se3.exp(se3.log(se3.inverse(first) @ second) * t / 0.02) for t in times[early]])
        window = min(_SMOOTHING_WINDOW, len(times) - 1 | 1)
        T[:, :3, 3] = savgol_filter(T[:, :3, 3], window, 3, axis=0)
        return T

    def _write_ground(self, path: Path) -> None:
        """Height of the ground, with curbs, NaN where unknown; T_grid_cam0 is the first pose in the map's frame."""
        terrain = self.world.terrain
        np.savez_compressed(
            path,
            elevation=terrain.elevation(),
            origin=terrain.origin,
            resolution=terrain.resolution,
            T_grid_cam0=self.T_world_lidar[0] @ self.T_lidar_cam0,
        )
