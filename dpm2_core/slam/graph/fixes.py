# SPDX-License-Identifier: Apache-2.0
"""Satellite fixes in the pose graph: the local frame east, north, up is one more node, and a fix is a loop from it.

Such a loop constrains a position and no rotation. In all other respects it is like any loop: it has a robust kernel,
and is left out if the optimized poses are far from it. The node is added once the trajectory is long enough to
determine its heading.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from dpm2_core.frame import Array, Fix, Georeference
from dpm2_core.geometry import geodesy, se3
from dpm2_core.geometry.sampling import evenly
from dpm2_core.slam.graph.fix_errors import inflation
from dpm2_core.slam.graph.graph_data import GraphData, Index
from dpm2_core.slam.graph.lag import STRETCH, Stretch, lag_of, moved_by

_MIN_FIXES = 5
_MAX_HEADING_SIGMA = np.radians(2.0)  # standard deviation up to which the heading counts as known
_KERNEL = 3.0  # standard deviations beyond which a fix hardly counts for the start
_SLACK, _DRIFT = 0.05, 0.02  # m, and m per m from the middle: error of the odometry
_TRIALS = 100  # headings
_MAX_DISTANCE = 10_000.0  # m from the median of all: farther fixes are wrong, and none of them is the origin
_TILT_SIGMA = np.radians(5.0)  # standard deviation of the map's level: a drive may begin on a hill
_FREE_ROTATION, _FREE_POSITION = 1e2, 1e6  # rad and m, standard deviations of values that are not measured
_MAX_FIX_INTERVAL = 5.0  # s, maximum between two fixes that give a speed
_MAX_HEIGHT_SIGMA = 100.0  # m, standard deviation from which on a height counts as not measured


class Fixes:
    """The fixes of a graph.

    Attributes:
        georeference: of the map; None before it is known.
        uncertain: (6, 6) covariance of T_map_enu due to the unknown lag of the fixes.
    """

    def __init__(self) -> None:
        self._fixes: list[tuple[int, Fix]] = []
        self._rows: dict[int, list[int]] = {}  # indices of the fixes of each trajectory
        self._used: list[bool] = []
        self._solved = 0  # fixes at the last optimization
        self.georeference: Georeference | None = None
        self.uncertain = np.zeros((6, 6))
        self._lag = self._lag_of_georeference = 0.0  # s, lag of the stamps of the fixes, as far as it is known
        self._inflation = np.ones(1)  # of each fix; the last one also of later fixes

    def __len__(self) -> int:
        return len(self._fixes)

    def used(self, chosen: Sequence[int]) -> int:
        """Number of the chosen fixes that constrain the poses, by the last optimization."""
        return sum(self._used[k] for k in chosen)

    @property
    def due(self) -> int:
        """Number of fixes since the last optimization."""
        return len(self) - self._solved

    def add(self, node: int, fix: Fix, trajectory: int) -> None:
        """Add a fix that was measured near a node of that trajectory."""
        self._rows.setdefault(trajectory, []).append(len(self))
        self._fixes.append((node, fix))
        self._used.append(True)

    def chosen(self, placed: NDArray[np.bool_]) -> list[int]:
        """Indices of the fixes to use, none before the georeference is known; `placed`: (N,) allowed nodes."""
        return [] if self.georeference is None else [k for k, (node, _) in enumerate(self._fixes) if placed[node]]

    def kept(self, chosen: Sequence[int]) -> list[bool]:
        """For each edge that `joined` adds, whether it constrains the poses."""
        return [*(self._used[k] for k in chosen), True] if chosen else []

    def locate(self, poses: Array, placed: NDArray[np.bool_]) -> None:
        """Determine the georeference, unless it is known and most fixes agree with it.

        `poses`: (N, 4, 4). `placed`: as in `chosen`.
        """
        mask = np.array([placed[node] for node, _ in self._fixes], np.bool_)
        if mask.sum() < _MIN_FIXES:
            return
        in_map, velocities = self._antenna_states(poses)
        in_map = (in_map - self._lag * velocities)[mask]
        on_earth, sigmas = (part[mask] for part in self._measured_positions())
        from_middle = np.linalg.norm(in_map - np.median(in_map, axis=0), axis=1)
        sigmas = np.hypot(sigmas, _SLACK + _DRIFT * from_middle)
        near = np.linalg.norm(on_earth - np.median(on_earth, axis=0), axis=1) < _MAX_DISTANCE
        origin = self._fixes[np.flatnonzero(mask)[np.argmax(near)]][1].geodetic
        if self.georeference is not None:
            origin, T = self.georeference.origin, self.georeference.T_enu_map
            errors = np.linalg.norm((se3.transform(T, in_map) - _to_enu(origin, on_earth))[:, :2], axis=1)
            if np.median(errors / sigmas) < 2 * _KERNEL and self._lag == self._lag_of_georeference:
                return
        T_enu_map, self._lag_of_georeference = fitted(in_map, _to_enu(origin, on_earth), sigmas), self._lag
        if T_enu_map is None:  # most fixes contradict the old one, as those of another robot; no other fits
            self.georeference = None
        else:
            self.georeference, self._solved = Georeference(origin, T_enu_map), 0

    def calibrate(self, odometry: Array, placed: NDArray[np.bool_]) -> None:
        """Estimate the lag of the fixes, and how alike their errors are.

        `odometry`: (N, 4, 4), each trajectory as driven. `placed`: as in `chosen`.
        """
        assert self.georeference is not None
        T_enu_map, (here, velocities) = self.georeference.T_enu_map, self._antenna_states(odometry)
        here, moving = se3.transform(T_enu_map, here), velocities @ T_enu_map[:3, :3].T
        there, sigmas = self._measured_positions()
        there, stretches = _to_enu(self.georeference.origin, there), []
        for row in self._rows.values():
            timed = [k for k in row if velocities[k].any() and placed[self._fixes[k][0]]]
            for k in (timed[first : first + STRETCH] for first in range(0, len(timed), STRETCH)):
                stretches.append(Stretch(here[k], there[k], moving[k], sigmas[k]))
        lag = lag_of(stretches)
        seconds = lag.seconds if lag.known else 0.0
        if abs(seconds - self._lag) > lag.sigma:
            self._lag = seconds
        self._inflation = self._inflations(here - self._lag * moving, there, sigmas)
        moves = moved_by(stretches)
        excess = max(0.0, (lag.seconds - self._lag) ** 2 - lag.sigma**2)
        self.uncertain = excess * np.outer(moves, moves)

    def _inflations(self, here: Array, there: Array, sigmas: Array) -> Array:
        """(K,) of the fixes of each trajectory, which has a receiver of its own; see `fix_errors.inflation`."""
        stamps, out = self._stamps(), np.ones(len(self))
        for row in self._rows.values():
            out[row] = inflation(here[row], there[row], sigmas[row], stamps[row])
        return out

    def loaded(self) -> None:
        """The georeference is that of an optimized map with these fixes."""
        self._lag_of_georeference, self._solved = self._lag, len(self)

    def _antenna_states(self, poses: Array) -> tuple[Array, Array]:
        """(K, 3) m, antenna positions in the map at the stamps of the fixes, and (K, 3) m/s, their velocities since the
        previous fix, 0 if unknown; `poses`: (N, 4, 4)."""
        positions = np.array([poses[node] @ np.append(fix.antenna, 1) for node, fix in self._fixes])[:, :3]
        stamps, velocities = self._stamps(), np.zeros_like(positions)
        for row in self._rows.values():
            seconds = np.diff(stamps[row])[:, None] * 1e-9
            valid = (seconds > 0) & (seconds < _MAX_FIX_INTERVAL)
            velocities[row[1:]] = np.where(valid, np.diff(positions[row], axis=0) / np.where(valid, seconds, 1.0), 0.0)
        return positions, velocities

    def _stamps(self) -> Index:
        return np.array([fix.stamp for _, fix in self._fixes], np.int64)

    def _measured_positions(self) -> tuple[Array, Array]:
        """(K, 3) m, antenna positions on Earth by the fixes, and (K,) m, their horizontal standard deviations."""
        sigmas = np.array([np.sqrt(np.trace(fix.covariance[:2, :2]) / 2) for _, fix in self._fixes])
        return geodesy.ecef([fix.geodetic for _, fix in self._fixes]), sigmas

    def joined(self, data: GraphData, places: Index, chosen: Sequence[int]) -> GraphData:
        """The graph with the local frame as its last node, and an edge from it for each of the chosen fixes.

        One more edge, the last, constrains the map to be about level. `places`: (N,) of the nodes in `data`.
        """
        if not chosen:
            return data
        assert self.georeference is not None
        T_map_enu, last = se3.inverse(self.georeference.T_enu_map), len(data)
        at = places[[self._fixes[k][0] for k in chosen]]
        fixes = [self._fixes[k][1] for k in chosen]
        T = self.georeference.T_enu_map @ data.poses[at]  # with the current rotations: a fix measures none
        R = T[:, :3, :3]
        lever_arms = (R @ np.array([fix.antenna for fix in fixes])[..., None])[..., 0]
        if self._lag:
            lever_arms -= (
                self._lag * self._antenna_states(data.poses[places])[1][chosen] @ self.georeference.T_enu_map[:3, :3].T
            )
        local = _to_enu(self.georeference.origin, geodesy.ecef([fix.geodetic for fix in fixes]))
        measured = np.array([fix.covariance for fix in fixes])
        # A residual is the logarithm of a pose: unconstrained large height errors would affect east and north.
        no_height = measured[:, 2, 2] > _MAX_HEIGHT_SIGMA**2
        local[no_height, 2] = (T[:, :3, 3] + lever_arms)[no_height, 2]
        measured[no_height, 2], measured[no_height, :, 2], measured[no_height, 2, 2] = 0.0, 0.0, _MAX_HEIGHT_SIGMA**2
        T[:, :3, 3] = local - lever_arms
        covariances = np.tile(np.eye(6) * _FREE_ROTATION**2, (len(at) + 1, 1, 1))
        covariances[:-1, 3:, 3:] = np.swapaxes(R, 1, 2) @ measured @ R
        covariances[-1] = (
            np.diag([_TILT_SIGMA, _TILT_SIGMA, _FREE_ROTATION, _FREE_POSITION, _FREE_POSITION, _FREE_POSITION]) ** 2
        )
        factors = np.pad(self._inflation, (0, max(0, len(self) - len(self._inflation))), mode="edge")
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
            inflation=np.concatenate([np.ones(len(data.ends)), factors[chosen], [1.0]]),
        )

    def solved(self, chosen: Sequence[int], T_map_enu: Array, kept: NDArray[np.bool_]) -> None:
        """Apply the optimized local frame (4, 4) and the result for the edges that `joined` added."""
        assert self.georeference is not None
        self.georeference = replace(self.georeference, T_enu_map=se3.orthonormalized(se3.inverse(T_map_enu)))
        for k, used in zip(chosen, kept[:-1].tolist(), strict=True):
            self._used[k] = used

    def sent(self) -> None:
        """An optimization with all current fixes begins."""
        self._solved = len(self)


def fitted(here: Array, there: Array, sigmas: Array) -> Array | None:
    """T_enu_map (4, 4) of a level map by heading and translation; None if they are not determined.

    Args:
        here, there: (K, 3) the same positions in the map and in the local frame, m; up to half may be wrong.
        sigmas: (K,) horizontal standard deviations, m.
    """
    a, b = here[:, :2] @ [1, 1j], there[:, :2] @ [1, 1j]  # as complex numbers a rotation is a factor
    half = len(a) // 2
    first = evenly(half, _TRIALS)
    rotations = np.exp(1j * np.angle((b[first + half] - b[first]) * np.conj(a[first + half] - a[first])))
    moved = rotations[:, None] * a
    offsets = np.median((b - moved).real, axis=1) + 1j * np.median((b - moved).imag, axis=1)
    errors = np.abs(b - moved - offsets[:, None]) / (_KERNEL * sigmas)
    best = int(np.argmin(np.log1p(errors**2).sum(1)))
    rotation, offset = rotations[best], offsets[best]
    for _ in range(10):
        weights = 1 / sigmas**2 / (1 + (np.abs(b - rotation * a - offset) / (_KERNEL * sigmas)) ** 2)
        middle_a, middle_b = np.average(a, weights=weights), np.average(b, weights=weights)
        rotation = np.exp(1j * np.angle(np.sum(weights * (b - middle_b) * np.conj(a - middle_a))))
        offset = middle_b - rotation * middle_a
    spread = np.sum(weights * np.abs(a - middle_a) ** 2)
    agree = np.mean(np.abs(b - rotation * a - offset) < _KERNEL * sigmas)
    if spread * _MAX_HEADING_SIGMA**2 < 1 or agree <= 0.5:
        return None
    up = np.median(there[:, 2] - here[:, 2])
    return se3.make(se3.rotation(np.array([0.0, 0.0, np.angle(rotation)])), [offset.real, offset.imag, up])


def _to_enu(origin: Array, ecef: Array) -> Array:
    """(K, 3) from the Earth's frame to east, north, up about a geodetic origin (3,)."""
    return np.asarray(se3.transform(se3.inverse(geodesy.enu_frame(origin)), ecef))
