# SPDX-License-Identifier: Apache-2.0
"""Joins clouds that are parts of a sweep, as of a driver that publishes each packet, to clouds that show a whole one.

One part shows too little of the scene to be registered: a tenth of a sweep of a spinning LiDAR covers 36 degrees.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace

import numpy as np

from dpm2_core.frame import NO_POINTS, Frame, Guess, Image
from dpm2_core.geometry import se3

MAX_PART_SPAN = 0.025
"""s: a cloud that spans less is a part if the next one follows as soon. No LiDAR rotates more than 40 times per second.
"""
MAX_PERIOD = 0.03
"""s, between recognized parts: halves of a sweep of 0.05 s jitter about `MAX_PART_SPAN`."""
# Smallest and largest span of a part, relative to the period. Clouds with a smaller span are whole ones, as of a flash
# LiDAR; clouds with a larger span overlap the previous one, as if several clouds arrive at once.
_SPAN_RATIOS = 0.3, 1.5
SWEEP = 0.1
"""s that a joined cloud spans."""


class SweepParts:
    """Collects parts until they span a sweep.

    Clouds without point times are never joined: parts look like whole clouds that arrive at once.
    """

    def __init__(self) -> None:
        self._stamp: int | None = None  # of the last cloud
        self._candidate: Frame | None = None  # the last cloud, if it may be a part, while none has been recognized
        self._parts: list[Frame] = []
        self._joining = False  # whether clouds have been recognized as parts
        self._has_close_parts = False  # whether a part of this sweep followed another one as soon as parts do
        self._has_joined = False  # whether the last sweep had such parts

    def join(self, frame: Frame) -> Frame | None:
        """The sweep that this frame completes, with its stamp and index; the frame itself unless it is a part; None
        while the sweep is incomplete.

        The first part of a drive is returned as it is, because only the second shows that they are parts. It is in the
        first sweep as well. A sweep has only the IMU samples of its last part: the samples of a frame must be used
        also if None is returned.
        """
        step = float("inf") if self._stamp is None else (frame.stamp - self._stamp) * 1e-9
        self._stamp, period = frame.stamp, step / (1 + frame.dropped)
        if period > SWEEP:
            self._resume(frame)
        if self._joining:
            self._has_close_parts |= period < MAX_PERIOD
        elif not self._recognize_parts(frame, period):
            return frame
        if step <= 0:
            self._stop_joining()
            return frame
        received, (start, end) = frame, frame.time_range
        # No times if all points are of one moment; wrong ones if few points span little, so that the unit is unknown,
        # or if one is an outlier.
        if frame.time_offset is None or end - start > 2 * SWEEP:
            start, end, frame = 0.0, 0.0, replace(frame, points=NO_POINTS, time_offset=None)
        if step > SWEEP:  # a sweep or more was dropped in between
            self._parts.clear()
        self._parts.append(_copied(frame))
        if self._span_to(end) < SWEEP - (end - start) / 2:
            return None
        sweep = frame if len(self._parts) == 1 else _joined(self._parts, frame)
        self._parts.clear()
        if len(received.points) and not len(sweep.points):  # no cloud has usable times any more
            self._stop_joining()
            return received
        self._has_joined = self._has_close_parts
        if not self._has_close_parts:  # whole clouds, of which two followed each other too soon once
            self._stop_joining()
        self._has_close_parts = False
        return sweep

    def _resume(self, frame: Frame) -> None:
        """A frame after more than a sweep: after a pause, parts go on as parts; one that is not followed soon does not.

        Alone, the first part after a pause would be registered as if it were a sweep, and become a keyframe.
        """
        is_alone = len(self._parts) > 0 and not self._has_close_parts
        if not self._has_joined or is_alone or not may_be_part(frame):
            self._stop_joining()
        self._has_close_parts = False

    def _recognize_parts(self, frame: Frame, period: float) -> bool:
        """Whether this frame and the previous one, `period` s earlier, are the first two parts of a drive."""
        before, self._candidate = self._candidate, None
        if not may_be_part(frame):
            return False
        start, end = frame.time_range
        filled = _SPAN_RATIOS[0] * period < end - start < _SPAN_RATIOS[1] * period
        self._joining = before is not None and period < MAX_PART_SPAN and filled
        if before is not None and self._joining:
            self._parts.append(replace(before, fix=None, dropped=0, stepped=False))
        else:
            self._candidate = _copied(frame)
        return self._joining

    def _stop_joining(self) -> None:
        """Join no more clouds until parts are recognized again."""
        self._parts.clear()
        self._joining, self._has_close_parts, self._has_joined = False, False, False

    def _span_to(self, end: float) -> float:
        """s from the first point of the parts to the last, which was measured `end` s after the last stamp."""
        first, last = self._parts[0], self._parts[-1]
        return (last.stamp - first.stamp) * 1e-9 + end - first.time_range[0]


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
    start, end = frame.time_range
    return frame.problem is None and 0 < end - start < MAX_PART_SPAN


def _copied(frame: Frame) -> Frame:
    """With points of its own: a caller may use its arrays again."""
    offset = frame.time_offset
    return replace(frame, points=frame.points.copy(), time_offset=None if offset is None else offset.copy())


def _joined(parts: Sequence[Frame], last: Frame) -> Frame:
    """One frame at the stamp of the last part."""
    timed = [part.later((last.stamp - part.stamp) * 1e-9) for part in parts]
    offsets = [part.time_offset for part in timed if part.time_offset is not None]
    starts, ends = zip(*[part.time_range for part in timed], strict=True)
    points = np.concatenate([part.points for part in parts])
    return replace(
        last,
        points=points,
        problem=None if len(points) else last.problem,  # an unreadable part is one without points
        time_offset=np.concatenate(offsets) if offsets else None,
        images=_nearest([image for part in timed for image in part.images]),
        guess=_guess_at((min(starts) + max(ends)) / 2, timed),
        fix=next((part.fix for part in reversed(parts) if part.fix is not None), None),
        dropped=sum(part.dropped for part in parts),
        stepped=any(part.stepped for part in parts),
    )


def _guess_at(middle: float, parts: Sequence[Frame]) -> Guess | None:
    """The pose of another odometry `middle` s after the stamp: between those of the parts before and after. The nearest
    one would be half a part off, now to one side, now to the other."""
    known = [(sum(part.time_range) / 2 - middle, part.guess) for part in parts if part.guess is not None]
    nearest = min(known, key=lambda one: abs(one[0]), default=None)
    if nearest is None:
        return None
    at, guess = nearest
    others = [one for one in known if one[0] * at < 0]  # beyond the middle
    if not others:
        return guess
    beyond, other = min(others, key=lambda one: abs(one[0]))
    T = se3.interpolated(guess.T_other_lidar, other.T_other_lidar, at / (at - beyond))
    return replace(guess, T_other_lidar=T)


def _nearest(images: Sequence[Image]) -> tuple[Image, ...]:
    """Of each camera the image that was taken nearest to the stamp."""
    found = dict[str, Image]()
    for image in sorted(images, key=lambda image: -abs(image.time_offset)):
        found[image.camera.name] = image
    return tuple(found.values())
