# SPDX-License-Identifier: Apache-2.0
"""Restores the pose graph of a loaded map."""

from __future__ import annotations

from dpm2_core.estimates import Edge
from dpm2_core.slam.graph.pose_graph import PoseGraph
from dpm2_core.slam.store.map_data import MapData, odometry_by_node


def restore(graph: PoseGraph, data: MapData) -> None:
    """Add the nodes and constraints of a map to a pose graph, after the nodes that it has."""
    first, chain = len(graph), odometry_by_node(data.constraints)
    for node, T_map_kf in enumerate(data.poses):
        graph.add_node(T_map_kf, chain[node].shifted(first) if node in chain else None)
    for edge in data.constraints:
        if chain.get(edge.to_node) is not edge:
            graph.add_loop(edge.shifted(first))
    for node, keyframe in enumerate(data.keyframes):
        if keyframe.fix is not None:
            graph.add_fix(first + node, keyframe.fix)
    if data.georeference is not None and not first:
        graph.set_georeference(data.georeference)


def judged(graph: PoseGraph, data: MapData) -> list[Edge]:
    """The edges of a map as judged by the last optimization of a graph with this map only, as `restore` made it."""
    chain, loops = odometry_by_node(data.constraints), iter(graph.loops)
    return [next(loops) if edge.ok and chain.get(edge.to_node) is not edge else edge for edge in data.edges]


def restore_solved(graph: PoseGraph, data: MapData) -> None:
    """Add a map to an empty pose graph with the poses that it has.

    `restore` alone moves each part by its first loop, which may be one that the optimization rejects.
    """
    restore(graph, data)
    for node, T_map_kf in enumerate(data.poses):
        graph.place(node, T_map_kf)
    if data.georeference is not None:  # again: the poses determine which fixes constrain them
        graph.set_georeference(data.georeference)
