# SPDX-License-Identifier: Apache-2.0
"""The pose graph of the running system: it grows by keyframes and loops, and no wrong loop bends it."""

from __future__ import annotations

import logging
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dpm2_core.errors import Dpm2Error
from dpm2_core.frame import Array
from dpm2_core.geometry import se3
from dpm2_core.slam.graph import robust
from dpm2_core.slam.graph.g2o import G2o, write_g2o
from dpm2_core.slam.graph.graph_data import GraphData
from dpm2_core.slam.graph.robust import RobustSettings, Solution
from dpm2_core.slam.graph.worker import GraphWorker

_log = logging.getLogger(__name__)
_SHORT = 50  # loops: fewer are solved in about 20 ms, sooner than they are sent anywhere
_ATTEMPTS = 2  # processes that may die over one graph


class PoseGraphSettings(RobustSettings):
    """Optimization of the keyframe poses."""

    background: bool = False
    """Optimize in another process while the drive goes on, for a live system; the result then depends on its timing."""


@dataclass(frozen=True)
class LoopCheck:
    """What the graph thinks of a loop; a later one may differ.

    Attributes:
        kept: False: the poses do without it. reason: in words, empty until it has been judged.
    """

    from_node: int
    to_node: int
    kept: bool
    reason: str


class PoseGraph:
    """Keyframe poses T_map_kf, odometry edges and loop edges; node n is the n-th one added.

    Attributes:
        problem: why the last optimization failed, in words; empty since one went well.
    """

    def __init__(self, settings: PoseGraphSettings) -> None:
        self._settings = settings
        self._poses: list[Array] = []
        self._before: list[int] = []  # by odometry; -1 where a trajectory begins
        self._trajectory: list[int] = []  # number of each node's
        self._ends: list[int] = []  # last node of each trajectory
        self._steps: list[Array] = []
        self._step_covariances: list[Array] = []
        self._loops: list[tuple[int, int, Array, Array]] = []
        self._loop_checks: list[LoopCheck] = []
        self._worker = GraphWorker()
        self._moved = False  # a part, since a graph was sent: its solution is of no use
        self._sent = 0  # loops in the graph that is being solved
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
    def edges(self) -> list[tuple[int, int, Array, Array]]:
        """Odometry edges, then the loops that are kept or not judged yet: from, to, T_from_to, covariance."""
        chain = [
            (before, node, self._steps[node], self._step_covariances[node])
            for node, before in enumerate(self._before)
            if before >= 0
        ]
        return chain + [loop for loop, info in zip(self._loops, self._loop_checks, strict=True) if info.kept]

    @property
    def loop_checks(self) -> list[LoopCheck]:
        """One for each loop, in the order in which they were added."""
        return list(self._loop_checks)

    @property
    def busy(self) -> bool:
        """Whether another process is optimizing."""
        return self._worker.busy

    def add_node(
        self, T_map_kf: Array, T_before_this: Array | None, covariance: Array | None, before: int | None = None
    ) -> None:
        """Append a keyframe: with an edge to the one before, or as the start of a trajectory of its own.

        A part of the graph that nothing ties to another keeps the pose of its first node.

        Args:
            before: the last node of its trajectory, where several grow at a time; None: the last node of all.

        Raises:
            ValueError: odometry goes on from there already.
            Dpm2Error: the pose or the edge is not sound; nothing was appended.
        """
        _check("node", len(self), T_map_kf)
        node = len(self)
        if T_before_this is None or covariance is None:
            before, T_before_this, covariance = -1, np.eye(4), np.zeros((6, 6))
            self._trajectory.append(len(self._ends))
            self._ends.append(node)
        else:
            _check("edge to node", node, T_before_this, covariance)
            before = node - 1 if before is None else before
            number = self._trajectory[before]
            if self._ends[number] != before:
                raise ValueError(f"node {before} is not the last of its trajectory")
            self._trajectory.append(number)
            self._ends[number] = node
        self._before.append(before)
        self._poses.append(T_map_kf)
        self._steps.append(T_before_this)
        self._step_covariances.append(covariance)

    def add_loop(self, from_node: int, to_node: int, T_from_to: Array, covariance: Array) -> None:
        """Tie two keyframes that saw the same place.

        Where it is the first between two parts of the graph, the younger one is moved there as it is: from any other
        start an optimization would take the loop for a wrong one.

        Raises:
            Dpm2Error: the loop is not sound; nothing was added.
        """
        _check("loop to node", to_node, T_from_to, covariance)
        parts = self._parts()
        a, b = parts[self._trajectory[from_node]], parts[self._trajectory[to_node]]
        if a != b:
            T_to = self._poses[from_node] @ T_from_to  # where the loop has that node
            T = T_to @ se3.inverse(self._poses[to_node])
            self._move(max(a, b), T if b > a else se3.inverse(T), parts)
        self._loops.append((from_node, to_node, T_from_to, covariance))
        self._loop_checks.append(LoopCheck(from_node, to_node, True, ""))

    def part(self, node: int) -> int:
        """Number of the part of the graph that a node is in: nodes of two parts have nothing to do with each other."""
        return self._parts()[self._trajectory[node]]

    def optimize(self) -> None:
        """Move the poses to the optimum and judge the loops: here and now, or (`background`) in another process.

        Raises:
            Dpm2Error: the graph cannot be solved.
        """
        if self._settings.background and len(self._loops) >= _SHORT:
            self.collect()
            if not self.busy:
                self._submit()
            return
        try:
            self._apply(robust.optimize(self._data(), self._settings), len(self._loops))
            self.problem = ""
        except (RuntimeError, np.linalg.LinAlgError) as error:  # gtsam's or numpy's: the system is singular
            raise Dpm2Error(f"pose graph: {' '.join(str(error).split())}") from None

    def collect(self, wait: bool = False) -> bool:
        """Take in what the other process found, if it has; call it with every keyframe.

        The nodes added meanwhile follow the ones before them by their odometry. Loops added meanwhile are sent off.

        Args:
            wait: until there is nothing more to wait for, as at the end of a drive.

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
                _log.warning("%s%s", error, ": started again" if self._failures < _ATTEMPTS else "")
                if self._failures < _ATTEMPTS:
                    self._submit()
                continue
            if solution is None:
                break
            if self._moved:
                self._submit()
                continue
            self._apply(solution, self._sent)
            self.problem, self._failures, changed = "", 0, True
            if len(self._loops) > self._sent:
                self._submit()
        return changed

    def close(self) -> None:
        """End the other process, if there is one."""
        self._worker.close()

    def covariance(self, node: int) -> Array:
        """(6, 6) [rotation rad, translation m] of xi in T_map_kf @ Exp(xi), relative to the node that is held fixed."""
        return self._joint([node])

    def relative_covariance(self, a: int, b: int) -> Array:
        """(6, 6) of xi in T_a_b @ Exp(xi) of two different nodes; small between neighbors, however far from the start.

        Raises:
            ValueError: it is one node.
        """
        if a == b:
            raise ValueError(f"covariance of node {a} relative to itself")
        joint = self._joint([a, b])
        J = np.hstack([-se3.adjoint(se3.inverse(self._poses[b]) @ self._poses[a]), np.eye(6)])
        return np.asarray(J @ joint @ J.T)

    def write_g2o(self, path: Path) -> None:
        """All vertices, the odometry and the loops that are kept, in g2o's SE3:QUAT format at full precision."""
        kept = np.array([info.kept for info in self._loop_checks], np.bool_)
        write_g2o(path, G2o(self._data(), self._order(), planar=False), kept)

    def _joint(self, nodes: list[int]) -> Array:
        kept, data = np.array([info.kept for info in self._loop_checks], np.bool_), self._data()
        return robust.joint_covariance(data, data.poses, kept, self._places()[nodes])

    def _order(self) -> NDArray[np.intp]:
        """(N,) nodes as the solver has them: one trajectory after the other, so that each is a chain."""
        return np.argsort(self._trajectory, kind="stable")

    def _places(self) -> NDArray[np.intp]:
        """(N,) place of each node in that order."""
        return np.argsort(self._order())

    def _data(self) -> GraphData:
        order = self._order()
        ends = np.array([loop[:2] for loop in self._loops], np.intp).reshape(-1, 2)
        return GraphData(
            self.poses[order],
            np.array(self._before, np.intp)[order] >= 0,
            np.array(self._steps).reshape(-1, 4, 4)[order],
            np.array(self._step_covariances).reshape(-1, 6, 6)[order],
            self._places()[ends],
            np.array([loop[2] for loop in self._loops]).reshape(-1, 4, 4),
            np.array([loop[3] for loop in self._loops]).reshape(-1, 6, 6),
        )

    def _parts(self) -> list[int]:
        """Of each trajectory, the oldest one that loops tie it to."""
        parts = list(range(len(self._ends)))
        for (a, b, *_), info in zip(self._loops, self._loop_checks, strict=True):
            one, other = sorted((parts[self._trajectory[a]], parts[self._trajectory[b]]))
            if info.kept and one != other:
                parts = [one if part == other else part for part in parts]
        return parts

    def _move(self, part: int, T: Array, parts: list[int]) -> None:
        """All of a part to T @ T_map_kf."""
        for node, number in enumerate(self._trajectory):
            if parts[number] == part:
                self._poses[node] = T @ self._poses[node]
        self._moved = True

    def _submit(self) -> None:
        self._moved = False
        self._sent = len(self._loops)
        self._worker.submit(self._data(), self._settings)

    def _apply(self, solution: Solution, loops: int) -> None:
        count = len(solution.poses)
        places = np.argsort(np.argsort(self._trajectory[:count], kind="stable"))
        old, self._poses[:count] = self._poses[:count], list(solution.poses[places])
        last = dict(zip(self._trajectory[:count], range(count), strict=True))  # solved for, of each trajectory
        for node in range(count, len(self)):
            at = last.get(self._trajectory[node])
            if at is not None:  # else another trajectory: nothing ties it to what moved
                self._poses[node] = self._poses[at] @ se3.inverse(old[at]) @ self._poses[node]
        for loop in range(loops):
            a, b = self._loops[loop][:2]
            self._loop_checks[loop] = LoopCheck(a, b, bool(solution.kept[loop]), solution.reason(loop))


def _check(what: str, node: int, T: Array, covariance: Array | None = None) -> None:
    """One NaN would reach every pose with the next optimization."""
    if not se3.is_rigid(T):
        raise Dpm2Error(f"pose graph: {what} {node}: not a finite rigid transform")
    if covariance is not None and not se3.is_covariance(covariance):
        raise Dpm2Error(f"pose graph: {what} {node}: its covariance is not finite, symmetric and positive definite")
