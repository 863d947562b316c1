# SPDX-License-Identifier: Apache-2.0
"""Geometric verification of a proposed pose: inlier test and covariance."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from dpm2_core.config import Settings
from dpm2_core.estimates import Registration
from dpm2_core.frame import Array, Points
from dpm2_core.geometry import se3
from dpm2_core.geometry.ground import height_above_ground
from dpm2_core.geometry.voxel import voxel_first
from dpm2_core.slam.loops.probe import probed
from dpm2_core.slam.preprocess import PreprocessSettings
from dpm2_core.slam.registration.icp import GeometricRegistration, GeometricSettings
from dpm2_core.slam.registration.local_map import LocalMap, LocalMapSettings

_GROUND_CELL = 2.0  # m, of the grid whose lowest points are the ground
_MIN_HEIGHT = 0.5  # m above it: points on objects
_GOOD_FIT = 0.75  # fraction of these that fits at a right pose; with less, a pose next to it may fit better
_MAX_RATIO = 0.5  # of the unmatched fraction at the best place to that at the second best
_MIN_UNMATCHED = 0.02  # fraction: small rooms of one plan all fit to 100 %
_ASSUMED_FIT = 0.8  # fit that an untried place is assumed to have: in car parks they have 0.5 to 0.89
_MAX_ROTATION = 5.0  # degrees, from the proposed pose
SAME_PLACE = 5.0  # m, poses closer to each other than this are of one place...
_SAME_HEADING = 30.0
"""...and so are headings, degrees: in the middle of a room with two similar ends, both headings fit."""


Along = Callable[[Registration], Registration]
"""Finds the position along the direction that the points leave unconstrained; else returns the result itself."""


class VerificationSettings(Settings):
    """Criteria to accept the pose of a loop, or of a place in a search."""

    min_inliers: float = Field(0.6, ge=0, le=1)
    """Fraction of the points that must fit the map."""
    min_structure: float = Field(0.6, ge=0, le=1)
    """The same for points on objects above the ground: the road fits anywhere."""
    min_points: int = Field(150, ge=0)
    """Minimum number of points above the ground; with fewer, places cannot be distinguished."""
    max_rmse: float = Field(0.2, gt=0)
    """Largest residual of the inliers, m."""
    max_sigma: float = Field(0.1, gt=0)
    """Largest standard deviation of the position in its worst direction, m: rejects loops along a tunnel."""
    max_moved: float = Field(2.0, gt=0)
    """The points may not move the proposed pose farther than this, m, or rotate it by more than 5 degrees."""
    range: float = Field(40.0, gt=0)
    """Points farther than this from the sensor are not used, m: from another lane the view behind objects differs."""


def second_best(best: Registration, others: Sequence[Registration], assumed: float, clearly: float) -> float | None:
    """Confidence of the place that fits nearly as well as the best one; None if the best is clear.

    As the ratio test of D. Lowe, "Distinctive Image Features from Scale-Invariant Keypoints", IJCV 2004, with the
    unmatched fraction as the distance.

    Args:
        others: results at other places, also those that were not accepted.
        assumed: confidence of a place that was not tried.
        clearly: maximum ratio of the unmatched fraction at a clear best place to that at the second best.
    """
    second = max([assumed, *(other.confidence for other in others)])
    return None if max(1 - best.confidence, _MIN_UNMATCHED) <= clearly * (1 - second) else second


def objection_of_others(best: Registration, others: Sequence[Registration]) -> str:
    """Why a verified pose without a prior is rejected: another place fits nearly as well; empty if none does.

    Args:
        others: verifications at other places, also those that were not accepted.
    """
    second = second_best(best, others, _ASSUMED_FIT, _MAX_RATIO)
    if second is None:
        return ""
    if second == _ASSUMED_FIT:
        return f"{best.confidence:.0%} of the points fit: no more than at a place that looks alike"
    return f"two places of the map fit alike: {best.confidence:.0%} and {second:.0%} of the points"


def looks_elsewhere(one: Array, other: Array) -> bool:
    """Whether two poses (4, 4) differ so much in heading that they are two different results."""
    return se3.apart(one, other)[1] > _SAME_HEADING


class Verifier:
    """Registers a cloud to the keyframes around a place, from a proposed pose, and checks the result.

    The point density is that of the odometry.
    """

    def __init__(
        self, settings: VerificationSettings, registration: GeometricSettings, points: PreprocessSettings
    ) -> None:
        self._settings, self._points = settings, points
        self._registration = GeometricRegistration(registration)

    def surroundings(self, clouds: Sequence[Points], poses: Array) -> LocalMap:
        """A local map of (M, 4) clouds at (N, 4, 4) poses, in the frame of those poses, to verify against."""
        local_map = LocalMap(LocalMapSettings(), self._points.map_voxel)
        parts = [se3.transform(T, cloud) for T, cloud in zip(poses, clouds, strict=True)]
        local_map.insert(np.concatenate(parts), np.eye(4), poses)
        return local_map

    def source(self, cloud: Points) -> Array:
        """Points (N, 3) of a cloud (M, 4) that are registered."""
        return cloud[voxel_first(cloud, self._points.source_voxel, far=self._settings.range), :3].astype(np.float64)

    def register(self, source: Array, around: LocalMap, T_proposed: Array, widen: float) -> Registration:
        """Register points (N, 3) of `source` to a map, without verification."""
        return self._registration.register(source, around, T_proposed, widen)

    def verify(
        self, cloud: Points, around: LocalMap, T_proposed: Array, widen: float = 1.0, along: Along | None = None
    ) -> Registration:
        """The refined pose of a cloud (M, 4) in a map; `ok`: whether it is accepted, `reason`: why not.

        Args:
            widen: factor on the search range around the proposed pose.
            along: called if the points leave a direction unconstrained.
        """
        source = self.source(cloud)
        result = self._registration.register(source, around, T_proposed, widen)
        if not result.ok:
            return result
        on_objects = height_above_ground(source, _GROUND_CELL, reach=0) > _MIN_HEIGHT
        points = int(on_objects.sum())
        ratio, structure = self._fit_ratios(source, around, result.T_target_source, on_objects)
        if result.worst_sigma > self._settings.max_sigma or structure < _GOOD_FIT:
            result = probed(self._registration, source, around, result)
            if along is not None and result.worst_sigma > self._settings.max_sigma:
                result = along(result)
            ratio, structure = self._fit_ratios(source, around, result.T_target_source, on_objects)
        T_proposed_found = se3.inverse(T_proposed) @ result.T_target_source
        reason = self._fit_objection(result, ratio, structure, points) or self._shift_objection(T_proposed_found, widen)
        return replace(result, confidence=min(result.confidence, structure), ok=not reason, reason=reason)

    def _fit_ratios(
        self, source: Array, around: LocalMap, T: Array, on_objects: NDArray[np.bool_]
    ) -> tuple[float, float]:
        """Fractions on a surface of the map: of the points (N, 3), and of those on objects."""
        fits = self._registration.fits(source, around, T)
        return float(fits.mean()), float(fits[on_objects].mean()) if on_objects.any() else 0.0

    def _fit_objection(self, result: Registration, ratio: float, structure: float, points: int) -> str:
        """Why the points, this number of them above the ground, do not confirm a pose; empty if they do."""
        s = self._settings
        if ratio < s.min_inliers:
            return f"only {ratio:.0%} of the points fit"
        if points < s.min_points:
            return f"only {points} points above the ground"
        if structure < s.min_structure:
            return f"only {structure:.0%} of the points above the ground fit"
        if result.rmse > s.max_rmse:
            return f"residual {result.rmse:.2f} m"
        if (sigma := result.worst_sigma) > s.max_sigma:
            return f"position uncertain by {sigma:.2f} m"
        return ""

    def _shift_objection(self, T_proposed_found: Array, widen: float) -> str:
        """Why a pose is too far from the proposed one; empty if it is not."""
        meters, degrees = se3.magnitude(T_proposed_found)
        if meters > widen * self._settings.max_moved or degrees > widen * _MAX_ROTATION:
            return f"the points and the proposed pose are {meters:.1f} m, {degrees:.1f} deg apart"
        return ""
