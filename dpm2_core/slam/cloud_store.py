# SPDX-License-Identifier: Apache-2.0
"""Keyframe clouds on disk: the memory of a drive does not grow with its clouds."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from contextlib import suppress
from typing import BinaryIO, overload

import numpy as np

from dpm2_core.frame import Points


class CloudStore(Sequence[Points]):
    """An append-only sequence of (M, 4) float32 clouds in an anonymous file, gone when the process is.

    A disk that is full or not there is no reason to lose a map: the clouds then stay in memory.
    """

    def __init__(self) -> None:
        self._where: list[tuple[int, int] | Points] = []  # offset and number of points, or the points themselves
        self._end = 0
        self._file: BinaryIO | None = None
        with suppress(OSError):
            self._file = tempfile.TemporaryFile(prefix="dpm2_clouds_", buffering=0)  # noqa: SIM115

    def append(self, points: Points) -> None:
        """Add a cloud (M, 4)."""
        try:
            if self._file is None:
                raise OSError("no temporary file")
            self._file.seek(self._end)
            data = np.ascontiguousarray(points, np.float32)
            if self._file.write(data.tobytes()) != data.nbytes:
                raise OSError("disk full")
        except OSError:
            self._where.append(points)
            return
        self._where.append((self._end, len(points)))
        self._end += data.nbytes

    def __len__(self) -> int:
        return len(self._where)

    @overload
    def __getitem__(self, index: int) -> Points: ...

    @overload
    def __getitem__(self, index: slice) -> list[Points]: ...

    def __getitem__(self, index: int | slice) -> Points | list[Points]:
        if isinstance(index, slice):
            return [self[i] for i in range(len(self))[index]]
        where = self._where[index]
        if isinstance(where, np.ndarray):
            return where
        assert self._file is not None
        offset, count = where
        self._file.seek(offset)
        return np.frombuffer(bytearray(self._file.read(16 * count)), np.float32).reshape(count, 4)
