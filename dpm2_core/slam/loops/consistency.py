# SPDX-License-Identifier: Apache-2.0
"""Consistency of a loop with the odometry between its ends, or with another loop nearby.

Two loops and the paths between their ends, by odometry or through the map, form a circle, which must close:
J. Mangelson et al., "Pairwise Consistent Measurement Set Maximization for Robust Multi-robot Map Merging",
ICRA 2018.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from dpm2_core.config import Settings
from dpm2_core.estimates import Edge, Keyframe, Registration
from dpm2_core.frame import Array
from dpm2_core.geometry import se3

UNCERTAIN = 0.5  # m, sigma of an odometry edge beyond drift: a direction was unconstrained, or nothing fitted
_STOREY_CORRECTION = 2.0
"""A loop that corrects the odometry by more than this, m, may lead to another storey that looks alike..."""
_MAX_SIGMAS = 3.0
"""...unless the correction is at most this many standard deviations of the odometry. Loops to the next storey of a car
park have 3.7 to 5.1. The odometry's covariance is cautious: correct loops of drives have 0.2, real ones perhaps 1."""
_SLACK, _DRIFT = 1.0, 0.02  # m, and per meter of path: error of the odometry without such an edge
_MAX_ROTATION = 3.0, 0.02  # degrees, and per meter of path: allowed correction of the odometry by a loop
_CIRCLE_DRIFT = 0.01  # m, per meter of path: added to the allowed error of the circle of two loops
_MAX_COMPARED = 200  # loops, the newest: one that is farther along the path than `reach` agrees with none; 5 ms


class ConsistencySettings(Settings):
    """Allowed differences of loops from the odometry and from each other."""

    drift: float = Field(_DRIFT, gt=0)
    """Expected odometry drift per meter. A loop is rejected if it corrects more than this times the path, plus 1 m, or
    more than 0.02 degrees per meter, plus 3."""
    certain: float = Field(2.0, ge=0)
    """A loop that corrects the odometry by no more than this, m (and degrees), needs no other loop to confirm it."""
    reach: float = Field(100.0, gt=0)
    """Another loop can confirm it if both its ends are nearer than this along the path, m..."""
    circle: float = Field(0.4, ge=0)
    """...and the circle of the two ends within this distance of its start, m, plus 0.01 m per meter of its path (three
    times that in degrees)."""


class OdometryChain:
    """The odometry of all keyframes, in segments: one robot, one session.

    Within a segment the odometry between two nodes is known if its uncertain edges, with three standard deviations
    each, add no more than the usual drift over the path. So 1 m of unconstrained motion does not separate the two ends
    of a drive of 1 km, but it separates the nodes directly before and after it.
    """

    def __init__(self) -> None:
        self._segment = np.zeros(256, np.int64)
        self._meters = np.zeros(256)  # path since the start of the segment
        self._uncertainty = np.zeros(256)  # since then: three sigmas of all uncertain edges, m or degrees, the larger
        self._covariances: list[Array] = []  # (6, 6) of the motion since then, in the odometry frame
        self._T_odom_kf: list[Array] = []
        self._last: dict[str, int] = {}  # by robot

    def __len__(self) -> int:
        return len(self._T_odom_kf)

    def append(self, keyframe: Keyframe) -> None:
        """Add the next node."""
        node, previous = len(self), self._last.get(keyframe.robot)
        if node == len(self._segment):
            arrays = self._segment, self._meters, self._uncertainty
            self._segment, self._meters, self._uncertainty = (np.concatenate([a, np.zeros_like(a)]) for a in arrays)
        self._last[keyframe.robot] = node
        self._T_odom_kf.append(keyframe.T_odom_kf)
        if previous is None or keyframe.edge is None:
            self._segment[node] = node
            self._covariances.append(np.zeros((6, 6)))
            return
        step = np.linalg.norm(keyframe.T_odom_kf[:3, 3] - self._T_odom_kf[previous][:3, 3])
        self._segment[node], self._meters[node] = self._segment[previous], self._meters[previous] + step
        self._uncertainty[node] = self._uncertainty[previous] + _uncertainty(keyframe.edge)
        A = se3.adjoint(keyframe.T_odom_kf)
        self._covariances.append(self._covariances[previous] + A @ keyframe.edge.covariance @ A.T)

    def since(self, node: int) -> Array:
        """(N,) meters of path between each node and this one; inf if the odometry between them is unknown."""
        return self._known_meters(slice(len(self)), node)

    def between(self, a: int, b: int) -> float:
        """Meters of path between two nodes; inf if the odometry between them is unknown."""
        return float(self._known_meters(a, b))

    def _known_meters(self, nodes: int | slice, node: int) -> Array:
        meters, uncertainty = (np.abs(sums[nodes] - sums[node]) for sums in (self._meters, self._uncertainty))
        known = (self._segment[nodes] == self._segment[node]) & (uncertainty <= _SLACK + _DRIFT * meters)
        return np.where(known, meters, np.inf)

    def in_same_segment(self, a: int, b: int) -> bool:
        """Whether two nodes are in one segment, though the odometry between them may be unknown."""
        return bool(self._segment[a] == self._segment[b])

    def T(self, a: int, b: int) -> Array:
        """T_a_b (4, 4) by odometry, of two nodes of one segment."""
        return se3.inverse(self._T_odom_kf[a]) @ self._T_odom_kf[b]

    def sigmas(self, loop: Edge) -> float:
        """Distance of a loop within a segment from the odometry, in standard deviations of both together."""
        a, b = sorted((loop.from_node, loop.to_node))
        A = se3.adjoint(se3.inverse(self._T_odom_kf[loop.to_node]))
        covariance = A @ (self._covariances[b] - self._covariances[a]) @ A.T + loop.covariance
        T_odometry = self.T(loop.from_node, loop.to_node)
        return float(np.sqrt(se3.squared_sigmas(loop.T_from_to, T_odometry, covariance)))


