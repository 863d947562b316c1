# SPDX-License-Identifier: Apache-2.0
"""`python -m benchmarks.livox_drive FOLDER SEQUENCE`: converts a public drive of another LiDAR to a KITTI sequence.

FOLDER is datas/benchmark_realworld of github.com/hku-mars/BALM (Liu et al., "Efficient and consistent bundle adjustment
on LiDAR point clouds", T-RO 2023): 177 scans of a Livox Avia at walking pace, two per second. It needs the extra
`datasets`.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

from dpm2_core.commands.options import run_command
from dpm2_core.data.cloud_folder import CloudFolder
from dpm2_core.data.trajectory import write_kitti
from dpm2_core.errors import UsageError

_POSES = "alidarPose.csv"


def write_sequence(folder: Path, sequence: Path) -> None:
    """Write scans, times and poses in the layout of KITTI odometry.

    Raises:
        UsageError: scans cannot be read, there are not as many poses as scans, or `sequence` exists already.
    """
    scans = CloudFolder(folder)
    try:
        rows = np.loadtxt(folder / _POSES, delimiter=",", usecols=range(4), ndmin=2)
    except (OSError, ValueError) as error:
        raise UsageError(f"{folder / _POSES}: {error}") from None
    if len(rows) != 4 * len(scans):
        raise UsageError(f"{folder / _POSES}: {len(rows)} rows for {len(scans)} scans, want four each")
    if sequence.exists():
        raise UsageError(f"{sequence}: exists already")
    poses = rows.reshape(-1, 4, 4)
    times = poses[:, 3, 3].copy()  # in place of the 1 of a transform
    poses[:, 3] = 0, 0, 0, 1
    (sequence / "velodyne").mkdir(parents=True)
    for frame in scans.frames():
        if frame.problem is not None:
            raise UsageError(frame.problem)
        frame.points.astype("<f4").tofile(sequence / "velodyne" / f"{frame.index:06d}.bin")
    np.savetxt(sequence / "times.txt", times - times[0], "%.6f")
    (sequence / "calib.txt").write_text("Tr: 1 0 0 0 0 1 0 0 0 0 1 0\n")  # the poses are of the LiDAR
    write_kitti(sequence / "poses.txt", poses)


if __name__ == "__main__":
    sys.exit(run_command(write_sequence))
