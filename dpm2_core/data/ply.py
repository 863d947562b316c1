# SPDX-License-Identifier: Apache-2.0
"""Point clouds as binary PLY, which CloudCompare, MeshLab, Open3D and Blender open."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from dpm2_core.files import atomic_write
from dpm2_core.frame import Points

_HEADER = """ply
format binary_little_endian 1.0
comment dpm2: metres, intensity 0..1
element vertex {count}
property float x
property float y
property float z
property float intensity
end_header
"""


def write_ply(path: Path | str, points: Points) -> None:
    """Write (N, 4) [x, y, z in m, intensity 0..1]; N may be 0.

    Raises:
        Dpm2Error: the file could not be written; an older one at `path` survives.
    """
    if points.ndim != 2 or points.shape[1] != 4:
        raise ValueError(f"{path}: points are {points.shape}, want (N, 4)")
    with atomic_write(path, "wb") as file:
        file.write(_HEADER.format(count=len(points)).encode("ascii"))
        file.write(np.ascontiguousarray(points, "<f4").data)
