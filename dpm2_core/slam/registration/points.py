# SPDX-License-Identifier: Apache-2.0
"""Registration of scans by their points, to a local map."""

from __future__ import annotations

from dpm2_core.frame import Array, Frame, Registration
from dpm2_core.slam.preprocess import Preprocessor, Scan
from dpm2_core.slam.registration.icp import GeometricRegistration
from dpm2_core.slam.registration.local_map import LocalMap
from dpm2_core.slam.registration.protocol import Prediction

_EQUAL = 0.02
"""Mean log likelihoods of the points that differ by less say nothing, such as along a tunnel."""


class GeometricScanRegistration:
    """Points to a local map of points."""

    uses_images = False

    def __init__(self, preprocessor: Preprocessor, registration: GeometricRegistration, local_map: LocalMap) -> None:
        self._preprocessor = preprocessor
        self._registration = registration
        self._local_map = local_map

    def __len__(self) -> int:
        return len(self._local_map)

    def clear(self) -> None:
        self._local_map.clear()

    def fresh(self) -> GeometricScanRegistration:
        return GeometricScanRegistration(self._preprocessor, self._registration, self._local_map.fresh())

    def prepare(self, frame: Frame, twist: Array) -> Scan:
        return self._preprocessor.prepare(frame, twist)

    def rejection(self, scan: Scan) -> str:
        least = self._registration.min_points
        return "" if len(scan.source) >= least else f"{len(scan.source)} points; a map needs {least}"

    def register(self, scan: Scan, prediction: Prediction) -> Registration:
        p = prediction
        found = [self._registration.register(scan.source, self._local_map, T, p.widen, p.information) for T in p.starts]
        if len(found) == 1:
            return found[0]
        fit = [self._registration.likelihood(scan.source, self._local_map, r.T_target_source) for r in found]
        ok = max(r.ok for r in found)
        best = max(value for r, value in zip(found, fit, strict=True) if r.ok == ok)
        # The first of equals: least motion, where a tunnel fits anywhere.
        return next(r for r, value in zip(found, fit, strict=True) if r.ok == ok and value >= best - _EQUAL)

    def update(self, scan: Scan, T_odom_lidar: Array) -> None:
        if self._local_map.wants(T_odom_lidar):
            self._local_map.insert(scan.cloud, T_odom_lidar)
