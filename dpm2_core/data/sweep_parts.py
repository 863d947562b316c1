# SPDX-License-Identifier: Apache-2.0
"""Joins clouds that are parts of a sweep, as of a driver that publishes each packet, to clouds that show a whole one.

One part shows too little of the scene to be registered: a tenth of a sweep of a spinning LiDAR covers 36 degrees.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from operator import itemgetter

import numpy as np

from dpm2_core.frame import NO_POINTS, Frame, Image

_PART = 0.025
"""s: a cloud that spans less is a part if the next one follows as soon. No LiDAR rotates more than 40 times per second.
"""
_STILL_PART = 0.03  # s: then parts may follow each other a little later, as halves of a sweep of 0.05 s do
# Of the period, which the parts of a sweep fill. A cloud that spans more overlaps the one before, as clouds do that
# arrive in a burst; a cloud that spans less is a whole one, as of a flash LiDAR.
_FILLED = 0.3, 1.5
SWEEP = 0.1
"""s that a joined cloud spans."""


class SweepParts:
    """Collects parts until they span a sweep.

    Clouds whose points have no times are never joined: nothing tells parts from whole clouds that arrive in a burst.
    """

    def __init__(self) -> None:
        self._stamp: int | None = None  # of the last cloud
        self._before: Frame | None = None  # the last cloud, if it may be a part, while none has been recognized
        self._parts = deque[Frame]()
        self._joins = False  # whether clouds have been recognized as parts
        self._follows = False  # whether a part of this sweep followed another one as soon as parts do

    def join(self, frame: Frame) -> Frame | None:
        """The sweep that this frame completes, with its stamp and index; the frame itself unless it is a part; None
        while the sweep is incomplete.

        The first part of a drive is returned as it is, because only the second shows that they are parts. It is in the
        first sweep as well. A sweep has only the IMU samples of its last part: the samples of a frame must be used
        also if None is returned.
        """
        step = float("inf") if self._stamp is None else (frame.stamp - self._stamp) * 1e-9
        self._stamp, period = frame.stamp, step / (1 + frame.dropped)
        if period > SWEEP:  # a pause, or whole clouds
            self._end()
        if self._joins:
            self._follows |= period < _STILL_PART
        elif not self._begins(frame, period):
            return frame
        if frame.problem is not None:
            return frame
        if step <= 0 or (frame.time_offset is None and len(frame.points)):
            self._end()
            return frame
        start, end = _times(frame)
        if end - start > 2 * SWEEP:  # wrong times: the unit is unknown if few points span little, or one is an outlier
            start, end, frame = 0.0, 0.0, replace(frame, points=NO_POINTS, time_offset=None)
        self._parts.append(_copied(frame))
        while len(self._parts) > 1 and self._spanned(end) > 2 * SWEEP:  # parts were dropped in between
            self._parts.popleft()
        if self._spanned(end) < SWEEP - (end - start) / 2:
            return None
        sweep = frame if len(self._parts) == 1 else _joined(list(self._parts), frame)
        self._parts.clear()
        if not self._follows:  # whole clouds, of which two followed each other too soon once
            self._end()
        self._follows = False
        return sweep

    def _begins(self, frame: Frame, period: float) -> bool:
        """Whether a frame and the one before, a `period` (s) earlier, are the first parts that are recognized."""
        before, self._before = self._before, None
        if not may_be_part(frame):
            return False
        start, end = _times(frame)
        filled = _FILLED[0] * period < end - start < _FILLED[1] * period
        self._joins = before is not None and period < _PART and filled
        if before is not None and self._joins:
            self._parts.append(replace(before, fix=None, dropped=0, stepped=False))
        else:
            self._before = _copied(frame)
        return self._joins

    def _end(self) -> None:
        """Join no more clouds until parts are recognized again."""
        self._parts.clear()
        self._joins, self._follows = False, False

    def _spanned(self, end: float) -> float:
        """s from the first point of the parts to the last, which was measured `end` s after the last stamp."""
        first, last = self._parts[0], self._parts[-1]
        return (last.stamp - first.stamp) * 1e-9 + end - _times(first)[0]


def whole_sweeps(frames: Iterable[Frame], start: int = 0) -> Iterator[tuple[int, Frame]]:
    """The frames from a drive's position `start` on, parts joined to sweeps, and the position of each (last) frame.

    Other than by `SweepParts`, the first part is only in the first sweep.
    """
    parts, held = SweepParts(), None
    for position, frame in enumerate(frames, start):
        sweep = parts.join(frame)
        if sweep is not None and held is not None:
            yield held
        held = None if sweep is None else (position, sweep)
        if held is not None and not (sweep is frame and may_be_part(frame)):
            yield held
            held = None
    if held is not None:
        yield held


def may_be_part(frame: Frame) -> bool:
    """Whether a frame spans no more than a part; only the next one shows whether it is one."""
    start, end = _times(frame)
    return frame.problem is None and 0 < end - start < _PART


def _times(frame: Frame) -> tuple[float, float]:
    """The first and the last time of its points, s after its stamp; zeros without times."""
    offset = frame.time_offset
    return (0.0, 0.0) if offset is None or not len(offset) else (float(offset.min()), float(offset.max()))


def _copied(frame: Frame) -> Frame:
    """With points of its own: a caller may use its arrays again."""
    offset = frame.time_offset
    return replace(frame, points=frame.points.copy(), time_offset=None if offset is None else offset.copy())


def _joined(parts: Sequence[Frame], last: Frame) -> Frame:
    """One frame at the stamp of the last part."""
    timed = [part.later((last.stamp - part.stamp) * 1e-9) for part in parts]
    offsets = [part.time_offset for part in timed if part.time_offset is not None]
    start, end = min(times[0] for times in map(_times, timed)), max(times[1] for times in map(_times, timed))
    guesses = [(abs(sum(_times(part)) - start - end), part.guess) for part in timed if part.guess is not None]
    return replace(
        last,
        points=np.concatenate([part.points for part in parts]),
        time_offset=np.concatenate(offsets) if offsets else None,
        images=_nearest([image for part in timed for image in part.images]),
        guess=min(guesses, key=itemgetter(0))[1] if guesses else None,  # nearest to the middle of the sweep
        fix=next((part.fix for part in reversed(parts) if part.fix is not None), None),
        dropped=sum(part.dropped for part in parts),
        stepped=any(part.stepped for part in parts),
    )


def _nearest(images: Sequence[Image]) -> tuple[Image, ...]:
    """Of each camera the image that was taken nearest to the stamp."""
    found = dict[str, Image]()
    for image in sorted(images, key=lambda image: -abs(image.time_offset)):
        found[image.camera.name] = image
    return tuple(found.values())
