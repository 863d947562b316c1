# SPDX-License-Identifier: Apache-2.0
"""CARLA-64 and ARD-16 as DSLR (AAAI 2021) publishes them: pairs of arrays of range images, static and dynamic.

A pair is s3.npy and d3.npy in one folder (a prefix, as in tests3.npy and testd3.npy, is allowed), or files of the same
number in two: s/ and d/, static/ and dynamic/, or static_out_npy/ and dynamic_out_npy/. An array is (N, 2, rows,
columns) of d and z in units of 120 m, filled. Or, not preprocessed, it is (N, rows, columns, 3 or 4) of x, y, z in m
with zeros where there is no point. Of these the authors leave out points whose x, y or z is among the smallest or the
largest hundredth of the array. x is ahead and y to the left; the columns of x, y, z may begin in any direction and run
in either direction. Those of d and z, which do not show it, begin straight ahead and run to the left.

True poses, if known, are in poses3.txt next to the pair of that number: a line of 12 numbers for each scan,
T_world_lidar row by row.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from dpm2_core.data.trajectory import read_trajectory
from dpm2_core.errors import UsageError
from dpm2_core.frame import Array
from dpm2_core.network.perception.range_image import CHANNELS, RangeImageSettings, azimuths, fill, to_points
from dpm2_core.tasks.scan import TaskScan

SCALE = 120.0
"""Length that a value of one has in the preprocessed arrays, m."""
_FOLDER_PAIRS = (("s", "d"), ("static", "dynamic"), ("static_out_npy", "dynamic_out_npy"))
_SAMPLED_SCANS = 64
"""Scans of an array that are used for percentiles and azimuths: with all scans, gigabytes would be read."""
_COMPARED_VALUES = 512
"""Values of a scan that are compared with those of before."""
_MIN_EVENNESS = 0.99
"""Least length of the mean of unit vectors that represent the columns' errors: 8 degrees, root mean square."""
_FILE_NAME = re.compile(r"(.*?)([sd])(\d+)")


@dataclass(frozen=True, eq=False)
class ImageScan(TaskScan):
    """A scan that is stored as a range image.

    Attributes:
        image, static_image: (2, rows, columns) float32, filled, in units of `SCALE`. mask, static_mask: (rows, columns)
            bool, where there was a point; true everywhere if the data do not show it.
    """

    image: Tensor
    static_image: Tensor
    mask: Tensor
    static_mask: Tensor


def open_pairs(path: Path) -> list[ArrayPair]:
    """A sequence for each pair of arrays in a folder, by number; none if it contains no arrays of these names.

    Raises:
        UsageError: an array without its twin, or of another shape than its twin; a file that is no array of numbers; or
            columns of x, y, z that do not go around in even steps.
    """
    return [ArrayPair.open(static, dynamic, number, path) for number, static, dynamic in _pairs(path)]


def _pairs(path: Path) -> Iterator[tuple[int, Path, Path]]:
    """Number, static and dynamic file of each pair."""
    groups: list[tuple[dict[tuple[str, int], Path], dict[tuple[str, int], Path]]] = [
        (_arrays_by_number(path / s), _arrays_by_number(path / d)) for s, d in _FOLDER_PAIRS
    ]
    named: dict[str, dict[tuple[str, int], Path]] = {"s": {}, "d": {}}
    for file in path.glob("*.npy"):
        if match := _FILE_NAME.fullmatch(file.stem):
            named[match[2]][match[1], int(match[3])] = file
    for static, dynamic in [*groups, (named["s"], named["d"])]:
        for key in sorted(static.keys() ^ dynamic.keys()):
            unpaired = static.get(key) or dynamic[key]
            raise UsageError(f"{unpaired}: no {'dynamic' if key in static else 'static'} twin of the same number")
        yield from ((key[1], static[key], dynamic[key]) for key in sorted(static))


def _arrays_by_number(folder: Path) -> dict[tuple[str, int], Path]:
    """The arrays of a folder by the number at the end of their names."""
    found = {file: re.search(r"(\d+)$", file.stem) for file in folder.glob("*.npy")}
    return {("", int(match[1])): file for file, match in found.items() if match}


