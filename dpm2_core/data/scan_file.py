# SPDX-License-Identifier: Apache-2.0
"""Scans and images of one file each."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dpm2_core.data.compressed import decode_compressed
from dpm2_core.frame import Points


def read_scan(path: Path) -> tuple[Points, str | None]:
    """A velodyne file to (N, 4) float32 [x, y, z in m, intensity 0..1], or an empty array and what is wrong."""
    nothing = np.empty((0, 4), np.float32)
    try:
        values, size = np.fromfile(path, "<f4"), path.stat().st_size
    except OSError as error:
        return nothing, f"{path}: {error.strerror}"
    if size % 16:
        return nothing, f"{path}: {size} bytes are no whole number of points (16 bytes each)"
    return values.reshape(-1, 4), None


def read_image(path: Path) -> NDArray[np.uint8] | None:
    """An image file to (H, W, 3) uint8 RGB; None if it cannot be decoded."""
    try:
        return decode_compressed(path.read_bytes())
    except (OSError, ValueError):
        return None
