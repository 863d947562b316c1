# SPDX-License-Identifier: Apache-2.0
"""The odometry for where the robot is: with tools for streets or rooms, by what the scans show (`slam.preset: auto`).

The first scan that shows what it is decides. Later every fifth is looked at, and only several in a row that are clearly
of the other kind change it. Then the odometry goes on with the other tools from the same pose and motion, with the last
scan as its map.
"""

from __future__ import annotations

from dpm2_core.estimates import OdometryResult
from dpm2_core.frame import Frame
from dpm2_core.geometry.scale import ByScale, is_room
from dpm2_core.slam.odometry.odometry import Odometry, Tools

_EVERY = 5  # scans: a look takes a tenth of the time of a registration
_SURE = 4  # looks in a row


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

    def process(self, frame: Frame) -> OdometryResult:
        """As of `Odometry`."""
        self._scans += 1
        if not self._undecided and self._scans % _EVERY:
            return super().process(frame)
        found = is_room(frame.points) if frame.problem is None else None
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
