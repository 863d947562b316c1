# SPDX-License-Identifier: Apache-2.0
"""WGS84 compared with known values: the ellipsoid's axes, published arcs of a meridian and a parallel, and round
trips."""

from __future__ import annotations

import numpy as np
import pytest

from dpm2_core.geometry import geodesy, se3

PLACES = np.array([[0, 0, 0], [49.0, 8.4, 110], [-33.9, 151.2, 8848], [89.9999, -45, -50], [0.1, 179.9999, 12000.0]])


def test_on_the_axes_the_radii_are_those_of_the_ellipsoid() -> None:
    """a = 6378137 m and b = 6356752.3142 m: NIMA TR8350.2, tables 3.1 and 3.3."""
    expected = [[6378137.0, 0, 0], [0, 6378137.0 + 100, 0], [0, 0, 6356752.3142]]
    np.testing.assert_allclose(geodesy.ecef([[0, 0, 0], [0, 90, 100], [90, 0, 0]]), expected, atol=1e-4)


@pytest.mark.parametrize(
    ("latitude", "north", "east"),
    [(0, 110574, 111320), (15, 110649, 107550), (45, 111132, 78847), (60, 111412, 55800), (75, 111618, 28902)],
)
def test_a_degree_is_as_long_as_published(latitude: float, north: float, east: float) -> None:
    """Meters per degree on WGS84: P. Osborne, The Mercator Projections (2013), chapter 5."""
    a, b = geodesy.ecef([[latitude - 0.005, 8.0, 0], [latitude + 0.005, 8.0, 0]])
    assert np.linalg.norm(a - b) * 100 == pytest.approx(north, abs=1.0)
    a, b = geodesy.ecef([[latitude, 8.0, 0], [latitude, 8.01, 0]])
    assert np.linalg.norm(a - b) * 100 == pytest.approx(east, abs=1.0)


def test_there_and_back_is_exact_to_a_millimeter() -> None:
    back = geodesy.geodetic(geodesy.ecef(PLACES))
    np.testing.assert_allclose(geodesy.ecef(back), geodesy.ecef(PLACES), atol=1e-3)
    np.testing.assert_allclose(back, PLACES, atol=1e-3)


def test_the_local_frame_points_east_north_and_up() -> None:
    T = geodesy.enu_frame(PLACES[1])
    assert se3.is_rigid(T, 1e-12)
    steps = geodesy.ecef(PLACES[1] + np.array([[0, 1e-5, 0], [1e-5, 0, 0], [0, 0, 1.0]])) - T[:3, 3]
    local = steps @ T[:3, :3]
    np.testing.assert_allclose(local / np.linalg.norm(local, axis=1, keepdims=True), np.eye(3), atol=1e-6)
