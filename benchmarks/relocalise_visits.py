# SPDX-License-Identifier: Apache-2.0
"""One visit to a saved map, and the summary of many."""

from __future__ import annotations

from collections.abc import Callable
from time import perf_counter
from typing import Any

import numpy as np

from dpm2_core.estimates import Keyframe, Registration
from dpm2_core.frame import Array, Frame, Points
from dpm2_core.geometry import se3
from dpm2_core.geometry.scale import ByScale
from dpm2_core.geometry.voxel import voxel_first
from dpm2_core.network.model import DeepPointMap2
from dpm2_core.slam.build import make_verifier
from dpm2_core.slam.loops.pictures import KnownMap
from dpm2_core.slam.loops.relocalization import Relocalizer
from dpm2_core.slam.preprocess import Preprocessor
from dpm2_core.slam.settings import SlamSettings

RIGHT_M, RIGHT_DEG = 0.3, 1.0
"""Largest error of a result that is right."""


def relocalizer_in(settings: SlamSettings, network: DeepPointMap2, known: KnownMap) -> Relocalizer:
    """A relocalizer in a map of streets."""
    verifier = make_verifier(settings)
    return Relocalizer(settings.relocalise, settings.visual, ByScale(verifier, verifier), network, known)


def success_rates(rows: list[tuple[bool, float, float, float]]) -> dict[str, Any]:
    """Summary of results: found or not, error in m and degrees, seconds."""
    ok, meters, degrees, seconds = (np.array(column) for column in zip(*rows, strict=True))
    right = ok & (meters <= RIGHT_M) & (degrees <= RIGHT_DEG)
    found_errors = meters[ok]
    return {
        "visits": len(rows),
        "right": round(float(right.mean()), 4),
        "no_answer": int((~ok).sum()),
        "wrong": int((ok & ~right).sum()),
        "median_error_m": round(float(np.median(found_errors)), 4) if len(found_errors) else None,
        "seconds": {f"p{q}": round(float(np.percentile(seconds, q)), 3) for q in (50, 95)},
    }


def evaluate_visit(
    find: Callable[[Keyframe], Registration], visit: Keyframe, truth: Array
) -> tuple[bool, float, float, float]:
    """The result of a visit, for `success_rates`; `truth` T_map_lidar (4, 4)."""
    started = perf_counter()
    result = find(visit)
    seconds = perf_counter() - started
    return result.ok, *se3.apart(result.T_target_source, truth), seconds


def preprocessed(frame: Frame, settings: SlamSettings) -> Points:
    """The points (N, 4) of a frame at rest, preprocessed as in the SLAM."""
    return Preprocessor(settings.preprocess).measured(frame, np.zeros(6))[0]


def keyframe_cloud(points: Points, settings: SlamSettings) -> Points:
    """The (M, 4) of these points that a keyframe stores."""
    return points[voxel_first(points, settings.keyframes.voxel, far=settings.keyframes.range)]
