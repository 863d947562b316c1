# SPDX-License-Identifier: Apache-2.0
"""Capture time of each point of a cloud: its field, its unit and its clock."""

from __future__ import annotations

import re
from typing import Any, Literal, cast

import numpy as np
from numpy.typing import NDArray

from dpm2_core.frame import Points

TimeUnit = Literal["auto", "s", "ms", "us", "ns"]

# Without underscores and unit: time_stamp becomes timestamp, time_offset_ns becomes timeoffset.
_TIME_NAMES = (
    "t",
    "time",
    "timestamp",
    "offsettime",
    "timeoffset",
    "pointtime",
    "pointtimeoffset",
    "relativetime",
    "deltatime",
    "reltime",
    "ts",
    "dt",
    "stamp",
    "times",
    "timestamps",
)
_TIME_NAME = re.compile(r"(?P<name>[a-z_]+?)(?:_?(?P<unit>ns|us|ms|s)|_(?P<long>nsec|usec|msec|sec))?")
_SECONDS_PER_UNIT = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
# No sweep is longer, no usable one a thousand times shorter: so exactly one unit puts the span of a scan in this range.
_LONGEST_SCAN = 2.0


def time_field_of(available: list[str]) -> tuple[str | None, TimeUnit]:
    """The field with the time of each point, among the available ones, and the unit in its name, if any."""
    found: dict[str, tuple[str, TimeUnit]] = {}
    for field in available:
        name = field.lower()
        if name.replace("_", "") in _TIME_NAMES:  # whole names first: the s of ts is no unit
            found.setdefault(name.replace("_", ""), (field, "auto"))
        elif match := _TIME_NAME.fullmatch(name):
            unit = match["unit"] or (match["long"] or "auto").removesuffix("ec")
            found.setdefault(match["name"].replace("_", ""), (field, cast(TimeUnit, unit)))
    return next((found[name] for name in _TIME_NAMES if name in found), (None, "auto"))


def time_offsets(time: NDArray[Any], returned: NDArray[np.bool_], stamp: int, unit: TimeUnit) -> Points | None:
    """(N,) float32 s relative to a stamp, ns, from the values of a time field; None if the values are unusable.

    Args:
        time: (N,) of each point. returned: (N,) which points were measured: drivers often zero the time of the others.
    """
    value = time.astype(np.float64)
    seen = returned & np.isfinite(value)
    zero = value == 0
    if not (seen & ~zero).any():
        return None
    first, last = _span(value[seen & ~zero])
    if 0 < 10 * (last - first) < first:  # the clock started long before the scan
        seen &= ~zero  # 0 marks a missing return, even if its point was transformed to another frame since
    elif (seen & zero).any():
        first, last = min(first, 0.0), max(last, 0.0)
    if first == last:
        return None
    scale = _SECONDS_PER_UNIT[unit] if unit != "auto" else _time_scale(first, last, time.dtype.kind == "f")
    origin, clock = 0.0, stamp * 1e-9 / scale
    # If the clock started less than 2 s ago, as in a simulation, absolute times look like relative ones.
    by_clock = _distance_to_interval(first, last, clock) + (last - first) / 10 < _distance_to_interval(first, last, 0.0)
    if by_clock or max(abs(first), abs(last)) * scale > _LONGEST_SCAN:
        origin = clock
        if max(abs(first - origin), abs(last - origin)) * scale > _LONGEST_SCAN:
            # The sensor's clock differs from the clock of the stamps: only times since the first point are known.
            measured = value[seen]
            # Unlike numpy's median it is always one of the values.
            median = np.partition(measured, len(measured) // 2)[len(measured) // 2]
            origin = measured[np.abs(measured - median) * scale <= _LONGEST_SCAN].min()
    with np.errstate(invalid="ignore", over="ignore"):
        offset = (value - origin) * scale
    valid = seen & (np.abs(offset) <= _LONGEST_SCAN)  # others are invalid
    return np.where(valid, offset, 0.0).astype(np.float32) if 2 * valid.sum() > seen.sum() else None


def last_point(offset: Points | None) -> int:
    """ns from the stamp of a cloud to its last point, from (N,) s after it; 0 if unknown, or if it is not later."""
    return 0 if offset is None else round(float(offset.max(initial=0.0)) * 1e9)


def _distance_to_interval(first: float, last: float, time: float) -> float:
    """Distance of a time from the interval first..last of a scan."""
    return max(first - time, time - last, 0.0)


def _span(times: NDArray[np.float64]) -> tuple[float, float]:
    """The earliest and the latest of times (N,), without one percent at either end, which may be outliers."""
    trimmed = len(times) // 100
    ordered = np.partition(times, (trimmed, len(times) - 1 - trimmed))
    return float(ordered[trimmed]), float(ordered[-1 - trimmed])


def _time_scale(first: float, last: float, floating: bool) -> float:
    """Seconds per unit: from the span, else (very few points) from the size as an epoch time, else from the type."""
    for scale in [_SECONDS_PER_UNIT[unit] for unit in (("s", "ms") if floating else ()) + ("us", "ns")]:
        if _LONGEST_SCAN / 1000 < (last - first) * scale <= _LONGEST_SCAN:
            return scale
    for scale in _SECONDS_PER_UNIT.values():
        if 1e8 < abs(last) * scale < 1e11:  # 1973 to 5138
            return scale
    return 1.0 if floating else 1e-9
