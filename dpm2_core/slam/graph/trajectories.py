# SPDX-License-Identifier: Apache-2.0
"""Which nodes of a pose graph follow each other by odometry, and which of these chains its loops tie together."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from dpm2_core.estimates import Edge


class Trajectories:
    """Chains of nodes; node n is the n-th one added.

    Attributes:
        of: number of each node's trajectory.
    """

    def __init__(self) -> None:
        self.of: list[int] = []
        self._ends: list[int] = []  # last node of each
        self._parts: list[int] | None = None  # until loops or trajectories change

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
        """The oldest trajectory that accepted loops tie a node's to: nodes of two parts have nothing in common."""
        return self._tied(loops)[self.of[node]]

    def parts(self, loops: Sequence[Edge]) -> NDArray[np.intp]:
        """(N,) the part of each node."""
        return np.array(self._tied(loops), np.intp)[self.of]

    def _tied(self, loops: Sequence[Edge]) -> list[int]:
        """The part of each trajectory."""
        if self._parts is None:
            parts = list(range(len(self._ends)))
            for loop in loops:
                one, other = sorted(parts[self.of[end]] for end in (loop.from_node, loop.to_node))
                if loop.ok and one != other:
                    parts = [one if part == other else part for part in parts]
            self._parts = parts
        return self._parts

    def order(self, count: int | None = None) -> NDArray[np.intp]:
        """(N,) the nodes, or the first so many, one trajectory after the other, so that each is a chain."""
        return np.argsort(self.of[:count], kind="stable")

    def places(self, count: int | None = None) -> NDArray[np.intp]:
        """(N,) place of each node in that order."""
        return np.argsort(self.order(count))
