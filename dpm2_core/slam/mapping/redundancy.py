# SPDX-License-Identifier: Apache-2.0
"""Driving a block ten times does not make ten maps: a keyframe that came back to an old one uses its payload.

Its own cloud tells how the place looks now, for the grid that robots plan in, and stays until the next one comes.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

from pydantic import Field

from dpm2_core.config import Settings
from dpm2_core.estimates import Edge
from dpm2_core.geometry import se3
from dpm2_core.slam.store.cloud_store import Loan

LAP = 10
"""Keyframes: those nearer along the drive are its neighbors, and no revisit."""


class RedundancySettings(Settings):
    """Which keyframes of a revisit are given up: their pose stays in the graph, cloud and descriptors go."""

    distance: float = Field(3.0, ge=0)
    """Of a keyframe to the one that an accepted loop ties it to, m; 0 keeps all."""
    angle: float = Field(30.0, ge=0, le=180)
    """Turn between them, degrees: from another direction a place may look different."""


def lender(
    node: int, loops: Sequence[Edge], loan_of: Callable[[int], Loan | None], settings: RedundancySettings
) -> Loan | None:
    """The node whose payload a new node can share; None: it keeps its own.

    Args:
        node: with `loops` those that were tried for it, to it.
        loan_of: of older nodes: one that borrows itself hands on.
    """
    for edge in loops:
        if not edge.ok or edge.to_node != node:
            continue
        T_kf_lender, other = se3.inverse(edge.T_from_to), edge.from_node
        if (loan := loan_of(other)) is not None:
            T_kf_lender, other = T_kf_lender @ loan.T_kf_lender, loan.lender
        meters, degrees = se3.magnitude(T_kf_lender)
        if meters <= settings.distance and degrees <= settings.angle:
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
