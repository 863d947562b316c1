# SPDX-License-Identifier: Apache-2.0
"""Registration of scans by their points, to a local map."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from dpm2_core.frame import Array, Frame, Registration
from dpm2_core.geometry import se3
from dpm2_core.slam.preprocess import Preprocessor, Scan
from dpm2_core.slam.registration.icp import GeometricRegistration
from dpm2_core.slam.registration.local_map import LocalMap
from dpm2_core.slam.registration.protocol import Prediction

_EQUAL = 0.02
"""Mean log likelihoods of the points that differ by less say nothing, such as along a tunnel."""
_DISTINCT = 0.06
"""By so much must the mean log likelihood of a place exceed that of every other one that a search has found."""
_FEW = 400  # points show which places of a search are likely;
_PLACES = 6  # so many of them are registered to,
_PART = 4  # by one point in so many; all points compare the best two
_NEAR = (1.0, 5.0)  # m and degrees: results within are one place


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
        if p.unique:
            return self._searched(scan.source, p)
        found = [self._registration.register(scan.source, self._local_map, T, p.widen, p.information) for T in p.starts]
        if len(found) == 1:
            return found[0]
        fit = [self._registration.likelihood(scan.source, self._local_map, r.T_target_source) for r in found]
        ok = max(r.ok for r in found)
        best = max(value for r, value in zip(found, fit, strict=True) if r.ok == ok)
        # The first of equals: least motion, where a tunnel fits anywhere.
        chosen = next(r for r, value in zip(found, fit, strict=True) if r.ok == ok and value >= best - _EQUAL)
        likely = [r for r, value in zip(found, fit, strict=True) if r.ok == ok and value >= best - _DISTINCT]
        return _with_spread(chosen, likely)

    def _searched(self, source: Array, prediction: Prediction) -> Registration:
        """The place that fits best, if no other one fits nearly as well."""
        poses = np.asarray(prediction.starts)
        few = source[:: -(-len(source) // _FEW)]
        places: list[Array] = []
        for i in np.argsort(-self._local_map.fit(few, poses), kind="stable"):
            if all(_apart(poses[i], T) for T in places):
                places.append(poses[i])
            if len(places) == _PLACES:
                break
        part = np.ascontiguousarray(source[::_PART])
        found = [self._registration.register(part, self._local_map, T).T_target_source for T in places]
        fit = [self._registration.likelihood(part, self._local_map, T) for T in found]
        order = np.argsort(fit)[::-1]
        rival = next((found[i] for i in order if _apart(found[i], found[order[0]])), None)
        result, likelihood = self._fitted(source, found[order[0]])
        if result.confidence < self._registration.min_inliers_expected:
            return replace(result, ok=False)
        if rival is not None:
            other, its_likelihood = self._fitted(source, rival)
            meters, _ = se3.magnitude(se3.inverse(result.T_target_source) @ other.T_target_source)
            if its_likelihood > likelihood - _DISTINCT and _apart(other.T_target_source, result.T_target_source):
                return replace(result, ok=False, reason=f"a place {meters:.1f} m away fits as well")
        return replace(result, ok=True, reason="")

    def _fitted(self, source: Array, T: Array) -> tuple[Registration, float]:
        """Registered from T, and the likelihood there."""
        result = self._registration.register(source, self._local_map, T)
        return result, self._registration.likelihood(source, self._local_map, result.T_target_source)

    def update(self, scan: Scan, T_odom_lidar: Array) -> bool:
        wanted = self._local_map.wants(T_odom_lidar)
        if wanted:
            self._local_map.insert(scan.cloud, T_odom_lidar)
        return wanted


def _with_spread(chosen: Registration, likely: Sequence[Registration]) -> Registration:
    """With the way (6,) to the farthest of the results that are nearly as likely in its covariance."""
    T = se3.inverse(chosen.T_target_source)
    way = max((se3.log(T @ other.T_target_source) for other in likely), key=lambda xi: float(np.linalg.norm(xi[3:])))
    return replace(chosen, covariance=chosen.covariance + np.outer(way, way))


def _apart(T: Array, T_other: Array) -> bool:
    meters, degrees = se3.magnitude(se3.inverse(T) @ T_other)
    return meters > _NEAR[0] or degrees > _NEAR[1]
