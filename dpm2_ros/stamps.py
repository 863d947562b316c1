# SPDX-License-Identifier: Apache-2.0
"""Stamps as messages."""

from __future__ import annotations

from builtin_interfaces.msg import Time


def stamp_to_msg(stamp: int) -> Time:
    """ns to builtin_interfaces/Time; a stamp beyond its 32-bit seconds is clipped to the limit."""
    seconds, nanoseconds = divmod(stamp, 10**9)
    return Time(sec=min(max(seconds, -(2**31)), 2**31 - 1), nanosec=nanoseconds)
