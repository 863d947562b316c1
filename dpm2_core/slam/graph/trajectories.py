# SPDX-License-Identifier: Apache-2.0
"""Which nodes of a pose graph follow each other by odometry, and which of these chains its loops tie together."""

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
        """The next node is the start of another one."""
        self._ends.append(len(self.of))
        self.of.append(len(self._ends) - 1)
        self.loops_changed()

    def extend(self, node: int) -> None:
        """The next node follows this one.

        Raises:
            ValueError: another one does already.
        """
        number = self.of[node]
        if self._ends[number] != node:
            raise ValueError(f"node {node} is not the last of its trajectory")
        self._ends[number] = len(self.of)
        self.of.append(number)

    def loops_changed(self) -> None:
        """Loops came, or were rejected: what is tied together is asked for anew."""
        self._parts = None

    def part(self, node: int, loops: Sequence[Edge]) -> int:
        """The part of the graph, from 0 and the oldest first, that a node is in by the accepted loops: nodes of two
        parts have nothing in common."""
        return int(self._tied(loops)[self.of[node]])

    def parts(self, loops: Sequence[Edge]) -> NDArray[np.int32]:
        """(N,) the part of each node."""
        return self._tied(loops)[self.of]

    def _tied(self, loops: Sequence[Edge]) -> NDArray[np.int32]:
        """The part of each trajectory."""
        if self._parts is None:
            ends = [(self.of[loop.from_node], self.of[loop.to_node]) for loop in loops if loop.ok]
            self._parts = components(len(self._ends), np.array(ends, np.intp).reshape(-1, 2))
        return self._parts

    def order(self, count: int | None = None) -> NDArray[np.intp]:
        """(N,) the nodes, or the first so many, one trajectory after the other, so that each is a chain."""
        return np.argsort(self.of[:count], kind="stable")

    def places(self, count: int | None = None) -> NDArray[np.intp]:
        """(N,) place of each node in that order."""
        return np.argsort(self.order(count))
