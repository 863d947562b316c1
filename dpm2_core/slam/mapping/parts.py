# SPDX-License-Identifier: Apache-2.0
"""Connected parts of a map's keyframes: the poses of two parts relative to each other are unknown."""

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
    """(N,) number of the part of each node, by the accepted edges."""
    ends = np.array([(edge.from_node, edge.to_node) for edge in data.constraints], np.intp).reshape(-1, 2)
    return components(len(data), ends)


def placed(data: MapData) -> NDArray[np.bool_]:
    """(N,) whether each node is connected to the first; the pose of any other in its map and on Earth is unknown."""
    return parts_of(data) == 0


def first_part(data: MapData) -> MapData:
    """The map of the keyframes that are connected to the first one."""
    own = placed(data)
    if own.all():
        return data
    for node in np.flatnonzero(own).tolist():
        loan = data.clouds.loan(node)  # if its loop was rejected since then, the lender may be in another part
        own[node] = loan is None or own[loan.lender]
    return subset(data, np.flatnonzero(own).tolist(), data.edges, data.trail)


def located(data: MapData, own: NDArray[np.bool_]) -> Georeference | None:
    """Pose of the map on Earth by the fixes of the nodes in `own` (N,) only; None if they do not determine it."""
    fixes = Fixes()
    for node in np.flatnonzero(own).tolist():
        if (fix := data.keyframes[node].fix) is not None:
            fixes.add(node, fix, data.keyframes[node].session)
    fixes.locate(data.poses, own)
    return fixes.georeference


def georeferenced(data: MapData) -> MapData:
    """The map; if it has no georeference, with that of its first part's fixes, if they determine one."""
    return replace(data, georeference=data.georeference or located(data, placed(data)))


def frame_of(known: Georeference) -> Array:
    """T_ecef_map (4, 4)."""
    return np.asarray(geodesy.enu_frame(known.origin) @ known.T_enu_map)


def placed_on_earth(data: MapData) -> MapData:
    """The map with poses (N, 4, 4) T_ecef_kf.

    The georeference is that of the first keyframe's part; other parts are placed by their own fixes. The poses of a
    part with an unknown position are NaN.
    """
    parts, poses = parts_of(data), np.full_like(data.poses, np.nan)
    for part in np.unique(parts):
        own = parts == part
        known = data.georeference if own[0] else located(data, own)
        if known is not None:
            poses[own] = frame_of(known) @ data.poses[own]
    return replace(data, poses=poses)
