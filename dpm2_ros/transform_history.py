# SPDX-License-Identifier: Apache-2.0
"""Moving frames over the last seconds: the pose of one in another at a stamp. Pure logic: no ROS, no clock, no thread.

The buffer of tf2 is not part of ROS from pip, and has no covariances.
"""

from __future__ import annotations

from bisect import bisect_left
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from dpm2_core.data.pairing import JUMP, SetBack
from dpm2_core.data.transforms import TransformTree
from dpm2_core.errors import UsageError
from dpm2_core.frame import Array
from dpm2_core.geometry import se3
from dpm2_core.slam.mapping.admission import RejectedError
from dpm2_ros.checks import checked_pose

GAP = 500_000_000
"""ns: no pose is interpolated between samples that are farther apart."""
_MAX_HISTORY = 20_000_000_000  # ns
_MAX_SAMPLES = 4000  # of a frame
_MAX_FRAMES = 200
_MAX_DEPTH = 20  # parents in a chain of frames


@dataclass(eq=False)
class _Track:
    """A frame in its parent. Samples are kept as messages, since few of them are ever converted."""

    parent: str
    stamps: list[int] = field(default_factory=list)
    samples: list[tuple[Any, Array | None]] = field(default_factory=list)
    _set_back: SetBack = field(default_factory=SetBack)

    def add(self, stamp: int, pose: Any, covariance: Array | None) -> None:
        new = [(stamp, (pose, covariance))]
        if self.stamps and self.stamps[-1] - JUMP <= stamp <= self.stamps[-1]:
            new = self._set_back.add(stamp, new[0])
            if not new:
                return
        self._set_back.end()
        if self.stamps and stamp <= self.stamps[-1]:  # a clock that was set, a looped bag, or a stray stamp before
            self.stamps.clear()
            self.samples.clear()
        self.stamps += [at for at, _ in new]
        self.samples += [sample for _, sample in new]
        n_old = bisect_left(self.stamps, stamp - _MAX_HISTORY)
        if n_old > 100 or len(self.stamps) > _MAX_SAMPLES:  # now and then: it moves the whole list
            n_old = max(n_old, len(self.stamps) - _MAX_SAMPLES // 2)
            del self.stamps[:n_old], self.samples[:n_old]

    def at(self, stamp: int, child: str) -> tuple[Array, Array | None]:
        """(4, 4), and the covariance (6, 6) of the nearest sample.

        Raises:
            UsageError: there is none before or after, or they are too far apart.
        """
        after = bisect_left(self.stamps, stamp)
        if after < len(self.stamps) and self.stamps[after] == stamp:
            return _matrix(self.samples[after][0], child), self.samples[after][1]
        link = f"{self.parent} -> {child}"
        if after in (0, len(self.stamps)):
            is_before_start, nearest = after == 0, self.stamps[-1 if after else 0]
            seconds, side = abs(stamp - nearest) * 1e-9, "after" if is_before_start else "before"
            raise UsageError(f"{link} {'begins' if is_before_start else 'ends'} {seconds:.2f} s {side} the cloud")
        begin, end = self.stamps[after - 1], self.stamps[after]
        if end - begin > GAP:
            raise UsageError(f"{link} has a gap of {(end - begin) * 1e-9:.2f} s")
        (pose_before, covariance_before), (pose_after, covariance_after) = self.samples[after - 1 : after + 1]
        fraction = (stamp - begin) / (end - begin)
        T = se3.interpolated(_matrix(pose_before, child), _matrix(pose_after, child), fraction)
        return T, covariance_before if fraction < 0.5 else covariance_after


class TransformHistory:
    """Moving frames by name, each with its parent."""

    def __init__(self) -> None:
        self._tracks: dict[str, _Track] = {}

    def add(self, parent: str, child: str, stamp: int, pose: Any, covariance: Array | None = None) -> None:
        """Add the pose of `child` in `parent` at a stamp (ns).

        Args:
            pose: geometry_msgs Pose or Transform.
            covariance: (6, 6) as in `Registration`.

        Raises:
            RejectedError: there are too many frames.
        """
        track = self._tracks.get(child)
        if track is None and len(self._tracks) >= _MAX_FRAMES:
            raise RejectedError("frame", f"more than {_MAX_FRAMES} moving frames")
        if track is None or track.parent != parent:
            track = self._tracks[child] = _Track(parent)
        track.add(stamp, pose, covariance)

    def lookup(self, target: str, source: str, stamp: int, static: TransformTree) -> tuple[Array, Array | None]:
        """T_target_source (4, 4) at a stamp (ns), between two samples, and its covariance (6, 6) if one is stated.

        Args:
            static: the static transforms.

        Raises:
            UsageError: why it is not known, in words.
        """
        T, covariance, frame = np.eye(4), None, source
        for _ in range(_MAX_DEPTH):
            if frame == target:
                return T, covariance
            if (track := self._tracks.get(frame)) is not None:
                T_parent, covariance = track.at(stamp, frame)
                frame, T = track.parent, T_parent @ T
            elif (static_link := static.parent(frame)) is not None:
                frame, T = static_link[0], static_link[1] @ T
            else:
                break
        raise UsageError(f"no transform from {source!r} to {target!r}: {frame!r} has no parent")


def _matrix(pose: Any, child: str) -> Array:
    try:
        return checked_pose(pose)
    except RejectedError as error:
        raise UsageError(f"{child}: {error}") from None
