# SPDX-License-Identifier: Apache-2.0
"""A whole map in memory, but for its clouds, which stay in the file: what mapper and tools begin with."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from dpm2_core.errors import Dpm2Error
from dpm2_core.frame import Array, Keyframe, Points, Registration
from dpm2_core.geometry import se3
from dpm2_core.geometry.voxel import voxel_first
from dpm2_core.slam.graph.pose_graph import PoseGraph
from dpm2_core.slam.map.cloud_store import CloudStore, Loan
from dpm2_core.slam.map.rows import Edge, Pruned, Session, bytes_array, edge_of, pruned_of, unpack_descriptors
from dpm2_core.slam.map.store import Change, MapStore

NO_POINTS: Points = np.zeros((0, 4), np.float32)
Thumbnail = Callable[[int], bytes | None]


@dataclass(eq=False)
class MapData:
    """A map. A node is a position among the keyframes.

    Attributes:
        keyframes: without clouds. session: of each, from 1. poses: (N, 4, 4) optimised T_map_kf.
        edges: odometry and loops, refused ones too. trail: keyframes that were pruned. sessions: who wrote it.
        clouds: of each keyframe, read from the file when asked for.
        thumbnail: JPEG of a node, or None.
    """

    keyframes: list[Keyframe]
    session: list[int]
    poses: Array
    edges: list[Edge]
    trail: list[Pruned]
    sessions: list[Session]
    clouds: CloudStore
    thumbnail: Thumbnail = field(default=lambda node: None)

    def __len__(self) -> int:
        return len(self.keyframes)

    @property
    def constraints(self) -> list[Edge]:
        """The edges that hold: odometry and accepted loops."""
        return [edge for edge in self.edges if edge.ok]


def load_map(store: MapStore, descriptors: bool = True) -> MapData:
    """Read a map, which stays open for its clouds; `descriptors` False leaves those in the file, too.

    Raises:
        Dpm2Error: it is damaged; the message says where.
    """
    try:
        with store.snapshot():
            return _load(store, descriptors)
    except ValueError as error:
        raise Dpm2Error(f"{store.path}: {error}; see dpm2 map check") from None


def _load(store: MapStore, descriptors: bool) -> MapData:
    keyframes, session, loans = [], [], {}
    for position, (node, id, robot, number, stamp, frame, T, lender, T_lent) in enumerate(store.rows("keyframes")):
        if node != position:
            raise ValueError(f"keyframe {position} is missing")
        keyframes.append(Keyframe(id, stamp, frame, bytes_array(T, 4), NO_POINTS, None, robot))
        session.append(number)
        if lender is not None:
            loans[node] = Loan(lender, bytes_array(T_lent, 4))
    count = len(keyframes)
    if descriptors:
        for node in range(count):
            if (data := store.payload(node, "descriptors")) is not None:
                keyframes[node] = replace(keyframes[node], descriptors=unpack_descriptors(data))
        for node, loan in loans.items():
            keyframes[node] = borrowing(keyframes[node], keyframes, loan)
    edges = [edge_of(row) for row in store.rows("edges")]
    owner = [(keyframe.robot, number) for keyframe, number in zip(keyframes, session, strict=True)]
    for node, edge in _chain(edge for edge in edges if max(edge.from_node, edge.to_node) < count).items():
        if owner[edge.from_node] == owner[node]:
            known = (edge.T_from_to, edge.covariance, edge.confidence, edge.rmse, edge.method)
            keyframes[node] = replace(keyframes[node], edge=Registration(*known))
    poses = {node: bytes_array(T, 4) for node, T in store.rows("poses")}
    if missing := set(range(count)) - poses.keys():
        raise ValueError(f"keyframe {min(missing)} has no pose")
    moving: dict[int, bytes] = dict(store.rows("moving"))
    return MapData(
        keyframes,
        session,
        np.array([poses[node] for node in range(count)]).reshape(-1, 4, 4),
        edges,
        [pruned_of(row) for row in store.rows("trail")],
        [Session(*row) for row in store.rows("sessions")],
        CloudStore(store.cloud, [moving.get(node) for node in range(count)], loans),
        lambda node: store.payload(node, "thumbnail"),
    )


def borrowing(keyframe: Keyframe, keyframes: Sequence[Keyframe], loan: Loan) -> Keyframe:
    """The keyframe with the descriptors of another one, moved to its own frame; their features take no memory."""
    lent = keyframes[loan.lender].descriptors
    return replace(keyframe, descriptors=None if lent is None else lent.moved(loan.T_kf_lender))


def save_as(data: MapData, path: Path) -> None:
    """Write a map to a new file, which appears whole or not at all; clouds pass through one at a time.

    Raises:
        UsageError: there is a file already. Dpm2Error: it could not be written.
    """
    part = path.with_name(f".{path.name}.part")
    _remove(part)
    MapStore.create(path).close()  # refuses a file that is there, and a folder that cannot be written
    try:
        with MapStore.create(part) as store:
            _fill(store, data)
        part.replace(path)
    except BaseException:
        _remove(path)
        raise
    finally:
        _remove(part)


def _fill(store: MapStore, data: MapData) -> None:
    store.add_sessions(data.sessions)
    sessions = dict(enumerate(data.session))
    for node, keyframe in enumerate(data.keyframes):
        packed = data.clouds.loan(node) or data.clouds.packed(node)
        mask = data.clouds.moving(node)
        change = Change(
            keyframes=[(node, keyframe, packed, data.thumbnail(node))],
            poses={node: data.poses[node]},
            moving={} if mask is None else {node: mask},
        )
        store.write(change, sessions)
    store.write(Change(edges=data.edges, trail=data.trail))


def _remove(path: Path) -> None:
    for suffix in ("", "-wal", "-shm", "-journal"):
        Path(f"{path}{suffix}").unlink(missing_ok=True)


def subset(data: MapData, nodes: Sequence[int], edges: list[Edge], trail: list[Pruned]) -> MapData:
    """The map of some of its nodes, lenders among them, renumbered; `edges` and `trail` are in the new numbers."""
    where = list(nodes)
    new = {node: i for i, node in enumerate(where)}
    loans = {new[node]: Loan(new[loan.lender], loan.T_kf_lender) for node in where if (loan := data.clouds.loan(node))}
    clouds = CloudStore(lambda i: data.clouds.packed(where[i]), [data.clouds.moving(node) for node in where], loans)
    return MapData(
        [data.keyframes[node] for node in where],
        [data.session[node] for node in where],
        data.poses[where],
        edges,
        trail,
        data.sessions,
        clouds,
        lambda node: data.thumbnail(where[node]),
    )


def map_cloud(clouds: CloudStore, poses: Array, voxel: float) -> Points:
    """The cloud (M, 4) float32 of a map in its frame, one point in each voxel of `voxel` m."""
    cloud = NO_POINTS
    own = [node for node in range(len(poses)) if clouds.loan(node) is None]
    for start in range(0, len(own), 50):  # in parts: memory is that of the map, not of all the clouds
        part = own[start : start + 50]
        cloud = np.concatenate([cloud, *(se3.transform(poses[node], clouds[node]) for node in part)])
        cloud = cloud[voxel_first(cloud, voxel)]
    return cloud


def trajectory(data: MapData) -> tuple[list[int], Array]:
    """Stamps (ns) and (K, 4, 4) T_map_kf of all keyframes that ever were, pruned ones too, by robot and time."""
    rows = [(k.robot, s, k.stamp, T) for k, s, T in zip(data.keyframes, data.session, data.poses, strict=True)]
    rows += [(p.robot, p.session, p.stamp, data.poses[p.node] @ p.T_node_kf) for p in data.trail]
    rows.sort(key=lambda row: row[:3])
    return [row[2] for row in rows], np.array([row[3] for row in rows]).reshape(-1, 4, 4)


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


def _chain(edges: Iterable[Edge]) -> dict[int, Edge]:
    """The odometry by the node that it leads to: no node has two before it, or two after it."""
    chain: dict[int, Edge] = {}
    left: set[int] = set()
    # Nearest nodes first: what pruning has left goes round about.
    odometry = (edge for edge in edges if edge.ok and edge.kind == "odometry" and edge.from_node < edge.to_node)
    for edge in sorted(odometry, key=lambda edge: edge.to_node - edge.from_node):
        if edge.to_node not in chain and edge.from_node not in left:
            chain[edge.to_node] = edge
            left.add(edge.from_node)
    return chain
