# SPDX-License-Identifier: Apache-2.0
"""Where in a map am I? From one cloud, without any prior, from anywhere and whatever the heading.

The descriptors find the keyframes that look alike and a pose in each; the points decide. Where the second best place
fits nearly as well there is no answer: it is better not to know than to be sure of the wrong one. Where the points do
not know how far along a road one is, a picture may: see `pictures`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Protocol

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from dpm2_core.config import Settings
from dpm2_core.descriptors import Descriptors
from dpm2_core.errors import Dpm2Error
from dpm2_core.estimates import Keyframe, Registration
from dpm2_core.frame import Array, Points
from dpm2_core.geometry import se3
from dpm2_core.geometry.scale import ByScale
from dpm2_core.slam.loops.pictures import BETWEEN, KnownMap, PicturedPlaces
from dpm2_core.slam.loops.place_recognition import PlaceRecognition
from dpm2_core.slam.loops.verification import SAME_PLACE, Verifier, looks_elsewhere, objection_of_others
from dpm2_core.slam.registration.texture import Texture, VisualSettings

if TYPE_CHECKING:  # torch takes seconds to import
    from dpm2_core.network.model import DeepPointMap2


HEIGHT = 4.0
"""m that a meter of height counts for between two places: 3 m up, on the next storey, one sees other things."""
CANDIDATES = 6
"""Keyframes that look like the scan, which the network registers and the points verify."""
_PICTURED = 150  # keyframes, no two next to each other, whose pictures are compared where the points leave the way open
_KEYFRAMES = 9  # make up the map around a place, at most
_REACH = 1.0  # m, along the road around a place that a picture has found


class RelocalizationSettings(Settings):
    """Finding oneself in a map."""

    surroundings: float = Field(22.0, gt=0)
    """Keyframes so near to a candidate make up the map to register to, m; a meter of height counts for four;
    of more than nine the nearest."""
    hint_radius: float = Field(20.0, gt=0)
    """With a hint, keyframes farther from it than this are no candidates, m."""


class FindsPlaces(Protocol):
    """What a `Localizer` asks: see `Relocalizer`."""

    def find(self, keyframe: Keyframe, hint: Array | None = None) -> Registration:
        """T_map_lidar of a keyframe, which has its cloud, or why it is not known."""

    def verify(self, keyframe: Keyframe, T_map_lidar: Array) -> Registration:
        """Verifies a pose in the map by the points."""


class Relocalizer:
    """A map to find oneself in. Reads it, never changes it."""

    def __init__(
        self,
        settings: RelocalizationSettings,
        visual: VisualSettings,
        verifiers: ByScale[Verifier],
        network: DeepPointMap2,
        known: KnownMap,
    ) -> None:
        self._settings = settings
        self._keyframes, self._cloud, self._poses = known.keyframes, known.cloud, known.poses
        self._places = PlaceRecognition(network)
        self._places.update(self._keyframes)
        self._pictures = PicturedPlaces(visual, known)
        self._verifiers = verifiers

    def __len__(self) -> int:
        return len(self._keyframes)

    def find(self, keyframe: Keyframe, hint: Array | None = None) -> Registration:
        """T_map_lidar of a keyframe, which has its cloud, or why it is not known.

        Its thumbnail is asked where the points do not say how far along a road it was.

        Args:
            hint: T_map_lidar (4, 4) to look around; its heading does not matter.
        """
        cloud = keyframe.cloud
        try:
            descriptors = self._places.descriptors(keyframe)
        except Dpm2Error as error:
            return nowhere(str(error))
        allowed = np.ones(len(self), bool)
        if hint is not None:  # as on a plan: who points at a map on a screen gives no height
            allowed = np.linalg.norm(self._poses[:, :2, 3] - hint[:2, 3], axis=1) <= self._settings.hint_radius
        places = self._by_points(cloud, descriptors, allowed)
        found = _unique(places) if places else nowhere(f"no keyframe of {int(allowed.sum())} matches the descriptors")
        texture = self._pictures.texture(keyframe)
        if found.ok or texture is None:
            return found
        nodes = self._places.similar(descriptors, allowed, _PICTURED)
        verifier, T_across = self._verifiers.suited_to(cloud), self._across(places)
        place = self._pictures.find(cloud, texture, nodes, verifier, T_across)
        if place is None:
            return found
        if not place.ok:
            return nowhere(f"{found.reason}; {place.reason}", found.confidence)
        return self._verified(cloud, place.T_target_source, texture, _REACH)

    def verify(self, keyframe: Keyframe, T_map_lidar: Array) -> Registration:
        """Verifies a pose in the map by the points, and the thumbnail where they leave a direction open: T_map_lidar,
        `ok` or not."""
        return self._verified(keyframe.cloud, T_map_lidar, self._pictures.texture(keyframe), BETWEEN)

    def _verified(
        self, cloud: Points, T_map_lidar: Array, picture: Texture | None = None, reach: float = 0.0
    ) -> Registration:
        """As `verify`; where the points leave a direction open a picture is compared up to `reach` m to either side."""
        distance = _distance(self._poses, T_map_lidar)
        near = np.flatnonzero(distance <= self._settings.surroundings)
        if not len(near):
            return nowhere("outside the map")
        nodes = near[np.argsort(distance[near])[:_KEYFRAMES]].tolist()
        T_at_map = se3.inverse(self._poses[nodes[0]])
        verifier = self._verifiers.suited_to(cloud)
        around = verifier.surroundings([self._cloud(n) for n in nodes], T_at_map @ self._poses[nodes])
        along = None if picture is None else self._pictures.along(picture, reach, nodes)
        result = verifier.verify(cloud, around, T_at_map @ T_map_lidar, along=along)
        T = se3.orthonormalized(self._poses[nodes[0]] @ result.T_target_source)
        return replace(result, T_target_source=T, method="relocalisation")

    def _by_points(self, cloud: Points, descriptors: Descriptors, allowed: NDArray[np.bool_]) -> list[Registration]:
        """The places that the descriptors propose among `allowed` (N,) keyframes, `ok` if the points confirm them."""
        nodes = self._places.similar(descriptors, allowed, CANDIDATES)
        return [self._verified(cloud, proposal.T_target_source) for proposal in self._proposals(descriptors, nodes)]

    def _across(self, places: Sequence[Registration]) -> Array:
        """Where across the road, seen from a keyframe beside it that looks the same way, and with which heading."""
        nearest = [self._poses[_distance(self._poses, place.T_target_source).argmin()] for place in places]
        seen = [(place, se3.inverse(T) @ place.T_target_source) for place, T in zip(places, nearest, strict=True)]
        ahead = [(place, T) for place, T in seen if place.confidence > 0 and T[0, 0] > 0]
        if not ahead:
            return np.eye(4)
        place, T = max(ahead, key=lambda one: one[0].confidence)
        way = T[:3, :3] @ place.open_direction
        return se3.make(T[:3, :3], T[:3, 3] - way * (way @ T[:3, 3]))

    def _proposals(self, descriptors: Descriptors, nodes: Sequence[int]) -> list[Registration]:
        """T_map_lidar by each keyframe, the most confident first, one for each place."""
        known = [(node, d) for node in nodes if (d := self._keyframes[node].descriptors) is not None]
        results = self._places.register(descriptors, [d for _, d in known])
        proposals: list[Registration] = []
        in_map = [
            replace(result, T_target_source=self._poses[node] @ result.T_target_source)
            for (node, _), result in zip(known, results, strict=True)
            if result.ok
        ]
        for proposal in sorted(in_map, key=lambda r: -r.confidence):
            if all(_is_elsewhere(proposal, other) for other in proposals):
                proposals.append(proposal)
        return proposals


def _unique(places: Sequence[Registration]) -> Registration:
    """The best of several verified places, if no other one fits nearly as well; else why not."""
    best = max(places, key=lambda place: (place.ok, place.confidence))
    if not best.ok:
        return nowhere("; ".join(place.reason for place in places))
    others = [place for place in places if _is_elsewhere(place, best)]
    objection = objection_of_others(best, others)
    if objection:
        return nowhere(objection, best.confidence)
    for other in others:  # which of two equal storeys fits better depends on where the keyframes were taken
        beside = np.linalg.norm((other.T_target_source - best.T_target_source)[:2, 3])
        storey = beside <= SAME_PLACE < _distance(other.T_target_source, best.T_target_source)
        if storey and other.ok and not objection_of_others(other, []):
            return nowhere(f"{other.confidence:.0%} of the points fit on another storey, too", best.confidence)
    return best


def _is_elsewhere(place: Registration, other: Registration) -> bool:
    T, T_other = place.T_target_source, other.T_target_source
    return bool(_distance(T, T_other) > SAME_PLACE) or looks_elsewhere(T, T_other)


def _distance(poses: Array, pose: Array) -> Array:
    """Between the positions of (..., 4, 4) poses and another (4, 4), m."""
    return np.linalg.norm((poses[..., :3, 3] - pose[:3, 3]) * [1.0, 1.0, HEIGHT], axis=-1)


def nowhere(reason: str, confidence: float = 0.0) -> Registration:
    """No pose, and why; `confidence`: of the best of places that fit alike, 0 where none fits."""
    return replace(Registration.failed("relocalisation", reason), confidence=confidence)
