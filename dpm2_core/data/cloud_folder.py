# SPDX-License-Identifier: Apache-2.0
"""A folder of PCD or PLY files, one per scan, as a `Source`."""

from __future__ import annotations

import os
import re
import struct
from collections.abc import Mapping
from decimal import Decimal
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from dpm2_core.data.frames import Calibration, FrameBuilder
from dpm2_core.data.messages import point_cloud
from dpm2_core.data.ply import read_vertices
from dpm2_core.data.settings import InputSettings
from dpm2_core.data.source import IndexedSource
from dpm2_core.data.text import date_ns
from dpm2_core.errors import UsageError, one_line
from dpm2_core.extras import needs
from dpm2_core.frame import NO_POINTS, Frame

SUFFIXES = (".pcd", ".ply")
_MAX_SCAN_PERIOD = 30_000_000_000  # ns between scans: if it is longer, the numbers are something else, such as ms
_PCD_HEADER_LINES = 10  # of a header: the package reads no more
_MAX_COMPRESSION = 100  # largest accepted compression ratio: LZF makes at most 264 bytes from 3
_MAX_COLUMNS = 1000  # of a PCD file; a normal with curvature has 4, a histogram of features 308
_SECONDS_AND_FRACTION = re.compile(r"(?:.*\D)?(\d{9,10})[_-](\d{1,9})")
"""Seconds since 1970 and their fraction, of 3, 6 or 9 digits; nanoseconds also without leading zeros."""
_EPOCH_RANGES = ((10**8, 10**11, 10**9), (10**11, 10**14, 10**6), (10**14, 10**17, 10**3), (10**17, 10**20, 1))
"""Range from, to, and ns per unit: numbers in names that are times since 1970, after 1973."""

_MAX_MEDIAN_STEP = 3  # a median step above this multiple of the common divisor: no count of scans, but ms of a clock


class CloudFolder(IndexedSource):
    """Scans in the order of the numbers in their names. See `Source`; no images and no ground truth.

    Fields are those of PointCloud2: intensity, and the time of each point, under their usual names. The stamp is the
    last number in the name if all of these are times since 1970 (s, ms, us or ns). It may also be the last two numbers,
    seconds and their fraction, or a date and time of day. Else scans are `input.period` apart, more where numbers are
    missing.

    Raises:
        UsageError: no such file in the folder, or the package that reads PCD is not installed.
    """

    def __init__(self, path: Path | str, settings: InputSettings | None = None) -> None:
        folder, settings = Path(path), settings or InputSettings()
        found = [file for file in folder.iterdir() if file.suffix.lower() in SUFFIXES] if folder.is_dir() else []
        if not found:
            raise UsageError(f"{folder}: no .pcd or .ply file in this folder")
        super().__init__(folder.resolve().name, len(found))
        times = name_times(found)
        if times:
            self._files = [found[i] for i in np.argsort(times)]
            self.stamps = np.sort(np.array(times, np.int64))
        else:
            self._files = sorted(
                found, key=lambda file: (not _numbers_in_name(file), _numbers_in_name(file), file.name)
            )
            numbers = _scan_indices(self._files)
            self.stamps = settings.steady_stamps(numbers, f"{folder}: the names are not times", self.notes)
            if missing := int(numbers[-1]) + 1 - len(numbers):
                self.notes.append(f"{folder}: {missing} numbers are missing among the names: counted as missing scans")
        if any(file.suffix.lower() == ".pcd" for file in self._files):
            _pcd_types()  # report a missing package now, not at the first scan
        self._frames = FrameBuilder(settings, Calibration(self.name), self.notes.append)

    def frame(self, position: int) -> Frame:
        """See `IndexedSource`."""
        file, stamp = self._files[position], int(self.stamps[position])
        try:
            frame = self._frames.frame(stamp, _read_cloud(file, stamp), position)
        except UsageError as error:
            self.notes.append(str(error))
            return Frame(stamp, NO_POINTS, index=position, problem=str(error))
        if self._frames.time_problem and not any(self._frames.time_problem in note for note in self.notes):
            self.notes.append(f"{file}: {self._frames.time_problem}")
        return frame


def _read_cloud(path: Path, stamp: int) -> Any:
    """A file as a sensor_msgs/PointCloud2, so that it is decoded like any cloud message."""
    columns = _read_pcd(path) if path.suffix.lower() == ".pcd" else read_vertices(path)
    # PointField has no 64-bit integers, as in times since 1970 in ns; only their differences matter.
    parts = {name: part.astype(np.float64) if part.dtype.itemsize == 8 else part for name, part in columns.items()}
    if not parts:
        raise UsageError(f"{path}: no fields")
    return point_cloud(parts, stamp)


