# SPDX-License-Identifier: Apache-2.0
"""The interface of every loader: a drive as frames in time order, read lazily."""

from __future__ import annotations

import hashlib
from abc import ABC, abstractmethod
from collections.abc import Iterator
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from dpm2_core.errors import UsageError
from dpm2_core.frame import Array, Frame, is_rigid

Span = tuple[int, int | None]
"""Position of the first frame, and of the one after the last; None: to the end."""
ROUNDED = 0.01
"""Deviation of a rotation from an orthonormal one that is rounding: some files have three decimals."""


class Source(Protocol):
    """A drive.

    Attributes:
        name: name of the drive in reports, such as "04" or the bag's file name.
        notes: messages for the user, each once (a missing Tr, the chosen topics). Reading frames may add some.
        truth: origin of `poses`: a file, relative to the data set's root, or a topic; empty without ground truth.
    """

    name: str
    notes: list[str]

    @property
    def truth(self) -> str: ...

    @property
    def poses(self) -> Array | None:
        """(len, 4, 4) float64 T_world_lidar ground truth, one per frame, NaN where unknown; None without any."""
        ...

    @property
    def T_cam_lidar(self) -> Array | None:
        """(4, 4) LiDAR to left camera 0 (KITTI's Tr); None if the calibration has none."""
        ...

    def __len__(self) -> int:
        """Number of frames."""
        ...

    def frames(self, start: int = 0, stop: int | None = None) -> Iterator[Frame]:
        """Frames start..stop-1 by position, read one at a time; an unreadable frame has `problem` set."""
        ...


class IndexedSource(ABC):
    """A `Source` of frames that can be read in any order. Subclasses set the attributes that they have values for."""

    truth = ""
    poses: Array | None = None
    T_cam_lidar: Array | None = None

    def __init__(self, name: str, count: int) -> None:
        self.name, self.notes, self._count = name, list[str](), count

    def __len__(self) -> int:
        return self._count

    @abstractmethod
    def frame(self, position: int) -> Frame:
        """The frame at a position, the same at every call; an unreadable frame has `problem` set."""

    def frames(self, start: int = 0, stop: int | None = None) -> Iterator[Frame]:
        """Frames start..stop-1 by position, read one at a time."""
        return map(self.frame, range(len(self))[start:stop])

    def _note_unposed(self, where: object, known: NDArray[np.bool_]) -> None:
        """Add a note with the number of frames that have no pose; `known` (len,): which frames have one."""
        if not known.all():
            self.notes.append(f"{where}: {(~known).sum()} of {len(self)} frames have no pose")


def true_poses(source: Source) -> Array | None:
    """`Source.poses`, checked before they are used: a source may be a user's own.

    Raises:
        UsageError: not one for each frame, or one that is known is no rigid transform.
    """
    poses = source.poses
    if poses is None:
        return None
    if np.shape(poses) != (len(source), 4, 4):
        raise UsageError(f"{source.name}: poses of shape {np.shape(poses)}, want ({len(source)}, 4, 4)")
    poses = np.asarray(poses, np.float64)
    for position in np.flatnonzero(np.isfinite(poses).all((1, 2))):
        if not is_rigid(poses[position], ROUNDED):
            raise UsageError(f"{source.name}: pose {position} is no rigid transform (is it transposed?)")
    return poses


def frame_at(source: Source, position: int) -> Frame:
    """The frame at a position of a drive; for a bag this reads all frames before it."""
    return next(iter(source.frames(position, position + 1)))


def note_once(notes: list[str], what: str, detail: str = "") -> None:
    """Add a note to those of a drive, with a detail, unless a note that begins with `what` is there already."""
    if not any(note.startswith(what) for note in notes):
        notes.append(f"{what} ({detail})" if detail else what)


def digest_of(source: Source) -> str:
    """Digest of a drive, 16 characters: number of frames, true poses, calibration, and points and images of the first
    frame. It changes if more frames are downloaded later, or if the ground truth is replaced."""
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
        UsageError: the text has another form.
    """
    first, colon, last = text.partition(":")
    if not colon or not all(part.isdecimal() or not part for part in (first, last)):
        raise UsageError(f"--frames {text}: want a:b, such as 0:100")
    start, stop = int(first or 0), int(last) if last else None
    if stop is not None and stop <= start:
        raise UsageError(f"--frames {text}: want a before b in a:b, such as 0:100")
    return start, stop
