# SPDX-License-Identifier: Apache-2.0
"""Texture that is constant along a road does not determine the position along it."""

from __future__ import annotations

import numpy as np
import pytest

from dpm2_core.frame import Array
from dpm2_core.slam.registration.texture import VisualSettings, glance, peaks, reference, textured

from ....helpers.corridor import HALF, Paint, frame, random_paint

AXIS = np.array([1.0, 0.0, 0.0])
SETTINGS = VisualSettings()


def railed(contrast: float) -> Paint:
    """Walls with faint paint next to two black rails."""
    walls = random_paint(4)

    def paint(points: Array) -> Array:
        on_wall = np.abs(points[:, 1]) > HALF - 1e-6
        rail = on_wall & (np.abs(np.abs(points[:, 2]) - 0.8) < 0.15)
        return np.where(rail, 0.0, 128 + contrast * (walls(points) - 128))

    return paint


@pytest.mark.parametrize(("contrast", "truck"), [(1.0, False), (0.4, False), (1.0, True)])
def test_neither_rails_nor_a_truck_ahead_hide_the_way(contrast: float, truck: bool) -> None:
    """1.7 m, to 5 cm, and nothing else correlates half as well. The truck drives at the same speed."""
    paint = railed(contrast)
    first, second = frame(0.0, paint, truck=truck), frame(1.7, paint, 1, gain=0.8, truck=truck)
    known = reference(first.points, textured(first.images[0]), AXIS)
    image = textured(second.images[0])
    best, *others = peaks(SETTINGS, known, image, np.eye(4), AXIS, 6.0)
    assert best.offset == pytest.approx(1.7, abs=0.05)
    assert all(peak.correlation < best.correlation / 2 for peak in others if abs(peak.offset - best.offset) > 0.6)
    assert glance(known, image, np.eye(4), AXIS, 6.0).offset == pytest.approx(1.7, abs=0.2)
