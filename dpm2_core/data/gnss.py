# SPDX-License-Identifier: Apache-2.0
"""Buffers GNSS positions (sensor_msgs/NavSatFix) until a scan arrives."""

from __future__ import annotations

import threading
from collections import deque
from typing import Any

import numpy as np

from dpm2_core.data.messages import MessageError
from dpm2_core.data.pairing import JUMP
from dpm2_core.frame import Fix

_NO_FIX = -1  # -2, Jazzy's default, means that the driver sets no status at all
_MAX_FIXES = 1000  # fixes kept; bounds memory if no cloud arrives
_MIN_SIGMA = 0.01  # m, its square is added to every variance: antenna position and clock are not known better
_DEFAULT_SIGMAS = np.array([5.0, 5.0, 10.0])  # m east, north, up if none is stated: those of a plain receiver, open sky
_UNKNOWN_ALTITUDE_SIGMA = 1e4  # m, of an unknown altitude


def decode_fix(message: Any, stamp: int) -> Fix | None:
    """The fix of a sensor_msgs/NavSatFix with that stamp (ns), its antenna at the LiDAR; None without a fix.

    A variance that is unknown, or 0, is taken to be that of a plain receiver; an altitude of NaN is unknown, as in the
    message's definition.

    Raises:
        MessageError: it is no position on Earth, or has no valid covariance.
    """
    if message.status.status == _NO_FIX:
        return None
    geodetic = np.array([message.latitude, message.longitude, message.altitude], np.float64)
    if not geodetic[:2].any():
        raise MessageError("latitude and longitude 0, which receivers send before they have a fix")
    covariance = np.array(message.position_covariance, np.float64).reshape(3, 3)
    unknown = (np.diag(covariance) == 0) | (message.position_covariance_type == 0)
    covariance[unknown], covariance[:, unknown] = 0.0, 0.0
    covariance[unknown, unknown] = _DEFAULT_SIGMAS[unknown] ** 2
    if np.isnan(geodetic[2]):
        geodetic[2], covariance[2], covariance[:, 2] = 0.0, 0.0, 0.0
        covariance[2, 2] = _UNKNOWN_ALTITUDE_SIGMA**2
    try:
        return Fix(stamp, geodetic, covariance + _MIN_SIGMA**2 * np.eye(3), np.zeros(3))
    except ValueError as error:
        raise MessageError(str(error)) from None


class FixBuffer:
    """The latest fixes; thread-safe.

    Attributes:
        frame: frame of the antenna, from the last message.
    """

    def __init__(self) -> None:
        self.frame = ""
        self._lock = threading.Lock()
        self._fixes: deque[Fix] = deque(maxlen=_MAX_FIXES)

    def clear(self) -> None:
        """Remove all fixes."""
        with self._lock:
            self._fixes.clear()

    def add(self, stamp: int, message: Any) -> bool:
        """Add a sensor_msgs/NavSatFix with its stamp (ns); returns whether the receiver has a fix.

        Raises:
            MessageError: see `decode_fix`.
        """
        if (fix := decode_fix(message, stamp)) is None:
            return False
        with self._lock:
            self.frame = message.header.frame_id
            self._fixes.append(fix)
        return True

    def take(self, stamp: int) -> Fix | None:
        """The latest fix up to a scan's stamp (ns) that was not taken before; None if there is none."""
        with self._lock:
            found = max((fix for fix in self._fixes if fix.stamp <= stamp), key=lambda fix: fix.stamp, default=None)
            later = [fix for fix in self._fixes if stamp < fix.stamp < stamp + JUMP]
            self._fixes.clear()
            self._fixes.extend(later)
        return found
