# SPDX-License-Identifier: Apache-2.0
"""Drives with a gap: is the odometry right after it, and does it report if it is not?"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import reduce
from typing import Any

import numpy as np

from benchmarks.harness import Options, Report, drives, processors, requested, settings_of, truth_of
from dpm2_core.console import progress_bar
from dpm2_core.data.trajectory import frame_period
from dpm2_core.estimates import OdometryResult, State
from dpm2_core.frame import Array, Frame, Inertial
from dpm2_core.geometry import se3
from dpm2_core.geometry.sampling import evenly
from dpm2_core.slam.build import make_odometry
from dpm2_core.slam.settings import SlamSettings
from dpm2_core.tables import FigureTable, record_table

_SECONDS = (1.0, 2.0, 3.0, 5.0, 7.0, 10.0)
_GAPS_PER_LENGTH = 5
_MIN_BEFORE, _MAX_BEFORE, _MAX_AFTER = 10, 40, 30  # numbers of frames before and after a gap
_WRONG_ERROR = 1.0  # m, across the gap
_MAX_CHI2 = 14.16  # for 3 degrees of freedom: 3 sigma


@dataclass(frozen=True)
class Gap:
    """Frames first to stop - 1 of a drive are missing."""

    first: int
    stop: int
    seconds: float


def gaps(stamps: Sequence[int]) -> Iterator[Gap]:
    """The gaps of each length that fit into a drive with these stamps (ns), evenly spread over it."""
    period = frame_period(stamps)
    for seconds in _SECONDS:
        missing = round(seconds / period)
        for place in evenly(len(stamps) - 2 * _MIN_BEFORE - missing + 1, _GAPS_PER_LENGTH).tolist():
            yield Gap(_MIN_BEFORE + place, _MIN_BEFORE + place + missing, seconds)


def bench_gaps(options: Options) -> Report:
    """Every gap on every drive with every registration; `--only` chooses one registration.

    Raises:
        UsageError: there is no drive, or one has no ground truth.
    """
    methods = requested(options, ("geometric", "adaptive", "refined", "neural"))
    results: dict[str, Any] = {}
    with drives(options) as sources, processors(options.threads), progress_bar() as progress:
        for name, source in sources.items():
            truth, frames = truth_of(source), list(source.frames())
            cases = list(gaps([frame.stamp for frame in frames]))
            task = progress.add_task(name, total=len(cases) * len(methods))
            results[name] = {}
            for method in methods:
                settings, rows = settings_of(options, f"slam.registration={method}"), []
                for gap in cases:
                    rows.append(evaluated(frames, truth, gap, settings))
                    progress.advance(task)
                results[name][method] = {"summary": summary(rows), "gaps": rows}
    return Report({"wrong_m": _WRONG_ERROR, "drives": results}, _table(results))


def evaluated(
    frames: Sequence[Frame], truth: Array, gap: Gap, settings: SlamSettings, warm: int = _MAX_BEFORE
) -> dict[str, Any]:
    """Results of the odometry after one gap, with at most `warm` frames before it; errors are of the motion since the
    last pose before it."""
    odometry = make_odometry(settings)
    before = [odometry.process(frame) for frame in frames[max(gap.first - warm, 0) : gap.first]][-1]
    last, base, errors, states, uncovered = before, np.zeros((6, 6)), [], [], 0
    for i in range(gap.stop, min(gap.stop + _MAX_AFTER, len(frames))):
        tracked = odometry.process(measured_on(frames[gap.first : i + 1]) if i == gap.stop else frames[i])
        T_true = se3.inverse(truth[gap.first - 1]) @ truth[i]
        error = se3.log(se3.inverse(T_true) @ se3.inverse(before.T_odom_lidar) @ tracked.T_odom_lidar)[3:]
        errors.append(float(np.linalg.norm(error)))
        states.append(tracked.state)
        covariance = _accumulated_covariance(last, base, tracked)
        uncovered += int(errors[-1] > _WRONG_ERROR and error @ np.linalg.solve(covariance[3:, 3:], error) > _MAX_CHI2)
        if tracked.registration.ok:
            last, base = tracked, covariance
    tracking = [i for i, state in enumerate(states) if state is State.TRACKING]
    wrong = sum(errors[i] > _WRONG_ERROR for i in tracking)
    meters, degrees = se3.apart(truth[gap.first - 1], truth[gap.stop])
    return {
        "first": gap.first,
        "seconds": gap.seconds,
        "moved_m": round(meters, 1),
        "turned_deg": round(degrees, 1),
        "silently_wrong_frames": wrong,
        "uncovered_frames": uncovered,
        "tracking_after_frames": tracking[0] + 1 if tracking and not wrong else None,
        "breaks": tracked.breaks,
        "error_m": {"first": round(errors[0], 3), "last": round(errors[-1], 3)},
    }


def measured_on(frames: Sequence[Frame]) -> Frame:
    """The last frame with the IMU samples of all frames: an IMU continues in a gap."""
    imus = [frame.imu for frame in frames if frame.imu is not None]
    return replace(frames[-1], imu=reduce(Inertial.then, imus) if imus else None)


def _accumulated_covariance(last: OdometryResult, base: Array, tracked: OdometryResult) -> Array:
    """Covariance (6, 6) of a pose from `base`, that of the last registered pose; accumulated as in the ROS node."""
    A = se3.adjoint(se3.inverse(tracked.T_odom_lidar) @ last.T_odom_lidar)
    return np.asarray(A @ base @ A.T + tracked.covariance)


def summary(rows: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Number of gaps, and of those that are silently wrong, bridged, and broken; for each length and for all."""
    parts = {f"{s:g} s": [row for row in rows if row["seconds"] == s] for s in _SECONDS} | {"all": list(rows)}
    return {
        name: {
            "gaps": len(part),
            "silently_wrong": sum(row["silently_wrong_frames"] > 0 for row in part),
            "uncovered": sum(row["uncovered_frames"] > 0 for row in part),
            "bridged": sum(row["tracking_after_frames"] is not None for row in part),
            "broken": sum(row["breaks"] > 0 for row in part),
        }
        for name, part in parts.items()
        if part
    }


def _table(results: dict[str, Any]) -> FigureTable:
    columns = {"number": "{gaps}", "silently wrong": "{silently_wrong}", "beyond 3 sigma": "{uncovered}",
               "bridged": "{bridged}", "broken": "{broken}"}  # fmt: skip
    rows = {drive: {name: method["summary"] for name, method in methods.items()} for drive, methods in results.items()}
    return record_table("After a gap in the stream", ["drive", "method", "gap"], columns, rows)
