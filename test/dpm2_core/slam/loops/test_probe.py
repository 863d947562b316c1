# SPDX-License-Identifier: Apache-2.0
"""A direction that the normals leave open is constrained if the scan fits worse on either side."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from dpm2_core.slam.loops.probe import probed
from dpm2_core.slam.preprocess import Preprocessor, PreprocessSettings
from dpm2_core.slam.registration.icp import GeometricRegistration, GeometricSettings
from dpm2_core.slam.registration.local_map import LocalMap, LocalMapSettings

from ....helpers.drives import Drive


def test_a_direction_is_open_only_where_the_scan_fits_as_well_a_meter_away(
    suburb_drive: Drive, tunnel_drive: Drive
) -> None:
    """The covariance leaves the direction open in both drives; in a street the scan fits clearly worse a meter away."""
    sigma = {}
    for name, drive in {"street": suburb_drive, "tunnel": tunnel_drive}.items():
        registration, local_map = (
            GeometricRegistration(GeometricSettings()),
            LocalMap(LocalMapSettings(), PreprocessSettings().map_voxel),
        )
        scans = [Preprocessor(PreprocessSettings()).prepare(frame, np.zeros(6)) for frame in drive[0][:6]]
        for scan, T in zip(scans[:5], drive[1][:5], strict=True):
            local_map.insert(scan.cloud, T)
        source = scans[5].source
        result = registration.register(source, local_map, drive[1][5])
        doubted = replace(result, covariance=result.covariance + np.diag([0, 0, 0, 1.0, 0, 0]))
        sigma[name] = probed(registration, source, local_map, doubted).worst_sigma
    assert sigma["street"] < 0.1  # as for an accepted loop
    assert sigma["tunnel"] > 0.5
