# SPDX-License-Identifier: Apache-2.0
"""The network in loop closure and relocalization: finds keyframes that look like a scan, and their relative pose."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from dpm2_core.descriptors import Descriptors, merge
from dpm2_core.estimates import Keyframe, Registration
from dpm2_core.frame import Array, Frame
from dpm2_core.geometry import se3
from dpm2_core.slam.loops.retrieval import PlaceIndex, pooled

if TYPE_CHECKING:  # torch takes seconds to import
    from dpm2_core.network.model import DeepPointMap2


AGREEING = 0.08
"""Fraction of the pairs of descriptors of two places that must agree on a motion during a drive: nearly every candidate
is another place, and the next keyframe has another chance. For a single scan a smaller fraction may be right.

Measured: up to 8 m apart at least 0.22 on KITTI, 0.24 on synthetic roads in either direction, 0.09 in rooms and 0.14 in
car parks. Places far apart: at most 0.08 on KITTI and, for 95 in 100, on synthetic roads."""


class PlaceRecognition:
    """The descriptors of all keyframes by their node: their index in the map."""

    def __init__(self, network: DeepPointMap2) -> None:
        self._network = network
        self._index = PlaceIndex()

    @property
    def channels(self) -> int:
        """Width of the network's features."""
        return self._network.settings.channels

    def descriptors(self, keyframe: Keyframe) -> Descriptors:
        """The descriptors of a keyframe; made from its cloud, if its registration made none.

        The downsampled cloud gives descriptors that are as good as those of the whole scan.

        Raises:
            Dpm2Error: the keyframe has none.
        """
        return keyframe.descriptors or self._network.describe(Frame(0, keyframe.cloud, up=keyframe.up))

    def update(self, keyframes: Sequence[Keyframe]) -> None:
        """Add the new keyframes."""
        for node in range(len(self._index), len(keyframes)):
            self._index.append(keyframes[node].descriptors)

    def similar(self, descriptors: Descriptors, allowed: NDArray[np.bool_], count: int) -> list[int]:
        """Up to `count` most similar nodes among `allowed` (N,), best first, no two of them next to each other."""
        return self._index.nearest(pooled(descriptors), allowed, count, apart=1)

    def register(
        self, source: Descriptors, targets: Sequence[Descriptors], agreeing: float = 0.0
    ) -> list[Registration]:
        """The pose of a place in the frame of each of the others; no start is needed.

        Args:
            agreeing: if a smaller fraction of the descriptors agrees on a motion, a place is rejected before the
                network correlates the two, which takes seven times as long.
        """
        agreement = self._network.agreement(source, targets) if agreeing else [1.0] * len(targets)
        return [
            self._network.register(source, target)
            if ratio >= agreeing
            else Registration.failed("neural", f"another place: {ratio:.0%} of the descriptors agree on a motion")
            for ratio, target in zip(agreement, targets, strict=True)
        ]


def merged(keyframes: Sequence[Keyframe], poses: Array, nodes: Sequence[int], at: int) -> Descriptors:
    """Descriptors of several nodes, merged in the frame of node `at`, which has some; `poses` (N, 4, 4) T_map_kf."""
    T_at_map = se3.inverse(poses[at])
    first = [at, *(node for node in nodes if node != at)]  # `merge` keeps the scale (room or not) of the first
    found = ((node, keyframes[node].descriptors) for node in first)
    return merge([d if node == at else d.moved(T_at_map @ poses[node]) for node, d in found if d is not None])
