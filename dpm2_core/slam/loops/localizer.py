# SPDX-License-Identifier: Apache-2.0
"""Localization mode: keyframes are localized in a map that does not change; a kidnapped robot is relocalized."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dpm2_core.errors import Dpm2Error
from dpm2_core.estimates import Keyframe, Registration, State, isotropic
from dpm2_core.frame import Array
from dpm2_core.geometry import se3
from dpm2_core.slam.loops.consistency import UNCERTAIN
from dpm2_core.slam.loops.relocalization import PlaceFinder, nowhere
from dpm2_core.slam.loops.verification import looks_elsewhere

LOST = isotropic(1.0, 100.0)
"""Covariance of an uninformative prior."""
_MIN_INTERVAL = 1_000_000_000  # ns
_MAX_FAILURES = 3  # consecutive keyframes that do not fit the map at their predicted pose: then the state is lost
_MIN_MOTION = 1.0  # m: scans that are closer to each other show the same


@dataclass(frozen=True, eq=False)
class LocalizationResult:
    """The pose of a keyframe in the map.

    Attributes:
        T_map_kf: (4, 4); by the odometry unless `registration.ok`.
        covariance: (6, 6) of it, as in `Registration`; huge while lost.
        state: RELOCALISED: the pose is not the expected one, after the robot was lost or kidnapped.
        registration: how it was found, or why not.
        unreadable: the map could not be read there, `registration.reason` states why. Then it does not confirm the
            odometry, as if nothing fits.
    """

    T_map_kf: Array
    covariance: Array
    state: State
    registration: Registration
    unreadable: bool = False


class Localizer:
    """Takes the part of the mapper: keyframes in, `T_map_odom` out; but the map does not grow.

    Attributes:
        T_map_odom: (4, 4), the last verified one; undefined unless `state.located`.
        state: RELOCALISING before the first result, which makes it RELOCALISED; the next one TRACKING; DEGRADED if the
            map does not confirm the odometry, LOST if that lasts or the odometry is broken.
        found: id of the last keyframe that was localized in the map; None before the first.
    """

    def __init__(self, relocalizer: PlaceFinder) -> None:
        self._relocalizer = relocalizer
        self._hint: Array | None = None
        self.restart()

    @property
    def state(self) -> State:
        """State at the last keyframe, or LOST if the odometry was lost since: the robot may have been carried away."""
        return State.LOST if self._last_id < self._first_after_loss and self._state.located else self._state

    def odometry_lost(self, following: int) -> None:
        """The odometry was lost: the pose of keyframes from id `following` on is unknown. Ids give the order, not
        stamps, since a clock may be set back.

        May be called in another thread than the other methods: an earlier keyframe that still waits is localized as
        usual, and the state stays LOST.
        """
        self._first_after_loss = following

    def wants(self, stamp: int) -> bool:
        """Whether to request a keyframe now (ns): once per second, also at a halt, until another confirms the pose."""
        return self.state is not State.TRACKING and (self._stamp is None or abs(stamp - self._stamp) >= _MIN_INTERVAL)

    def restart(self) -> None:
        """The odometry has restarted: the pose is unknown."""
        self.T_map_odom: Array = np.eye(4)
        self._state = State.RELOCALIZING
        self._failures = 0
        self._path = 0.0  # m, path since the map last confirmed the odometry
        self._T_last: Array | None = None
        self._candidate: tuple[Array, Array] | None = None  # T_map_odom and T_odom_kf of a result to be found again
        self._ambiguous = False  # whether several places fitted equally since the last known pose
        self._stamp: int | None = None
        self._last_id = -1  # id of the last keyframe
        self.found: int | None = None
        self._first_after_loss = 0  # id of the first keyframe after the odometry was lost

    def hint(self, T_map_lidar: Array) -> None:
        """Set a prior for the pose of the next keyframe (4, 4), for example from RViz."""
        self._hint, self._state, self._ambiguous = T_map_lidar, State.RELOCALIZING, False

    def add(self, keyframe: Keyframe) -> LocalizationResult:
        """Localize a keyframe, which has its cloud, in the map."""
        lost = self._last_id < self._first_after_loss <= keyframe.id
        if lost or (keyframe.edge is not None and keyframe.edge.worst_sigma > UNCERTAIN):
            self._state = State.LOST if self._state.located else self._state  # its odometry may have been lost
            self._candidate = None
        self._stamp, self._last_id = keyframe.stamp, keyframe.id
        if self._T_last is not None:
            self._path += float(np.linalg.norm(keyframe.T_odom_kf[:3, 3] - self._T_last[:3, 3]))
        self._T_last = keyframe.T_odom_kf
        try:
            if self._state.located:
                return self._track(keyframe)
            return self._find(keyframe, nowhere("lost"))
        except Dpm2Error as error:
            self._failures += 1
            self._lower_state()
            T_predicted, why = self.T_map_odom @ keyframe.T_odom_kf, nowhere(str(error))
            return LocalizationResult(T_predicted, LOST, self.state, why, unreadable=True)

    def _track(self, keyframe: Keyframe) -> LocalizationResult:
        """Verify the pose by the odometry with the points; if they do not confirm it, search everywhere."""
        T_predicted = self.T_map_odom @ keyframe.T_odom_kf
        result = self._relocalizer.verify(keyframe, T_predicted)
        if result.ok:
            return self._accept(keyframe, result, State.TRACKING)
        self._failures += 1
        return self._find(keyframe, result)

    def _find(self, keyframe: Keyframe, rejected: Registration) -> LocalizationResult:
        """Search the whole map, or around the hint. A result must be found a second time if it is far from the tracked
        pose, or if places look alike."""
        result = self._relocalizer.find(keyframe, self._hint)
        self._hint = None
        tracking = self._state.located
        T_predicted = self.T_map_odom @ keyframe.T_odom_kf
        if result.ok:
            near = tracking and self._is_near(T_predicted, result)
            if near or not (tracking or self._ambiguous) or self._confirms_earlier(keyframe, result):
                return self._accept(keyframe, result, State.TRACKING if near else State.RELOCALIZED)
            meters, degrees = se3.apart(T_predicted, result.T_target_source)
            where = f"{meters:.1f} m, {degrees:.0f} deg away" if tracking else "where places look alike"
            result = result.rejected(f"found {where}, not confirmed yet")
        else:
            self._ambiguous = self._ambiguous or result.confidence > 0
            result = rejected if tracking else result
        self._lower_state()
        covariance = LOST if self._state is not State.DEGRADED else np.eye(6) * (0.1 + 0.01 * self._path) ** 2
        return LocalizationResult(T_predicted, covariance, self._state, result)

    def _confirms_earlier(self, keyframe: Keyframe, result: Registration) -> bool:
        """Whether a result confirms an earlier one. While tracking: once the map has contradicted the odometry often
        enough. Else: after some motion, since sooner or later a scan fits the wrong one of places that look alike."""
        T_map_odom, T_odom_other = self._candidate or (None, keyframe.T_odom_kf)
        agrees = T_map_odom is not None and self._is_near(T_map_odom @ keyframe.T_odom_kf, result)
        moved = float(np.linalg.norm(keyframe.T_odom_kf[:3, 3] - T_odom_other[:3, 3])) >= _MIN_MOTION
        if not agrees or moved:
            self._candidate = result.T_target_source @ se3.inverse(keyframe.T_odom_kf), keyframe.T_odom_kf
        return agrees and (self._failures >= _MAX_FAILURES if self._state.located else moved)

    def _is_near(self, T_map_lidar: Array, result: Registration) -> bool:
        """Whether a result is as near to a pose (4, 4) as the odometry may have drifted since the last confirmation."""
        meters, _ = se3.apart(T_map_lidar, result.T_target_source)
        return meters <= 2.0 + 0.02 * self._path and not looks_elsewhere(T_map_lidar, result.T_target_source)

    def _lower_state(self) -> None:
        """Lower the state: the pose, if known, is by the odometry alone."""
        if self._state.located:
            self._state = State.LOST if self._failures >= _MAX_FAILURES else State.DEGRADED

    def _accept(self, keyframe: Keyframe, result: Registration, state: State) -> LocalizationResult:
        self.T_map_odom = se3.orthonormalized(result.T_target_source @ se3.inverse(keyframe.T_odom_kf))
        self._state = state
        self._failures, self._path, self._candidate, self._ambiguous, self.found = 0, 0.0, None, False, keyframe.id
        return LocalizationResult(result.T_target_source, result.covariance, state, result)
