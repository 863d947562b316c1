# SPDX-License-Identifier: Apache-2.0
"""Removes keyframes from a map: the constraints through them are composed, and their poses are kept as a trail."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from dpm2_core.estimates import Edge, Keyframe
from dpm2_core.frame import Fix
from dpm2_core.geometry import se3
from dpm2_core.slam.graph.graph_data import Index
from dpm2_core.slam.loops.relocalization import HEIGHT
from dpm2_core.slam.mapping.parts import parts_of
from dpm2_core.slam.mapping.redundancy import LAP
from dpm2_core.slam.store.map_data import MapData, subset
from dpm2_core.slam.store.rows import RemovedKeyframe

_MAX_LEVER = 20.0  # m: a fix farther from its keyframe would depend more on the keyframe's heading than on its position


def redundant_nodes(data: MapData, distance: float, angle: float) -> list[int]:
    """Keyframes without a cloud of their own, and those near an older one that stays and does not borrow; never the
    last of a part.

    Two keyframes that no accepted edges connect are not compared: their relative pose is unknown. A keyframe with
    descriptors is not removed because of one without: nothing could be localized there any more.

    Args:
        distance: m, maximum, where height differences count four times; 0: only those without a cloud.
        angle: degrees, maximum, between their headings.
    """
    if not len(data):
        return []
    positions, parts = data.poses[:, :3, 3] * [1, 1, HEIGHT], parts_of(data)
    session = np.array([keyframe.session for keyframe in data.keyframes])
    tree, lasts = KDTree(positions), {int(part): node for node, part in enumerate(parts)}.values()
    needed = {*lasts, *(loan.lender for node in lasts if (loan := data.clouds.loan(node)))}
    stays, own = np.ones(len(data), np.bool_), data.clouds.own
    described = np.array([own[node] and data.descriptors(node) is not None for node in range(len(data))])
    for node in range(len(data)):
        if node in needed:
            continue
        if (loan := data.clouds.loan(node)) is not None:  # keep one with the last observation of a place
            stays[node] = data.clouds.keeps(node) and loan.lender < node and stays[loan.lender]
            continue
        near = np.array(tree.query_ball_point(positions[node], distance) if distance else [], np.intp)
        # Not near one that borrows: its cloud is not part of the map, and nothing is localized there.
        near = near[(near < node) & stays[near] & own[near] & (parts[near] == parts[node])]
        near = near[(node - near >= LAP) | (session[near] != session[node])]
        near = near[described[near] >= described[node]]
        rotations = se3.angle(se3.inverse(data.poses[near]) @ data.poses[node]) if len(near) else np.inf
        stays[node] = np.min(rotations) > np.radians(angle)
    return np.flatnonzero(~stays).tolist()


def prune(data: MapData, nodes: Collection[int]) -> MapData:
    """The map without those nodes. Their poses are kept as `trail`, the constraints through them as composed edges.

    A fix of a removed keyframe is passed to the nearest kept keyframe, if that has none.

    Raises:
        ValueError: a kept node borrows the cloud of a removed one, or no node of a part is kept.
    """
    gone = set(nodes)
    kept = [node for node in range(len(data)) if node not in gone]
    for node in kept:
        if (loan := data.clouds.loan(node)) is not None and loan.lender in gone:
            raise ValueError(f"keyframe {node} borrows the cloud of {loan.lender}")
    parts, kept_nodes = parts_of(data), np.array(kept, np.intp)
    anchors = {node: _anchor(data, node, kept_nodes[parts[kept_nodes] == parts[node]]) for node in gone}
    trail = [
        RemovedKeyframe(
            keyframe.id,
            keyframe.robot,
            keyframe.session,
            keyframe.stamp,
            anchors[node],
            se3.inverse(data.poses[anchors[node]]) @ data.poses[node],
        )
        for node in sorted(gone)
        for keyframe in [data.keyframes[node]]
    ]
    for old in data.trail:
        anchor = anchors.get(old.node, old.node)
        T_anchor_old = se3.inverse(data.poses[anchor]) @ data.poses[old.node]
        trail.append(replace(old, node=anchor, T_node_kf=T_anchor_old @ old.T_node_kf))
    keyframes = _with_fixes(data, parts, sorted(gone), kept_nodes)
    return subset(replace(data, keyframes=keyframes), kept, eliminate(data.edges, sorted(gone)), trail)


def _with_fixes(data: MapData, parts: NDArray[np.int32], gone: Sequence[int], kept: Index) -> list[Keyframe]:
    """The keyframes of all nodes; kept ones have taken over fixes of removed ones.

    A fix is passed to the nearest kept keyframe of its part, which need not be its anchor on the trail: if a whole
    drive is removed, that is the end of the drive. Of several fixes the one with the smallest covariance is used, then
    the nearest.
    """
    keyframes = list(data.keyframes)
    offered: list[tuple[float, float, int, Fix]] = []
    for node in gone:
        fix, near = data.keyframes[node].fix, kept[parts[kept] == parts[node]]
        if fix is None:
            continue
        heir = int(near[np.argmin(np.linalg.norm(data.poses[near, :3, 3] - data.poses[node, :3, 3], axis=1))])
        fix = fix.moved(se3.inverse(data.poses[heir]) @ data.poses[node])
        if (lever := float(np.linalg.norm(fix.antenna))) <= _MAX_LEVER:
            offered.append((float(np.trace(fix.covariance)), lever, heir, fix))
    for _, _, heir, fix in sorted(offered, key=lambda offer: offer[:2]):
        if keyframes[heir].fix is None:
            keyframes[heir] = replace(keyframes[heir], fix=fix)
    return keyframes


def _anchor(data: MapData, node: int, near: Index) -> int:
    """The node of `near`, the kept nodes of its part, that a removed node is attached to: its lender, or else the
    nearest along the drive. Attached to another part it would move with that part, whose relative pose is unknown."""
    if not len(near):
        raise ValueError(f"nothing that is tied to keyframe {node} stays")
    loan = data.clouds.loan(node)
    if loan is not None and loan.lender in near:
        return loan.lender
    return int(near[np.argmin(np.abs(near - node))])


def eliminate(edges: Sequence[Edge], nodes: Sequence[int]) -> list[Edge]:
    """Edges of a graph after nodes are removed, one after the other.

    The neighbors of a node are connected by compositions of two of its edges, one fewer than it had, as on a chain.
    Each edge is composed with the best edge of its kind, and the best loop with the best odometry edge. (Exact
    marginalization would connect all neighbors with each other.) On a street that was driven again, loops stay near
    their places: the odometry takes one of them to the next node, not all those of the nodes before. Rejected loops of
    a node are removed with it. Of several compositions between the same two nodes the one with the smallest covariance
    is kept, else laps would add up.
    """
    remaining: dict[int, Edge] = dict(enumerate(edges))
    edges_of: dict[int, set[int]] = {}
    for number, edge in remaining.items():
        edges_of.setdefault(edge.from_node, set()).add(number)
        edges_of.setdefault(edge.to_node, set()).add(number)
    count, number_by_ends = len(remaining), dict[tuple[int, int, str], int]()
    for node in nodes:
        numbers = sorted(edges_of.pop(node, ()))
        incident = [remaining.pop(number) for number in numbers]
        for number, edge in zip(numbers, incident, strict=True):
            edges_of[edge.from_node if edge.to_node == node else edge.to_node].discard(number)
        for edge in _replacement_edges(node, [edge for edge in incident if edge.ok]):
            ends = edge.from_node, edge.to_node, edge.kind
            if (known := remaining.get(before := number_by_ends.get(ends, -1))) is not None:
                if np.trace(known.covariance) <= np.trace(edge.covariance):
                    continue
                del remaining[before]
                edges_of[edge.from_node].discard(before)
                edges_of[edge.to_node].discard(before)
            remaining[count], number_by_ends[ends] = edge, count
            edges_of[edge.from_node].add(count)
            edges_of[edge.to_node].add(count)
            count += 1
    return list(remaining.values())


def _replacement_edges(node: int, incident: list[Edge]) -> list[Edge]:
    """The edges between the neighbors of a node that replace the node's edges."""
    spokes = [edge if edge.from_node == node else inverted(edge) for edge in incident]
    best: dict[str, Edge] = {}
    for spoke in sorted(spokes, key=lambda edge: float(np.trace(edge.covariance))):
        best.setdefault(spoke.kind, spoke)
    hub = best.get("odometry", best.get("loop"))
    pairs = [(hub if spoke is best[spoke.kind] else best[spoke.kind], spoke) for spoke in spokes]
    out = [composed(inverted(one), other) for one, other in pairs if one and one.to_node != other.to_node]
    return [edge if edge.from_node < edge.to_node else inverted(edge) for edge in out]


def inverted(edge: Edge) -> Edge:
    """The same constraint from its other end."""
    A = se3.adjoint(edge.T_from_to)  # (T exp(xi))^-1 = T^-1 exp(-Ad_T xi)
    T_to_from, covariance = se3.inverse(edge.T_from_to), A @ edge.covariance @ A.T
    inverse = replace(edge.registration, T_target_source=T_to_from, covariance=covariance)
    return Edge(edge.kind, edge.to_node, edge.from_node, inverse)


def composed(first: Edge, second: Edge) -> Edge:
    """Two consecutive constraints as one, with independent errors."""
    A = se3.adjoint(se3.inverse(second.T_from_to))
    both = replace(
        second.registration,
        T_target_source=se3.orthonormalized(first.T_from_to @ second.T_from_to),
        covariance=A @ first.covariance @ A.T + second.covariance,
        confidence=min(first.registration.confidence, second.registration.confidence),
        rmse=max(first.registration.rmse, second.registration.rmse),
    )
    kind: Literal["odometry", "loop"] = "odometry" if first.kind == second.kind == "odometry" else "loop"
    return Edge(kind, first.from_node, second.to_node, both)
