# SPDX-License-Identifier: Apache-2.0
"""What every loader offers: a drive as lazily read frames in time order."""

from __future__ import annotations

import hashlib
from abc import ABC, abstractmethod
from collections.abc import Iterator
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from dpm2_core.errors import UsageError
from dpm2_core.frame import Array, Frame

Span = tuple[int, int | None]
"""Positions of the first frame and of the one after the last; None: to the end."""


class Source(Protocol):
    """A drive.

    Attributes:
        name: what reports call it, such as "04" or the bag's file name.
        notes: messages for the user, each once (a missing Tr, topics chosen), in words. Reading frames may add to it.
        truth: what `poses` are read from, a file below the data set's root or a topic; empty without any.
    """

    name: str
    notes: list[str]

    @property
    def truth(self) -> str: ...

    @property
    def poses(self) -> Array | None:
        """(len, 4, 4) float64 T_world_lidar ground truth, one a frame, NaN where unknown; None without any."""
        ...

    @property
    def T_cam_lidar(self) -> Array | None:
        """(4, 4) LiDAR to left camera 0 (KITTI's Tr), None when the calibration has none."""
        ...

    def __len__(self) -> int:
        """Number of frames."""
        ...

    def frames(self, start: int = 0, stop: int | None = None) -> Iterator[Frame]:
        """Frames start..stop-1 by position, read one at a time; an unreadable one comes with `problem` set."""
        ...


class IndexedSource(ABC):
    """A `Source` of frames that can be read in any order. What is None or empty here its kinds find, or do without."""

    truth = ""
    poses: Array | None = None
    T_cam_lidar: Array | None = None

    def __init__(self, name: str, count: int) -> None:
        self.name, self.notes, self._count = name, list[str](), count

    def __len__(self) -> int:
        return self._count

    @abstractmethod
    def frame(self, position: int) -> Frame:
        """The frame at a position, the same whenever it is asked for; an unreadable one comes with `problem` set."""

    def frames(self, start: int = 0, stop: int | None = None) -> Iterator[Frame]:
        """Frames start..stop-1 by position, read one at a time."""
        return map(self.frame, range(len(self))[start:stop])

    def _note_unposed(self, where: object, known: NDArray[np.bool_]) -> None:
        """Say of how many frames there is no pose; `known` (len,)."""
        if not known.all():
            self.notes.append(f"{where}: {(~known).sum()} of {len(self)} frames have no pose")


def frame_at(source: Source, position: int) -> Frame:
    """The frame at a position of a drive; of a bag that reads all before it."""
    return next(iter(source.frames(position, position + 1)))


def note_once(notes: list[str], what: str, detail: str = "") -> None:
    """Add to the notes of a drive what is to be said of it, with a detail, unless it is there with any."""
    if not any(note.startswith(what) for note in notes):
        notes.append(f"{what} ({detail})" if detail else what)


def digest_of(source: Source) -> str:
    """What a drive holds, in 16 characters: how many frames, their true poses, the calibration, and the points and
    images of the first: more frames that were downloaded since, or another truth, make another one."""
    poses, T = (b"" if array is None else array.tobytes() for array in (source.poses, source.T_cam_lidar))
    digest = hashlib.sha256(str(len(source)).encode() + poses + T)
    for frame in source.frames(0, 1):
        digest.update(frame.points.tobytes())
        for image in frame.images:
            digest.update(image.pixels.tobytes() + image.camera.K.tobytes() + image.camera.T_lidar_cam.tobytes())
    return digest.hexdigest()[:16]


def parse_range(text: str) -> Span:
    """`a:b`, `a:`, `:b` or `:` to (a, b or None).

    Raises:
        UsageError: it is something else.
    """
    first, colon, last = text.partition(":")
    if not colon or not all(part.isdecimal() or not part for part in (first, last)):
        raise UsageError(f"--frames {text}: want a:b, such as 0:100")
    start, stop = int(first or 0), int(last) if last else None
    if stop is not None and stop <= start:
        raise UsageError(f"--frames {text}: want a before b in a:b, such as 0:100")
    return start, stop
