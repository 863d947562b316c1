# SPDX-License-Identifier: Apache-2.0
"""A pose graph as arrays, and its odometry chain in closed form: motion and covariance between two nodes."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from dpm2_core.frame import Array
from dpm2_core.geometry import se3

Index = NDArray[np.intp]


@dataclass(frozen=True, eq=False)
class GraphData:
    """Nodes are 0..N-1; the odometry is a chain of edges n-1 -> n, which may be broken; all other edges are loops.

    Attributes:
        poses: (N, 4, 4) T_map_node, the start of an optimization.
        chained: (N,) whether odometry connects node n with n-1. If not, a trajectory begins.
        steps: (N, 4, 4) T_before_this of the odometry; identity if there is none.
        step_covariances: (N, 6, 6) [rotation rad, translation m] of `steps`; zero if there is none.
        ends: (E, 2) from and to of each loop.
        T_from_to: (E, 4, 4) of each loop.
        covariances: (E, 6, 6) of each loop.
        fixed: nodes that keep their pose; the first node of each unconnected trajectory does so anyway.
        enu: the node, if any, of the local frame of fixes, which is no keyframe; its start is good.
        inflation: (E,) factors by which the covariances of loops are larger as constraints than for the check whether
            they can be right: errors of fixes that are alike do not average out. None: all are 1.
    """

    poses: Array
    chained: NDArray[np.bool_]
    steps: Array
    step_covariances: Array
    ends: Index = field(default_factory=lambda: np.zeros((0, 2), np.intp))
    T_from_to: Array = field(default_factory=lambda: np.zeros((0, 4, 4)))
    covariances: Array = field(default_factory=lambda: np.zeros((0, 6, 6)))
    fixed: Index = field(default_factory=lambda: np.zeros(0, np.intp))
    enu: Index = field(default_factory=lambda: np.zeros(0, np.intp))
    inflation: Array | None = None

    def __len__(self) -> int:
        return len(self.poses)

    @property
    def constraint_covariances(self) -> Array:
        """(E, 6, 6) of each loop as a constraint: see `inflation`."""
        return self.covariances if self.inflation is None else self.covariances * self.inflation[:, None, None]

    @property
    def odometry_ends(self) -> Index:
        """(S, 2) from and to of each step of the odometry, in order."""
        nodes = np.flatnonzero(self.chained)
        return np.stack([nodes - 1, nodes], -1)


def components(count: int, ends: Index) -> NDArray[np.int32]:
    """(N,) number of each node's part of the graph, for `count` nodes with edges (E, 2): from 0, that of node 0, in the
    order of their first nodes."""
    graph = coo_array((np.ones(len(ends)), (ends[:, 0], ends[:, 1])), (count, count))
    return np.asarray(connected_components(graph, directed=False)[1], np.int32)


def loop_errors(poses: Array, ends: Index, T_from_to: Array) -> Array:
    """(E, 6) tangent from the measured pose of each edge to that of the poses."""
    return se3.log(se3.inverse(T_from_to) @ se3.inverse(poses[ends[:, 0]]) @ poses[ends[:, 1]])


def mahalanobis(errors: Array, covariances: Array) -> Array:
    """(E,) squared lengths of (E, 6) errors, in standard deviations."""
    return np.einsum("ni,ni->n", errors, np.linalg.solve(covariances, errors[..., None])[..., 0])


def total_chi2(graph: GraphData, poses: Array, loops: NDArray[np.bool_] | slice = slice(None)) -> float:
    """Sum of chi2 over the odometry and the chosen loops."""
    steps = graph.odometry_ends
    nodes = steps[:, 1]
    odometry = mahalanobis(loop_errors(poses, steps, graph.steps[nodes]), graph.step_covariances[nodes])
    errors = loop_errors(poses, graph.ends[loops], graph.T_from_to[loops])
    return float(odometry.sum() + mahalanobis(errors, graph.covariances[loops]).sum())


def trajectories(graph: GraphData) -> Index:
    """(N,) number of each node's trajectory, from 0."""
    return np.cumsum(~graph.chained) - 1


