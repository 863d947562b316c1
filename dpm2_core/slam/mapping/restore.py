# SPDX-License-Identifier: Apache-2.0
"""The pose graph of a map that was loaded."""

from __future__ import annotations

from dpm2_core.slam.graph.pose_graph import PoseGraph
from dpm2_core.slam.store.map_data import MapData, _chain


def restore(graph: PoseGraph, data: MapData) -> None:
    """Fill an empty pose graph with the nodes and constraints of a map."""
    chain = _chain(data.constraints)
    for node, T_map_kf in enumerate(data.poses):
        if (edge := chain.get(node)) is not None:
            graph.add_node(T_map_kf, edge.T_from_to, edge.covariance, edge.from_node)
        else:
            graph.add_node(T_map_kf, None, None)
    for edge in data.constraints:
        if chain.get(edge.to_node) is not edge:
            graph.add_loop(edge.from_node, edge.to_node, edge.T_from_to, edge.covariance)
