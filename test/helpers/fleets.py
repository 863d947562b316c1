# SPDX-License-Identifier: Apache-2.0
"""Maps of drives without clouds, and the joins between them."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from dpm2_core.estimates import Edge, Keyframe, Registration
from dpm2_core.fleet.regions import Join
from dpm2_core.frame import NO_POINTS, Array
from dpm2_core.geometry import se3
from dpm2_core.slam.store.map_data import MapData

from .maps import FIRM, SESSION, stored


def drive_map(poses: Array, seed: int) -> MapData:
    """Map of a drive whose odometry has drifted, in a frame of its own."""
    rng = np.random.default_rng(seed)
    keyframes = [Keyframe(i, i, i, np.eye(4), NO_POINTS, session=1) for i in range(len(poses))]
    edges, own = [], [se3.exp(rng.normal(size=6) * [0, 0, 1, 50, 50, 0])]
    for i in range(1, len(poses)):
        T = se3.inverse(poses[i - 1]) @ poses[i] @ se3.exp(rng.normal(size=6) * np.sqrt(np.diag(FIRM)))
        edges.append(Edge("odometry", i - 1, i, Registration(T, FIRM)))
        own.append(own[-1] @ T)
    clouds = stored(np.ones((1, 4), np.float32) for _ in poses)
    return MapData(keyframes, np.array(own), edges, [], [SESSION], clouds)


def fleet_maps(count: int, turn: float = 0.01) -> tuple[dict[str, Array], dict[str, MapData], list[Join]]:
    """Drives along one trajectory, each sharing its last 20 keyframes with the next. There are 10 true joins for each
    pair, and a false one.

    Args:
        turn: rad per keyframe.
    """
    way = se3.exp(np.arange(40 * count + 40)[:, None] * np.array([0, 0, turn, 2.0, 0, 0]))
    names = [f"d{number}" for number in range(count)]
    truth = {name: way[40 * i : 40 * i + 60] for i, name in enumerate(names)}
    maps = {name: drive_map(poses, i) for i, (name, poses) in enumerate(truth.items())}
    joins = []
    for one, other in pairwise(names):
        for k in range(0, 20, 2):
            T = se3.inverse(truth[one][40 + k]) @ truth[other][k]
            joins.append(Join(one, other, Edge("loop", 40 + k, k, Registration(T, FIRM))))
        wrong = T @ se3.exp(np.array([0, 0, 0.3, 8.0, 0, 0]))
        joins.append(Join(one, other, Edge("loop", 5, 5, Registration(wrong, FIRM))))
    return truth, maps, joins
