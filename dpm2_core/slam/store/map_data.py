# SPDX-License-Identifier: Apache-2.0
"""A whole map in memory, except its clouds, which stay in the file; used by the mapper and the tools."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from itertools import groupby, pairwise
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from dpm2_core.descriptors import Descriptors
from dpm2_core.errors import Dpm2Error
from dpm2_core.estimates import Edge, Keyframe
from dpm2_core.files import named, part_beside
from dpm2_core.frame import Array, Georeference
from dpm2_core.slam.store.cloud_store import CloudStore, Loan
from dpm2_core.slam.store.map_file import check_new, name_map, remove_map
from dpm2_core.slam.store.map_store import Change, MapStore
from dpm2_core.slam.store.rows import (
    RemovedKeyframe,
    Session,
    check_ends,
    edge_of,
    fix_of,
    georeference_of,
    keyframe_of,
    pose_of,
    removed_of,
    session_of,
    unpack_descriptors,
)

_T = TypeVar("_T")
Thumbnail = Callable[[int], bytes | None]
Describe = Callable[[int], Descriptors | None]


@dataclass(eq=False)
class MapData:
    """A map. A node is an index into the keyframes.

    Attributes:
        keyframes: without clouds. poses: (N, 4, 4) optimized T_map_kf.
        edges: odometry and loops, rejected ones too. trail: removed keyframes. sessions: the drives that wrote it.
        clouds: of each keyframe, read from the file when needed.
        thumbnail: JPEG of a node, or None.
        describe: descriptors of a node from the file, if `keyframes` were read without them; or None.
        georeference: pose of the map on Earth; None if no fixes have determined it.
    """

    keyframes: list[Keyframe]
    poses: Array
    edges: list[Edge]
    trail: list[RemovedKeyframe]
    sessions: list[Session]
    clouds: CloudStore
    thumbnail: Thumbnail = field(default=lambda node: None)
    describe: Describe = field(default=lambda node: None)
    georeference: Georeference | None = None

    def __len__(self) -> int:
        return len(self.keyframes)

    def descriptors(self, node: int) -> Descriptors | None:
        """Descriptors of a node that does not borrow, from memory or from the file; None if it has none.

        Raises:
            Dpm2Error: they are damaged.
        """
        return self.keyframes[node].descriptors or self.describe(node)

    @property
    def constraints(self) -> list[Edge]:
        """The valid edges: odometry and accepted loops."""
        return [edge for edge in self.edges if edge.ok]


def load_map(store: MapStore, descriptors: bool = True) -> MapData:
    """Read a map, which stays open for its clouds; with `descriptors` False those also stay in the file, and are
    checked when they are read.

    Raises:
        Dpm2Error: it is damaged; the message states where.
    """
    try:
        with store.snapshot():
            return _load(store, descriptors)
    except ValueError as error:
        raise Dpm2Error(f"{store.path}: {error}; see dpm2 map check") from None


def _load(store: MapStore, descriptors: bool) -> MapData:
    describe = _reader_of_descriptors(store)
    keyframes, loans = _load_keyframes(store, describe if descriptors else None)
    nodes = range(len(keyframes))
    edges = []
    for number, edge in _read_objects(store, "edges", edge_of):
        with _naming_row("edge", number):
            check_ends(edge, nodes)
        edges.append(edge)
    owner = [(keyframe.robot, keyframe.session) for keyframe in keyframes]
    for node, edge in odometry_by_node(edges).items():
        if owner[edge.from_node] == owner[node]:
            keyframes[node] = replace(keyframes[node], edge=edge.registration)
    for _, (node, fix) in _read_objects(store, "fixes", fix_of):
        if node not in nodes:
            raise ValueError(f"a fix of keyframe {node}, which is not there")
        keyframes[node] = replace(keyframes[node], fix=fix)
    poses = dict(_read_objects(store, "poses", lambda row: pose_of(row[1])))
    if missing := set(nodes) - poses.keys():
        raise ValueError(f"keyframe {min(missing)} has no pose")
    moving: dict[int, bytes] = dict(store.rows("moving"))
    if not all(isinstance(mask, bytes) for mask in moving.values()):
        raise ValueError("invalid mask of moving points")
    trail = [pruned for _, pruned in _read_objects(store, "trail", removed_of)]
    if any(pruned.node not in nodes for pruned in trail):
        raise ValueError("a pruned keyframe that refers to no existing one")
    return MapData(
        keyframes,
        np.array([poses[node] for node in nodes]).reshape(-1, 4, 4),
        edges,
        trail,
        [made for _, made in _read_objects(store, "sessions", session_of)],
        CloudStore(
            lambda node: store.payload(node, "cloud"), [moving.get(node) for node in nodes], loans, str(store.path)
        ),
        lambda node: store.payload(node, "thumbnail"),
        describe,
        next((made for _, made in _read_objects(store, "georeference", georeference_of)), None),
    )


def _load_keyframes(store: MapStore, describe: Describe | None) -> tuple[list[Keyframe], dict[int, Loan]]:
    """Keyframes with their odometry pose, and descriptors if there is `describe`; and the loans of those that
    borrow."""
    keyframes, loans = [], {}
    for position, (_, (node, keyframe, loan)) in enumerate(_read_objects(store, "keyframes", keyframe_of)):
        if node != position:
            raise ValueError(f"keyframe {position} is missing")
        keyframes.append(keyframe)
        if loan is not None:
            loans[node] = loan
    for node, loan in loans.items():  # a lender has its own cloud: there are no chains, and so no cycles
        if not 0 <= loan.lender < len(keyframes) or loan.lender in loans:
            raise ValueError(f"keyframe {node} borrows the cloud of {loan.lender}, which has none")
    if describe is not None:
        keyframes = [replace(keyframe, descriptors=describe(node)) for node, keyframe in enumerate(keyframes)]
        for node, loan in loans.items():
            keyframes[node] = borrowing(keyframes[node], keyframes, loan)
    return keyframes, loans


def _reader_of_descriptors(store: MapStore) -> Describe:
    """Reads the descriptors of a node from the file. Raises Dpm2Error if they are damaged, or if they have another
    number of channels than those that were read before."""
    known = set[int]()

    def describe(node: int) -> Descriptors | None:
        if (packed := store.payload(node, "descriptors")) is None:
            return None
        try:
            made = unpack_descriptors(packed)
            known.add(made.features.shape[1])
            if len(known) > 1:
                raise ValueError(f"descriptors of {', '.join(map(str, sorted(known)))} channels cannot be compared")
        except ValueError as error:
            raise Dpm2Error(f"{store.path}: keyframe {node}: {error}; see dpm2 map check") from None
        return made

    return describe


def _read_objects(store: MapStore, table: str, make: Callable[[tuple[Any, ...]], _T]) -> Iterator[tuple[int, _T]]:
    """Number and object of each row of a table; errors name their row."""
    for row in store.rows(table):
        with _naming_row("fix" if table == "fixes" else table.removesuffix("s"), row[0]):
            made = make(row)
        yield row[0], made


@contextmanager
def _naming_row(what: str, number: int) -> Iterator[None]:
    try:
        yield
    except ValueError as error:
        raise ValueError(f"{what} {number}: {error}") from None


def borrowing(keyframe: Keyframe, keyframes: Sequence[Keyframe], loan: Loan) -> Keyframe:
    """The keyframe with the descriptors of its lender, moved to its own frame; the features are shared in memory."""
    lent = keyframes[loan.lender].descriptors
    return replace(keyframe, descriptors=None if lent is None else lent.moved(loan.T_kf_lender))


def save_as(data: MapData, path: Path) -> None:
    """Write a map to a new file, which appears whole or not at all; only one cloud at a time is in memory.

    Raises:
        UsageError: see `check_new`. Dpm2Error: it could not be written.
    """
    check_new(path)
    part = part_beside(path)
    try:
        with named(path, part), MapStore.create(part) as store:
            append_map(store, data)
        name_map(part, path)  # fails if another program has made one meanwhile
    finally:
        remove_map(part)


def append_map(store: MapStore, data: MapData) -> None:
    """Append a map to a file; its nodes and sessions are numbered after those of the file. Only one cloud at a time is
    in memory.

    An edge is written with the later of its keyframes, as in a drive: if writing is interrupted, the rest is connected.

    Raises:
        Dpm2Error: it could not be written.
    """
    first = store.size
    data = renumbered_after(data, first, max((row[0] for row in store.rows("sessions", "session")), default=0))
    store.add_sessions(data.sessions)
    ending: dict[int, list[Edge]] = {}
    for edge in data.edges:
        ending.setdefault(max(edge.from_node, edge.to_node), []).append(edge)
    for node, keyframe in enumerate(data.keyframes):
        loan, mask = data.clouds.loan(node), data.clouds.moving(node)
        if loan is None:
            keyframe = replace(keyframe, descriptors=data.descriptors(node))
        change = Change(
            keyframes=[(first + node, keyframe, data.clouds.packed(node), data.thumbnail(node))],
            loans={} if loan is None else {first + node: replace(loan, lender=loan.lender + first)},
            edges=ending.get(first + node, []),
            poses={first + node: data.poses[node]},
            moving={} if mask is None else {first + node: mask},
        )
        store.write(change)
    store.write(Change(trail=data.trail, georeference=None if first else data.georeference))


def renumbered_after(data: MapData, nodes: int, sessions: int) -> MapData:
    """A map with edges, trail and sessions renumbered, to follow this number of nodes and sessions of another map."""
    return replace(
        data,
        keyframes=[replace(keyframe, session=keyframe.session + sessions) for keyframe in data.keyframes],
        edges=[edge.shifted(nodes) for edge in data.edges],
        trail=[replace(p, node=p.node + nodes, session=p.session + sessions) for p in data.trail],
        sessions=[replace(session, number=session.number + sessions) for session in data.sessions],
    )


def subset(data: MapData, nodes: Sequence[int], edges: Iterable[Edge], trail: Iterable[RemovedKeyframe]) -> MapData:
    """The map of some of its nodes, lenders among them, with those of `edges` and `trail` between and at them.

    All arguments have the numbers of `data`; the result is renumbered.
    """
    kept = list(nodes)
    new = {node: i for i, node in enumerate(kept)}
    loans = {new[node]: Loan(new[loan.lender], loan.T_kf_lender) for node in kept if (loan := data.clouds.loan(node))}
    clouds = CloudStore(lambda i: data.clouds.packed(kept[i]), [data.clouds.moving(node) for node in kept], loans,
                        data.clouds.name)  # fmt: skip
    return MapData(
        [data.keyframes[node] for node in kept],
        data.poses[kept],
        [e.between(new[e.from_node], new[e.to_node]) for e in edges if e.from_node in new and e.to_node in new],
        [replace(pruned, node=new[pruned.node]) for pruned in trail if pruned.node in new],
        data.sessions,
        clouds,
        lambda node: data.thumbnail(kept[node]),
        lambda node: data.describe(kept[node]),
        data.georeference,
    )


@dataclass(frozen=True, eq=False)
class Way:
    """Trajectory of a robot in a session: stamps (K,) in ns and (K, 4, 4) T_map_kf."""

    robot: str
    session: int
    stamps: list[int]
    poses: Array


def ways(data: MapData) -> list[Way]:
    """The trajectory of each drive, including removed keyframes; one robot and session after the other.

    A session has several if the odometry restarted, as when a recording was played again; among removed keyframes this
    is not known. Ids give the order, not stamps, since a clock may be set back.
    """
    chain = odometry_by_node(data.edges)
    steps: list[tuple[str, int, int, int, int | None, Array]] = [
        (k.robot, k.session, k.id, k.stamp, node, data.poses[node]) for node, k in enumerate(data.keyframes)
    ]
    steps += [(p.robot, p.session, p.id, p.stamp, None, data.poses[p.node] @ p.T_node_kf) for p in data.trail]
    steps.sort(key=lambda step: step[:4])
    found = []
    for (robot, session), drive in groupby(steps, lambda step: step[:2]):
        drive_steps = list(drive)
        nodes = enumerate(pairwise([step[4] for step in drive_steps]), 1)
        cuts = [at for at, (before, node) in nodes if None not in (before, node) and node not in chain]
        for start, end in pairwise([0, *cuts, len(drive_steps)]):
            _, _, _, stamps, _, poses = zip(*drive_steps[start:end], strict=True)
            found.append(Way(robot, session, list(stamps), np.array(poses)))
    return found


def trajectory(data: MapData) -> tuple[list[int], Array]:
    """Stamps (ns) and (K, 4, 4) T_map_kf of all `ways`, one after the other, the earliest first.

    The frame where a drive was interrupted and continued is a keyframe of both sessions, but is included once.
    """
    stamps, poses, ends = list[int](), [data.poses[:0]], set[tuple[str, int]]()
    for way in sorted(ways(data), key=lambda way: way.stamps[0]):
        repeated = int((way.robot, way.stamps[0]) in ends)
        ends.add((way.robot, way.stamps[-1]))
        stamps += way.stamps[repeated:]
        poses.append(way.poses[repeated:])
    return stamps, np.concatenate(poses)


def odometry_by_node(edges: Iterable[Edge]) -> dict[int, Edge]:
    """The odometry edges by the node that they lead to: no node has two predecessors, or two successors."""
    chain: dict[int, Edge] = {}
    with_successor: set[int] = set()
    # Nearest nodes first: edges that pruning has composed may skip nodes.
    odometry = (edge for edge in edges if edge.ok and edge.kind == "odometry" and edge.from_node < edge.to_node)
    for edge in sorted(odometry, key=lambda edge: edge.to_node - edge.from_node):
        if edge.to_node not in chain and edge.from_node not in with_successor:
            chain[edge.to_node] = edge
            with_successor.add(edge.from_node)
    return chain
