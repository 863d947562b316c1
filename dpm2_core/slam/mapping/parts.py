# SPDX-License-Identifier: Apache-2.0
"""Which keyframes of a map hang together: where two parts are relative to each other is not known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from dpm2_core.frame import Array, Georeference
from dpm2_core.geometry import geodesy
from dpm2_core.slam.graph.fixes import Fixes
from dpm2_core.slam.graph.graph_data import components
from dpm2_core.slam.store.map_data import MapData, subset


def parts_of(data: MapData) -> NDArray[np.int32]:
    """(N,) number of the part that each node is in, by the accepted edges."""
    ends = np.array([(edge.from_node, edge.to_node) for edge in data.constraints], np.intp).reshape(-1, 2)
    return components(len(data), ends)


def placed(data: MapData) -> NDArray[np.bool_]:
    """(N,) whether each node is tied to the first: where any other is in its map, and on Earth, is not known."""
    return parts_of(data) == 0


def first_part(data: MapData) -> MapData:
    """The map of the keyframes that are tied to the first one."""
    own = placed(data)
    if own.all():
        return data
    for node in np.flatnonzero(own).tolist():
        loan = data.clouds.loan(node)  # by a loop that was rejected since then, it may be of another part
        own[node] = loan is None or own[loan.lender]
    return subset(data, np.flatnonzero(own).tolist(), data.edges, data.trail)


def located(data: MapData, own: NDArray[np.bool_]) -> Georeference | None:
    """Where on Earth the map is by the fixes of some of its nodes, (N,), alone; None where these do not tell."""
    fixes = Fixes()
    for node in np.flatnonzero(own).tolist():
        if (fix := data.keyframes[node].fix) is not None:
            fixes.add(node, fix, data.keyframes[node].session)
    fixes.locate(data.poses, own)
    return fixes.georeference


def georeferenced(data: MapData) -> MapData:
    """The map, if it has no georeference, with that of its first part's fixes, where these tell."""
    return replace(data, georeference=data.georeference or located(data, placed(data)))


def frame_of(known: Georeference) -> Array:
    """T_ecef_map (4, 4)."""
    return np.asarray(geodesy.enu_frame(known.origin) @ known.T_enu_map)


def placed_on_earth(data: MapData) -> MapData:
    """The map with poses (N, 4, 4) T_ecef_kf.

    The georeference is that of the first keyframe's part; another part is placed by its own fixes. The poses of a part
    whose place is not known are NaN.
    """
    parts, poses = parts_of(data), np.full_like(data.poses, np.nan)
    for part in np.unique(parts):
        own = parts == part
        known = data.georeference if own[0] else located(data, own)
        if known is not None:
            poses[own] = frame_of(known) @ data.poses[own]
    return replace(data, poses=poses)
