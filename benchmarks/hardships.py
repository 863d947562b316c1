# SPDX-License-Identifier: Apache-2.0
"""Failure cases for odometry, made from any drive: low frame rates, gaps, blindness, fog, a bad start, kidnapping."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np

from dpm2_core.data.corrupt import in_fog
from dpm2_core.data.trajectory import frame_period
from dpm2_core.estimates import State
from dpm2_core.frame import Array, Frame
from dpm2_core.geometry import se3

EVERY = (1, 3, 6, 10)
"""Only every Nth frame: at 10 Hz and 50 km/h 1.4, 4, 8 and 14 m apart."""
GAPS, BLIND = (1.0, 2.0, 3.0, 5.0), (1.0, 2.0, 3.0)  # s
FOG = {"fog 40 m": (0.4, 40.0), "fog 20 m": (0.6, 20.0)}
"""Fraction of pulses that return from the fog, and visibility, m."""
_FRAMES_BEFORE, _FRAMES_AFTER = 14, 14  # frames around a gap or a blind sensor
_START_FRAMES = 18  # frames of a drive that starts in motion
_KIDNAPPING_TIME = 2.0  # s, duration of a kidnapping
_MAX_ERROR = 0.5, 0.02  # m, and fraction of the distance: the largest error that is right
_MIN_SPEED = 3.0  # m/s: least speed of a start in motion
_MIN_TURN_RATE = 0.1  # rad/s: least rate of a start in a curve


@dataclass(frozen=True, eq=False)
class Case:
    """One hardship.

    Attributes:
        frames: input of the method. truth: (N, 4, 4) their poses.
        event: the first frame after the event.
        base: the last frame before the event; errors are of the motion since then.
    """

    name: str
    frames: list[Frame]
    truth: Array
    event: int = 1
    base: int = 0


def cases(frames: Sequence[Frame], truth: Array) -> Iterator[Case]:
    """All cases that fit into a drive, given its frames and their poses (N, 4, 4)."""
    count = len(frames)
    for every in [every for every in EVERY if count > every]:  # at least two frames
        yield Case(f"every {every}", list(frames[::every]), truth[::every])
    period = frame_period([frame.stamp for frame in frames])
    for kind, lengths in (("gap", GAPS), ("blind", BLIND)):
        for seconds in lengths:
            missing = round(seconds / period)
            first = (count - missing) // 2
            if min(first, count - first - missing) >= _FRAMES_AFTER // 2:
                yield _interrupted(f"{kind} {seconds:g} s", frames, truth, first, missing)
    yield from _starts(frames, truth, period)
    if count >= 3 * _FRAMES_AFTER // 2:
        for name, (dust, visibility) in FOG.items():
            yield Case(name, [_foggy(frame, dust, visibility) for frame in frames], truth)
        yield _kidnapped(frames, truth)


def judged(case: Case, poses: Array, states: Sequence[State | None]) -> dict[str, Any]:
    """Error in the second half of the frames after the event, and whether the method reported it.

    Args:
        poses: (N, 4, 4). states: of each frame; None if the method has none, and so reports no doubt.

    Returns:
        `error_m`, the largest, m; `verdict`: `right`, `said` (wrong, but no wrong frame has the state tracking) or
        `silent` (wrong without a report).
    """
    base = case.base
    steps = np.linalg.norm(np.diff(case.truth[:, :3, 3], axis=0), axis=1)
    worst, verdict = 0.0, "right"
    for i in range(case.event + (len(case.frames) - case.event) // 2, len(case.frames)):
        T_true, T = se3.inverse(case.truth[base]) @ case.truth[i], se3.inverse(poses[base]) @ poses[i]
        error = float(np.linalg.norm((se3.inverse(T_true) @ T)[:3, 3]))
        worst = max(worst, error)
        if error > _MAX_ERROR[0] + _MAX_ERROR[1] * steps[base:i].sum():
            claimed = states[i] in (None, State.TRACKING)
            verdict = "silent" if claimed or verdict == "silent" else "said"
    return {"error_m": round(worst, 3), "verdict": verdict}


def _interrupted(name: str, frames: Sequence[Frame], truth: Array, first: int, missing: int) -> Case:
    """Without some frames, or, for `blind`, with frames that contain only dirt on the window."""
    start, stop = max(first - _FRAMES_BEFORE, 0), min(first + missing + _FRAMES_AFTER, len(frames))
    blind = range(first, first + missing) if name.startswith("blind") else range(0)
    indices = [*range(start, first), *blind, *range(first + missing, stop)]
    inputs = [_dirty(frames[i]) if i in blind else frames[i] for i in indices]
    return Case(name, inputs, truth[indices], first - start + len(blind), first - start - 1)


def _dirty(frame: Frame) -> Frame:
    """A frame with only some returns from the window itself."""
    rng = np.random.default_rng(frame.index)
    points = np.c_[rng.uniform(-0.5, 0.5, (300, 3)), np.zeros(300)].astype(np.float32)
    return Frame(frame.stamp, points, index=frame.index)


def _foggy(frame: Frame, dust: float, visibility: float) -> Frame:
    points, seen = in_fog(frame.points, dust, visibility, np.random.default_rng(frame.index))
    offset = None if frame.time_offset is None else frame.time_offset[seen]
    return replace(frame, points=points[seen], time_offset=offset)


def _starts(frames: Sequence[Frame], truth: Array, period: float) -> Iterator[Case]:
    """Starts where the vehicle is fastest, and where it rotates fastest."""
    n_starts = len(frames) - _START_FRAMES
    if n_starts < 1:
        return
    motion = np.array([se3.way(a, b) / period for a, b in pairwise(truth)])
    fast, turning = np.linalg.norm(motion[:n_starts, 3:], axis=1), np.abs(motion[:n_starts, 2])
    for name, rate, minimum in (("start at speed", fast, _MIN_SPEED), ("start in a curve", turning, _MIN_TURN_RATE)):
        i = int(rate.argmax())
        if rate[i] >= minimum:
            yield Case(name, list(frames[i : i + _START_FRAMES]), truth[i : i + _START_FRAMES])


def _kidnapped(frames: Sequence[Frame], truth: Array) -> Case:
    """Moved back to an earlier position, 2 s later: the stamps continue."""
    half = len(frames) // 2
    start = half // 4
    revisited = range(start, min(start + _FRAMES_AFTER, half))
    delay = frames[half - 1].stamp + round(_KIDNAPPING_TIME * 1e9) - frames[start].stamp
    inputs = [*frames[:half], *(replace(frames[i], stamp=frames[i].stamp + delay) for i in revisited)]
    return Case("kidnapped", inputs, truth[[*range(half), *revisited]], half, half - 1)
