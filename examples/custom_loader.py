# SPDX-License-Identifier: Apache-2.0
"""Runs the SLAM on recordings in a format that dpm2 cannot read, with your own loader:

python examples/custom_loader.py FOLDER OUT

FOLDER contains one cloud per file STAMP.npy (stamp in ns; (N, 4) float32: x, y, z in m, intensity 0..1). If there is
ground truth, it also contains poses.csv with a line "stamp,x,y,z,qx,qy,qz,qw" for each cloud with a known pose.
"""

import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from dpm2_core import Frame, OfflineRun, UsageError


class NumpyFolder:
    """A `dpm2_core.Source`: the interface through which the SLAM reads a drive."""

    T_cam_lidar = None  # there is no camera

    def __init__(self, folder: Path) -> None:
        self.name = folder.name
        self.notes: list[str] = []
        self._files = sorted(
            (path for path in folder.glob("*.npy") if path.stem.isdecimal()), key=lambda p: int(p.stem)
        )
        if not self._files:
            raise UsageError(f"{folder}: no STAMP.npy in it")
        self.truth = "poses.csv" if (folder / "poses.csv").is_file() else ""
        self.poses = self._read_poses(folder / "poses.csv") if self.truth else None

    def __len__(self) -> int:
        return len(self._files)

    def frames(self, start: int = 0, stop: int | None = None) -> Iterator[Frame]:
        """Frames from `start` to `stop`. For an unreadable frame, `problem` is the reason; the drive continues."""
        for index in range(*slice(start, stop).indices(len(self))):
            path, problem = self._files[index], None
            points = np.zeros((0, 4), np.float32)
            try:
                points = np.load(path, allow_pickle=False).astype(np.float32)
                if points.ndim != 2 or points.shape[1] != 4:
                    points, problem = np.zeros((0, 4), np.float32), f"{path.name}: want (N, 4), got {points.shape}"
            except (OSError, ValueError) as error:
                problem = f"{path.name}: {error}"
            yield Frame(int(path.stem), points, index=index, problem=problem)

    def _read_poses(self, path: Path) -> np.ndarray:
        rows = np.loadtxt(path, delimiter=",", ndmin=2)
        poses = np.full((len(self), 4, 4), np.nan)  # NaN: unknown pose
        place = {int(file.stem): number for number, file in enumerate(self._files)}
        for row in rows:
            if (number := place.get(int(row[0]))) is not None:
                poses[number] = np.eye(4)
                poses[number, :3, :3] = Rotation.from_quat(row[4:8]).as_matrix()
                poses[number, :3, 3] = row[1:4]
        return poses


with OfflineRun(NumpyFolder(Path(sys.argv[1]))) as drive:
    result = drive.run()
    result.save(Path(sys.argv[2]))
    error = "no ground truth" if result.metrics is None else f"APE {result.metrics.ape_rmse_m:.3f} m"
    print(f"{len(result)} frames, {result.methods['failed']} failed, {error}")
