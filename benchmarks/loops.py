# SPDX-License-Identifier: Apache-2.0
"""Loops compared with the ground truth: wrong loops, and revisits that were found."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from typing import Any

import numpy as np

from dpm2_core.data.trajectory import arc_lengths
from dpm2_core.estimates import Edge
from dpm2_core.frame import Array
from dpm2_core.geometry import se3

WRONG_M, WRONG_DEG = 5.0, 5.0
"""A loop with a larger error than either is wrong."""
NEAR, GAP = 10.0, 50.0
"""A revisit: a keyframe at most this far from an earlier one, m, with at least this length of path between them, m."""


def check_loops(loops: Sequence[Edge], truth: Array) -> dict[str, Any]:
    """Counts of loops and revisits.

    Args:
        loops: all candidates that were tried.
        truth: (N, 4, 4) true poses of the keyframes, in the order of the map.

    Returns:
        Accepted and wrong loops, and the median error of the right ones. For revisits in the same direction (within 45
        deg), in reverse (beyond 135 deg) and across: their number, and how many have an accepted right loop. A keyframe
        counts as a revisit in the same direction if any earlier one near it has that heading, and so on.
    """
    found: set[int] = set()
    errors, wrong, rejections = [], 0, Counter[str]()
    for loop in loops:
        meters, degrees = error_of(loop, truth)
        if not loop.ok:
            words = loop.registration.reason.split()
            rejections[" ".join(word for word in words if not any(c.isdigit() for c in word))] += 1
        elif meters > WRONG_M or degrees > WRONG_DEG:
            wrong += 1
        else:
            errors.append((meters, degrees))
            found.add(loop.to_node)
    result: dict[str, Any] = {
        "tried": len(loops),
        "accepted": len(errors) + wrong,
        "wrong": wrong,
        "error_m": _quantiles([e[0] for e in errors]),
        "error_deg": _quantiles([e[1] for e in errors]),
        "refusals": dict(rejections.most_common()),
    }
    for kind, nodes in revisits(truth).items():
        result[kind] = {"revisits": len(nodes), "found": len(nodes & found)}
    return result


def error_of(loop: Edge, truth: Array) -> tuple[float, float]:
    """Error of a loop, m and degrees, given (N, 4, 4) true poses of the keyframes."""
    T_from_to = se3.inverse(truth[loop.from_node]) @ truth[loop.to_node]
    return se3.apart(T_from_to, loop.T_from_to)


def revisits(truth: Array) -> dict[str, set[int]]:
    """The keyframes that return to an earlier position, by their heading there; (N, 4, 4) true poses."""
    positions = truth[:, :3, 3]
    path = arc_lengths(positions)
    heading = np.arctan2(truth[:, 1, 0], truth[:, 0, 0])
    kinds: dict[str, set[int]] = {"same": set(), "reverse": set(), "cross": set()}
    for node in range(len(truth)):
        near = np.linalg.norm(positions[:node] - positions[node], axis=1) < NEAR
        earlier = np.flatnonzero(near & (path[node] - path[:node] > GAP))
        turned = np.degrees(np.abs(np.angle(np.exp(1j * (heading[earlier] - heading[node])))))
        if (turned < 45).any():
            kinds["same"].add(node)
        elif (turned > 135).any():
            kinds["reverse"].add(node)
        elif len(earlier):
            kinds["cross"].add(node)
    return kinds


def _quantiles(values: Sequence[float]) -> dict[str, float] | None:
    if not values:
        return None
    return {"median": round(float(np.median(values)), 4), "max": round(float(np.max(values)), 4)}
