# SPDX-License-Identifier: Apache-2.0
"""Add drives to a map file, in one transaction: of the existing drives, only those that the new ones touch are moved.

The graph that is solved contains the new drives, those that they meet, and those on the paths between these, which
share the error when a ring is closed. All others are fixed. If this strains the loops to a fixed drive by more than
their own uncertainty, that drive is solved for as well.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import breadth_first_order

from dpm2_core.errors import Dpm2Error
from dpm2_core.estimates import Edge
from dpm2_core.fleet.joins import ENOUGH
from dpm2_core.fleet.regions import Join, first_nodes, owners, sizes_of
from dpm2_core.fleet.search import accepted_and_rejected, component
from dpm2_core.frame import Array, Georeference
from dpm2_core.slam.graph.graph_data import loop_errors, mahalanobis
from dpm2_core.slam.graph.pose_graph import PoseGraph
from dpm2_core.slam.graph.robust import RobustSettings
from dpm2_core.slam.mapping.parts import located, placed
from dpm2_core.slam.mapping.restore import restore
from dpm2_core.slam.store.map_data import MapData, append_map, odometry_by_node
from dpm2_core.slam.store.map_store import Change, MapStore
from dpm2_core.slam.store.rows import edge_of, pose_of
from dpm2_core.slam.store.writer import STILL

_MAX_STRAIN = 2.0  # standard deviations by which the loops to a drive are strained, in total
_SPANS_PER_QUERY = 200  # spans of nodes in one query


def spans_of(sizes: Mapping[str, int]) -> dict[str, range]:
    """The nodes of each drive in a file with these numbers of keyframes, one drive after the other."""
    return {name: range(first, first + sizes[name]) for name, first in first_nodes(sizes).items()}


@dataclass(frozen=True, eq=False)
class Growth:
    """Drives that are added to a map.

    Attributes:
        maps: of these, with their poses in the map. joins: all that were checked, between drives of the new map.
        moved: (4, 4) poses of existing nodes, by node. judged: loops of the map that no longer hold, by number.
    """

    maps: dict[str, MapData]
    joins: list[Join] = field(default_factory=list)
    moved: dict[int, Array] = field(default_factory=dict)
    judged: dict[int, Edge] = field(default_factory=dict)


def add_drives(store: MapStore, inside: Mapping[str, int], growth: Growth, refused: Iterable[Join] = ()) -> None:
    """Append drives to those in a file, each as a robot with the drive's name.

    A file without a georeference takes that of the first added drive with one.

    Args:
        refused: joins that were rejected; those of drives that are not in the file are left out.

    Raises:
        Dpm2Error: the file could not be written.
    """
    for name, data in growth.maps.items():
        append_map(store, _renamed(name, data))
    first = first_nodes({**inside, **sizes_of(growth.maps)})
    loops = [join.loop_at(first) for join in (*growth.joins, *refused) if {join.one, join.other} <= first.keys()]
    georeference = None
    if next(store.rows("georeference"), None) is None:
        georeference = next(filter(None, map(_georeference, growth.maps.values())), None)
    store.write(Change(edges=loops, judged=growth.judged, poses=growth.moved, georeference=georeference))


def joins_of(loops: Collection[Edge], inside: Mapping[str, int]) -> list[Join]:
    """Loops of a file as joins of the drives in it, including those within a drive."""
    first = first_nodes(inside)
    ones, others = (owners([getattr(loop, end) for loop in loops], first) for end in ("from_node", "to_node"))
    return [
        Join(one, other, loop.between(loop.from_node - first[one], loop.to_node - first[other]))
        for one, other, loop in zip(ones, others, loops, strict=True)
    ]


def _georeference(data: MapData) -> Georeference | None:
    """The georeference of the merged map, from a drive's fixes: the drive's own one is of its former frame."""
    return None if data.georeference is None else located(data, placed(data))


def _renamed(name: str, data: MapData) -> MapData:
    return replace(
        data,
        keyframes=[replace(k, robot=f"{name}/{k.robot}".rstrip("/")) for k in data.keyframes],
        trail=[replace(p, robot=f"{name}/{p.robot}".rstrip("/")) for p in data.trail],
    )


@dataclass(frozen=True)
class Standing:
    """An existing map.

    Attributes:
        store: its file. sizes: keyframes of each drive in it, in its order. ties: all pairs of drives that are joined.
        settings: of its graph. largest: most keyframes that are solved for at once.
    """

    store: MapStore
    sizes: Mapping[str, int]
    ties: Collection[tuple[str, str]]
    settings: RobustSettings
    largest: int

    def between(self, names: Collection[str]) -> set[str]:
        """These drives, and those on the shortest paths from the first of them to the others."""
        order = list(self.sizes)
        number_of = {name: number for number, name in enumerate(order)}
        rows, columns = np.array([[number_of[one], number_of[other]] for one, other in self.ties]).reshape(-1, 2).T
        graph = coo_array((np.ones(len(rows)), (rows, columns)), (len(order), len(order))).tocsr()
        ends = sorted(number_of[name] for name in names)
        predecessors = breadth_first_order(graph, ends[0], directed=False)[1] if ends else []
        found = set(ends)
        for end in ends:
            while (end := int(predecessors[end])) >= 0:
                found.add(end)
        return {order[number] for number in found}


def grown(existing: Standing, maps: Mapping[str, MapData], joins: Sequence[Join]) -> Growth | None:
    """Poses of new drives in an existing map, the verdicts on their joins, and the changes of what they touch.

    Args:
        maps: of the new drives, without descriptors. joins: accepted ones between two drives that have enough of them.

    Returns:
        None: the map must be made again, since too much of it moves, or its earlier joins no longer hold.

    Raises:
        Dpm2Error: the map cannot be read, or the graph cannot be solved.
    """
    refused: list[Join] = []
    maps, joins = dict(maps), list(joins)
    while maps:
        growth = _solve_touched(existing, _nearest_first(existing.sizes, maps, joins), joins)
        if growth is None:
            return None
        joins, contradicted = accepted_and_rejected(growth.joins)
        refused += contradicted
        sizes = {**existing.sizes, **sizes_of(maps)}
        connected = component(sizes, joins, existing.sizes)
        if not set(existing.sizes) <= set(connected):
            return None
        if not any(join.loop.ok for join in contradicted) and len(connected) == len(sizes):
            return replace(growth, joins=[*joins, *refused])
        maps = {name: maps[name] for name in maps if name in connected}
    return Growth({}, refused)


def _nearest_first(inside: Collection[str], maps: Mapping[str, MapData], joins: Sequence[Join]) -> dict[str, MapData]:
    """New drives, in the order in which they are reached from the map by their joins."""
    order: dict[str, MapData] = {}
    while True:
        reached = {*inside, *order}
        ends = {
            end for join in joins if (join.one in reached) != (join.other in reached) for end in (join.one, join.other)
        }
        if not ends - reached:
            return {**order, **{name: maps[name] for name in maps if name not in order}}
        order |= {name: maps[name] for name in maps if name in ends - reached}


def _solve_touched(existing: Standing, maps: Mapping[str, MapData], joins: Sequence[Join]) -> Growth | None:
    """Solve for new drives and the drives that they touch, and for more of the map while its borders are strained."""
    sizes, spans, first = existing.sizes, spans_of(existing.sizes), first_nodes(existing.sizes)
    active = existing.between({end for join in joins for end in (join.one, join.other) if end in sizes})
    while sum(map(len, maps.values())) + sum(sizes[name] for name in active) <= existing.largest:
        region = _Region(existing.store, [spans[name] for name in sizes if name in active], existing.settings)
        growth = region.with_drives(maps, joins, {name: first[name] for name in active})
        further = region.strained(first)
        if any(join.loop.ok for join in accepted_and_rejected(growth.joins)[1]) and len(active) < len(sizes):
            further = set(sizes)  # the fixed ones may be wrong
        if not further:
            return growth if region.keeps_joins(sizes) else None
        active |= further
    return None


class _Region:
    """Drives of a map file that are solved for; nodes of other drives at the ends of their loops are fixed.

    Raises:
        Dpm2Error: the file is damaged.
    """

    def __init__(self, store: MapStore, spans: Sequence[range], settings: RobustSettings) -> None:
        try:
            self._read(store, spans, settings)
        except KeyError as error:
            raise Dpm2Error(f"{store.path}: keyframe {error} is missing; see dpm2 map check") from None
        except ValueError as error:
            raise Dpm2Error(f"{store.path}: {error}; see dpm2 map check") from None

    def _read(self, store: MapStore, spans: Sequence[range], settings: RobustSettings) -> None:
        inner_nodes = [node for span in spans for node in span]
        edges = _rows(store, "edges", spans, "from_node", "to_node")
        numbered = sorted({int(row[0]): edge_of(row) for row in edges}.items())
        odometry = odometry_by_node(edge for _, edge in numbered)
        self._loops = {number: edge for number, edge in numbered if edge.ok and odometry.get(edge.to_node) is not edge}
        inner = set(inner_nodes)
        self._border = sorted({end for loop in self._loops.values() for end in (loop.from_node, loop.to_node)} - inner)
        nodes = [*spans, *(range(node, node + 1) for node in self._border)]
        self._poses = {row[0]: pose_of(row[1]) for row in _rows(store, "poses", nodes, "node")}
        self._graph, self._graph_node = PoseGraph(settings), dict[int, int]()
        self._add_nodes(inner_nodes, self._poses, odometry)
        self._add_nodes(self._border, self._poses, {})
        for loop in self._loops.values():
            self._graph.add_loop(_reindexed(loop, self._graph_node))
        self._inner = inner_nodes

    def _add_nodes(self, nodes: Iterable[int], poses: Mapping[int, Array], odometry: Mapping[int, Edge]) -> None:
        for node in nodes:
            self._graph_node[node] = len(self._graph)
            self._graph.add_node(
                poses[node], _reindexed(odometry[node], self._graph_node) if node in odometry else None
            )

    def with_drives(self, maps: Mapping[str, MapData], joins: Sequence[Join], first: Mapping[str, int]) -> Growth:
        """Solve with new drives; `first`: the first node in the file of each drive of the region."""
        graph, first_graph_node = self._graph, {name: self._graph_node[node] for name, node in first.items()}
        for name, data in maps.items():
            first_graph_node[name] = len(graph)
            restore(graph, data)
        loops = len(graph.loops)
        for join in joins:
            graph.add_loop(join.loop_at(first_graph_node))
        for node in self._inner:  # the first loop between two parts has moved one of them
            graph.place(self._graph_node[node], self._poses[node])
        for node in self._border:
            graph.hold(self._graph_node[node], self._poses[node])
        graph.optimize()
        checked = [join.judged(loop.registration) for join, loop in zip(joins, graph.loops[loops:], strict=True)]
        solved = graph.poses
        moved = {node: solved[self._graph_node[node]] for node in self._inner}
        return Growth(
            {name: replace(data, poses=solved[first_graph_node[name] :][: len(data)]) for name, data in maps.items()},
            checked,
            {node: T for node, T in moved.items() if np.abs(T - self._poses[node]).max() > STILL},
            {number: loop for number, loop in self._judged_loops().items() if not loop.ok},
        )

    def _judged_loops(self) -> dict[int, Edge]:
        """The loops of the file as the graph has them now, by number."""
        return {number: replace(loop, registration=judged.registration)
                for (number, loop), judged in zip(self._loops.items(), self._graph.loops, strict=False)}  # fmt: skip

    def strained(self, first: Mapping[str, int]) -> set[str]:
        """The drives outside the region whose loops to it are strained by the new poses; `first`: of all drives."""
        outer = set(self._border)
        border = [loop for loop in self._loops.values() if {loop.from_node, loop.to_node} & outer]
        if not border:
            return set()
        before, after = (self._errors(border, moved) for moved in (False, True))
        chi2 = mahalanobis(after - before, np.array([loop.covariance for loop in border]))
        neighbors = owners([end for loop in border for end in {loop.from_node, loop.to_node} & outer], first)
        return {name for name in neighbors if chi2[np.array(neighbors) == name].sum() > _MAX_STRAIN**2}

    def _errors(self, loops: Sequence[Edge], moved: bool) -> Array:
        """(E, 6) of loops, with the poses of the file or those that were solved for."""
        nodes = sorted({end for loop in loops for end in (loop.from_node, loop.to_node)})
        poses = np.array([self._graph.pose(self._graph_node[node]) if moved else self._poses[node] for node in nodes])
        ends = np.searchsorted(nodes, [(loop.from_node, loop.to_node) for loop in loops])
        return loop_errors(poses, ends, np.array([loop.T_from_to for loop in loops]))

    def keeps_joins(self, inside: Mapping[str, int]) -> bool:
        """Whether all drives that were joined are still joined by enough loops."""
        remaining: dict[tuple[str, str], set[int]] = defaultdict(set)
        for join in joins_of(self._judged_loops().values(), inside):
            remaining[join.one, join.other] |= {join.loop.to_node} if join.loop.ok else set()
        return all(len(nodes) >= ENOUGH for (one, other), nodes in remaining.items() if one != other)


def _span_condition(spans: Sequence[range], *columns: str) -> str:
    """The SQL condition that a column of a table is a node in these spans."""
    return " OR ".join(f"{column} BETWEEN {s.start} AND {s.stop - 1}" for s in spans for column in columns) or "FALSE"


def _rows(store: MapStore, table: str, spans: Sequence[range], *columns: str) -> Iterator[tuple[Any, ...]]:
    """Rows of a table in which a column is a node in these spans; some occur more than once."""
    for first in range(0, len(spans), _SPANS_PER_QUERY):  # SQLite limits the depth of an expression
        yield from store.rows(table, where=_span_condition(spans[first : first + _SPANS_PER_QUERY], *columns))


def _reindexed(edge: Edge, index: Mapping[int, int]) -> Edge:
    return edge.between(index[edge.from_node], index[edge.to_node])
