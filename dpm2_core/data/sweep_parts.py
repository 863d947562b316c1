# SPDX-License-Identifier: Apache-2.0
"""Joins clouds that are parts of a sweep, as of a driver that publishes each packet, to clouds that show a whole one.

One part shows too little of the scene to be registered: a tenth of a sweep of a spinning LiDAR covers 36 degrees.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from dpm2_core.frame import Frame, Image

_MAX_PART_SPAN = 0.025
"""s: a cloud that spans less is a part if the next one follows as soon. No LiDAR rotates more than 40 times per second.
"""
_MAX_SPAN = 1.5  # of the period: a cloud that spans more overlaps the one before, as clouds do that arrive in a burst
SWEEP = 0.1
"""s that a joined cloud spans."""


class SweepParts:
    """Collects parts until they span a sweep.

    Clouds whose points have no times are never joined: nothing tells parts from whole clouds that arrive in a burst.
    """

    def __init__(self) -> None:
        self._parts = deque[Frame]()
        self._has_parts = False  # whether clouds have been recognized as parts

    def join(self, frame: Frame) -> Frame | None:
        """The sweep that this frame completes, with its stamp and index; the frame itself unless it is a part; None
        while the sweep is incomplete.

        The first part of a drive is returned as it is, because only the second shows that they are parts. It is in the
        first sweep as well. A sweep has only the IMU samples of its last part: the samples of a frame must be used
        also if None is returned.
        """
        if frame.problem is not None:
            return frame
        if not len(frame.points) and self._has_parts:  # a part may look at the sky
            return None
        start, end = _time_range(frame)
        if not 0 < end - start < _MAX_PART_SPAN:
            self._parts.clear()
            self._has_parts = False
            return frame
        step = (frame.stamp - self._parts[-1].stamp) * 1e-9 if self._parts else 0.0
        self._has_parts |= 0 < step < _MAX_PART_SPAN and end - start < _MAX_SPAN * step
        if step < 0:
            self._parts.clear()
        self._parts.append(_copied(frame))
        while self._span(end) > 2 * SWEEP:  # the parts before a pause
            self._parts.popleft()
        if not self._has_parts:
            return frame
        if self._span(end) < SWEEP - (end - start) / 2:
            return None
        sweep = _joined(list(self._parts))
        self._parts.clear()
        return sweep

    def _span(self, end: float) -> float:
        """s from the first point of the parts to the last, which was measured `end` s after the last stamp."""
        first, last = self._parts[0], self._parts[-1]
        return (last.stamp - first.stamp) * 1e-9 + end - _time_range(first)[0]


def _time_range(frame: Frame) -> tuple[float, float]:
    """The first and the last time of its points, s after its stamp; zeros without times."""
    offset = frame.time_offset
    return (0.0, 0.0) if offset is None or not len(offset) else (float(offset.min()), float(offset.max()))


def _copied(frame: Frame) -> Frame:
    """With points of its own: a caller may use its arrays again."""
    offset = frame.time_offset
    return replace(frame, points=frame.points.copy(), time_offset=None if offset is None else offset.copy())


def _joined(parts: Sequence[Frame]) -> Frame:
    """One frame at the stamp of the last part."""
    stamp = parts[-1].stamp
    timed = [part.later((stamp - part.stamp) * 1e-9) for part in parts]
    return replace(
        parts[-1],
        points=np.concatenate([part.points for part in parts]),
        time_offset=np.concatenate([part.time_offset for part in timed if part.time_offset is not None]),
        images=_nearest([image for part in timed for image in part.images]),
        guess=parts[len(parts) // 2].guess,  # of the middle of the sweep
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
