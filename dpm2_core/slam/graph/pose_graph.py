# SPDX-License-Identifier: Apache-2.0
"""The pose graph of the running system: it grows by keyframes and loops, and is robust against wrong loops."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dpm2_core.errors import Dpm2Error
from dpm2_core.estimates import Edge
from dpm2_core.frame import Array, Fix, Georeference
from dpm2_core.geometry import se3
from dpm2_core.slam.graph import robust
from dpm2_core.slam.graph.fixes import Fixes
from dpm2_core.slam.graph.g2o import G2o, write_g2o
from dpm2_core.slam.graph.graph_data import GraphData, loop_errors, mahalanobis
from dpm2_core.slam.graph.robust import RobustSettings, Solution
from dpm2_core.slam.graph.trajectories import Trajectories
from dpm2_core.slam.graph.worker import GraphWorker

_log = logging.getLogger(__name__)
SHORT = 50
"""Number of loops; a graph with fewer is solved in about 20 ms, faster than it is sent to another process."""
_BATCH = 40  # pairs of nodes whose covariances are computed at once
_FIXES_DUE = 10, 20
"""Fixes that may wait for an optimization: this number, or one in this number of all fixes."""
_MAX_ATTEMPTS = 2  # worker processes that may fail on one graph


class PoseGraph:
    """Keyframe poses T_map_kf, odometry edges and loop edges; node n is the n-th one added.

    Attributes:
        problem: why the last optimization failed, in words; empty after a successful one.
    """

    def __init__(self, settings: RobustSettings, background: bool = False) -> None:
        """`background`: `optimize` sends a large graph to another process; the result depends on timing."""
        self._settings, self._background = settings, background
        self._poses: list[Array] = []
        self._steps: list[Edge | None] = []  # the odometry to each node; None at the start of a trajectory
        self._trajectories = Trajectories()
        self._loops: list[Edge] = []
        self._fixed_nodes: list[int] = []
        self._worker = GraphWorker()
        self._part_moved = False  # whether a part was moved since a graph was sent, so that its solution is invalid
        self._fixes, self._sent_fixes = Fixes(), list[int]()
        self._sent_loops = 0  # loops in the graph that is being solved
        self._failures = 0
        self.problem = ""

    def __len__(self) -> int:
        return len(self._poses)

    @property
    def poses(self) -> Array:
        """(N, 4, 4) T_map_kf."""
        return np.array(self._poses).reshape(-1, 4, 4)

    def pose(self, node: int) -> Array:
        """(4, 4) T_map_kf of one node."""
        return self._poses[node]

    @property
    def edges(self) -> list[Edge]:
        """Odometry edges, then the loops that are accepted or not checked yet."""
        return [step for step in self._steps if step is not None] + [loop for loop in self._loops if loop.ok]

    @property
    def loops(self) -> list[Edge]:
        """All loops in the order in which they were added; `ok` and `reason` by the last optimization."""
        return list(self._loops)

    @property
    def georeference(self) -> Georeference | None:
        """Pose of the map on Earth by its fixes; None while that is unknown."""
        return self._fixes.georeference

    @property
    def fixes(self) -> tuple[int, int]:
        """Number of fixes that constrain the poses, and of all."""
        return self._fixes.used(self._chosen_fixes()), len(self._fixes)

    @property
    def unsolved(self) -> bool:
        """Whether relevant fixes were added since the last optimization."""
        return self._fixes.due > 0 and self._fixes.georeference is not None

    @property
    def busy(self) -> bool:
        """Whether another process is optimizing."""
        return self._worker.busy

    def add_node(self, T_map_kf: Array, odometry: Edge | None = None) -> None:
        """Append a keyframe: with an edge from the last node of its trajectory, or as the start of another one.

        A part of the graph that is not connected to another keeps the pose of its first node.

        Raises:
            ValueError: the edge does not lead to the new node, or its other end has an odometry successor already.
            Dpm2Error: the pose or the edge is invalid; nothing was appended.
        """
        node = len(self)
        _check_valid("node", node, T_map_kf)
        if odometry is None:
            self._trajectories.begin()
        else:
            _check_valid("edge to node", node, odometry.T_from_to, odometry.covariance)
            if odometry.to_node != node:
                raise ValueError(f"the edge leads to node {odometry.to_node}, not to {node}")
            self._trajectories.extend(odometry.from_node)
        self._poses.append(T_map_kf)
        self._steps.append(odometry)

    def add_loop(self, loop: Edge) -> None:
        """Connect two keyframes that saw the same place.

        The first loop between two parts of the graph moves the younger part rigidly to its pose: from any other start
        an optimization would reject the loop as wrong.

        Raises:
            Dpm2Error: the loop is invalid; nothing was added.
        """
        _check_valid("loop to node", loop.to_node, loop.T_from_to, loop.covariance)
        a, b = self.part(loop.from_node), self.part(loop.to_node)
        if a != b:
            T_to = self._poses[loop.from_node] @ loop.T_from_to  # pose of that node by the loop
            T = T_to @ se3.inverse(self._poses[loop.to_node])
            self._move_part(max(a, b), T if b > a else se3.inverse(T))
            self._trajectories.loops_changed()
        self._loops.append(loop)

    def add_fix(self, node: int, fix: Fix) -> bool:
        """Add a satellite position at a node; returns whether there are enough new ones to optimize."""
        self._fixes.add(node, fix, self._trajectories.of[node])
        if self._fixes.georeference is None:
            self._fixes.locate(self.poses, self.placed)
            return self._fixes.georeference is not None
        min_count, divisor = _FIXES_DUE
        return self._fixes.due >= max(min_count, len(self._fixes) // divisor)

    def set_georeference(self, georeference: Georeference) -> None:
        """Set the pose of a loaded map on Earth."""
        self._fixes.georeference = georeference
        self._calibrate_fixes()
        self._fixes.loaded()
        chosen, first = self._chosen_fixes(), len(self._loops)
        if chosen:
            data = self._graph_data()
            errors = loop_errors(data.poses, data.ends[first:], data.T_from_to[first:])
            kept = mahalanobis(errors, data.covariances[first:]) <= self._settings.loop_sigmas**2
            self._fixes.solved(chosen, data.poses[-1], kept)

    def place(self, node: int, T_map_kf: Array) -> None:
        """Set the pose (4, 4) of a node, as the start of the next optimization."""
        _check_valid("node", node, T_map_kf)
        self._poses[node] = T_map_kf

    def hold(self, node: int, T_map_kf: Array) -> None:
        """Set the pose (4, 4) of a node and keep it fixed."""
        self.place(node, T_map_kf)
        self._fixed_nodes.append(node)

    def part(self, node: int) -> int:
        """Number of a node's part of the graph: nodes of different parts have no constraints between them."""
        return self._trajectories.part(node, self._loops)

    @property
    def parts(self) -> NDArray[np.int32]:
        """(N,) the part of each node; that of the first is 0."""
        return self._trajectories.parts(self._loops)

    @property
    def placed(self) -> NDArray[np.bool_]:
        """(N,) whether each node is in the part of the first node. The poses of other nodes in its map, and on Earth,
        are unknown."""
        return self.parts == 0

    def optimize(self) -> None:
        """Move the poses to the optimum and check the loops, now or (`background`) in another process.

        Raises:
            Dpm2Error: the graph cannot be solved.
        """
        if self._background and len(self._loops) + len(self._fixes) >= SHORT:
            self.collect()
            if not self.busy:
                self._submit()
            return
        self._apply(robust.optimize(self._prepare_graph(), self._settings))
        self.problem = ""

    def collect(self, wait: bool = False) -> bool:
        """Apply the result of the other process, if there is one; call it with every keyframe.

        Nodes added meanwhile follow the earlier ones by their odometry. Loops added meanwhile are sent to the process.

        Args:
            wait: until all is solved, as at the end of a drive.

        Returns:
            Whether poses or results changed.
        """
        changed = False
        while self.busy:
            try:
                solution = self._worker.take(wait)
            except Dpm2Error as error:
                self.problem = str(error)
                self._failures += 1
                _log.warning("%s%s", error, ": started again" if self._failures < _MAX_ATTEMPTS else "")
                if self._failures < _MAX_ATTEMPTS:
                    self._submit()
                continue
            if solution is None:
                break
            if self._part_moved:
                self._submit()
                continue
            self._apply(solution)
            self.problem, self._failures, changed = "", 0, True
            if len(self._loops) > self._sent_loops or (wait and self.unsolved):
                self._submit()
        return changed

    def close(self) -> None:
        """End the other process, if there is one."""
        self._worker.close()

    def georeference_covariance(self) -> Array | None:
        """(6, 6) of xi in T_map_enu @ Exp(xi), about and along east, north, up; None if there are too few fixes."""
        if not self._chosen_fixes():
            return None
        data = self._graph_data()
        try:
            return robust.joint_covariance(data, self._kept_edges(), np.array([len(self)])) + self._fixes.uncertain
        except RuntimeError:  # gtsam's: the system is singular, as with one fix, which does not give the heading
            return None

    def relative_covariances(self, pairs: Sequence[tuple[int, int]]) -> Array:
        """(P, 6, 6) [rad, m] of xi in T_a_b @ Exp(xi) of each pair; small between neighbors anywhere in the map.

        The graph is factorized once for many pairs.

        Raises:
            ValueError: both nodes of a pair are the same.
        """
        if same := [a for a, b in pairs if a == b]:
            raise ValueError(f"covariance of node {same[0]} relative to itself")
        out, data, places = np.zeros((len(pairs), 6, 6)), self._graph_data(), self._trajectories.places()
        for first in range(0, len(pairs), _BATCH):
            batch = pairs[first : first + _BATCH]
            nodes = sorted({node for pair in batch for node in pair})
            joint = robust.joint_covariance(data, self._kept_edges(), places[nodes])
            for number, (a, b) in enumerate(batch, first):
                rows = [6 * nodes.index(node) + k for node in (a, b) for k in range(6)]
                J = np.hstack([-se3.adjoint(se3.inverse(self._poses[b]) @ self._poses[a]), np.eye(6)])
                out[number] = J @ joint[np.ix_(rows, rows)] @ J.T
        return out

    def write_g2o(self, path: Path) -> None:
        """Write all vertices, the odometry and the accepted loops in g2o's SE3:QUAT format at full precision.

        With fixes the local frame east, north, up is the last vertex.
        """
        data = self._graph_data()
        ids = np.append(self._trajectories.order(), np.arange(len(self), len(data)))
        write_g2o(path, G2o(data, ids, planar=False), self._kept_edges())

    def _kept_edges(self) -> NDArray[np.bool_]:
        """(E,) which loops, then which fixes, constrain the poses."""
        return np.array([*(loop.ok for loop in self._loops), *self._fixes.kept(self._chosen_fixes())], np.bool_)

    def _chosen_fixes(self) -> list[int]:
        """Indices of the fixes that are used."""
        return self._fixes.chosen(self.placed) if len(self._fixes) else []

    def _graph_data(self) -> GraphData:
        order, places, steps = self._trajectories.order(), self._trajectories.places(), self._steps
        ends = np.array([(loop.from_node, loop.to_node) for loop in self._loops], np.intp).reshape(-1, 2)
        data = GraphData(
            self.poses[order],
            np.array([step is not None for step in steps], np.bool_)[order],
            np.array([np.eye(4) if step is None else step.T_from_to for step in steps]).reshape(-1, 4, 4)[order],
            np.array([np.zeros((6, 6)) if step is None else step.covariance for step in steps]).reshape(-1, 6, 6)[
                order
            ],
            places[ends],
            np.array([loop.T_from_to for loop in self._loops]).reshape(-1, 4, 4),
            np.array([loop.covariance for loop in self._loops]).reshape(-1, 6, 6),
            places[self._fixed_nodes],
        )
        return self._fixes.joined(data, places, self._chosen_fixes())

    def _prepare_graph(self) -> GraphData:
        """The graph for the next optimization."""
        self._calibrate_fixes()
        self._fixes.locate(self.poses, self.placed)
        self._sent_loops, self._sent_fixes = len(self._loops), self._chosen_fixes()
        self._fixes.sent()
        return self._graph_data()

    def _calibrate_fixes(self) -> None:
        """Estimate the errors of the fixes, once the georeference is known."""
        if self.georeference is None or not len(self._fixes):
            return
        odometry = self.poses
        for node, step in enumerate(self._steps):
            if step is not None:
                odometry[node] = odometry[step.from_node] @ step.T_from_to
        self._fixes.calibrate(odometry, self.placed)

    def _move_part(self, part: int, T: Array) -> None:
        """Move a part: all its poses become T @ T_map_kf."""
        T = se3.orthonormalized(T)  # from poses of this graph: else rounding errors double with each part that is moved
        for node in np.flatnonzero(self.parts == part):
            self._poses[node] = T @ self._poses[node]
        self._part_moved = True

    def _submit(self) -> None:
        self._part_moved = False
        self._worker.submit(self._prepare_graph(), self._settings)

    def _apply(self, solution: Solution) -> None:
        loops, fixes = self._sent_loops, self._sent_fixes
        count = len(solution.poses) - bool(fixes)
        self._poses[:count] = list(solution.poses[self._trajectories.places(count)])
        if fixes:
            self._fixes.solved(fixes, solution.poses[-1], solution.kept[loops:])
        for node in range(count, len(self)):
            if (step := self._steps[node]) is not None:
                self._poses[node] = self._poses[step.from_node] @ step.T_from_to
        for number, loop in enumerate(self._loops[:loops]):
            checked = replace(loop.registration, ok=bool(solution.kept[number]), reason=solution.reason(number))
            self._loops[number] = replace(loop, registration=checked)
        self._trajectories.loops_changed()


def _check_valid(what: str, node: int, T: Array, covariance: Array | None = None) -> None:
    """Reject invalid values: one NaN would reach every pose in the next optimization."""
    if not se3.is_rigid(T):
        raise Dpm2Error(f"pose graph: {what} {node}: not a finite rigid transform")
    if covariance is not None and not se3.is_covariance(covariance):
        raise Dpm2Error(f"pose graph: {what} {node}: its covariance is not finite, symmetric and positive definite")
