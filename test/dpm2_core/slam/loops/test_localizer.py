# SPDX-License-Identifier: Apache-2.0
"""The place in a map is confirmed before it is sure, at a halt too; one that is far off must be found again."""

from __future__ import annotations

import numpy as np
import pytest

from dpm2_core.descriptors import Descriptors
from dpm2_core.frame import Array, Image, Keyframe, Points, Registration, State
from dpm2_core.geometry import se3
from dpm2_core.slam.loops.localizer import Localizer
from dpm2_core.slam.loops.relocalization import nowhere

FIRM = np.diag([1e-3] * 3 + [0.02] * 3) ** 2


class Places:
    """Stands in for the relocalizer: what it finds is said; the map never confirms where the odometry leads."""

    def __init__(self, *found: float, confirms: bool = False) -> None:
        """`found`: meters along x, NaN where nothing is found."""
        self._found, self._confirms = list(found), confirms

    def find(
        self,
        cloud: Points,
        hint: Array | None = None,
        descriptors: Descriptors | None = None,
        picture: Image | None = None,
    ) -> Registration:
        x = self._found.pop(0)
        return nowhere("nothing fits") if np.isnan(x) else Registration(at(x), FIRM, 0.95, 0.05, "relocalisation")

    def verify(
        self, cloud: Points, T_map_lidar: Array, widen: float = 1.0, picture: Image | None = None
    ) -> Registration:
        return (
            Registration(T_map_lidar, FIRM, 0.95, 0.05, "relocalisation") if self._confirms else nowhere("nothing fits")
        )


def at(x: float) -> Array:
    return se3.make(np.eye(3), np.array([x, 0.0, 0.0]))


def halt(node: int) -> Keyframe:
    return Keyframe(node, node * 10**9, node, at(0.0), np.zeros((0, 4), np.float32))


def test_at_a_halt_a_second_keyframe_confirms_the_place() -> None:
    """A mission that waits for `tracking` before it begins to drive would wait for ever."""
    localizer = Localizer(Places(0.0, confirms=True))
    assert localizer.add(halt(0)).state is State.RELOCALIZED
    assert localizer.wants(10**9)
    assert localizer.add(halt(1)).state is State.TRACKING
    assert not localizer.wants(2 * 10**9)


@pytest.mark.parametrize(
    ("found", "last"),
    [
        ((0.0, 300.0, 300.5, 301.0), State.RELOCALIZED),
        ((0.0, 100.0, 200.0, 300.0), State.LOST),
        ((0.0, np.nan, np.nan, 300.0), State.LOST),
    ],
    ids=["thrice there", "here and there", "once"],
)
def test_a_far_off_place_counts_when_it_is_found_again(found: tuple[float, ...], last: State) -> None:
    localizer = Localizer(Places(*found))
    states = [localizer.add(halt(node)).state for node in range(4)]
    assert states == [State.RELOCALIZED, State.DEGRADED, State.DEGRADED, last]
