# SPDX-License-Identifier: Apache-2.0
"""Builds a globally consistent map from keyframes; with a store, the map file is never more than a keyframe behind."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from dpm2_core.config import Settings
from dpm2_core.errors import Dpm2Error, UsageError
from dpm2_core.estimates import Edge, Keyframe, Registration
from dpm2_core.frame import NO_POINTS, Array, Points
from dpm2_core.geometry import se3
from dpm2_core.slam.graph.pose_graph import PoseGraph
from dpm2_core.slam.loops.closure import LoopCloser
from dpm2_core.slam.mapping.admission import check_keyframe
from dpm2_core.slam.mapping.moving import MovingWindow
from dpm2_core.slam.mapping.occupancy_map import OccupancyMap
from dpm2_core.slam.mapping.redundancy import SAME, lender, to_lender
from dpm2_core.slam.mapping.restore import restore_solved
from dpm2_core.slam.store.cloud_codec import pack_cloud
from dpm2_core.slam.store.cloud_store import CloudStore
from dpm2_core.slam.store.map_cloud import map_cloud
from dpm2_core.slam.store.map_data import Thumbnail, borrowing, load_map
from dpm2_core.slam.store.map_store import MapStore
from dpm2_core.slam.store.writer import MapWriter

_MAX_MISSED = 1000  # missing keyframes between two, for which the covariance of an edge is increased


class MapSettings(Settings):
    """The map that is displayed and saved."""

    voxel: float = Field(0.3, gt=0)
    """Spacing of the map's points, m."""
    thumbnail: int = Field(0, ge=0, le=1024)
    """Width of the image that a map file stores of each keyframe, pixels. 0: only of the first keyframe of a drive, and
    of those whose image gives the position along a tunnel or a highway, see `slam.visual`: 6 to 10 kB each."""
    moving_window: int = Field(5, ge=0)
    """Number of keyframes before and after one that show which of its points move; the map omits these; 0 keeps all."""
    redundancy: float = Field(SAME, ge=0)
    """A keyframe gives up its cloud and descriptors for those of an older one if an accepted loop connects the two
    within this distance, m, and a rotation of 30 degrees; 0 keeps all."""


@dataclass(eq=False)
class _Robot:
    """A robot that has sent keyframes.

    Attributes:
        window: of its clouds. last: node of its last keyframe in this session, None before the first.
        ids: number of ids given so far. offset: of the ids of its present drive.
    """

    window: MovingWindow
    last: int | None = None
    ids: int = 0
    offset: int = 0


class _SessionStart(NamedTuple):
    """Start of a session in a loaded map; see `Mapper.start_session`."""

    T_map_odom: Array | None
    covariance: Array


