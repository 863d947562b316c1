# SPDX-License-Identifier: Apache-2.0
"""Data sets that KISS-ICP reads, as a `Source`: MulRan, Newer College, NCLT, HeLiPR, Boreas, ...

I. Vizzo et al., "KISS-ICP", RA-L 2023; its package `kiss_icp.datasets` (MIT) has the loaders.
"""

from __future__ import annotations

import contextlib
import io
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from dpm2_core.data.cloud_folder import name_times
from dpm2_core.data.point_times import TimeUnit, time_offsets
from dpm2_core.data.settings import InputSettings
from dpm2_core.data.source import IndexedSource, note_once
from dpm2_core.data.text import read_lines
from dpm2_core.data.trajectory import interpolate
from dpm2_core.errors import UsageError
from dpm2_core.extras import needs
from dpm2_core.frame import NO_POINTS, Array, Frame
from dpm2_core.geometry import se3

_SWEEP_PERIOD = 0.1  # s, one revolution of the LiDAR
_STAMPED_AT = {"kitti_raw": 0.5}
"""Fraction of the sweep at the stamp, where it is not the start: KITTI stamps the moment the LiDAR faces forward."""
_T_BASE_OUSTER = se3.make(
    Rotation.from_euler("xyz", (0.0001, 0.0003, 179.6654), degrees=True).as_matrix(), np.array([1.7042, -0.021, 1.8047])
)
"""Pose of MulRan's LiDAR on its car, from the data set's calib_base2ouster.txt."""
_FILES = {
    "apollo": ("pcds/*.pcd", "poses/gt_poses.txt"),
    "boreas": ("lidar/*.bin", "applanix/lidar_poses.csv"),
    "helipr": ("LiDAR/{sequence}/*.bin", "LiDAR_GT/global_{sequence}_gt.txt"),
    "mulran": ("Ouster/*.bin", "global_pose.csv"),
    "ncd": ("raw_format/ouster_scan/*.pcd", "ground_truth/registered_poses.csv"),
    "nclt": ("velodyne_sync/*.bin", "../ground_truth/groundtruth_{drive}.csv"),
}
"""Scans and ground truth in the folder of a drive; the loaders need both."""
_ONE_POSE_PER_SCAN = {"boreas": 1, "helipr": 0}
"""Loaders whose ground truth has a line for each scan, and the number of lines before these."""
_GRIDS = ("mulran", "ncd")  # the order of the points determines their times
_LIDARS = ("Ouster", "Velodyne", "Avia", "Aeva")  # of HeLiPR
_NATIVE_LOADERS = ("generic", "mcap", "ouster", "rosbag")  # dpm2 reads these itself, with times and intensities