def _read_pcd(path: Path) -> Mapping[str, NDArray[Any]]:
    MetaData, PointCloud = _pcd_types()
    try:
        with path.open("rb") as file:
            _check_header(MetaData.parse_header(_pcd_header(file)), file)
        cloud = PointCloud.from_path(path)
        return {name: np.ascontiguousarray(cloud.pc_data[name]) for name in cloud.fields}
    except Exception as error:  # damaged headers and data raise anything from ValueError to lzf's own errors
        raise UsageError(f"{path}: cannot be read as PCD: {one_line(error)[:200]}") from None


def _pcd_types() -> tuple[Any, Any]:
    with needs("datasets", "reading PCD"):
        from pypcd4 import MetaData, PointCloud
    return MetaData, PointCloud


def _pcd_header(file: BinaryIO) -> list[str]:
    """The lines that the package reads as the header; the data follow."""
    lines = list[str]()
    while len(lines) < _PCD_HEADER_LINES and not (lines and lines[-1].startswith("DATA")) and (line := file.readline()):
        if (text := line.decode().strip()) and not text.startswith("#"):
            lines.append(text)
    return lines


def _check_header(header: Any, file: BinaryIO) -> None:
    """Check a header before the package uses it. The package makes a name for each column, which is gigabytes for a few
    digits in a header. It also accepts less data than announced, or allocates memory for data that is not there.

    Args:
        file: at the start of its data.

    Raises:
        ValueError: there are too many columns, or the amount of data differs.
    """
    if sum(header.count) > _MAX_COLUMNS:
        raise ValueError(f"more than {_MAX_COLUMNS} columns")
    expected = header.points * int(np.dot(header.size, header.count))
    remaining = os.fstat(file.fileno()).st_size - file.tell()
    compressed = header.data.value == "binary_compressed" and expected > 0
    max_bytes = _MAX_COMPRESSION * remaining if compressed else remaining
    if (header.data.value != "ascii" and expected > max_bytes) or (
        compressed and struct.unpack("<II", file.read(8))[1] != expected
    ):
        raise ValueError(f"{header.points} points announced, in {remaining} bytes")


def _scan_indices(files: list[Path]) -> NDArray[np.int64]:
    """(N,) index of each of the sorted files in the drive, starting at 0. By the last numbers in their names if these
    count scans, of which some may be missing; else the files are consecutive."""
    last = [numbers[-1] for file in files if (numbers := _numbers_in_name(file))]
    are_integers = len(last) == len(files) > 1 and all(number == int(number) and number < 10**15 for number in last)
    steps = np.diff(np.array([int(number) for number in last], np.int64)) if are_integers else np.zeros(1, np.int64)
    divisor = max(int(np.gcd.reduce(steps)), 1)
    if steps.min() < 1 or np.median(steps) > _MAX_MEDIAN_STEP * divisor:
        return np.arange(len(files))
    return np.concatenate([[0], np.cumsum(steps // divisor)])


def _numbers_in_name(file: Path) -> list[Decimal]:
    """All numbers in a name, in order: of 2023-11-14_22-13-20_750 as of scan_012."""
    return [Decimal(number) for number in re.findall(r"\d+(?:\.\d+)?", file.stem)]


def name_times(files: list[Path]) -> list[int]:
    """ns of each file from its name; empty unless all names are different times since 1970, of one drive."""
    dates = [date for file in files if (date := date_ns(file.stem)) is not None]
    pairs = [match for file in files if (match := _SECONDS_AND_FRACTION.fullmatch(file.stem))]
    widths = {len(match[2]) for match in pairs}
    if len(dates) == len(files):
        times = dates
    elif len(pairs) == len(files) and (max(widths) == 9 or widths in ({6}, {3})):
        times = [int(match[1]) * 10**9 + int(match[2]) * 10 ** (9 - max(widths)) for match in pairs]
    else:
        last = [numbers[-1] for file in files if (numbers := _numbers_in_name(file))]
        matching = ((low, high, ns) for low, high, ns in _EPOCH_RANGES if all(low <= number < high for number in last))
        times = [round(number * ns) for *_, ns in matching for number in last]
    steps = np.diff(np.unique(np.array(times, np.int64)))
    one_drive = len(steps) + 1 == len(files) and (not len(steps) or np.median(steps) <= _MAX_SCAN_PERIOD)
    return times if one_drive else []