def margin(since: Array | float, settings: ConsistencySettings) -> Array | float:
    """Allowed distance of a loop from the odometry, m, after `since` meters of path; inf if that is unknown."""
    return _SLACK + settings.drift * since


def _uncertainty(edge: Registration) -> float:
    """Three standard deviations, m or degrees, the larger, of an edge if it is uncertain; else 0."""
    if edge.worst_sigma <= UNCERTAIN:
        return 0.0
    degrees = np.degrees(np.sqrt(np.linalg.eigvalsh(edge.covariance[:3, :3])[-1]))
    return 3 * max(edge.worst_sigma, float(degrees))


class Consistency:
    """Accepts a verified loop when the odometry or another loop agrees; until then the loop waits."""

    def __init__(self, path: OdometryChain) -> None:
        self._path = path
        self._accepted: list[Edge] = []
        self._waiting: list[Edge] = []
        self._poses: Array = np.zeros((0, 4, 4))
        self._parts: NDArray[np.integer] = np.zeros(0, np.intp)

    def update(self, poses: Array, parts: NDArray[np.integer]) -> None:
        """Set the current map: (N, 4, 4) T_map_kf, and the part (N,) of each keyframe."""
        self._poses, self._parts = poses, parts

    def is_first(self, loop: Edge, settings: ConsistencySettings) -> bool:
        """Whether nothing else gives the relative pose of its ends: no known odometry, and no accepted loop."""
        known = np.isfinite(self._path.between(loop.from_node, loop.to_node))
        return not known and not self._agrees_with_accepted(loop, settings)

    def check(self, loop: Edge, settings: ConsistencySettings) -> list[Edge]:
        """Check a loop that the points have verified.

        Args:
            settings: for the type of scene at the loop's new end.

        Returns:
            The loop, accepted or rejected with the reason; if accepted, with the waiting loops that it confirms.
        """
        s = settings
        since = self._path.between(loop.from_node, loop.to_node)
        T_expected = self._T_in_map(loop.from_node, loop.to_node)
        meters, degrees = se3.apart(T_expected, loop.T_from_to)
        confirmed = [w for w in self._waiting if self._agree(loop, w, s)]
        if np.isfinite(since):
            if meters > margin(since, s) or degrees > _MAX_ROTATION[0] + _MAX_ROTATION[1] * since:
                return [loop.rejected(f"{meters:.1f} m, {degrees:.1f} deg from the odometry")]
            if meters <= s.certain and degrees <= s.certain:
                return self._accept([loop, *confirmed])
            if meters > _STOREY_CORRECTION and (sigmas := self._path.sigmas(loop)) > _MAX_SIGMAS:
                return [loop.rejected(f"{meters:.1f} m, {sigmas:.0f} standard deviations from the odometry")]
        if confirmed or self._agrees_with_accepted(loop, s):
            return self._accept([loop, *confirmed])
        self._waiting = [*self._waiting, loop][-_MAX_COMPARED:]
        return [loop.rejected(f"{meters:.1f} m from the odometry: waits for a second loop that agrees")]

    def _agrees_with_accepted(self, loop: Edge, s: ConsistencySettings) -> bool:
        return any(self._agree(loop, accepted, s) for accepted in self._accepted[-_MAX_COMPARED:])

    def _accept(self, loops: Sequence[Edge]) -> list[Edge]:
        self._accepted += loops
        self._waiting = [w for w in self._waiting if all(w is not loop for loop in loops)]
        return list(loops)

    def _agree(self, one: Edge, other: Edge, s: ConsistencySettings) -> bool:
        """Whether the circle of both loops closes."""
        if one.to_node == other.to_node:
            return False
        path_from, T_from = self._motion_between(one.from_node, other.from_node)
        if path_from > s.reach:  # true for most pairs of a long drive
            return False
        path_to, T_to = self._motion_between(other.to_node, one.to_node)
        if path_to > s.reach:
            return False
        meters, degrees = se3.magnitude(se3.inverse(one.T_from_to) @ T_from @ other.T_from_to @ T_to)
        allowed = s.circle + _CIRCLE_DRIFT * (path_from + path_to)
        return meters <= allowed and degrees <= 3 * allowed

    def _motion_between(self, a: int, b: int) -> tuple[float, Array]:
        """Meters and T_a_b (4, 4) from one node to another: by odometry; for two drives through the map if both are in
        one part of it, else inf."""
        if self._path.in_same_segment(a, b):
            return self._path.between(a, b), self._path.T(a, b)
        T = self._T_in_map(a, b)
        return float(np.linalg.norm(T[:3, 3])) if self._parts[a] == self._parts[b] else np.inf, T

    def _T_in_map(self, a: int, b: int) -> Array:
        return se3.inverse(self._poses[a]) @ self._poses[b]
