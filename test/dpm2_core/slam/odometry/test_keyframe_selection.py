# SPDX-License-Identifier: Apache-2.0
"""Keyframes by motion, and, as DeepPointMap spaces them, by how well scans register."""

from __future__ import annotations

import numpy as np
import pytest

from dpm2_core.frame import Frame, Registration
from dpm2_core.geometry import se3
from dpm2_core.slam.odometry.keyframe_selection import KeyframeSelector, KeyframeSettings
from dpm2_core.slam.preprocess import Scan


def places(settings: KeyframeSettings, rmse: float, meters: int = 120) -> list[float]:
    """Where keyframes are made along a straight way with a scan per meter."""
    selector, scan, out = KeyframeSelector(settings), Scan(np.zeros((5, 4), np.float32)), []
    for x in range(meters):
        T = se3.make(np.eye(3), [float(x), 0, 0])
        if selector.select(Frame(x, scan.points), scan, T, Registration(T, np.eye(6) * 1e-4, 1.0, rmse, "test")):
            out.append(float(x))
    return out


def test_by_motion_the_residual_has_no_say() -> None:
    assert places(KeyframeSettings(distance=10), 0.0) == places(KeyframeSettings(distance=10), 0.9)
    assert np.unique(np.diff(places(KeyframeSettings(distance=10), 0.1))).tolist() == [10.0]


@pytest.mark.parametrize(("rmse", "spacing"), [(0.0, 20.0), (0.146, 10.0), (0.5, 1.0), (np.inf, 1.0)])
def test_by_the_residual_the_spacing_settles(rmse: float, spacing: float) -> None:
    """At 2 (1 - rmse / 0.5)^2 of the distance, but no less than 1 m."""
    at = places(KeyframeSettings(distance=10, residual=0.5), rmse)
    assert np.diff(at)[-3:] == pytest.approx(spacing, abs=1.01)  # a scan per meter
