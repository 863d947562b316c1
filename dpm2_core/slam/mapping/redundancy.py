# SPDX-License-Identifier: Apache-2.0
"""A keyframe that revisits an older one uses the older one's payload, so that repeated drives do not enlarge the map.

Its own cloud shows how the place looks now, for the navigation grid, and is kept until the next revisit.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

from dpm2_core.estimates import Edge
from dpm2_core.geometry import se3
from dpm2_core.slam.store.cloud_store import Loan

LAP = 10
"""Keyframes that are closer along the drive are neighbors, and no revisit."""
SAME = 3.0
"""Maximum distance, m, of a keyframe from the older one that it repeats."""
TURNED = 30.0
"""Maximum rotation between them, degrees: from another direction a place may look different."""


def lender(node: int, loops: Sequence[Edge], loan_of: Callable[[int], Loan | None], distance: float) -> Loan | None:
    """The node whose payload a node can share; None: it keeps its own.

    Args:
        node: the node; loops: the loops that were tried for it, to it.
        loan_of: loan of an older node: one that borrows itself passes on its lender.
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
    """A loop from a keyframe that borrows its cloud, moved to the lender, whose cloud was registered.

    So each lap is connected to keyframes with clouds, and the time to optimize the graph increases linearly with the
    number of laps. With loops between any two laps it is four to eight times as long with each doubling.
    """
    if (loan := loan_of(loop.from_node)) is None:
        return loop
    T_lender_to = se3.orthonormalized(se3.inverse(loan.T_kf_lender) @ loop.T_from_to)
    return replace(loop, from_node=loan.lender, registration=replace(loop.registration, T_target_source=T_lender_to))