class Mapper:
    """Keyframes and pose graph of one robot or several; their odometry is not changed by the map.

    Each robot has its own odometry frame. The map's frame is that of the first robot; the pose of another one in it is
    not known before a loop connects the two.

    Attributes:
        keyframes: all, without their clouds; a node is an index into them. ids continue over a robot's sessions.
        clouds: (M, 4) of each keyframe in its own frame, read from disk; without moving points.
        graph: poses of the keyframes, and the constraints between them.
        session_start: node of the first keyframe of this session: earlier ones are of a loaded map.
        loops: tried in this session, accepted or rejected.
        thumbnail: JPEG of a node of a loaded map, or None.
    """

    def __init__(
        self, settings: MapSettings, graph: PoseGraph, loops: LoopCloser, store: MapStore | None = None
    ) -> None:
        """`store`: the map file to continue, its session begun; None keeps the map in memory, clouds on disk."""
        self._settings = settings
        self.graph = graph
        self._closer = loops
        self.keyframes: list[Keyframe] = []
        self.loops: list[Edge] = []
        self.thumbnail: Thumbnail = lambda node: None
        self.clouds = CloudStore()
        self._writer: MapWriter | None = None
        self._robots: dict[str, _Robot] = {}
        self._start: _SessionStart | None = None
        if store is not None:
            self._load(store)
        self.session_start = len(self.keyframes)

    @property
    def poses(self) -> Array:
        """(N, 4, 4) optimized T_map_kf of all keyframes."""
        return self.graph.poses

    @property
    def edges(self) -> list[Edge]:
        """Odometry edges and accepted loops."""
        return self.graph.edges

    @property
    def T_map_odom(self) -> Array | None:
        """(4, 4) of the robot of the last keyframe, with all corrections; None before it is known."""
        if not self.keyframes:
            return np.eye(4)
        if len(self.keyframes) == self.session_start:
            return None if self._start is None else self._start.T_map_odom
        return self.T_map_odom_of(self.keyframes[-1].robot)

    def T_map_odom_of(self, robot: str) -> Array | None:
        """(4, 4) of a robot; None before its pose in the map is known."""
        last = self._robots[robot].last if robot in self._robots else None
        if last is None or self.graph.part(last) != 0:
            return None
        return se3.orthonormalized(self.graph.pose(last) @ se3.inverse(self.keyframes[last].T_odom_kf))

    @property
    def placed(self) -> NDArray[np.bool_]:
        """(N,) whether the pose of each keyframe in the map is known; unconnected keyframes are not drawn."""
        return self.graph.placed

    @property
    def robots(self) -> list[str]:
        """Names of the robots that have sent keyframes in this session."""
        return [name for name, robot in self._robots.items() if robot.last is not None]

    @property
    def store_problem(self) -> str:
        """Why the map file is behind, in words; empty if it is not, or if there is none."""
        return "" if self._writer is None else self._writer.problem

    @property
    def channels(self) -> int | None:
        """Width of the network's features; None without a network."""
        return self._closer.channels

    def start_session(self, T_map_odom: Array | None, covariance: Array) -> None:
        """Set where the odometry of a session in a loaded map begins, before its first keyframe; else only a loop can.

        Args:
            T_map_odom: (4, 4); a loop with it connects the first keyframe to the nearest one with a known pose. None:
                it has the pose of the map's last keyframe, is of the same frame, and continues its odometry.
            covariance: (6, 6) of the first keyframe's pose relative to that one.
        """
        self._start = _SessionStart(T_map_odom, covariance)

    def forget_start(self) -> None:
        """The odometry of `start_session` restarts before its first keyframe: only a loop can give its pose."""
        self._start = None

    def described(self, keyframe: Keyframe) -> Keyframe:
        """The keyframe with descriptors, if loops need them and its registration made none."""
        return self._closer.described(keyframe)

    def add(self, keyframe: Keyframe) -> list[Edge]:
        """Add a keyframe; returns the loops that were tried, accepted or not.

        Raises:
            RejectedError: the keyframe is invalid. Any error before the search for loops leaves the map unchanged;
                after a later error the keyframe is in the map, with the results so far.
        """
        check_keyframe(keyframe, self._closer.channels)
        node, cloud, thumbnail, odometry = len(self.keyframes), keyframe.cloud, keyframe.thumbnail, keyframe.edge
        origin = keyframe.origin
        robot = self._robot(keyframe.robot)
        follows = robot.last is not None and odometry is not None
        offset = robot.offset if follows else robot.ids
        keyframe = self.described(keyframe if follows else replace(keyframe, edge=None))
        keyframe = replace(keyframe, id=keyframe.id + offset, session=0)
        keyframe = replace(keyframe, cloud=NO_POINTS, thumbnail=None, origin=np.zeros(3))
        packed = pack_cloud(cloud, origin)
        new_edges = self._add_node(keyframe, odometry, robot.last if follows else None)
        self.clouds.append(packed)
        self.keyframes.append(keyframe)
        robot.last, robot.ids, robot.offset = node, keyframe.id + 1, offset
        n_loops = len(self.loops)
        try:
            self._close_loops(keyframe.fix is not None and self.graph.add_fix(node, keyframe.fix))
            self._borrow_clouds(node, new_edges, self.loops[n_loops:])
            if not follows:  # the motion since the previous keyframe is unknown: its clouds cannot show moving points
                self._mark_moving(robot.window.finish(self.poses))
                robot.window = MovingWindow(self._settings.moving_window)
            self._mark_moving(robot.window.add(node, cloud, self.poses, origin, keyframe.up))
        finally:
            self._store(node, thumbnail, [*new_edges, *self.loops[n_loops:]])
        return self.loops[n_loops:]

    def _borrow_clouds(self, node: int, new_edges: list[Edge], loops: list[Edge]) -> None:
        """Let keyframes that revisit older ones borrow their clouds: the new one, and any with a postponed loop."""
        odometry = [edge for edge in new_edges if edge.kind == "odometry"]
        repeated = odometry if node == self.session_start else []  # the frame with which the previous session ended
        edges = [*repeated, *self.kept(loops)]
        for revisit in sorted({edge.to_node for edge in edges}):
            loan = lender(revisit, edges, self.clouds.loan, self._settings.redundancy)
            if loan is None or not self.clouds.may_borrow(revisit):
                continue
            given_up = self.clouds.borrow(revisit, loan)
            self.keyframes[revisit] = borrowing(self.keyframes[revisit], self.keyframes, loan)
            if self._writer is not None and given_up is not None:
                self._writer.give_up(given_up)
            if self._writer is not None and revisit != node:
                self._writer.add(revisit, self.keyframes[revisit], None, [])

    def _store(self, node: int, thumbnail: bytes | None, edges: list[Edge]) -> None:
        """Update the map file, if there is one, with a new keyframe."""
        if self._writer is not None:
            self._writer.add(node, self.keyframes[node], thumbnail, edges)
            self._writer.sync(self.poses, self.graph.georeference)

    def kept(self, loops: Sequence[Edge]) -> list[Edge]:
        """Loops that the optimization has not rejected: only for these a cloud is given up, or a break crossed."""
        rejected = {(loop.from_node, loop.to_node) for loop in self.graph.loops if not loop.ok}
        return [loop for loop in loops if (loop.from_node, loop.to_node) not in rejected]

    def settle(self, wait: bool = False) -> bool:
        """Apply what another process has solved since the last keyframe, as none follows when the robot has stopped.
        Also write what the file lacks, if that is possible by now.

        `wait`: for everything that is to be solved. Returns whether anything was.
        """
        if unsolved := wait and self.graph.unsolved:
            self._optimize(changed=True)
        changed = self.graph.collect(wait) or unsolved
        if self._writer is not None and (changed or self._writer.problem):
            self._writer.sync(self.poses, self.graph.georeference)
        return changed

    def finish(self) -> None:
        """At the end of a drive: wait for the solver, find moving points in the last clouds, write the map file."""
        self.settle(wait=True)
        self.graph.close()
        for robot in self._robots.values():
            self._mark_moving(robot.window.finish(self.poses))
        if self._writer is not None:
            self._writer.sync(self.poses, self.graph.georeference, self.graph.loops)

    def cloud(self, voxel_size: float | None = None) -> Points:
        """The map (M, 4) float32 in the map frame, one point per voxel of that size (default: settings)."""
        placed = np.flatnonzero(self.placed).tolist()
        return map_cloud(self.clouds, self.poses, voxel_size or self._settings.voxel, placed)

    def update_grid(self, grid: OccupancyMap, seconds: float) -> bool:
        """Update a grid of this map; False if there is more to do than `seconds` allow."""
        return not self.keyframes or grid.update(self.clouds, self.poses, seconds, self.placed)

    def _load(self, store: MapStore) -> None:
        data, channels = load_map(store), self._closer.channels
        for d in (keyframe.descriptors for keyframe in data.keyframes):
            if d is not None and channels is not None and d.features.shape[1] != channels:
                width = d.features.shape[1]
                raise UsageError(f"{store.path}: descriptors of {width} channels, the network makes {channels}")
        self.keyframes, self.clouds, self.thumbnail = data.keyframes, data.clouds, data.thumbnail
        try:
            restore_solved(self.graph, data)
        except (ValueError, Dpm2Error) as error:
            raise Dpm2Error(f"{store.path}: {error}; see dpm2 map check") from None
        for keyframe in data.keyframes:
            robot = self._robot(keyframe.robot)
            robot.ids = max(robot.ids, keyframe.id + 1)
        if not store.read_only:
            self._writer = MapWriter(store, self.clouds, data.poses)

    def _robot(self, name: str) -> _Robot:
        return self._robots.setdefault(name, _Robot(MovingWindow(self._settings.moving_window)))

    def _add_node(self, keyframe: Keyframe, odometry: Registration | None, last: int | None) -> list[Edge]:
        """Add a node with an edge to its robot's `last` one, even if some between were lost; `odometry`: its edge."""
        node, result = len(self.keyframes), odometry
        if result is not None and last is not None:
            before = self.keyframes[last]
            T_before_this = se3.inverse(before.T_odom_kf) @ keyframe.T_odom_kf
            covariance = result.covariance * np.clip(keyframe.id - before.id, 1, _MAX_MISSED)
            result = replace(result, T_target_source=T_before_this, covariance=covariance)
        elif node == self.session_start and self._start is not None:
            return [self._begin_session(self._start, keyframe, odometry)]
        else:
            self.graph.add_node(keyframe.T_odom_kf)
            return []
        edge = Edge("odometry", last, node, result)
        self.graph.add_node(self.graph.pose(last) @ edge.T_from_to, edge)
        return [edge]

    def _begin_session(self, start: _SessionStart, keyframe: Keyframe, odometry: Registration | None) -> Edge:
        """Add the first node of a session and its edge: odometry from the last node, or a loop to the nearest.

        `odometry`: edge to it from a keyframe before the session, if there is one: it may include a break.
        """
        node, poses = len(self.keyframes), self.poses
        covariance = start.covariance if odometry is None else start.covariance + odometry.covariance
        if start.T_map_odom is None:
            edge = Edge("odometry", node - 1, node, Registration(np.eye(4), covariance))
            self.graph.add_node(poses[-1], edge)
            return edge
        T, known = start.T_map_odom @ keyframe.T_odom_kf, np.flatnonzero(self.placed)
        other = int(known[np.linalg.norm(poses[known, :3, 3] - T[:3, 3], axis=1).argmin()])
        self.graph.add_node(T)
        return self._add_to_graph(Edge("loop", other, node, Registration(se3.inverse(poses[other]) @ T, covariance)))

    def _close_loops(self, due: bool) -> None:
        """Search loops of the last keyframe and add them to the graph, unless they are rejected.

        `due`: optimize in any case.
        """
        found = self._closer.close(self.keyframes, self.clouds, self.poses, self.graph.parts, self.clouds.own)
        tried = [self._add_to_graph(loop) for loop in found]
        self.loops += tried
        self._optimize(due or any(loop.ok for loop in tried))

    def _add_to_graph(self, loop: Edge) -> Edge:
        """A tried loop, added to the graph if it was accepted; rejected if the graph does not accept it."""
        if loop.ok:
            loop = to_lender(loop, self.clouds.loan)
            try:
                self.graph.add_loop(loop)
            except Dpm2Error as error:
                return loop.rejected(str(error))
        return loop

    def _optimize(self, changed: bool) -> None:
        """Optimize the graph if it has `changed`, and apply what another process has solved."""
        self.graph.collect()
        if changed:
            try:
                self.graph.optimize()
            except Dpm2Error as error:  # the drive continues with the previous poses
                self.graph.problem = str(error)

    def _mark_moving(self, checked: Iterable[tuple[int, NDArray[np.bool_]]]) -> None:
        for node, moving in checked:
            if moving.any() and self.clouds.keeps(node):
                self.clouds.set_moving(node, moving)
                if self._writer is not None:
                    self._writer.set_moving(node)
