# SPDX-License-Identifier: Apache-2.0
"""A driver or a relay that sends a scan or an image again under a new stamp: to the odometry it would look like a halt.

Both are compared by checksums: a caller may use its arrays again.
"""

from __future__ import annotations

from zlib import crc32

import numpy as np

from dpm2_core.frame import Array, Frame, Guess, Image, Points
from dpm2_core.geometry import se3

PROBLEM = "the same cloud as before: the LiDAR or its driver repeats itself"
IMAGE_PROBLEM = "the same image as before: the camera or its driver repeats itself"
_STOPS = 0.3  # m: robots of simulations without noise stop dead, and then see the same again; at 3 m/s none does
_TURNS = 3.0  # degrees
_LOOKED_AT = 8192  # points: noise changes any few of them
_ROWS = 8  # of an image each so many-th row: noise changes any of them
_Seen = tuple[int, Guess | None, Array]  # checksum; the guess when it was new; R (3, 3) that it has turned since


class RepeatedCloud:
    """Remembers the last registered cloud, and how the sensor has moved since it was new."""

    def __init__(self) -> None:
        self._registered: _Seen | None = None
        self._now: _Seen | None = None
        self._again = False

    def repeats(self, frame: Frame, meters: float, turn: Array | None = None) -> bool:
        """Whether a cloud is the registered one to the last bit although the sensor should have moved meanwhile.

        Args:
            meters: the way since the last registered frame by the motion before. A repetition that was taken for a halt
                has ended that motion; the frame's guess and `turn` count from when the cloud was new.
            turn: R_before_now (3, 3) since the last registered frame, as an IMU has it; None where it shows none.
        """
        before, checksum = self._registered, _checksum(frame.points)
        if not len(frame.points) or before is None or before[0] != checksum:
            self._now, self._again = (checksum, frame.guess, np.eye(3)), False
            return False
        _, guess, R = before
        R = R if turn is None else R @ turn
        self._now, moved = (checksum, guess, R), [se3.make(R, np.zeros(3))]
        if guess is not None and frame.guess is not None:
            moved.append(se3.inverse(guess.T_other_lidar) @ frame.guess.T_other_lidar)
        self._again |= meters > _STOPS or any((np.array(se3.magnitude(T)) > (_STOPS, _TURNS)).any() for T in moved)
        return self._again

    def keep(self) -> None:
        """This cloud was registered."""
        self._registered = self._now


class RepeatedImages:
    """Remembers the last image of each camera, when it was taken, and the cloud beside it."""

    def __init__(self) -> None:
        self._last: dict[str, tuple[int, int, int]] = {}  # checksums of image and cloud, ns

    def new(self, frame: Frame) -> tuple[Image, ...]:
        """The images of a frame that are not those of before under a new stamp.

        One image may be the nearest of two clouds. In a simulation without noise a robot at rest sees the same again,
        but then its cloud is the same too.
        """
        if not frame.images:
            return ()
        cloud, found = _checksum(frame.points), []
        for image in frame.images:
            now = crc32(image.pixels[::_ROWS].tobytes()), cloud, frame.stamp + round(image.time_offset * 1e9)
            before = self._last.get(image.camera.name)
            if before is None or before[0] != now[0] or before[1] == now[1] or before[2] == now[2]:
                self._last[image.camera.name] = now
                found.append(image)
        return tuple(found)


def _checksum(points: Points) -> int:
    return crc32(points[:: max(1, len(points) // _LOOKED_AT)].tobytes())
