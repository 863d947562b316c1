# SPDX-License-Identifier: Apache-2.0
"""Resident memory of the SLAM over a long drive, to see whether it levels off."""

from __future__ import annotations

from typing import Any

import numpy as np

from benchmarks.harness import Options, Report, drives, settings_of
from benchmarks.resident import resident_mb
from dpm2_core.console import tracked
from dpm2_core.errors import UsageError
from dpm2_core.slam.build import make_slam
from dpm2_core.tables import FigureTable, record_table

_SAMPLE_PERIOD = 50  # frames between two samples


def bench_memory(options: Options) -> Report:
    """Run the SLAM over each drive, read frame by frame, and sample the resident set every 50 frames.

    Raises:
        UsageError: no drive was given; the KITTI excerpt is too short.
    """
    if not options.sources:
        raise UsageError("memory: give --source with a long drive; `dpm2 sim DIR --frames 2000 --no-images` makes one")
    settings = settings_of(options)
    results: dict[str, Any] = {}
    with drives(options) as sources:
        for name, source in sources.items():
            slam = make_slam(settings)
            samples = [(0, resident_mb())]
            for count, frame in enumerate(tracked(source.frames(), f"{name}: memory", len(source)), 1):
                slam.process(frame)
                if count % _SAMPLE_PERIOD == 0:
                    samples.append((count, resident_mb()))
            results[name] = levelling(samples) | {"keyframes": len(slam.mapper.keyframes)}
    return Report({"drives": results}, _table(results))


def levelling(samples: list[tuple[int, float]]) -> dict[str, Any]:
    """Growth of (frame, MB) samples: linear fit over the second half, and values at start, half and end."""
    frames, megabytes = np.array(samples, np.float64).T
    late = frames >= frames[-1] / 2
    slope = float(np.polyfit(frames[late], megabytes[late], 1)[0]) if late.sum() > 1 else None
    return {
        "frames": int(frames[-1]),
        "rss_mb": {"start": megabytes[0], "half": float(megabytes[late][0]), "end": megabytes[-1]},
        "growth_mb_per_1000_frames_second_half": None if slope is None else 1000 * slope,
        "samples": samples,
    }


def _table(results: dict[str, Any]) -> FigureTable:
    columns = {
        "frames": "{frames}", "keyframes": "{keyframes}", "start": "{rss_mb[start]:.0f}",
        "half way": "{rss_mb[half]:.0f}", "end": "{rss_mb[end]:.0f}",
        "growth per 1000 frames, second half": "{growth_mb_per_1000_frames_second_half:.1f}",
    }  # fmt: skip
    return record_table("Resident memory, MB", ["drive"], columns, results)
