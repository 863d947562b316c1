# SPDX-License-Identifier: Apache-2.0
"""Reads scans and images stored as one file each, and selects one of several sequences."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dpm2_core.data.compressed import decode_compressed
from dpm2_core.errors import UsageError
from dpm2_core.files import is_stream
from dpm2_core.frame import NO_POINTS, Camera, Image, Points

KITTI, KITTI_RAW = "*/velodyne", "*_drive_*/velodyne_points"
KITTI_360, KITTI_CARLA = "data_3d_raw/*/velodyne_points", "*/generated/frames"
"""Layouts of several drives in one folder: a glob pattern whose first * is the name of the drive."""


def numbered_scans(folder: Path) -> list[Path]:
    """The files NNNNNN.bin, ordered by number; other files are left out."""
    scans = (scan for scan in folder.glob("*.bin") if scan.stem.isdecimal())
    return sorted(scans, key=lambda scan: (int(scan.stem), scan.name))


def read_scan(path: Path) -> tuple[Points, str | None]:
    """A velodyne file as (N, 4) float32 [x, y, z in m, intensity 0..1], or an empty array and the problem."""
    if is_stream(path):
        return NO_POINTS, f"{path}: not a file"
    try:
        values, size = np.fromfile(path, "<f4"), path.stat().st_size
    except OSError as error:
        return NO_POINTS, f"{path}: {error.strerror}"
    if size % 16:
        return NO_POINTS, f"{path}: {size} bytes are no whole number of points (16 bytes each)"
    if size % 20 == 0 and _are_rings(values[4::5]) and not _are_rings(values[::5]):
        return NO_POINTS, f"{path}: 5 numbers per point, the last a ring, as in nuScenes; want 4"
    points = values.reshape(-1, 4)
    if _are_implausible(points):
        return NO_POINTS, f"{path}: not the points of a LiDAR; want 4 float32 per point: x, y, z in m, and intensity"
    return points, None


def _are_implausible(points: Points) -> bool:
    """Whether most of (N, 4) points are no plausible measurements, such as integers that are read as floats."""
    with np.errstate(over="ignore", invalid="ignore"):
        distance = np.abs(points[::16, :3]).max(1, initial=0)  # all of 120,000 would take 4 ms per scan
    return len(points) > 0 and bool(np.mean((distance > 0) & ~((distance > 1e-3) & (distance < 1e5))) > 0.5)


def _are_rings(values: NDArray[np.float32]) -> bool:
    """Whether all values are integers, not all equal, in the range of a LiDAR's beam numbers."""
    are_integers = (values >= 0) & (values < 256) & (values == np.floor(values))
    return len(values) > 0 and bool(are_integers.all()) and bool(np.ptp(values) > 0)


def read_image(path: Path) -> NDArray[np.uint8] | None:
    """An image file to (H, W, 3) uint8 RGB; None if it cannot be decoded."""
    try:
        return decode_compressed(path.read_bytes())
    except (OSError, ValueError):
        return None


def image_size(paths: Iterable[Path], notes: list[str]) -> tuple[int, int] | None:
    """Width and height of the first readable image; None without any, with a note if there are unreadable images."""
    path = None
    for path in paths:
        if (pixels := read_image(path)) is not None:
            return pixels.shape[1::-1]
    if path is not None:
        notes.append(f"{path.parent}: none of its images can be read")
    return None


def image_of(scan: Path, folder: Path) -> Path | None:
    """The image of a scan, by its number: PNG, or JPEG as in smaller copies of data sets."""
    paths = (folder / f"{scan.stem}{suffix}" for suffix in (".png", ".jpg"))
    return next((path for path in paths if path.is_file()), None)


def images_of(path: Path | None, camera: Camera | None, notes: list[str]) -> tuple[Image, ...]:
    """The image of a frame, if it has one and there is a camera; a note gives the reason if one is left out."""
    if camera is None or path is None or not path.is_file():
        return ()
    pixels = read_image(path)
    if pixels is not None and pixels.shape[1::-1] == camera.size:
        return (Image(pixels, camera),)
    found = "cannot be read" if pixels is None else f"is {pixels.shape[1]}x{pixels.shape[0]}"
    notes.append(f"{path} {found} (others are {'x'.join(map(str, camera.size))}): frame used without it")
    return ()


def is_frames(path: Path) -> bool:
    """Whether this is the folder `frames` of a KITTI-CARLA town: PLY files whose poses and images are next to it."""
    around = path.absolute().parent
    beside_frames = ("full_poses_lidar.txt", "images_rgb")
    return path.absolute().name == "frames" and any((around / name).exists() for name in beside_frames)


def drives_below(path: Path, layout: str) -> list[str]:
    """Names of the drives below `path` with that layout, sorted."""
    depth = layout.partition("*")[0].count("/")
    return sorted(found.relative_to(path).parts[depth] for found in path.glob(layout) if found.is_dir())


def chosen(path: Path, sequence: str, layout: str) -> str:
    """Name of the selected drive below a folder: `sequence`, which may be its four digits (0009), or the only one.

    Raises:
        UsageError: no drive matches, or several do.
    """
    if not (found := drives_below(path, layout)):
        raise UsageError(f"{path}: no drive ({layout}) in or below it")
    matching = [name for name in found if sequence in ("", name, name.removesuffix("_sync")[-4:])]
    if sequence in found or len(matching) == 1:
        return sequence if sequence in found else matching[0]
    problem = f"no sequence {sequence}" if sequence else "several sequences"
    raise UsageError(f"{path}: {problem}; choose one with input.sequence: {', '.join(found)}")
