# SPDX-License-Identifier: Apache-2.0
"""A search for the place of a scan: found among hundreds of starts, and rejected where two places look alike."""

from __future__ import annotations

import numpy as np
import pytest

from dpm2_core.frame import Array
from dpm2_core.geometry import se3
from dpm2_core.slam.preprocess import Preprocessor, PreprocessSettings, Scan
from dpm2_core.slam.registration.icp import GeometricRegistration, GeometricSettings
from dpm2_core.slam.registration.local_map import LocalMap, LocalMapSettings
from dpm2_core.slam.registration.points import GeometricScanRegistration
from dpm2_core.slam.registration.protocol import Prediction

from ....helpers.drives import Drive


def mapped(drive: Drive) -> GeometricScanRegistration:
    """Five scans of a drive as a map."""
    made = GeometricScanRegistration(
        Preprocessor(PreprocessSettings()), GeometricRegistration(GeometricSettings()), LocalMap(LocalMapSettings())
    )
    for frame, T in zip(*(part[:5] for part in drive), strict=True):
        made.update(made.prepare(frame, np.zeros(6)), T)
    return made


def searched(drive: Drive, starts: list[Array]) -> tuple[bool, str, float]:
    """Of the sixth scan: whether it is found, why not, and how far from where it was taken, m."""
    registration = mapped(drive)
    scan: Scan = registration.prepare(drive[0][5], np.zeros(6))
    result = registration.register(scan, Prediction(starts, unique=True))
    return result.ok, result.reason, float(np.linalg.norm((result.T_target_source - drive[1][5])[:3, 3]))


@pytest.mark.parametrize("turn", [0.0, 0.3])
def test_the_place_is_found_among_many(suburb_drive: Drive, turn: float) -> None:
    """Half a meter and four degrees are near enough for a start."""
    grid = [[0, 0, turn + yaw, x, y, 0] for yaw in (-0.3, -0.15, 0, 0.15) for x in range(-8, 9) for y in (-1, 0, 1)]
    off = np.array([0, 0, 0.07, 0.25, 0.25, 0])
    ok, reason, error = searched(suburb_drive, [suburb_drive[1][5] @ se3.exp(xi) for xi in np.array(grid) + off])
    assert (ok, reason) == (True, "")
    assert error < 0.03


def test_two_places_that_look_alike_are_none(tunnel_drive: Drive) -> None:
    """Along a tunnel every start fits."""
    starts = [tunnel_drive[1][5] @ se3.exp([0, 0, 0, x, 0, 0]) for x in np.arange(-6, 6.5, 0.5)]
    ok, reason, _ = searched(tunnel_drive, starts)
    assert not ok
    assert "m away fits as well" in reason


def test_where_the_scan_was_not_taken_it_is_not_found(suburb_drive: Drive) -> None:
    ok, reason, _ = searched(suburb_drive, [se3.exp([0, 0, 0, x, 60, 0]) for x in range(8)])
    assert not ok
    assert reason
