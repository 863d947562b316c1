# SPDX-License-Identifier: Apache-2.0
"""The odometry for where the robot is: one for streets and one for rooms, by what the scans show (`slam.preset: auto`).

The first scan that shows what it is decides. Later every fifth is looked at, and only several in a row that are clearly
of the other kind change it. Then the other odometry goes on from the same pose and motion, with the last scan as its
map.
"""

from __future__ import annotations

from dpm2_core.estimates import OdometryResult
from dpm2_core.frame import Frame
from dpm2_core.geometry.scale import is_room
from dpm2_core.slam.odometry.odometry import Odometry

_EVERY = 5  # scans: a look takes a tenth of the time of a registration
_SURE = 4  # looks in a row


class ScaledOdometry:
    """As `Odometry`.

    Args:
        open_air, room: the odometry for either.

    Attributes:
        scale: "outdoor" or "indoor", the one at work; "" before the first scan.
    """

    def __init__(self, open_air: Odometry, room: Odometry) -> None:
        self._open_air, self._room = open_air, room
        self.reset()

    @property
    def uses_images(self) -> bool:
        """Whether frames should come with their images."""
        return self._open_air.uses_images

    @property
    def scale(self) -> str:
        """See above."""
        return "" if self._undecided else "indoor" if self._active is self._room else "outdoor"

    def request_keyframe(self) -> None:
        """Make a keyframe of the next registered scan, however short the way."""
        self._active.request_keyframe()

    @property
    def next_keyframe(self) -> int:
        """Id that the next keyframe will have."""
        return self._active.next_keyframe

    def cross_breaks(self, found: int) -> None:
        """A map has shown where the keyframe of that id is."""
        self._active.cross_breaks(found)

    def reset(self) -> None:
        """Forget everything; the next scan is the first."""
        self._open_air.reset()
        self._room.reset()
        self._active, self._undecided, self._others, self._scans = self._open_air, True, 0, 0
        self._begun = False  # a scan has been registered while it was undecided

    def process(self, frame: Frame) -> OdometryResult:
        """Pose of one frame, as of `Odometry.process`."""
        self._scans += 1
        if not self._undecided and self._scans % _EVERY:
            return self._active.process(frame)
        found = is_room(frame.points) if frame.problem is None else None
        decides = self._undecided and found is not None
        if decides and not self._begun:
            self._active = self._room if found else self._open_air
        self._undecided &= not decides
        result = self._active.process(frame)
        self._begun |= result.registration.ok
        other = found is not None and found != (self._active is self._room)
        self._others = (_SURE if decides else self._others + 1) if other else 0
        if self._others >= _SURE and not self._undecided and result.registration.ok:
            before = self._active
            self._active = self._room if found else self._open_air
            self._active.take_over(before, frame)
            self._others = 0
        return result
