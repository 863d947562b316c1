# SPDX-License-Identifier: Apache-2.0
"""Scans in SemanticKITTI's layout (Behley et al., ICCV 2019): sequences/NN/{velodyne,labels};
`dpm2 sim` writes static/ next to them.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import torch
from numpy.typing import DTypeLike, NDArray

from dpm2_core.errors import UsageError
from dpm2_core.frame import Points
from dpm2_core.tasks.scan import RequiredData, TaskScan

_POINT_BYTES = {"velodyne": 16, "static": 16, "labels": 4}
"""Bytes of a point in a file of that folder."""
_PART = 4096
"""Bytes of a file that are compared: one block of a disk."""


def sequence_folders(path: Path) -> list[Path]:
    """Folders that contain velodyne/; these are not searched further."""
    found = []
    for folder, subfolders, _ in os.walk(path, followlinks=True):
        if "velodyne" in subfolders:
            found.append(Path(folder))
            subfolders.clear()
    return sorted(found)


def kitti_runs(folder: Path, root: Path, needs: Sequence[RequiredData]) -> list[_KittiRun]:
    """The scans of a folder, split where numbers are missing. Their files are checked: present, of the right length."""
    numbers = sorted(int(p.stem) for p in (folder / "velodyne").glob("*.bin") if p.stem.isdecimal())
    if not numbers:
        raise UsageError(f"{folder}: no scans (velodyne/NNNNNN.bin)")
    for need in needs:
        if not (folder / need).is_dir():
            raise UsageError(f"{folder}: no {need}/ next to velodyne/; this task needs it")
    name = str(folder.relative_to(root)) if folder != root else folder.resolve().name
    run = _KittiRun(folder, name, (folder / "labels").is_dir(), (folder / "static").is_dir(), numbers)
    for number in numbers:
        run.check(number)
    cuts = [0, *(i + 1 for i, (a, b) in enumerate(pairwise(numbers)) if b != a + 1), len(numbers)]
    return [replace(run, numbers=numbers[a:b]) for a, b in pairwise(cuts)]


@dataclass(frozen=True)
class _KittiRun:
    """Scans of one sequence folder whose numbers follow each other."""

    folder: Path
    name: str
    has_labels: bool
    has_static: bool
    numbers: list[int]

    def __len__(self) -> int:
        return len(self.numbers)

    def __getitem__(self, index: int) -> TaskScan:
        number = self.numbers[index]
        points, valid = self._points("velodyne", number)
        labels, static = None, None
        if self.has_labels:
            classes = (self._values("labels", number, "<u4") & 0xFFFF).astype(np.int64)
            if len(classes) != len(valid):
                raise UsageError(f"{self._path('labels', number)}: {len(classes)} labels for {len(valid)} points")
            labels = torch.from_numpy(classes[valid])
        if self.has_static:
            static = torch.from_numpy(self._points("static", number)[0])
        return TaskScan(torch.from_numpy(points), labels, static, self.name, number)

    def fingerprint(self, index: int) -> bytes:
        """Size and middle of each file of a scan."""
        kinds = ["velodyne", *["labels"] * self.has_labels, *["static"] * self.has_static]
        return b"".join(_size_and_middle(self._path(kind, self.numbers[index])) for kind in kinds)

    def _points(self, kind: str, number: int) -> tuple[Points, NDArray[np.bool_]]:
        """(N, 4) with finite coordinates, 0 for an unknown intensity, and which points of the file they are."""
        points = self._values(kind, number, "<f4").reshape(-1, 4)
        valid = np.isfinite(points[:, :3]).all(1)
        if not valid.any():
            raise UsageError(f"{self._path(kind, number)}: no valid points")
        return np.nan_to_num(points[valid], nan=0, posinf=0, neginf=0), valid

    def check(self, number: int) -> None:
        """Raise UsageError unless the files of a scan exist and have the right length."""
        points = self._count("velodyne", number)
        if self.has_static:
            self._count("static", number)
        if self.has_labels and (labels := self._count("labels", number)) != points:
            raise UsageError(f"{self._path('labels', number)}: {labels} labels for {points} points")

    def _path(self, kind: str, number: int) -> Path:
        return self.folder / kind / f"{number:06d}.{'label' if kind == 'labels' else 'bin'}"

    def _count(self, kind: str, number: int) -> int:
        path = self._path(kind, number)
        try:
            size = path.stat().st_size
        except OSError as error:
            raise UsageError(f"{path}: {error.strerror}") from None
        if size % _POINT_BYTES[kind]:
            raise UsageError(f"{path}: {size} bytes are not a multiple of {_POINT_BYTES[kind]}; damaged or cut off")
        if size == 0:
            raise UsageError(f"{path}: the file is empty")
        return size // _POINT_BYTES[kind]

    def _values(self, kind: str, number: int, dtype: DTypeLike) -> np.ndarray:
        self._count(kind, number)
        return np.fromfile(self._path(kind, number), dtype)


def _size_and_middle(path: Path) -> bytes:
    try:
        with path.open("rb", buffering=0) as file:
            size = os.fstat(file.fileno()).st_size
            file.seek(max(0, (size - _PART) // 2))
            return size.to_bytes(8, "little") + file.read(_PART)
    except OSError as error:
        raise UsageError(f"{path}: {error.strerror}") from None
