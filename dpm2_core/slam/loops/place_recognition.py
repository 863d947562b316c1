# SPDX-License-Identifier: Apache-2.0
"""The network's part in loops and relocalization: which keyframes look like this one, and from where it was taken."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from dpm2_core.descriptors import Descriptors, merge
from dpm2_core.errors import Dpm2Error
from dpm2_core.frame import Array, Frame, Keyframe, Points, Registration
from dpm2_core.geometry import se3
from dpm2_core.slam.loops.retrieval import PlaceIndex, pooled

if TYPE_CHECKING:  # torch takes seconds to import
    from dpm2_core.network.model import DeepPointMap2


class PlaceRecognition:
    """The descriptors of all keyframes by their node: their position in the map."""

    def __init__(self, network: DeepPointMap2) -> None:
        self._network = network
        self._index = PlaceIndex()

    @property
    def channels(self) -> int:
        """Width of the features that it makes."""
        return self._network.settings.channels

    def describe(self, points: Points) -> Descriptors | None:
        """Descriptors of a cloud (M, 4); None if it has too few points.

        A keyframe's cloud, downsampled as it is, gives descriptors that serve as well as those of the whole scan.
        """
        try:
            return self._network.describe(Frame(0, points))
        except Dpm2Error:
            return None

    def update(self, keyframes: Sequence[Keyframe]) -> None:
        """Take in those that are new."""
        for node in range(len(self._index), len(keyframes)):
            self._index.append(keyframes[node].descriptors)

    def similar(self, descriptors: Descriptors, allowed: NDArray[np.bool_], count: int) -> list[int]:
        """Up to `count` most similar nodes among `allowed` (N,), best first, no two of them next to each other."""
        return self._index.nearest(pooled(descriptors), allowed, count, apart=1)

    def register(self, source: Descriptors, targets: Sequence[Descriptors]) -> list[Registration]:
        """The pose of a place in the frame of each of the others; no start is needed."""
        if not targets:
            return []
        return self._network.register_many([source] * len(targets), list(targets))


def merged(keyframes: Sequence[Keyframe], poses: Array, nodes: Sequence[int], at: int) -> Descriptors:
    """The descriptors of several nodes in the frame of node `at`, which has some; `poses` (N, 4, 4) T_map_kf."""
    T_at_map = se3.inverse(poses[at])
    found = ((node, keyframes[node].descriptors) for node in nodes)
    return merge([d if node == at else d.moved(T_at_map @ poses[node]) for node, d in found if d is not None])