@dataclass(frozen=True, eq=False)
class ArrayPair:
    """One pair of arrays as a sequence of scans; the files stay on the disk.

    Attributes:
        number: of the pair. limits: (2, 3) smallest and largest x, y, z of points that are used, m; None for filled
            arrays.
        root: folder of the pairs. columns: (columns,) of the arrays by azimuth; None: as they are.
    """

    static: np.ndarray
    dynamic: np.ndarray
    path: Path
    number: int
    root: Path
    limits: Array | None = None
    static_limits: Array | None = None
    columns: NDArray[np.intp] | None = None

    @staticmethod
    def open(static: Path, dynamic: Path, number: int, root: Path) -> ArrayPair:
        """Open two files.

        Raises:
            UsageError: as `open_pairs`.
        """
        arrays = [_open_array(static), _open_array(dynamic)]
        if arrays[0].shape != arrays[1].shape:
            raise UsageError(f"{dynamic}: shape {arrays[1].shape}, its static twin {static.name} has {arrays[0].shape}")
        static_limits, limits = (_limits(array) for array in arrays)
        columns = None if limits is None else _column_order(np.concatenate([*map(_sample_points, arrays)]), dynamic)
        return ArrayPair(arrays[0], arrays[1], dynamic, number, root, limits, static_limits, columns)

    @property
    def name(self) -> str:
        """The name in reports."""
        return f"{self.path.parent.name}/{self.path.stem}"

    @property
    def poses(self) -> Array | None:
        """(N, 4, 4) T_world_lidar; None if there is no file of them.

        Raises:
            UsageError: the file does not have a pose for each scan.
        """
        path = self.root / f"poses{self.number}.txt"
        if not path.is_file():
            return None
        found = read_trajectory(path)
        if found.kind != "kitti" or len(found) != len(self):
            raise UsageError(f"{path}: {len(found)} poses for {len(self)} scans; want 12 numbers a line, one for each")
        return found.poses

    def __len__(self) -> int:
        return len(self.dynamic)

    def __getitem__(self, index: int) -> ImageScan:
        image, mask = self._image(self.dynamic, self.limits, index)
        static_image, static_mask = self._image(self.static, self.static_limits, index)
        points, static = (_cloud(values, known) for values, known in ((image, mask), (static_image, static_mask)))
        return ImageScan(points, None, static, self.name, index, image, static_image, mask, static_mask)

    def fingerprint(self, index: int) -> bytes:
        """Shape and middle of both arrays of a scan."""
        rows = [array[index].ravel() for array in (self.dynamic, self.static)]  # views: only the middle is read
        middle = max(0, (rows[0].size - _COMPARED_VALUES) // 2)
        parts = [row[middle : middle + _COMPARED_VALUES].tobytes() for row in rows]
        return str(self.dynamic.shape).encode() + b"".join(parts)

    def _image(self, array: np.ndarray, limits: Array | None, index: int) -> tuple[Tensor, Tensor]:
        """Filled image, and the mask of the slots that had points."""
        values = torch.from_numpy(np.array(array[index], np.float32))
        if not bool(values.isfinite().all()):
            raise UsageError(f"{self.path}: scan {index} of the pair has values that are not finite")
        if limits is None:
            return values, values[0] > 0
        if self.columns is not None:
            values = values[:, self.columns]
        d = torch.hypot(values[..., 0], values[..., 1])
        low, high = torch.from_numpy(limits).to(values)
        within_limits = ((values[..., :3] >= low) & (values[..., :3] <= high)).all(-1)
        mask = (d >= RangeImageSettings().min_distance) & (d < SCALE) & within_limits
        image = torch.stack([d, values[..., 2]]) * mask / SCALE
        return fill(image, mask), mask


def _is_preprocessed(array: np.ndarray) -> bool:
    return array.shape[1] == CHANNELS


def _limits(array: np.ndarray) -> Array | None:
    """(2, 3) limits of 98 % of all x, of all y and of all z, empty slots included, as the authors do it."""
    if _is_preprocessed(array):
        return None
    return np.asarray(np.nanpercentile(_sample_points(array).reshape(-1, 3), [1, 99], axis=0))


def _sample_points(array: np.ndarray) -> Array:
    """(n, rows, columns, 3) x, y, z of some scans of an array."""
    return np.asarray(array[:: max(1, len(array) // _SAMPLED_SCANS), ..., :3], np.float64)


def _column_order(xyz: Array, path: Path) -> NDArray[np.intp] | None:
    """(columns,) index of the column of x, y, z at each of `azimuths`; None if no slot has a point."""
    x, y = xyz[..., 0], xyz[..., 1]
    has_point = np.isfinite(x) & np.isfinite(y) & (np.hypot(x, y) > 0)
    if not has_point.any():
        return None
    count = has_point.shape[-1]
    angle, centers = np.arctan2(y, x)[has_point], np.broadcast_to(azimuths(count).numpy(), has_point.shape)[has_point]
    left, right = (np.exp(1j * (angle - direction * centers)).mean() for direction in (1, -1))
    offset = left if abs(left) >= abs(right) else right
    if abs(offset) < _MIN_EVENNESS:
        raise UsageError(
            f"{path}: its columns, or those of its twin, are not at equal steps of azimuth around the sensor"
        )
    start = round(float(np.angle(offset)) / (2 * np.pi) * count)
    column = np.arange(count)
    return (column - start if offset is left else start - 1 - column) % count


def _open_array(path: Path) -> np.ndarray:
    try:
        array: np.ndarray = np.load(path, mmap_mode="r", allow_pickle=False)
    except (OSError, ValueError, EOFError) as error:
        raise UsageError(f"{path}: no array of numbers: {str(error).splitlines()[0]}") from None
    if array.ndim != 4 or array.dtype.kind != "f" or not (_is_preprocessed(array) or array.shape[3] in (3, 4)):
        raise UsageError(
            f"{path}: shape {array.shape} {array.dtype}; want floating-point (N, 2, rows, columns) of d and z "
            "or (N, rows, columns, 3 or 4) of x, y, z"
        )
    return array


def _cloud(image: Tensor, mask: Tensor) -> Tensor:
    """(N, 4) points, m, of the slots that had one; intensity 0: there is none."""
    points = to_points(image, SCALE)[mask.flatten()]
    return torch.cat([points, points.new_zeros(len(points), 1)], 1)
