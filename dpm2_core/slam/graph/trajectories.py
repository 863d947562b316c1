# SPDX-License-Identifier: Apache-2.0
"""Odometry chains of nodes in a pose graph, and the parts of the graph that loops connect."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from dpm2_core.estimates import Edge
from dpm2_core.slam.graph.graph_data import components


class Trajectories:
    """Chains of nodes; node n is the n-th one added.

    Attributes:
        of: number of each node's trajectory.
    """

    def __init__(self) -> None:
        self.of: list[int] = []
        self._ends: list[int] = []  # last node of each
        self._parts: NDArray[np.int32] | None = None  # of each, until loops or trajectories change

    def begin(self) -> None:
        """The next node starts another trajectory."""
        self._ends.append(len(self.of))
        self.of.append(len(self._ends) - 1)
        self.loops_changed()

    def extend(self, node: int) -> None:
        """The next node follows this one.

        Raises:
            ValueError: the node is not the last of its trajectory.
        """
        number = self.of[node]
        if self._ends[number] != node:
            raise ValueError(f"node {node} is not the last of its trajectory")
        self._ends[number] = len(self.of)
        self.of.append(number)

    def loops_changed(self) -> None:
        """Loops were added or rejected: the connected parts must be computed again."""
        self._parts = None

    def part(self, node: int, loops: Sequence[Edge]) -> int:
        """A node's part of the graph by the accepted loops, numbered from 0 with the oldest: nodes of two parts have no
        constraints between them."""
        return int(self._trajectory_parts(loops)[self.of[node]])

    def parts(self, loops: Sequence[Edge]) -> NDArray[np.int32]:
        """(N,) the part of each node."""
        return self._trajectory_parts(loops)[self.of]

    def _trajectory_parts(self, loops: Sequence[Edge]) -> NDArray[np.int32]:
        """The part of each trajectory."""
        if self._parts is None:
            ends = [(self.of[loop.from_node], self.of[loop.to_node]) for loop in loops if loop.ok]
            self._parts = components(len(self._ends), np.array(ends, np.intp).reshape(-1, 2))
        return self._parts

    def order(self, count: int | None = None) -> NDArray[np.intp]:
        """(N,) the nodes, or the first `count`, one trajectory after the other, so that each is a chain."""
        return np.argsort(self.of[:count], kind="stable")

    def places(self, count: int | None = None) -> NDArray[np.intp]:
        """(N,) index of each node in that order."""
        return np.argsort(self.order(count))
