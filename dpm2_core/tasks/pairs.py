# SPDX-License-Identifier: Apache-2.0
"""CARLA-64 and ARD-16 as DSLR (AAAI 2021) publishes them: pairs of arrays of range images, static and dynamic.

A pair is s3.npy and d3.npy in one folder (a prefix, as in tests3.npy and testd3.npy, is allowed), or files of the same
number in two: s/ and d/, static/ and dynamic/, or static_out_npy/ and dynamic_out_npy/. An array is (N, 2, rows,
columns) of d and z in units of 120 m, filled; or, before that, (N, rows, columns, 3 or 4) of x, y, z in m with zeros
where there is no point.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from dpm2_core.errors import UsageError
from dpm2_core.network.perception.range_image import CHANNELS, RangeImageSettings, fill, to_points
from dpm2_core.tasks.scan import ScanSequence, TaskScan

SCALE = 120.0
"""What a value of one stands for in the preprocessed arrays, m."""
_FOLDERS = (("s", "d"), ("static", "dynamic"), ("static_out_npy", "dynamic_out_npy"))
_NAMED = re.compile(r"(.*?)([sd])(\d+)")


@dataclass(frozen=True, eq=False)
class ImageScan(TaskScan):
    """A scan that is a range image from the start.

    Attributes:
        image, static_image: (2, rows, columns) float32, filled, in units of `SCALE`. mask, static_mask: (rows, columns)
            bool, where there was a point; true everywhere if the data do not say.
    """

    image: Tensor
    static_image: Tensor
    mask: Tensor
    static_mask: Tensor

    def to(self, device: torch.device) -> ImageScan:
        """The scan on a device."""
        names = ("points", "static", "image", "static_image", "mask", "static_mask")
        return replace(self, **{name: getattr(self, name).to(device) for name in names})


def open_pairs(path: Path) -> list[ScanSequence]:
    """A sequence for each pair of arrays in a folder, by number; none if it holds no arrays of these names.

    Raises:
        UsageError: an array without its twin, of another shape than it, or no array of numbers.
    """
    found = [_ArrayPair.open(static, dynamic) for static, dynamic in _pairs(path)]
    return [*found]


def _pairs(path: Path) -> Iterator[tuple[Path, Path]]:
    """Static and dynamic files that belong together."""
    groups: list[tuple[dict[tuple[str, int], Path], dict[tuple[str, int], Path]]] = [
        (_numbered(path / s), _numbered(path / d)) for s, d in _FOLDERS
    ]
    named: dict[str, dict[tuple[str, int], Path]] = {"s": {}, "d": {}}
    for file in path.glob("*.npy"):
        if match := _NAMED.fullmatch(file.stem):
            named[match[2]][match[1], int(match[3])] = file
    for static, dynamic in [*groups, (named["s"], named["d"])]:
        for key in sorted(static.keys() ^ dynamic.keys()):
            alone = static.get(key) or dynamic[key]
            raise UsageError(f"{alone}: no {'dynamic' if key in static else 'static'} twin of the same number")
        yield from ((static[key], dynamic[key]) for key in sorted(static))


def _numbered(folder: Path) -> dict[tuple[str, int], Path]:
    """Its arrays by the number that their names end with."""
    found = {file: re.search(r"(\d+)$", file.stem) for file in folder.glob("*.npy")}
    return {("", int(match[1])): file for file, match in found.items() if match}


@dataclass(frozen=True, eq=False)
class _ArrayPair:
    """One pair of arrays as a sequence of scans; the files stay on the disk."""

    static: np.ndarray
    dynamic: np.ndarray
    path: Path

    @staticmethod
    def open(static: Path, dynamic: Path) -> _ArrayPair:
        arrays = [_mapped(static), _mapped(dynamic)]
        if arrays[0].shape != arrays[1].shape:
            raise UsageError(f"{dynamic}: shape {arrays[1].shape}, its static twin {static.name} has {arrays[0].shape}")
        return _ArrayPair(arrays[0], arrays[1], dynamic)

    def __len__(self) -> int:
        return len(self.dynamic)

    def __getitem__(self, index: int) -> ImageScan:
        image, mask = self._image(self.dynamic, index)
        static_image, static_mask = self._image(self.static, index)
        points, static = (_cloud(of, known) for of, known in ((image, mask), (static_image, static_mask)))
        name = f"{self.path.parent.name}/{self.path.stem}"
        return ImageScan(points, None, static, name, index, image, static_image, mask, static_mask)

    def _image(self, array: np.ndarray, index: int) -> tuple[Tensor, Tensor]:
        """Filled image and where it had points."""
        values = torch.from_numpy(np.array(array[index], np.float32))
        if not bool(values.isfinite().all()):
            raise UsageError(f"{self.path}: scan {index} of the pair has values that are not finite")
        if _preprocessed(array):
            return values, values[0] > 0
        d = torch.hypot(values[..., 0], values[..., 1])
        mask = (d >= RangeImageSettings().min_distance) & (d < SCALE)
        image = torch.stack([d, values[..., 2]]) * mask / SCALE
        return fill(image, mask), mask


def _preprocessed(array: np.ndarray) -> bool:
    return array.shape[1] == CHANNELS


def _mapped(path: Path) -> np.ndarray:
    try:
        array: np.ndarray = np.load(path, mmap_mode="r", allow_pickle=False)
    except (OSError, ValueError, EOFError) as error:
        raise UsageError(f"{path}: no array of numbers: {str(error).splitlines()[0]}") from None
    if array.ndim != 4 or array.dtype.kind != "f" or not (_preprocessed(array) or array.shape[3] in (3, 4)):
        raise UsageError(
            f"{path}: shape {array.shape} {array.dtype}; want floating-point (N, 2, rows, columns) of d and z "
            "or (N, rows, columns, 3 or 4) of x, y, z"
        )
    return array


def _cloud(image: Tensor, mask: Tensor) -> Tensor:
    """(N, 4) points, m, of the slots that had one; intensity 0: there is none."""
    points = to_points(image, SCALE)[mask.flatten()]
    return torch.cat([points, points.new_zeros(len(points), 1)], 1)
