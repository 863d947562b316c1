# SPDX-License-Identifier: Apache-2.0
"""The pose graph of a fleet in stages: drives that meet often are solved as a region, then the ties of the regions.

The second stage receives only the keyframes at which other regions touch a region, and its estimate of their relative
poses. If the second stage moves these, the region is solved again with them fixed. No stage needs a cloud.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from dpm2_core.estimates import Edge, Registration
from dpm2_core.frame import Array
from dpm2_core.geometry import se3
from dpm2_core.slam.graph.pose_graph import PoseGraph
from dpm2_core.slam.graph.robust import RobustSettings
from dpm2_core.slam.mapping.merge import merge_maps
from dpm2_core.slam.mapping.restore import restore
from dpm2_core.slam.store.map_data import MapData

LARGEST = 20_000
"""Most keyframes of a region."""
_MAX_BORDER_MOTION = 1e-3  # m and rad: if the borders moved by less, the region is not solved again


@dataclass(frozen=True, eq=False)
class Join:
    """A loop from a node of one drive to a node of another one, numbered as in their maps."""

    one: str
    other: str
    loop: Edge

    def loop_at(self, first: Mapping[str, int]) -> Edge:
        """The loop in a graph; `first`: the first node of each drive there."""
        return self.loop.between(self.loop.from_node + first[self.one], self.loop.to_node + first[self.other])

    def judged(self, registration: Registration) -> Join:
        """The join with the verdict of a graph."""
        return replace(self, loop=replace(self.loop, registration=registration))


@dataclass(frozen=True, eq=False)
class Region:
    """Drives that are solved together: poses (N, 4, 4) by drive, and the checked joins between them."""

    poses: dict[str, Array]
    joins: list[Join]


def regions_of(sizes: Mapping[str, int], joins: Sequence[Join], largest: int = LARGEST) -> list[list[str]]:
    """Group drives, in their order, into regions: each joins the region with most of its joins that has room.

    Args:
        sizes: keyframes of each drive. largest: of a region; a longer drive is a region by itself.
    """
    regions: list[list[str]] = []
    owner: dict[str, int] = {}
    for name in sizes:
        ties = Counter(owner[end] for join in joins if name in (join.one, join.other)
                       for end in (join.one, join.other) if end in owner)  # fmt: skip
        room = [r for r, _ in ties.most_common() if sum(sizes[d] for d in regions[r]) + sizes[name] <= largest]
        if not room:
            regions.append([])
        owner[name] = room[0] if room else len(regions) - 1
        regions[owner[name]].append(name)
    return regions


def solve(maps: Mapping[str, MapData], joins: Sequence[Join], settings: RobustSettings,
          largest: int = LARGEST) -> Region:  # fmt: skip
    """The poses of all drives in one frame, that of the first, and each join accepted, or rejected with the reason.

    Raises:
        Dpm2Error: a graph cannot be solved.
    """
    regions = regions_of(sizes_of(maps), joins, largest)
    owner = {name: number for number, names in enumerate(regions) for name in names}
    inner, outer = defaultdict(list), []
    for join in joins:
        if owner[join.one] == owner[join.other]:
            inner[owner[join.one]].append(join)
        else:
            outer.append(join)
    solved = [_solve_region({name: maps[name] for name in names}, inner[number], settings)
              for number, names in enumerate(regions)]  # fmt: skip
    poses = {name: T for region in solved for name, T in region.poses.items()}
    checked: list[Join] = []
    if outer:
        poses, checked = _solve_borders(maps, solved, inner, outer, settings)
    return Region(poses, [*(join for region in solved for join in region.joins), *checked])


def side_by_side(maps: Mapping[str, MapData], joins: Sequence[Join]) -> MapData:
    """The drives in one map, each with its own poses, and their joins as loops; its frame is that of the first."""
    first = first_nodes(sizes_of(maps))
    loops = [join.loop_at(first) for join in joins]
    drives = list(maps.values())
    merged = _merge_in_halves(drives)
    return replace(merged, edges=[*merged.edges, *loops], georeference=drives[0].georeference)


def sizes_of(maps: Mapping[str, MapData]) -> dict[str, int]:
    """Keyframes of each drive."""
    return {name: len(data) for name, data in maps.items()}


def first_nodes(sizes: Mapping[str, int]) -> dict[str, int]:
    """The first node of each drive if the drives are put one after the other."""
    return dict(zip(sizes, np.cumsum([0, *sizes.values()]).tolist(), strict=False))


def owners(nodes: Sequence[int], first: Mapping[str, int]) -> list[str]:
    """The drive of each node; `first`: the first node of each drive."""
    names = list(first)
    return [names[number] for number in np.searchsorted(list(first.values()), nodes, side="right") - 1]


def _merge_in_halves(maps: Sequence[MapData]) -> MapData:
    """One map of several, merged in halves, so that reading a cloud takes few calls, however many maps there are."""
    if len(maps) == 1:
        return maps[0]
    half = len(maps) // 2
    return merge_maps(_merge_in_halves(maps[:half]), _merge_in_halves(maps[half:]), np.eye(4))


def _solve_region(maps: Mapping[str, MapData], joins: Sequence[Join], settings: RobustSettings,
            held: Mapping[tuple[str, int], Array] | None = None) -> Region:  # fmt: skip
    """Solve drives and their joins; `held`: (4, 4) poses of nodes that are fixed."""
    data, first = side_by_side(maps, joins), first_nodes(sizes_of(maps))
    graph = PoseGraph(settings)
    restore(graph, data)
    for (name, node), T in (held or {}).items():
        graph.hold(first[name] + node, T)
    graph.optimize()
    verdicts = {(loop.from_node, loop.to_node): loop.registration for loop in graph.loops}
    loops = [join.loop_at(first) for join in joins]
    out = [join.judged(verdicts[loop.from_node, loop.to_node]) for join, loop in zip(joins, loops, strict=True)]
    return Region({name: graph.poses[begin : begin + len(maps[name])] for name, begin in first.items()}, out)


def _solve_borders(maps: Mapping[str, MapData], solved: Sequence[Region], inner: Mapping[int, Sequence[Join]],
             outer: Sequence[Join], settings: RobustSettings) -> tuple[dict[str, Array], list[Join]]:  # fmt: skip
    """Poses of all drives from those of the regions, and the checked joins between the regions."""
    ends = {(join.one, join.loop.from_node) for join in outer} | {(join.other, join.loop.to_node) for join in outer}
    graph, border_node = PoseGraph(settings), dict[tuple[str, int], int]()
    for region in solved:
        own = {name: maps[name] for name in region.poses}
        data = side_by_side(own, [join for join in region.joins if join.loop.ok])
        first = first_nodes(sizes_of(own))
        data = replace(data, poses=np.concatenate([region.poses[name] for name in own]))
        region_graph = PoseGraph(settings)
        restore(region_graph, data)
        nodes = {end: first[end[0]] + end[1] for end in sorted(ends) if end[0] in own}
        order = sorted(nodes, key=lambda end: (region_graph.part(nodes[end]), end))
        connected_pairs = [
            pair for pair in pairwise(order) if len({region_graph.part(nodes[end]) for end in pair}) == 1
        ]
        covariances = region_graph.relative_covariances([(nodes[a], nodes[b]) for a, b in connected_pairs])
        steps = {pair[1]: (pair[0], covariance) for pair, covariance in zip(connected_pairs, covariances, strict=True)}
        for end in order:
            border_node[end], step = len(graph), None
            if end in steps:
                previous, covariance = steps[end]
                T = se3.inverse(data.poses[nodes[previous]]) @ data.poses[nodes[end]]
                step = Edge("odometry", border_node[previous], border_node[end], Registration(T, covariance))
            graph.add_node(region.poses[end[0]][end[1]], step)
    for join in outer:
        graph.add_loop(
            join.loop.between(border_node[join.one, join.loop.from_node], border_node[join.other, join.loop.to_node])
        )
    graph.optimize()
    checked = [join.judged(loop.registration) for join, loop in zip(outer, graph.loops, strict=True)]
    poses: dict[str, Array] = {}
    for number, region in enumerate(solved):
        held = {end: graph.pose(node) for end, node in border_node.items() if end[0] in region.poses}
        poses |= _update_poses(maps, region, inner[number], held, settings)
    return poses, checked


def _update_poses(maps: Mapping[str, MapData], region: Region, joins: Sequence[Join],
           held: Mapping[tuple[str, int], Array], settings: RobustSettings) -> dict[str, Array]:  # fmt: skip
    """Poses of a region whose borders have moved: moved rigidly, or solved again if that is not enough."""
    if not held:
        return region.poses
    motions = [T @ se3.inverse(region.poses[name][node]) for (name, node), T in held.items()]
    T_new_old = motions[0]
    poses = {name: T_new_old @ T for name, T in region.poses.items()}
    if max(np.abs(poses[name][node] - T).max() for (name, node), T in held.items()) <= _MAX_BORDER_MOTION:
        return poses
    own = {name: replace(maps[name], poses=poses[name]) for name in region.poses}
    kept = [join for join, after in zip(joins, region.joins, strict=True) if after.loop.ok]
    return _solve_region(own, kept, settings, held).poses
