# SPDX-License-Identifier: Apache-2.0
"""A public drive of another sensor as a KITTI sequence: python -m benchmarks.livox_drive FOLDER SEQUENCE.

FOLDER is datas/benchmark_realworld of github.com/hku-mars/BALM (Liu et al., "Efficient and consistent bundle adjustment
on LiDAR point clouds", T-RO 2023): 177 scans of a Livox Avia at walking pace, two a second. It needs the extra
`datasets`.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from dpm2_core.data.cloud_folder import CloudFolder
from dpm2_core.data.trajectory import write_kitti
from dpm2_core.errors import UsageError, exit_code

_POSES = "alidarPose.csv"


def write_sequence(folder: Path, out: Path) -> None:
    """Scans, times and poses as KITTI's odometry has them.

    Raises:
        UsageError: scans cannot be read, there are not as many poses as scans, or `out` is there.
    """
    scans = CloudFolder(folder)
    try:
        rows = np.loadtxt(folder / _POSES, delimiter=",", usecols=range(4), ndmin=2)
    except (OSError, ValueError) as error:
        raise UsageError(f"{folder / _POSES}: {error}") from None
    if len(rows) != 4 * len(scans):
        raise UsageError(f"{folder / _POSES}: {len(rows)} rows for {len(scans)} scans, want four each")
    if out.exists():
        raise UsageError(f"{out}: is there already")
    poses = rows.reshape(-1, 4, 4)
    times = poses[:, 3, 3].copy()  # where others have a 1
    poses[:, 3] = 0, 0, 0, 1
    (out / "velodyne").mkdir(parents=True)
    for frame in scans.frames():
        if frame.problem is not None:
            raise UsageError(frame.problem)
        frame.points.astype("<f4").tofile(out / "velodyne" / f"{frame.index:06d}.bin")
    np.savetxt(out / "times.txt", times - times[0], "%.6f")
    (out / "calib.txt").write_text("Tr: 1 0 0 0 0 1 0 0 0 0 1 0\n")  # the poses are the LiDAR's
    write_kitti(out / "poses.txt", poses)


def main(arguments: Sequence[str]) -> None:
    """Raises UsageError unless there are two arguments."""
    if len(arguments) != 2:
        raise UsageError("want two arguments: the folder of the scans, and of the sequence")
    write_sequence(Path(arguments[0]), Path(arguments[1]))


if __name__ == "__main__":
    sys.exit(exit_code(lambda: main(sys.argv[1:])))
