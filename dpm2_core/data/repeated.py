# SPDX-License-Identifier: Apache-2.0
"""A driver or a relay that sends a scan again under a new stamp: to the odometry it would look like a halt."""

from __future__ import annotations

from zlib import crc32

from dpm2_core.frame import Points

PROBLEM = "the same cloud as before: the LiDAR or its driver repeats itself"
_STOPS = 0.3  # m: robots of simulations without noise stop dead, and then see the same again; at 3 m/s none does
_LOOKED_AT = 8192  # points: noise changes any few of them


class RepeatedCloud:
    """Remembers the last registered cloud by a checksum: a caller may use its array again."""

    def __init__(self) -> None:
        self._registered: int | None = None
        self._now: int | None = None

    def repeats(self, points: Points, meters: float) -> bool:
        """Whether a cloud (N, 4) is the registered one to the last bit although the sensor should have moved so far."""
        part = points[:: max(1, len(points) // _LOOKED_AT)]
        self._now = crc32(part.tobytes()) if len(part) else None
        return self._now is not None and self._now == self._registered and meters > _STOPS

    def keep(self) -> None:
        """This cloud was registered."""
        self._registered = self._now
