# SPDX-License-Identifier: Apache-2.0
"""Where along a tunnel or a highway am I? From a cloud and a picture, by the pictures of a map's keyframes.

The points say where across the road; the texture says where along it. At the right place what does not correlate is at
most half of that at the second best (two thirds of it here and there); on simulated roads of 1 km and on KITTI 04 it is
at least two thirds where the right place is not in the map.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np

from dpm2_core.data.thumbnail import image_of
from dpm2_core.frame import Array, Image, Keyframe, Points, Registration
from dpm2_core.geometry import se3
from dpm2_core.slam.loops.verification import Along, Verifier, objection_of_others
from dpm2_core.slam.registration.texture import (
    Reference,
    Texture,
    VisualSettings,
    along,
    glance,
    peaks,
    reference,
    textured,
)

_CORRELATED = 0.85  # at least, at the right place; at wrong ones up to 0.79 on KITTI
_EACH = 2  # every second point is registered, to a single keyframe
_WIDEN = 2.0  # of how far they may look: it can be in another lane
_CLOSER = 8  # so many keyframes are compared closely, and those beside them
_APART = 1.0  # m: other places
_KEPT = 1000  # references in memory, 30 kB each


@dataclass(frozen=True, eq=False)
class KnownMap:
    """A map in which places are looked for.

    Attributes:
        keyframes: with descriptors. clouds: (M, 4) of each. poses: (N, 4, 4) T_map_kf.
        thumbnail: JPEG of a node, or None.
    """

    keyframes: Sequence[Keyframe]
    clouds: Sequence[Points]
    poses: Array
    thumbnail: Callable[[int], bytes | None] = lambda node: None


@dataclass(frozen=True, eq=False)
class _View:
    """What is looked for: points (N, 3) to be registered, a picture, and T_kf_lidar but for the way along the road."""

    source: Array
    picture: Texture
    verifier: Verifier
    T_across: Array


class PicturedPlaces:
    """The keyframes of a map that have pictures."""

    def __init__(self, settings: VisualSettings, known: KnownMap) -> None:
        self._settings = settings.model_copy(update={"min_correlation": _CORRELATED})
        self._known, self._poses = known, known.poses
        self._references: dict[int, Reference | None] = {}

    def texture(self, picture: Image | None) -> Texture | None:
        """Of a picture that is looked for; None without one, and if none are to be used."""
        s = self._settings
        return textured(picture, s.width) if picture is not None and s.enabled else None

    def along(self, picture: Texture, reach: float, nodes: Sequence[int]) -> Along:
        """How far along a place is, at most `reach` m from where it is thought to be, by the nearest of `nodes`.

        The first of them is the target of the registration.
        """

        def nearest(result: Registration) -> Registration:
            found = ((node, known) for node in nodes if (known := self._reference(node)) is not None)
            node, known = next(found, (0, None))
            if known is None:
                return result
            T_ref_target = se3.inverse(self._poses[node]) @ self._poses[nodes[0]]
            return along(self._settings, result, known, picture, T_ref_target, reach)

        return nearest

    def find(
        self, cloud: Points, picture: Texture, nodes: Sequence[int], verifier: Verifier, T_across: Array
    ) -> Registration | None:
        """The place T_map_lidar of a cloud (M, 4) among keyframes; `ok` False where another one looks alike; or None.

        It is not verified by the points.

        Args:
            nodes: no two need be next to each other.
            T_across: (4, 4) T_kf_lidar, but for the way along the road.
        """
        view = _View(np.ascontiguousarray(verifier.source(cloud)[::_EACH]), picture, verifier, T_across)
        seen = {node: self._seen(node, view) for node in nodes}
        likely = sorted(nodes, key=lambda node: max((r.confidence for r in seen[node]), default=0.0), reverse=True)
        beside = {node + step for node in likely[:_CLOSER] for step in (-1, 0, 1)} & set(range(len(self._poses)))
        places = [place for node in sorted(beside) for place in self._seen(node, view, closely=True)]
        if not places:
            return None
        best = max(places, key=lambda place: place.confidence)
        others = [place for place in places if _meters(place, best) > _APART]
        why = objection_of_others(best, others, "pictures")
        return replace(best, ok=not why, reason=why)

    def _seen(self, node: int, view: _View, closely: bool = False) -> list[Registration]:
        """Places T_map_lidar at which a keyframe shows what the picture does; their confidence is the correlation."""
        known, s = self._reference(node), self._settings
        if known is None:
            return []
        around = view.verifier.surroundings([self._known.clouds[node]], np.eye(4)[None])
        result = view.verifier.register(view.source, around, view.T_across, _WIDEN)
        if not result.ok:
            return []
        T, axis, picture = result.T_target_source, result.open_direction, view.picture
        found = peaks(s, known, picture, T, axis, s.reach) if closely else [glance(known, picture, T, axis, s.reach)]
        moved = [T @ se3.make(np.eye(3), peak.offset * axis) for peak in found]
        return [
            replace(result, T_target_source=self._poses[node] @ T_kf_lidar, confidence=max(peak.correlation, 0.0))
            for T_kf_lidar, peak in zip(moved, found, strict=True)
        ]

    def _reference(self, node: int) -> Reference | None:
        """What a keyframe's picture shows; None where it has none that can be used."""
        if node not in self._references:
            if len(self._references) >= _KEPT:
                self._references.clear()
            self._references[node] = self._made(node)
        return self._references[node]

    def _made(self, node: int) -> Reference | None:
        jpeg = self._known.thumbnail(node)
        with suppress(ValueError):  # a damaged picture is no picture
            image = None if jpeg is None else image_of(jpeg)
            if image is not None:
                s = self._settings
                return reference(self._known.clouds[node], textured(image, s.width), s.points)
        return None


def _meters(a: Registration, b: Registration) -> float:
    return float(np.linalg.norm(a.T_target_source[:3, 3] - b.T_target_source[:3, 3]))
