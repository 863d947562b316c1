# SPDX-License-Identifier: Apache-2.0
"""The up direction is estimated from the ground at any tilt up to 35 degrees, and from nothing but the ground."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from dpm2_core.geometry import se3
from dpm2_core.geometry.tilt import up_of

from ...helpers.scenes import boxes


def tilted(
    points: NDArray[np.floating], degrees: float, heading: float
) -> tuple[NDArray[np.float32], NDArray[np.float64]]:
    """Points of a sensor that leans to this side, and its up direction."""
    lean = np.radians(degrees) * np.array([np.cos(heading), np.sin(heading), 0])
    R = se3.exp([*lean, 0, 0, 0])[:3, :3]
    return (points @ R.T).astype(np.float32), R[:, 2]


def street(noise: np.random.Generator) -> NDArray[np.float32]:
    """Level ground with boxes on it, with 2 cm of noise."""
    points = boxes(noise, 20_000)
    points = points[points[:, 2] >= -1.7]
    return (points + noise.normal(scale=0.02, size=points.shape)).astype(np.float32)


def angle(a: NDArray[np.floating] | None, b: NDArray[np.floating]) -> float:
    assert a is not None
    return float(np.degrees(np.arccos(np.clip(a @ b, -1, 1))))


@pytest.mark.parametrize("heading", [0.0, 2.0, 4.0])
@pytest.mark.parametrize("degrees", [0, 8, 20, 35])
def test_up_is_square_to_the_ground(noise: np.random.Generator, degrees: float, heading: float) -> None:
    points, up = tilted(street(noise), degrees, heading)
    assert angle(up_of(points), up) < 1.0  # the foot of a wall counts as ground


def test_up_is_the_same_for_the_same_scan_and_whatever_is_not_finite(noise: np.random.Generator) -> None:
    points, up = tilted(street(noise), 25, 1.0)
    first, second = up_of(points), up_of(points.copy())
    assert first is not None
    np.testing.assert_array_equal(first, second)
    holes = points.copy()
    holes[::7] = np.nan
    holes[1::7] = np.inf
    assert angle(up_of(holes), up) < 1.0


def test_a_slope_beside_level_ground_and_a_ceiling_are_no_ground(noise: np.random.Generator) -> None:
    floor = noise.uniform([-8, -8, -1.7], [8, 8, -1.7], (6000, 3))
    slope = noise.uniform([-8, 8, 0], [8, 20, 0], (3000, 3))
    slope[:, 2] = -1.7 + 0.5 * (slope[:, 1] - 8)
    ceiling = noise.uniform([-8, -8, 1.5], [8, 8, 1.5], (9000, 3))
    points, up = tilted(np.concatenate([floor, slope, ceiling]), 20, 3.0)
    assert angle(up_of(points), up) < 1.0


@pytest.mark.parametrize("what", ["nothing", "few points", "walls", "leaves", "ground too steep", "not finite"])
def test_without_ground_nothing_is_up(noise: np.random.Generator, what: str) -> None:
    walls = noise.uniform([-10, -3, -2], [10, 3, 6], (5000, 3))
    walls[:, 1] = np.sign(walls[:, 1]) * 3
    scans = {
        "nothing": np.zeros((0, 3)),
        "few points": street(noise)[:40],
        "walls": walls,
        "leaves": noise.normal(size=(5000, 3)) * 6,
        "ground too steep": tilted(street(noise), 60, 0.5)[0],
        "not finite": np.full((500, 3), np.nan),
    }
    assert up_of(scans[what]) is None
