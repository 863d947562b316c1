# SPDX-License-Identifier: Apache-2.0
"""Loops by geometry: near keyframes of long ago, verified by registering the points; each refusal has its reason."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from dpm2_core.config import Settings
from dpm2_core.frame import Array, Points, Registration
from dpm2_core.geometry import se3
from dpm2_core.geometry.voxel import voxel_first
from dpm2_core.slam.local_map import LocalMap, LocalMapSettings
from dpm2_core.slam.registration import GeometricRegistration, GeometricSettings

_SOURCE_VOXEL = 0.8  # m, spacing of the points that are registered, as in the odometry


class LoopSettings(Settings):
    """Search for and verification of loops."""

    enabled: bool = True
    """Close loops at all."""
    gap: float = 50.0
    """Path that must lie between two keyframes of a loop, m."""
    radius: float = 8.0
    """Keyframes nearer than this are candidates, m; `drift` widens it."""
    drift: float = 0.01
    """Odometry error to reckon with a metre of path since the candidate: widens the search and bounds a correction."""
    min_inliers: float = 0.6
    """Share of the points that must fit the map around the candidate."""
    max_rmse: float = 0.2
    """Largest residual of those that fit, m."""
    max_sigma: float = 0.1
    """Largest standard deviation of the position in its worst direction, m: refuses loops along a tunnel."""
    neighbours: int = 5
    """Keyframes on either side of the candidate that make up the map to register to."""


class LoopCloser:
    """Proposes the nearest old keyframe and registers the new one to the map around it."""

    def __init__(self, settings: LoopSettings, registration: GeometricSettings, threads: int = 2) -> None:
        self._settings = settings
        self._registration = GeometricRegistration(registration)
        self._threads = threads

    def close(self, clouds: Sequence[Points], poses: Array) -> tuple[int, Registration] | None:
        """Try to close a loop with the last keyframe.

        Args:
            clouds: those of all keyframes, each (M, 4) in its own frame.
            poses: (N, 4, 4) T_map_kf of all keyframes.

        Returns:
            The candidate and T_candidate_last, accepted or refused with its reason; None: nobody is near.
        """
        s = self._settings
        positions = poses[:, :3, 3]
        steps = np.linalg.norm(np.diff(positions, axis=0), axis=1)
        path = np.concatenate([[0.0], np.cumsum(steps)])
        since = path[-1] - path
        distance = np.linalg.norm(positions - positions[-1], axis=1)
        reach = s.radius + s.drift * since
        near = np.flatnonzero((since > s.gap) & (distance < reach))
        if not s.enabled or len(near) == 0:
            return None
        to = len(poses) - 1
        candidate = int(near[np.argmin(distance[near])])
        T_guess = se3.inverse(poses[candidate]) @ poses[to]
        found = self._verify(clouds, poses, candidate, T_guess)
        moved = se3.inverse(T_guess) @ found.T_target_source
        metres, degrees = float(np.linalg.norm(moved[:3, 3])), float(np.degrees(se3.angle(moved)))
        if found.ok and found.confidence < s.min_inliers:
            found = replace(found, ok=False, reason=f"only {found.confidence:.0%} of the points fit")
        elif found.ok and found.rmse > s.max_rmse:
            found = replace(found, ok=False, reason=f"residual {found.rmse:.2f} m")
        elif found.ok and (sigma := found.worst_sigma) > s.max_sigma:
            found = replace(found, ok=False, reason=f"position uncertain by {sigma:.2f} m")
        elif found.ok and (metres > 1.0 + s.drift * since[candidate] or degrees > 3.0 + 0.02 * since[candidate]):
            found = replace(found, ok=False, reason=f"{metres:.1f} m, {degrees:.1f} deg from the odometry")
        return candidate, found

    def _verify(self, clouds: Sequence[Points], poses: Array, candidate: int, T_guess: Array) -> Registration:
        """T_candidate_new by points against the keyframes around the candidate, in its frame."""
        around = range(max(0, candidate - self._settings.neighbours), candidate + self._settings.neighbours + 1)
        local_map = LocalMap(LocalMapSettings(), self._threads)
        to_candidate = se3.inverse(poses[candidate])
        near = [se3.transform(to_candidate @ poses[i], clouds[i]) for i in around if i < len(clouds) - 1]
        local_map.insert(np.concatenate(near), np.eye(4))
        last = clouds[-1]
        source = last[voxel_first(last, _SOURCE_VOXEL), :3].astype(np.float64)
        return self._registration.register(source, local_map, T_guess, widen=2.0)
