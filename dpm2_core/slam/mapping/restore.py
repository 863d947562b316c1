# SPDX-License-Identifier: Apache-2.0
"""The pose graph of a map that was loaded."""

from __future__ import annotations

from dpm2_core.slam.graph.pose_graph import PoseGraph
from dpm2_core.slam.store.map_data import MapData, odometry_by_node


def restore(graph: PoseGraph, data: MapData) -> None:
    """Fill an empty pose graph with the nodes and constraints of a map."""
    chain = odometry_by_node(data.constraints)
    for node, T_map_kf in enumerate(data.poses):
        graph.add_node(T_map_kf, chain.get(node))
    for edge in data.constraints:
        if chain.get(edge.to_node) is not edge:
            graph.add_loop(edge)
