# SPDX-License-Identifier: Apache-2.0
"""Fixes of satellites in the pose graph: the local frame east, north, up is one more node, a fix is a loop from it.

Such a loop states a position and no rotation. All else is as with every loop: a robust kernel weighs it, and one that
the optimized poses are far from is left out. The node enters once the way is long enough to tell its heading.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from dpm2_core.frame import Array, Fix, Georeference
from dpm2_core.geometry import geodesy, se3
from dpm2_core.geometry.sampling import evenly
from dpm2_core.slam.graph.graph_data import GraphData, Index
from dpm2_core.slam.graph.lag import STRETCH, Stretch, lag_of, moved_by

_FEWEST = 5
_HEADING = np.radians(2.0)  # standard deviation from which on the heading counts as known
_KERNEL = 3.0  # standard deviations beyond which a fix hardly counts for the start
_SLACK, _DRIFT = 0.05, 0.02  # m, and m per m from the middle: the odometry errs, too
_TRIALS = 100  # headings
_NEAR = 10_000.0  # m from the median of all: farther fixes are wrong, and none of them is the origin
_TILT = np.radians(5.0)  # standard deviation of the map's level: a drive may begin on a hill
_ANY_TURN, _ANY_PLACE = 1e2, 1e6  # rad and m, standard deviations of what is not measured
_SLOWEST = 5.0  # s between two fixes that tell a speed
_FLAT = 100.0  # m, standard deviation of a height from which on it counts as not measured


class Fixes:
    """The fixes of a graph.

    Attributes:
        georeference: of the map; None before it is known.
        uncertain: (6, 6) covariance of T_map_enu by how late the fixes may be.
    """

    def __init__(self) -> None:
        self._fixes: list[tuple[int, Fix]] = []
        self._rows: dict[int, list[int]] = {}  # positions of the fixes of each trajectory
        self._used: list[bool] = []
        self._solved = 0  # fixes at the last optimization
        self.georeference: Georeference | None = None
        self.uncertain = np.zeros((6, 6))
        self._lag = self._located_with = 0.0  # s that the fixes are stamped too late, as far as that is known

    def __len__(self) -> int:
        return len(self._fixes)

    def used(self, chosen: Sequence[int]) -> int:
        """How many of those chosen constrain the poses, by the last optimization."""
        return sum(self._used[k] for k in chosen)

    @property
    def due(self) -> int:
        """How many have come since the last optimization."""
        return len(self) - self._solved

    def add(self, node: int, fix: Fix, trajectory: int) -> None:
        """One that was measured near a node, which is in that trajectory."""
        self._rows.setdefault(trajectory, []).append(len(self))
        self._fixes.append((node, fix))
        self._used.append(True)

    def chosen(self, placed: NDArray[np.bool_]) -> list[int]:
        """Positions of the fixes that enter, none before the georeference is known; `placed`: (N,) nodes that may."""
        return [] if self.georeference is None else [k for k, (node, _) in enumerate(self._fixes) if placed[node]]

    def kept(self, chosen: Sequence[int]) -> list[bool]:
        """Of the edges that `joined` adds, whether each constrains the poses."""
        return [*(self._used[k] for k in chosen), True] if chosen else []

    def locate(self, poses: Array, placed: NDArray[np.bool_]) -> None:
        """Find where the map is, unless that is known and most fixes agree.

        `poses`: (N, 4, 4). `placed`: as in `chosen`.
        """
        which = np.array([placed[node] for node, _ in self._fixes], np.bool_)
        if which.sum() < _FEWEST:
            return
        here, velocities = self._antennas(poses)
        here = (here - self._lag * velocities)[which]
        there, sigmas = (part[which] for part in self._measured())
        middle = np.linalg.norm(here - np.median(here, axis=0), axis=1)
        sigmas = np.hypot(sigmas, _SLACK + _DRIFT * middle)
        near = np.linalg.norm(there - np.median(there, axis=0), axis=1) < _NEAR
        origin = self._fixes[np.flatnonzero(which)[np.argmax(near)]][1].geodetic
        if self.georeference is not None:
            origin, T = self.georeference.origin, self.georeference.T_enu_map
            apart = np.linalg.norm((se3.transform(T, here) - _local(origin, there))[:, :2], axis=1)
            if np.median(apart / sigmas) < 2 * _KERNEL and self._lag == self._located_with:
                return
        T_enu_map, self._located_with = fitted(here, _local(origin, there), sigmas), self._lag
        if T_enu_map is None:  # if there was one most fixes deny it, as those of another robot, and no other is better
            self.georeference = None
        else:
            self.georeference, self._solved = Georeference(origin, T_enu_map), 0

    def find_lag(self, odometry: Array, placed: NDArray[np.bool_]) -> None:
        """Find how late the fixes are; `odometry`: (N, 4, 4), each trajectory as it was driven. `placed`: as in
        `chosen`."""
        assert self.georeference is not None
        T_enu_map, (here, velocities) = self.georeference.T_enu_map, self._antennas(odometry)
        here, moving = se3.transform(T_enu_map, here), velocities @ T_enu_map[:3, :3].T
        there, sigmas = self._measured()
        there, stretches = _local(self.georeference.origin, there), []
        for row in self._rows.values():
            timed = [k for k in row if velocities[k].any() and placed[self._fixes[k][0]]]
            for k in (timed[first : first + STRETCH] for first in range(0, len(timed), STRETCH)):
                stretches.append(Stretch(here[k], there[k], moving[k], sigmas[k]))
        lag = lag_of(stretches)
        late = lag.seconds if lag.known else 0.0
        if abs(late - self._lag) > lag.sigma:
            self._lag = late
        moves = moved_by(stretches)
        beyond_chance = max(0.0, (lag.seconds - self._lag) ** 2 - lag.sigma**2)
        self.uncertain = beyond_chance * np.outer(moves, moves)

    def loaded(self) -> None:
        """The georeference is that of a map with these fixes, which was optimized."""
        self._located_with, self._solved = self._lag, len(self)

    def _antennas(self, poses: Array) -> tuple[Array, Array]:
        """(K, 3) m where the map has the antenna at the stamp of each fix, and (K, 3) m/s how fast it was since the fix
        before, 0 where that is not known; `poses`: (N, 4, 4)."""
        here = np.array([poses[node] @ np.append(fix.antenna, 1) for node, fix in self._fixes])[:, :3]
        stamps, velocities = np.array([fix.stamp for _, fix in self._fixes], np.int64), np.zeros_like(here)
        for row in self._rows.values():
            seconds = np.diff(stamps[row])[:, None] * 1e-9
            tells = (seconds > 0) & (seconds < _SLOWEST)
            velocities[row[1:]] = np.where(tells, np.diff(here[row], axis=0) / np.where(tells, seconds, 1.0), 0.0)
        return here, velocities

    def _measured(self) -> tuple[Array, Array]:
        """(K, 3) m where the fixes have the antenna on Earth, and (K,) m, their horizontal standard deviations."""
        sigmas = np.array([np.sqrt(np.trace(fix.covariance[:2, :2]) / 2) for _, fix in self._fixes])
        return geodesy.ecef([fix.geodetic for _, fix in self._fixes]), sigmas

    def joined(self, data: GraphData, places: Index, chosen: Sequence[int]) -> GraphData:
        """The graph with the local frame as its last node, and an edge from there for each of the fixes chosen.

        One more edge, the last, says that the map is about level. `places`: (N,) of the nodes in `data`.
        """
        if not chosen:
            return data
        assert self.georeference is not None
        T_map_enu, last = se3.inverse(self.georeference.T_enu_map), len(data)
        at = places[[self._fixes[k][0] for k in chosen]]
        fixes = [self._fixes[k][1] for k in chosen]
        T = self.georeference.T_enu_map @ data.poses[at]  # with the rotations of now: theirs is not measured
        R = T[:, :3, :3]
        arms = (R @ np.array([fix.antenna for fix in fixes])[..., None])[..., 0]
        if self._lag:
            arms -= self._lag * self._antennas(data.poses[places])[1][chosen] @ self.georeference.T_enu_map[:3, :3].T
        local = _local(self.georeference.origin, geodesy.ecef([fix.geodetic for fix in fixes]))
        measured = np.array([fix.covariance for fix in fixes])
        # A residual is the logarithm of a pose: where heights are free to go far, they take up those of east and north.
        flat = measured[:, 2, 2] > _FLAT**2
        local[flat, 2] = (T[:, :3, 3] + arms)[flat, 2]
        measured[flat, 2], measured[flat, :, 2], measured[flat, 2, 2] = 0.0, 0.0, _FLAT**2
        T[:, :3, 3] = local - arms
        covariances = np.tile(np.eye(6) * _ANY_TURN**2, (len(at) + 1, 1, 1))
        covariances[:-1, 3:, 3:] = np.swapaxes(R, 1, 2) @ measured @ R
        covariances[-1] = np.diag([_TILT, _TILT, _ANY_TURN, _ANY_PLACE, _ANY_PLACE, _ANY_PLACE]) ** 2
        yaw = np.arctan2(T_map_enu[1, 0], T_map_enu[0, 0])
        level = se3.make(se3.rotation(np.array([0.0, 0.0, yaw])), T_map_enu[:3, 3])
        return replace(
            data,
            poses=np.concatenate([data.poses, T_map_enu[None]]),
            chained=np.append(data.chained, False),
            steps=np.concatenate([data.steps, np.eye(4)[None]]),
            step_covariances=np.concatenate([data.step_covariances, np.zeros((1, 6, 6))]),
            ends=np.concatenate([data.ends, [(last, place) for place in at], [(places[0], last)]]),
            T_from_to=np.concatenate([data.T_from_to, T, (se3.inverse(data.poses[places[0]]) @ level)[None]]),
            covariances=np.concatenate([data.covariances, covariances]),
            enu=np.array([last], np.intp),
        )

    def solved(self, chosen: Sequence[int], T_map_enu: Array, kept: NDArray[np.bool_]) -> None:
        """Take in what became of the local frame (4, 4) and of the edges that `joined` added."""
        assert self.georeference is not None
        self.georeference = replace(self.georeference, T_enu_map=se3.orthonormalized(se3.inverse(T_map_enu)))
        for k, used in zip(chosen, kept[:-1].tolist(), strict=True):
            self._used[k] = used

    def sent(self) -> None:
        """An optimization begins with all that there are."""
        self._solved = len(self)


def fitted(here: Array, there: Array, sigmas: Array) -> Array | None:
    """T_enu_map (4, 4) of a level map by heading and translation; None while they are not certain.

    Args:
        here, there: (K, 3) the same places in the map and in the local frame, m; up to half of them may be wrong.
        sigmas: (K,) horizontal standard deviations, m.
    """
    a, b = here[:, :2] @ [1, 1j], there[:, :2] @ [1, 1j]  # as complex numbers a rotation is a factor
    half = len(a) // 2
    first = evenly(half, _TRIALS)
    turns = np.exp(1j * np.angle((b[first + half] - b[first]) * np.conj(a[first + half] - a[first])))
    moved = turns[:, None] * a
    offsets = np.median((b - moved).real, axis=1) + 1j * np.median((b - moved).imag, axis=1)
    apart = np.abs(b - moved - offsets[:, None]) / (_KERNEL * sigmas)
    best = int(np.argmin(np.log1p(apart**2).sum(1)))
    turn, offset = turns[best], offsets[best]
    for _ in range(10):
        weights = 1 / sigmas**2 / (1 + (np.abs(b - turn * a - offset) / (_KERNEL * sigmas)) ** 2)
        middle_a, middle_b = np.average(a, weights=weights), np.average(b, weights=weights)
        turn = np.exp(1j * np.angle(np.sum(weights * (b - middle_b) * np.conj(a - middle_a))))
        offset = middle_b - turn * middle_a
    lever = np.sum(weights * np.abs(a - middle_a) ** 2)
    agree = np.mean(np.abs(b - turn * a - offset) < _KERNEL * sigmas)
    if lever * _HEADING**2 < 1 or agree <= 0.5:
        return None
    up = np.median(there[:, 2] - here[:, 2])
    return se3.make(se3.rotation(np.array([0.0, 0.0, np.angle(turn)])), [offset.real, offset.imag, up])


def _local(origin: Array, ecef: Array) -> Array:
    """(K, 3) in the Earth's frame to east, north, up about a geodetic origin (3,)."""
    return np.asarray(se3.transform(se3.inverse(geodesy.enu_frame(origin)), ecef))
