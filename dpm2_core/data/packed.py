# SPDX-License-Identifier: Apache-2.0
"""Drives packed for training: cropped clouds as 2 mm integers, poses and small images, memory-mapped."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dpm2_core.errors import UsageError
from dpm2_core.files import new_folder
from dpm2_core.frame import Array, Camera, Image

QUANTUM = 0.002  # m; 60 m fit in 16 bits, and the LiDAR's noise is ten times larger
FORMAT = 1
_IMAGE_FILES = ("pixels", "K", "T_lidar_cam")  # files of a drive with images


class Sample(NamedTuple):
    """One frame: cloud (N, 3) float32, m, cropped; T_world_lidar (4, 4); images."""

    cloud: NDArray[np.float32]
    pose: Array
    images: tuple[Image, ...] = ()


class PackedWriter:
    """Writes a drive frame by frame; only poses and calibration are kept in memory until the end."""

    def __init__(self, folder: Path) -> None:
        """`folder`: an empty folder, see `packed_writer`."""
        self.folder = folder
        self.images: int | None = None  # per frame, once there is a frame
        self._offsets, self._poses = [0], list[Array]()
        self._K, self._T_lidar_cam = list[list[Array]](), list[list[Array]]()
        self._files: dict[str, _GrowingArray] = {}

    def __len__(self) -> int:
        return len(self._poses)

    def add(self, sample: Sample) -> None:
        """Add the next frame.

        Raises:
            UsageError: it has another number of images than the frames before, or images of another size.
        """
        pixels = np.array([image.pixels for image in sample.images], np.uint8)
        if self.images is None:
            self.images = len(pixels)
            self._files["clouds"] = _GrowingArray(self.folder / "clouds.npy", np.int16, (3,))
            if self.images:
                self._files["pixels"] = _GrowingArray(self.folder / "pixels.npy", np.uint8, pixels.shape)
        if len(pixels) != self.images or (self.images and pixels.shape != self._files["pixels"].row):
            raise UsageError(
                f"{self.folder}: some frames have an image and some have none, or another size; "
                "--set input.images=false packs them without"
            )
        self._files["clouds"].append(np.round(sample.cloud / QUANTUM).clip(-32767, 32767).astype(np.int16))
        self._offsets.append(self._offsets[-1] + len(sample.cloud))
        self._poses.append(sample.pose)
        if self.images:
            self._files["pixels"].append(pixels[None])
            self._K.append([image.camera.K for image in sample.images])
            self._T_lidar_cam.append([image.camera.T_lidar_cam for image in sample.images])

    def finish(self, about: dict[str, object]) -> None:
        """Complete the drive; `about` describes its origin."""
        for file in self._files.values():
            file.close()
        np.save(self.folder / "offsets.npy", np.array(self._offsets))
        np.save(self.folder / "poses.npy", np.stack(self._poses))
        if self.images:
            np.save(self.folder / "K.npy", np.array(self._K))
            np.save(self.folder / "T_lidar_cam.npy", np.array(self._T_lidar_cam))
        (self.folder / "about.json").write_text(json.dumps({"format": FORMAT, **about}, indent=1))

    def close(self) -> None:
        """Close the files, whether or not the drive is complete."""
        for file in self._files.values():
            with suppress(OSError):  # a full disk: the incomplete folder is removed
                file.close()


@contextmanager
def packed_writer(folder: Path) -> Iterator[PackedWriter]:
    """A writer whose folder appears only when the block ends without error; a killed run leaves no incomplete drive.

    Raises:
        Dpm2Error: files could not be written.
    """
    with new_folder(folder, replace=True) as part:
        writer = PackedWriter(part)
        try:
            yield writer
        finally:
            writer.close()


class _GrowingArray:
    """A .npy file whose first axis grows: numpy reserves space for it in the header."""

    def __init__(self, path: Path, dtype: type, row: tuple[int, ...]) -> None:
        self.row, self._dtype, self._count = row, np.dtype(dtype), 0
        self._file = path.open("wb")
        self._header()

    def append(self, rows: NDArray) -> None:
        """Append (n, *row) rows."""
        np.ascontiguousarray(rows, self._dtype).tofile(self._file)
        self._count += len(rows)

    def close(self) -> None:
        """Write the number of rows and close the file; a second call does nothing."""
        if not self._file.closed:
            self._file.seek(0)
            self._header()
            self._file.close()

    def _header(self) -> None:
        shape = (self._count, *self.row)
        head = {"descr": np.lib.format.dtype_to_descr(self._dtype), "fortran_order": False, "shape": shape}
        np.lib.format.write_array_header_1_0(self._file, head)


def write_packed(folder: Path, samples: Iterable[Sample], about: dict[str, object]) -> None:
    """Write a drive of at least one frame; see `packed_writer`."""
    with packed_writer(folder) as writer:
        for sample in samples:
            writer.add(sample)
        writer.finish(about)


class PackedDrive:
    """A packed drive, opened lazily: `poses` (n, 4, 4) in memory, the rest memory-mapped.

    Attributes:
        has_images: whether its frames have images. image_size: their height and width, pixels; None without images.
        preset: preset of the synthetic city; empty for drives from elsewhere.

    Raises:
        UsageError: the folder is not a packed drive, or is damaged.
    """

    def __init__(self, folder: Path) -> None:
        try:
            self.about = json.loads((folder / "about.json").read_text())
            self.poses: Array = np.load(folder / "poses.npy", allow_pickle=False)
            self.offsets = np.load(folder / "offsets.npy", allow_pickle=False)
            self.has_images = (folder / "pixels.npy").exists()
            clouds_shape, *image_shapes = [
                _memory_mapped(folder, name).shape for name in ("clouds", *(_IMAGE_FILES if self.has_images else ()))
            ]
        except (EOFError, MemoryError, OSError, RecursionError, TypeError, ValueError) as error:
            raise UsageError(f"{folder}: no packed drive: {error}") from None
        format = self.about.get("format") if isinstance(self.about, dict) else None
        if format != FORMAT:
            raise UsageError(f"{folder}: packed format {format}, want {FORMAT}: pack it again")
        frames = len(self.poses)
        shapes_match = self.poses.shape[1:] == (4, 4) and self.offsets.shape == (frames + 1,)
        if not shapes_match or clouds_shape != (self.offsets[-1], 3) or np.any(np.diff(self.offsets) < 0):
            raise UsageError(f"{folder}: poses, offsets and clouds do not fit each other: pack it again")
        if any(shape[0] != frames for shape in image_shapes):
            raise UsageError(f"{folder}: poses, images and their calibration do not fit each other: pack it again")
        if not np.isfinite(self.poses).all():
            raise UsageError(f"{folder}: a pose is not finite: pack it again")
        self.image_size: tuple[int, int] | None = image_shapes[0][2:4] if image_shapes else None
        self.folder = folder
        self.preset = str(self.about.get("preset", ""))
        self.name = folder.name
        self._arrays: dict[str, NDArray] = {}

    def __len__(self) -> int:
        return len(self.poses)

    def __getitem__(self, index: int) -> Sample:
        start, end = self.offsets[index : index + 2]
        cloud = self._array("clouds")[start:end].astype(np.float32) * np.float32(QUANTUM)
        return Sample(cloud, self.poses[index], self._images(index))

    def _array(self, name: str) -> NDArray:
        if name not in self._arrays:
            self._arrays[name] = _memory_mapped(self.folder, name)
        return self._arrays[name]

    def _images(self, index: int) -> tuple[Image, ...]:
        if not self.has_images:
            return ()
        pixels, K, T = (self._array(name)[index] for name in _IMAGE_FILES)
        return tuple(
            Image(np.array(p), Camera(np.array(k), np.array(t), (p.shape[1], p.shape[0])))
            for p, k, t in zip(pixels, K, T, strict=True)
        )


def _memory_mapped(folder: Path, name: str) -> NDArray:
    return np.load(folder / f"{name}.npy", mmap_mode="r", allow_pickle=False)


def _is_unfinished(folder: Path) -> bool:
    return any(name.endswith(".part") for name in folder.parts)


def open_packed(root: Path) -> list[PackedDrive]:
    """Every packed drive below `root`, by name.

    Raises:
        UsageError: there is no packed drive.
    """
    folders = (path.parent for path in sorted(root.rglob("about.json")))
    found = [PackedDrive(folder) for folder in folders if not _is_unfinished(folder.relative_to(root))]
    if not found:
        raise UsageError(f"{root}: no packed drive below it; `dpm2 train pack` makes some")
    return found


def scans_of(drives: Iterable[PackedDrive]) -> set[bytes]:
    """Identifiers of all scans: position of the scan and its number of points. They are the same if a part of the drive
    is packed again. Scans at the origin are left out, since many drives begin there."""
    scans = ((t, n) for d in drives for t, n in zip(d.poses[:, :3, 3], np.diff(d.offsets), strict=True))
    return {t.tobytes() + n.tobytes() for t, n in scans if t.any()}


def packed_digest(drives: Iterable[PackedDrive]) -> str:
    """Digest of drives, 16 characters: number of points and pose of each frame, and the images of the first and last.
    The images count because the same world in other weather has the same points."""
    digest = hashlib.sha256()
    for drive in drives:
        digest.update(drive.offsets.tobytes() + drive.poses.tobytes())
        for index in range(len(drive))[:: max(1, len(drive) - 1)]:
            for image in drive[index].images:
                digest.update(image.pixels.tobytes() + image.camera.K.tobytes() + image.camera.T_lidar_cam.tobytes())
    return digest.hexdigest()[:16]
