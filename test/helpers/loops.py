# SPDX-License-Identifier: Apache-2.0
"""A loop search with given results: the search itself is tested elsewhere."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from dpm2_core.estimates import Edge, Keyframe
from dpm2_core.slam.loops.closure import LoopCloser


class KnownLoops(LoopCloser):
    """Returns `found` for the newest node."""

    channels = None

    def __init__(self, found: Callable[[int], list[Edge]]) -> None:
        self._found = found

    def described(self, keyframe: Keyframe) -> Keyframe:
        return keyframe

    def close(self, keyframes: Sequence[Keyframe], *given: Any) -> list[Edge]:
        return self._found(len(keyframes) - 1)