class KissSource(IndexedSource):
    """A drive read by KISS-ICP's loader `input.dataset`. See `Source`; there are no images and no intensities.

    Point times are those of the files for HeLiPR and Boreas, in s from the stamp. The other loaders return fractions of
    the sweep, whose start is the stamp, as Ouster's driver has it (`_STAMPED_AT` has the exception).

    Raises:
        UsageError: no such loader, it lacks a package, or it cannot read the folder.
    """

    def __init__(self, path: Path | str, settings: InputSettings | None = None) -> None:
        self._settings, self.path = settings or InputSettings(), Path(path)
        self._printed = ""  # output of the loader's constructor, which may name what is missing
        kind = self._settings.dataset
        with needs("datasets", f"input.dataset={kind}"):
            from kiss_icp.datasets import available_dataloaders, dataset_factory
        names = sorted(set(available_dataloaders()).difference(_NATIVE_LOADERS))
        if kind not in names:
            raise UsageError(f"input.dataset={kind}: there is no such loader; there are {', '.join(names)}")
        _check_files(self.path, kind, self._settings.sequence)
        arguments = {"data_dir": self.path.resolve(), "sequence": self._settings.sequence}
        self._loader = self._call_loader(lambda: dataset_factory(kind, **arguments))
        super().__init__(self.path.resolve().stem, int(self._call_loader(lambda: len(self._loader))))
        if not self._count:
            raise UsageError(f"{self.path}: KISS-ICP's loader {kind} finds no scans here")
        self.stamps = self._read_stamps()
        self.poses = self._poses()
        if self.poses is not None:
            self.truth = "global_pose.csv" if kind == "mulran" else f"gt_poses of KISS-ICP's loader {kind}"

    def frame(self, position: int) -> Frame:
        """See `IndexedSource`."""
        stamp = int(self.stamps[position])
        file = self._file(position)
        try:
            xyz, offset = self._call_loader(lambda: self._scan(position, stamp), file)
            if not len(xyz):
                raise UsageError(f"{file}: no points")
        except UsageError as error:
            return Frame(stamp, NO_POINTS, index=position, problem=str(error))
        points = np.zeros((len(xyz), 4), np.float32)
        points[:, :3] = np.asarray(xyz)[:, :3]
        if offset is None and self._settings.dataset in _GRIDS:
            note_once(self.notes, f"{self.path}: scans of other than 64 x 1024 points: not de-skewed", f"first {file}")
        elif offset is None:
            note_once(self.notes, f"{self.path}: no time field: not de-skewed")
        return Frame(stamp, points, offset, index=position)

    def _file(self, position: int) -> str:
        """The file of a scan, for messages."""
        files = getattr(self._loader, "scan_files", ())
        # For names without a folder.
        folder = getattr(self._loader, "scans_dir", getattr(self._loader, "scan_folder", ""))
        return str(Path(folder, files[position])) if len(files) == self._count else f"{self.path}: scan {position}"

    def _call_loader(self, call: Any, scan_file: str = "") -> Any:
        """Result of a call of the loader, which prints and exits on errors; `scan_file`: for messages."""
        printed = io.StringIO()
        try:
            with contextlib.redirect_stdout(printed), contextlib.redirect_stderr(printed):
                result = call()
        except (Exception, SystemExit) as error:
            output = printed.getvalue() if isinstance(error, SystemExit) else f"{self._printed} {error}"
            message = " ".join(output.split()[-30:]) or type(error).__name__
            raise UsageError(
                f"{scan_file or self.path}: KISS-ICP's loader {self._settings.dataset}: {message}"
            ) from None
        self._printed = self._printed or printed.getvalue()
        return result

    def _poses(self) -> Array | None:
        found: Any
        if self._settings.dataset == "mulran":
            found = _mulran_poses(Path(self._loader.sequence_dir) / "global_pose.csv", self.stamps)
        else:
            found = getattr(self._loader, "gt_poses", None)
        if found is None:
            return None
        poses = np.asarray(found, np.float64)
        if poses.shape != (self._count, 4, 4):
            self.notes.append(f"{self.path}: no ground truth: {poses.shape} poses for {self._count} scans")
            return None
        known = np.isfinite(poses.sum((1, 2)))
        self._note_unposed(self.path, known)
        return np.where(known[:, None, None], poses, np.nan) if known.any() else None

    def _read_stamps(self) -> NDArray[np.int64]:
        """(len,) ns: the loader's times, else the scans' names if they are times, else at constant `input.period`."""
        known = getattr(self._loader, "get_frames_timestamps", None)
        if known is not None:
            found = np.asarray(self._call_loader(known), np.float64).ravel()
            if len(found) == self._count and np.isfinite(found).all():
                return np.asarray(np.round(found * 1e9), np.int64)
        names = [Path(str(file)) for file in getattr(self._loader, "scan_files", ())]
        if len(names) == self._count and (named := name_times(names)):
            return np.asarray(named, np.int64)
        why = f"{self.path}: the loader has no times"
        return np.asarray(self._settings.steady_stamps(np.arange(self._count), why, self.notes))

    def _scan(self, position: int, stamp: int) -> tuple[Any, Any]:
        """Points (N, 3) in m, and their times (N,) in s from the stamp (ns); None if the points have no times."""
        loader, kind = self._loader, self._settings.dataset
        if kind == "helipr":  # the loader scales these to 0..1, so that neither unit nor origin is left
            data = loader.get_data(position)
            unit: TimeUnit = "s" if self._settings.sequence == "Velodyne" else "ns"
            return loader.read_point_cloud(data), _offsets(data[:, loader.time_channel], stamp, unit)
        if kind == "nclt":  # the loader reads these numbers as signed ones: 327.68 m off beyond 63.84 m
            raw = np.fromfile(Path(loader.scans_dir) / loader.scan_files[position], "<u2").reshape(-1, 4)
            return (raw[:, :3] * 0.005 - 100) * (1, -1, -1), None
        xyz, fractions = loader[position]
        if kind == "boreas":  # the loader guesses these from the azimuth
            rows = np.fromfile(loader.scan_files[position], np.float32).reshape(-1, 6).astype(np.float64)
            return xyz, _offsets(rows[:, 5], stamp, "s")
        times = np.asarray(fractions, np.float64).ravel()
        if len(times) != len(xyz) or not len(xyz) or np.ptp(times) == 0:
            return xyz, None
        return xyz, ((times - _STAMPED_AT.get(kind, 0.0)) * _SWEEP_PERIOD).astype(np.float32)


def _check_files(path: Path, kind: str, sequence: str) -> None:
    """Raise UsageError if a loader's scans or ground truth are not in the folder of a drive."""
    if kind == "helipr" and sequence not in _LIDARS:
        raise UsageError(f"{path}: input.dataset=helipr: choose a LiDAR with input.sequence: {', '.join(_LIDARS)}")
    wanted = [name.format(sequence=sequence, drive=path.resolve().name) for name in _FILES.get(kind, ())]
    for name in wanted:
        if not any(path.resolve().glob(name)):
            below = sorted({found.relative_to(path).parts[0] for found in path.glob(f"*/{name}") if ".." not in name})
            but = f", but in {', '.join(below)} below it" if below else ""
            need = f"input.dataset={kind} needs {' and '.join(wanted)}"
            raise UsageError(f"{path}: no {name} in this folder{but}; {need}")
    if kind in _ONE_POSE_PER_SCAN:
        scans, truth = len(list(path.glob(wanted[0]))), path / wanted[1]
        poses = sum(bool(line.strip()) for line in read_lines(truth)) - _ONE_POSE_PER_SCAN[kind]
        if poses != scans:
            raise UsageError(f"{truth}: {poses} poses for {scans} scans; input.dataset={kind} needs one for each")


def _mulran_poses(path: Path, stamps: NDArray[np.int64]) -> Array:
    """(N, 4, 4) poses of the LiDAR at stamps (N,) ns, relative to the first one, from those of the car; NaN outside.

    The loader has its transform between car and LiDAR the wrong way round, which puts the LiDAR below the road and
    rotates it by 0.67 degrees. It also takes the nearest pose of the file, however far away in time.
    """
    rows = np.loadtxt(path, delimiter=",", ndmin=2)
    poses = interpolate(rows[:, 0].astype(np.int64), se3.from_rows(rows[:, 1:]) @ _T_BASE_OUSTER, stamps)
    known = np.isfinite(poses).all((1, 2))
    return se3.inverse(poses[np.argmax(known)]) @ poses


def _offsets(times: Array, stamp: int, unit: TimeUnit) -> Any:
    """(N,) s from the stamp (ns) of a scan file's times (N,); None if there are none."""
    return time_offsets(times, np.ones(len(times), bool), stamp, unit)
