# SPDX-License-Identifier: Apache-2.0
"""Writes point clouds as binary PCD 0.7, the format of the Point Cloud Library, and as LAS, the surveyors' format."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from dpm2_core.extras import needs
from dpm2_core.files import atomic_write
from dpm2_core.frame import Points

_HEADER = """# .PCD v0.7 - Point Cloud Data file format
VERSION 0.7
FIELDS x y z intensity
SIZE 4 4 4 4
TYPE F F F F
COUNT 1 1 1 1
WIDTH {count}
HEIGHT 1
VIEWPOINT 0 0 0 1 0 0 0
POINTS {count}
DATA binary
"""


def write_pcd(path: Path | str, points: Points) -> None:
    """Write (N, 4) [x, y, z in m, intensity 0..1]; N may be 0.

    Raises:
        Dpm2Error: the file could not be written; an older one at `path` is kept.
    """
    with atomic_write(path, "wb") as file:
        file.write(_HEADER.format(count=len(points)).encode("ascii"))
        file.write(np.ascontiguousarray(points, "<f4").data)


def write_las(path: Path | str, points: Points) -> None:
    """Write (N, 4) as LAS 1.4, point format 6: millimeters, intensities scaled to 0..65535.

    Raises:
        MissingPackageError: laspy is not installed. Dpm2Error: the file could not be written.
    """
    with needs("las", "LAS"):
        import laspy

    las = laspy.create(point_format=6, file_version="1.4")
    las.header.scales = [1e-3, 1e-3, 1e-3]
    las.header.offsets = np.floor(points[:, :3].min(0)) if len(points) else np.zeros(3)
    las.x, las.y, las.z = points[:, :3].astype(np.float64).T
    las.intensity = np.rint(np.clip(points[:, 3], 0, 1) * 65535).astype(np.uint16)
    with atomic_write(path, "wb") as file:
        las.write(file)