def integrate(graph: GraphData) -> Array:
    """(N, 4, 4) poses of each trajectory by its odometry from the pose of its first node."""
    out = graph.poses.copy()
    for node in np.flatnonzero(graph.chained):  # each needs the one before: a recursion, 3 us per node
        out[node] = out[node - 1] @ graph.steps[node]
    return out


class CondensedOdometry:
    """The odometry between chosen nodes, compounded: a graph that is small if loops are few, with the same optimum.

    Attributes:
        nodes: (K,) chosen nodes, ascending, with the first and the last of each trajectory.
        T: (K, 4, 4) T_before_this between each and the previous chosen one; identity where `chained` is False.
        covariances: (K, 6, 6) of `T`; identity where `chained` is False.
        chained: (K,) whether odometry connects it with the previous chosen one.
    """

    def __init__(self, graph: GraphData, odometry: Array, chosen: Index) -> None:
        """`odometry`: (N, 4, 4) of `integrate`; `chosen`: any nodes, in any order."""
        starts = np.flatnonzero(~graph.chained)
        lasts = np.append(starts[1:], len(graph)) - 1
        self.nodes: Index = np.unique(np.concatenate([chosen, starts, lasts]))
        self.chained = graph.chained[self.nodes]
        before = np.where(self.chained, np.arange(len(self.nodes)) - 1, np.arange(len(self.nodes)))
        ends = odometry[self.nodes]
        self.T = se3.inverse(ends[before]) @ ends
        self._owner = np.searchsorted(self.nodes, np.arange(len(graph)))  # the chosen node at or after each node
        self._T_owner_node = se3.inverse(ends[self._owner]) @ odometry
        A = se3.adjoint(self._T_owner_node)
        # Covariance of each step, at the end of its stretch.
        self._step_parts = A @ graph.step_covariances @ np.swapaxes(A, -1, -2)
        first = np.concatenate([[0], self.nodes[:-1] + 1])
        self.covariances = np.add.reduceat(self._step_parts, first, axis=0)
        self.covariances[~self.chained] = np.eye(6)
        self._first = first

    def spread(self, poses: Array) -> Array:
        """(N, 4, 4) poses of all nodes from those of the chosen ones, (K, 4, 4).

        The error of the odometry between two chosen nodes is distributed to its steps by their covariances, as least
        squares does, to first order.
        """
        k = np.flatnonzero(self.chained)
        errors = np.zeros((len(self.nodes), 6))
        errors[k] = se3.log(se3.inverse(self.T[k]) @ se3.inverse(poses[k - 1]) @ poses[k])
        weighted_errors = np.linalg.solve(self.covariances, errors[..., None])
        corrections = (self._step_parts @ weighted_errors[self._owner])[..., 0]
        accumulated = np.cumsum(corrections, axis=0)
        accumulated -= (accumulated - corrections)[self._first][self._owner]
        ends = poses.copy()
        ends[k] = poses[k - 1] @ self.T[k]  # by the odometry alone
        out = ends[self._owner] @ se3.exp(accumulated) @ self._T_owner_node
        out[self.nodes] = poses
        return out


def chain_chi2(graph: GraphData, odometry: Array) -> Array:
    """(E,) squared distance of each loop from the odometry between its ends, in standard deviations of both together.

    nan if the ends are in two trajectories. `odometry`: (N, 4, 4) of `integrate`.
    """
    trajectory = trajectories(graph)[graph.ends]
    out = np.full(len(graph.ends), np.nan)
    same = np.flatnonzero(trajectory[:, 0] == trajectory[:, 1])
    A = se3.adjoint(odometry)
    summed = np.cumsum(A @ graph.step_covariances @ np.swapaxes(A, -1, -2), axis=0)  # in the map frame: steps add up
    ends = graph.ends[same]
    A_end = se3.adjoint(se3.inverse(odometry[ends[:, 1]]))
    odometry_covariances = A_end @ (summed[ends.max(1)] - summed[ends.min(1)]) @ np.swapaxes(A_end, -1, -2)
    errors = loop_errors(odometry, ends, graph.T_from_to[same])
    out[same] = mahalanobis(errors, odometry_covariances + graph.covariances[same])
    return out
