# SPDX-License-Identifier: Apache-2.0
"""Driving a block ten times does not make ten maps: a keyframe that came back to an old one uses its payload.

Its own cloud tells how the place looks now, for the grid that robots plan in, and stays until the next one comes.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

from dpm2_core.estimates import Edge
from dpm2_core.geometry import se3
from dpm2_core.slam.store.cloud_store import Loan

LAP = 10
"""Keyframes: those nearer along the drive are its neighbors, and no revisit."""
SAME = 3.0
"""m, at most, from a keyframe to the older one that it repeats."""
TURNED = 30.0
"""The same, degrees: from another direction a place may look different."""


def lender(node: int, loops: Sequence[Edge], loan_of: Callable[[int], Loan | None], distance: float) -> Loan | None:
    """The node whose payload a new node can share; None: it keeps its own.

    Args:
        node: with `loops` those that were tried for it, to it.
        loan_of: of older nodes: one that borrows itself hands on.
        distance: m, at most, to the lender.
    """
    for edge in loops:
        if not edge.ok or edge.to_node != node:
            continue
        T_kf_lender, other = se3.inverse(edge.T_from_to), edge.from_node
        if (loan := loan_of(other)) is not None:
            T_kf_lender, other = T_kf_lender @ loan.T_kf_lender, loan.lender
        meters, degrees = se3.magnitude(T_kf_lender)
        if meters <= distance and degrees <= TURNED:
            return Loan(other, T_kf_lender)
    return None


def to_lender(loop: Edge, loan_of: Callable[[int], Loan | None]) -> Edge:
    """A loop from a keyframe that borrows its cloud, from the lender, whose cloud it is that was seen.

    So each lap hangs on keyframes that have clouds, and the solution of the graph takes as much longer as there are
    more laps. With loops from any lap to any other one it takes four to eight times as long with each doubling.
    """
    if (loan := loan_of(loop.from_node)) is None:
        return loop
    T_lender_to = se3.orthonormalized(se3.inverse(loan.T_kf_lender) @ loop.T_from_to)
    return replace(loop, from_node=loan.lender, registration=replace(loop.registration, T_target_source=T_lender_to))
