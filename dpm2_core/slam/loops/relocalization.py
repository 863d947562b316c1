# SPDX-License-Identifier: Apache-2.0
"""Global relocalization in a map, from one cloud, without any prior, at any position and heading.

The descriptors find similar keyframes and a pose in each; the points decide. If the second best place fits nearly as
well, there is no result, which is better than a wrong pose. If the points do not determine the position along a road,
an image may: see `pictures`.
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
from dpm2_core.slam.loops.pictures import REACH, KnownMap, PicturedPlaces
from dpm2_core.slam.loops.place_recognition import PlaceRecognition
from dpm2_core.slam.loops.verification import SAME_PLACE, Verifier, looks_elsewhere, objection_of_others
from dpm2_core.slam.registration.texture import Texture, VisualSettings

if TYPE_CHECKING:  # torch takes seconds to import
    from dpm2_core.network.model import DeepPointMap2


HEIGHT = 4.0
"""Weight of height in the distance of two places: 3 m higher, on the next storey, the view is different."""
CANDIDATES = 6
"""Keyframes similar to the scan that the network registers and the points verify."""
_MAX_IMAGES = 150  # keyframes, no two adjacent, whose images are compared if the points do not determine the position
_MAX_KEYFRAMES = 9  # of the map around a place
_IMAGE_REACH = 1.0  # m, along the road around a place that an image has found


class RelocalizationSettings(Settings):
    """Relocalization in a map."""

    surroundings: float = Field(22.0, gt=0)
    """Keyframes within this distance of a candidate make up the map to register to, m; a meter of height counts as
    four; if there are more than nine, the nearest nine."""
    hint_radius: float = Field(20.0, gt=0)
    """With a hint, keyframes farther from it than this are not candidates, m."""


class PlaceFinder(Protocol):
    """Interface that a `Localizer` uses: see `Relocalizer`."""

    def find(self, keyframe: Keyframe, hint: Array | None = None) -> Registration:
        """T_map_lidar of a keyframe with its cloud, or why it is unknown."""

    def verify(self, keyframe: Keyframe, T_map_lidar: Array) -> Registration:
        """Verify a pose in the map by the points."""


class Relocalizer:
    """A map for relocalization; it is only read, never changed."""

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
        """T_map_lidar of a keyframe with its cloud, or why it is unknown.

        Its thumbnail is used if the points do not determine the position along a road.

        Args:
            hint: T_map_lidar (4, 4) to search around; its heading is not used.
        """
        cloud = keyframe.cloud
        try:
            descriptors = self._places.descriptors(keyframe)
        except Dpm2Error as error:
            return nowhere(str(error))
        allowed = np.ones(len(self), bool)
        if hint is not None:  # in x and y only: a click on a map on a screen has no height
            allowed = np.linalg.norm(self._poses[:, :2, 3] - hint[:2, 3], axis=1) <= self._settings.hint_radius
        places = self._verified_proposals(cloud, descriptors, allowed)
        found = (
            _clear_best(places) if places else nowhere(f"no keyframe of {int(allowed.sum())} matches the descriptors")
        )
        texture = self._pictures.texture(keyframe)
        if found.ok or texture is None:
            return found
        nodes = self._places.similar(descriptors, allowed, _MAX_IMAGES)
        verifier, T_across = self._verifiers.suited_to(cloud), self._pose_across_road(places)
        place = self._pictures.find(cloud, texture, nodes, verifier, T_across)
        if place is None:
            return found
        if not place.ok:
            return nowhere(f"{found.reason}; {place.reason}", found.confidence)
        return self._verify_pose(cloud, place.T_target_source, texture, _IMAGE_REACH)

    def verify(self, keyframe: Keyframe, T_map_lidar: Array) -> Registration:
        """Verify a pose in the map by the points, and by the thumbnail if they leave a direction unconstrained; returns
        T_map_lidar, `ok` or not."""
        return self._verify_pose(keyframe.cloud, T_map_lidar, self._pictures.texture(keyframe), REACH)

    def _verify_pose(
        self, cloud: Points, T_map_lidar: Array, picture: Texture | None = None, reach: float = 0.0
    ) -> Registration:
        """As `verify`; an image is compared up to `reach` m to either side along an unconstrained direction."""
        distance = _distance(self._poses, T_map_lidar)
        near = np.flatnonzero(distance <= self._settings.surroundings)
        if not len(near):
            return nowhere("outside the map")
        nodes = near[np.argsort(distance[near])[:_MAX_KEYFRAMES]].tolist()
        T_at_map = se3.inverse(self._poses[nodes[0]])
        verifier = self._verifiers.suited_to(cloud)
        around = verifier.surroundings([self._cloud(n) for n in nodes], T_at_map @ self._poses[nodes])
        along = None if picture is None else self._pictures.along(picture, reach, nodes)
        result = verifier.verify(cloud, around, T_at_map @ T_map_lidar, along=along)
        T = se3.orthonormalized(self._poses[nodes[0]] @ result.T_target_source)
        return replace(result, T_target_source=T, method="relocalisation")

    def _verified_proposals(
        self, cloud: Points, descriptors: Descriptors, allowed: NDArray[np.bool_]
    ) -> list[Registration]:
        """The poses that the descriptors propose among `allowed` (N,) keyframes, `ok` if the points confirm them."""
        nodes = self._places.similar(descriptors, allowed, CANDIDATES)
        return [self._verify_pose(cloud, proposal.T_target_source) for proposal in self._propose(descriptors, nodes)]

    def _pose_across_road(self, places: Sequence[Registration]) -> Array:
        """Position across the road and heading, relative to a keyframe nearby with a similar heading."""
        nearest = [self._poses[_distance(self._poses, place.T_target_source).argmin()] for place in places]
        relative = [(place, se3.inverse(T) @ place.T_target_source) for place, T in zip(places, nearest, strict=True)]
        ahead = [(place, T) for place, T in relative if place.confidence > 0 and T[0, 0] > 0]
        if not ahead:
            return np.eye(4)
        place, T = max(ahead, key=lambda one: one[0].confidence)
        axis = T[:3, :3] @ place.open_direction
        return se3.make(T[:3, :3], T[:3, 3] - axis * (axis @ T[:3, 3]))

    def _propose(self, descriptors: Descriptors, nodes: Sequence[int]) -> list[Registration]:
        """T_map_lidar by each keyframe, the most confident first, one per place."""
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


def _clear_best(places: Sequence[Registration]) -> Registration:
    """The best of several verified poses, if no other place fits nearly as well; else why there is none."""
    best = max(places, key=lambda place: (place.ok, place.confidence))
    if not best.ok:
        return nowhere("; ".join(place.reason for place in places))
    others = [place for place in places if _is_elsewhere(place, best)]
    objection = objection_of_others(best, others)
    if objection:
        return nowhere(objection, best.confidence)
    for other in others:  # which of two equal storeys fits better depends on the positions of the keyframes
        horizontal = np.linalg.norm((other.T_target_source - best.T_target_source)[:2, 3])
        storey = horizontal <= SAME_PLACE < _distance(other.T_target_source, best.T_target_source)
        if storey and other.ok and not objection_of_others(other, []):
            return nowhere(f"{other.confidence:.0%} of the points fit on another storey, too", best.confidence)
    return best


def _is_elsewhere(place: Registration, other: Registration) -> bool:
    T, T_other = place.T_target_source, other.T_target_source
    return bool(_distance(T, T_other) > SAME_PLACE) or looks_elsewhere(T, T_other)


def _distance(poses: Array, pose: Array) -> Array:
    """Distance between the positions of (..., 4, 4) poses and another (4, 4), m, with weighted height."""
    return np.linalg.norm((poses[..., :3, 3] - pose[:3, 3]) * [1.0, 1.0, HEIGHT], axis=-1)


def nowhere(reason: str, confidence: float = 0.0) -> Registration:
    """No pose, with the reason; `confidence`: of the best of places that fit equally well, 0 if none fits."""
    return replace(Registration.failed("relocalisation", reason), confidence=confidence)
