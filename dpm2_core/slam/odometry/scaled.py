# SPDX-License-Identifier: Apache-2.0
"""Odometry that selects its tools, for streets or for rooms, by what the scans show (`slam.preset: auto`).

The first scan that shows the scene type decides. Later, every fifth scan is checked, and only several checks in a row
that are clearly of the other type change the tools. The odometry then continues with the other tools from the same pose
and motion, with the last scan as its map. In fog or dust all returns are near, too, but they are fewer: not a room.
"""

from __future__ import annotations

from dpm2_core.estimates import OdometryResult
from dpm2_core.frame import Frame
from dpm2_core.geometry.scale import ByScale, look
from dpm2_core.slam.odometry.odometry import Odometry, Tools

_CHECK_INTERVAL = 5  # scans: a check takes a tenth of the time of a registration
_MIN_CHECKS = 4  # checks in a row
_MIN_ROOM_RATIO = 2 / 3
"""Of the largest number of points of a scan in the open: a room has more. Measured, with 16 and 64 beams: 0.63 to 0.93
of the pulses return in the open, 0.65 to 0.90 in rooms; with a visibility of 10 m, 0.12 to 0.55 on roads."""


class ScaledOdometry(Odometry):
    """An odometry that changes its tools with the scene."""

    def __init__(self, choice: ByScale[Tools], robot: str = "") -> None:
        self._choice = choice
        super().__init__(choice.outdoor, robot)

    @property
    def scale(self) -> str:
        """`outdoor` or `indoor`, the type of the current tools; empty before the first scan that decides."""
        return "" if self._undecided else "indoor" if self._tools is self._choice.indoor else "outdoor"

    def reset(self) -> None:
        """Reset the state; the next scan is the first."""
        self._use_tools(self._choice.outdoor)
        super().reset()
        self._undecided, self._contrary_checks, self._scans = True, 0, 0
        self._registered = False  # whether a scan was registered while undecided
        self._max_open_points = 0  # points of a scan in the open
        self._last_points = 0  # points of the previously checked scan

    def process(self, frame: Frame) -> OdometryResult:
        """As `Odometry.process`."""
        self._scans += 1
        if not self._undecided and self._scans % _CHECK_INTERVAL:
            return super().process(frame)
        is_room = self._is_room(frame) if frame.problem is None else None
        decides = self._undecided and is_room is not None
        if decides and is_room and not self._registered:
            self._use_tools(self._choice.indoor)
            super().reset()
        self._undecided &= not decides
        result = super().process(frame)
        self._registered |= result.registration.ok
        contrary = is_room is not None and is_room != (self._tools is self._choice.indoor)
        self._contrary_checks = (_MIN_CHECKS if decides else self._contrary_checks + 1) if contrary else 0
        if self._contrary_checks >= _MIN_CHECKS and not self._undecided and result.registration.ok:
            self._switch_tools(self._choice.indoor if is_room else self._choice.outdoor, frame)
            self._contrary_checks = 0
        return result

    def _discard_first(self, frame: Frame, dt: float) -> None:
        """A part of the scene does not show its type either: this frame decides."""
        is_room = self._is_room(frame)
        self._use_tools(self._choice.indoor if is_room else self._choice.outdoor)
        self._undecided = is_room is None
        super()._discard_first(frame, dt)

    def _is_room(self, frame: Frame) -> bool | None:
        """Whether a scan shows a room, see `is_room`.

        A second LiDAR with half the rate contributes only to every second scan: its points count in the next one, too.
        """
        is_room, points = look(frame.points)
        if is_room is False:
            self._max_open_points = max(self._max_open_points, points)
        points, self._last_points = max(points, self._last_points), points
        return None if is_room and points < _MIN_ROOM_RATIO * self._max_open_points else is_room
