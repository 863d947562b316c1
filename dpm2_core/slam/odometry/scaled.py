# SPDX-License-Identifier: Apache-2.0
"""The odometry for where the robot is: with tools for streets or rooms, by what the scans show (`slam.preset: auto`).

The first scan that shows what it is decides. Later every fifth is looked at, and only several in a row that are clearly
of the other kind change it. Then the odometry goes on with the other tools from the same pose and motion, with the last
scan as its map. In fog or dust all that is seen is near, too, but less is seen: that is no room.
"""

from __future__ import annotations

from dpm2_core.estimates import OdometryResult
from dpm2_core.frame import Frame
from dpm2_core.geometry.scale import ByScale, look
from dpm2_core.slam.odometry.odometry import Odometry, Tools

_EVERY = 5  # scans: a look takes a tenth of the time of a registration
_SURE = 4  # looks in a row
_CLEAR = 2 / 3
"""Of the most points that a scan in the open had: a room has more. Measured, 16 and 64 beams: 0.63 to 0.93 of the
pulses come back in the open, 0.65 to 0.90 in rooms; where one sees no farther than 10 m, 0.12 to 0.55 on roads."""


class ScaledOdometry(Odometry):
    """One that changes its tools."""

    def __init__(self, choice: ByScale[Tools], robot: str = "") -> None:
        self._choice = choice
        super().__init__(choice.outdoor, robot)

    @property
    def scale(self) -> str:
        """`outdoor` or `indoor`, by the tools at work; empty before the first scan that decides."""
        return "" if self._undecided else "indoor" if self._tools is self._choice.indoor else "outdoor"

    def reset(self) -> None:
        """Forget everything; the next scan is the first."""
        self._use(self._choice.outdoor)
        super().reset()
        self._undecided, self._others, self._scans = True, 0, 0
        self._begun = False  # a scan has been registered while it was undecided
        self._most = 0  # points of a scan in the open
        self._last = 0  # points that the scan looked at before has shown

    def process(self, frame: Frame) -> OdometryResult:
        """As of `Odometry`."""
        self._scans += 1
        if not self._undecided and self._scans % _EVERY:
            return super().process(frame)
        found = self._found(frame) if frame.problem is None else None
        decides = self._undecided and found is not None
        if decides and found and not self._begun:
            self._use(self._choice.indoor)
            super().reset()
        self._undecided &= not decides
        result = super().process(frame)
        self._begun |= result.registration.ok
        other = found is not None and found != (self._tools is self._choice.indoor)
        self._others = (_SURE if decides else self._others + 1) if other else 0
        if self._others >= _SURE and not self._undecided and result.registration.ok:
            self._go_on_with(self._choice.indoor if found else self._choice.outdoor, frame)
            self._others = 0
        return result

    def _found(self, frame: Frame) -> bool | None:
        """Whether a scan shows a room, see `is_room`.

        A second LiDAR of half the rate is in every second scan: what it sees counts in the next one, too.
        """
        found, points = look(frame.points)
        if found is False:
            self._most = max(self._most, points)
        points, self._last = max(points, self._last), points
        return None if found and points < _CLEAR * self._most else found
