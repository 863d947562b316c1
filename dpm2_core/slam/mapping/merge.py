# SPDX-License-Identifier: Apache-2.0
"""Merges several maps: by a known transform between their frames, or by loops between them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from dpm2_core.estimates import Edge, Registration, isotropic
from dpm2_core.frame import Array, Georeference
from dpm2_core.geometry import se3
from dpm2_core.slam.graph.pose_graph import PoseGraph
from dpm2_core.slam.loops.closure import LoopCloser
from dpm2_core.slam.mapping.parts import frame_of, parts_of, placed
from dpm2_core.slam.mapping.restore import judged, restore
from dpm2_core.slam.store.cloud_store import CloudStore, Loan
from dpm2_core.slam.store.map_data import MapData, renumbered_after

_GIVEN_COVARIANCE = isotropic(0.05, 1.0)  # of a transform given by hand: any loop is more accurate
FindLoops = Callable[[MapData, MapData], list[Edge]]
"""Accepted loops from a node of one map to a node of another, each with its own numbers."""


def merge_maps(a: MapData, b: MapData, T_a_b: Array, loops: Sequence[Edge] = ()) -> MapData:
    """One map in the frame of `a`. Nodes and sessions of `b` are numbered after those of `a`.

    Its georeference is that of `a`; or else that of `b`, if `loops` connect the first keyframes of both: a georeference
    is that of the first keyframe's part.

    Args:
        T_a_b: (4, 4). loops: as returned by `FindLoops`.
    """
    n = len(a)
    b = renumbered_after(b, n, max((session.number for session in a.sessions), default=0))
    moving = [*(a.clouds.moving(i) for i in range(n)), *(b.clouds.moving(i) for i in range(len(b)))]
    loans = {i: loan for i in range(n) if (loan := a.clouds.loan(i))}
    loans |= {n + i: Loan(n + loan.lender, loan.T_kf_lender) for i in range(len(b)) if (loan := b.clouds.loan(i))}
    both = MapData(
        [*a.keyframes, *b.keyframes],
        np.concatenate([a.poses, T_a_b @ b.poses]),
        [*a.edges, *b.edges, *(e.between(e.from_node, e.to_node + n) for e in loops)],
        [*a.trail, *b.trail],
        [*a.sessions, *b.sessions],
        CloudStore(lambda i: a.clouds.packed(i) if i < n else b.clouds.packed(i - n), moving, loans),
        lambda i: a.thumbnail(i) if i < n else b.thumbnail(i - n),
        lambda i: a.describe(i) if i < n else b.describe(i - n),
        a.georeference,
    )
    if a.georeference is None and b.georeference is not None and placed(both)[n : n + 1].any():
        return replace(both, georeference=_transformed(T_a_b, b.georeference))
    return both


def tie_of(a: MapData, b: MapData, T_a_b: Array) -> list[Edge]:
    """A known transform (4, 4) as an edge between two maps, as from `FindLoops`; none if a map is empty.

    Without it the file would not record that the pose of the second map in the first is known.
    """
    if not len(a) or not len(b):
        return []
    T = se3.inverse(a.poses[0]) @ T_a_b @ b.poses[0]
    return [Edge("loop", 0, 0, Registration(T, _GIVEN_COVARIANCE, method="transform"))]


def _transformed(T_a_b: Array, known: Georeference) -> Georeference:
    """The georeference of b expressed for a."""
    return replace(known, T_enu_map=known.T_enu_map @ se3.inverse(T_a_b))


def off_by_satellites(a: MapData, b: MapData, T_a_b: Array) -> float:
    """Median distance, m, between the keyframes of `b` by a transform (4, 4) and by the georeferences of both maps; 0
    if these are not known."""
    if a.georeference is None or b.georeference is None or not len(b):
        return 0.0
    difference = T_a_b @ b.poses - se3.inverse(frame_of(a.georeference)) @ frame_of(b.georeference) @ b.poses
    return float(np.median(np.linalg.norm(difference[:, :2, 3], axis=1)))


def align(a: MapData, b: MapData, find_loops: FindLoops) -> tuple[Array, list[Edge]] | None:
    """T_a_b (4, 4) by the loops between two maps, and these loops; None without any."""
    loops = find_loops(a, b)
    if not loops:
        return None
    guesses = np.array([a.poses[e.from_node] @ e.T_from_to @ se3.inverse(b.poses[e.to_node]) for e in loops])
    # The transform nearest to the others: a start for the optimization, which weights them all.
    distances = [np.median(np.linalg.norm(guesses[:, :3, 3] - T[:3, 3], axis=1)) for T in guesses]
    return se3.orthonormalized(guesses[int(np.argmin(distances))]), loops  # else rounding errors double with each merge


def loops_by(closer: LoopCloser) -> FindLoops:
    """Let a loop closer process the second map as a drive, with the keyframes of the first one in its memory."""

    def find(a: MapData, b: MapData) -> list[Edge]:
        both = merge_maps(a, b, np.eye(4))
        keyframes, parts, own = list(a.keyframes), parts_of(both), both.clouds.own
        out = []
        for node, keyframe in enumerate(b.keyframes):
            # Another robot name keeps the odometry of the two apart.
            keyframes.append(replace(keyframe, robot=f"{keyframe.robot}/second", edge=keyframe.edge if node else None))
            end = len(keyframes)
            for loop in closer.close(keyframes, both.clouds, both.poses[:end], parts[:end], own[:end]):
                if loop.ok and loop.from_node < len(a) <= loop.to_node:
                    out.append(loop.between(loop.from_node, loop.to_node - len(a)))
        return out

    return find


def optimized(data: MapData, graph: PoseGraph) -> MapData:
    """The map with the poses that its constraints give, without the constraints that these poses contradict.

    `graph` is empty.
    """
    restore(graph, data)
    graph.optimize()
    return replace(data, poses=graph.poses, edges=judged(graph, data), georeference=graph.georeference)
