# SPDX-License-Identifier: Apache-2.0
"""Selects the scans that become keyframes, and estimates the uncertainty of the edge from each to the previous one."""

from __future__ import annotations

from collections import deque
from dataclasses import replace

import numpy as np
from pydantic import Field

from dpm2_core.config import Settings
from dpm2_core.estimates import Keyframe, Registration, isotropic
from dpm2_core.frame import Array, Fix, Frame
from dpm2_core.geometry import se3
from dpm2_core.geometry.voxel import voxel_first
from dpm2_core.slam.preprocess import Scan
from dpm2_core.slam.registration.spacing import Spacing

_IDENTITY = np.eye(4)
_TRACE_LENGTH = 30  # frames that a fix may be older than the frame with which it arrives
_DRIFT, _DRIFT_RAD = 0.01, np.radians(0.03)  # m and rad per m of motion, standard deviations besides the registration's
_MAX_UNCERTAINTY = 1e5  # m: no larger uncertainty is needed


class KeyframeSettings(Settings):
    """Spacing of keyframes, and the points that they keep of their scans."""

    distance: float = Field(5.0, ge=0)
    """Motion after which a scan becomes a keyframe, m."""
    angle: float = Field(25.0, ge=0)
    """Rotation after which a scan becomes a keyframe, degrees, unless a keyframe nearby has a similar heading."""
    residual: float = Field(0.0, ge=0)
    """Residual of registrations, m, at which `distance` shrinks to 1 m; at zero residual it grows to twice its value,
    as in DeepPointMap. 0: `distance` is constant."""
    voxel: float = Field(0.3, gt=0)
    """Spacing of the points of a keyframe, m."""
    range: float = Field(60.0, gt=0)
    """Points beyond this range do not enter the map, m."""


class KeyframeSelector:
    """Makes a keyframe of the first registered scan, and further ones by motion."""

    def __init__(self, settings: KeyframeSettings, robot: str = "") -> None:
        self._robot = robot
        self.use(settings)
        self.reset()

    def use(self, settings: KeyframeSettings) -> None:
        """Use other settings from now on; existing keyframes are kept."""
        self._settings, self._spacing = settings, Spacing(settings.distance, settings.residual)

    def reset(self) -> None:
        """Reset the state."""
        self.use(self._settings)
        self._last: Keyframe | None = None
        self._near: list[Array] = []  # T_odom_kf of the keyframes near which the robot has stayed since
        self._uncertainty = np.zeros((6, 6))
        self._open_sigma = np.zeros((3, 3))  # root of the covariance, m, of the motion in unconstrained directions
        self._weakest: Registration | None = None  # the one with the largest sigma since the last keyframe
        self._requested = False
        self._trace: deque[tuple[int, Array]] = deque(maxlen=_TRACE_LENGTH)  # stamps and poses, without a break
        self._fix: tuple[Fix, Array] | None = None  # the last fix, and T_odom_lidar when it was measured

    @property
    def next_id(self) -> int:
        """Id of the next keyframe."""
        return 0 if self._last is None else self._last.id + 1

    def request(self) -> None:
        """Make a keyframe of the next registered scan at any distance: relocalization needs one also at standstill."""
        self._requested = True

    def add_uncertainty(self, covariance: Array) -> None:
        """Add the uncertainty (6, 6) of a break to the next edge, which must not be more certain."""
        self._uncertainty = self._uncertainty + covariance
        self._near = [] if self._last is None else [self._last.T_odom_kf]  # relative poses of the others are unknown

    def leave_open(self, step: Array) -> None:
        """Add a registered step whose covariance (3, 3), m, in unconstrained directions of the scene is `step`.

        The unknown there is the velocity, which persists: errors of the steps add up, not their squares.
        """
        variances, axes = np.linalg.eigh(step)
        if np.trace(self._open_sigma) < _MAX_UNCERTAINTY:
            self._open_sigma = self._open_sigma + (axes * np.sqrt(np.maximum(variances, 0))) @ axes.T

    def select(
        self, frame: Frame, scan: Scan, T_odom_lidar: Array, registration: Registration, T_scan_lidar: Array = _IDENTITY
    ) -> Keyframe | None:
        """The keyframe of this scan, or None. A scan that was not registered never becomes one.

        Args:
            T_odom_lidar: (4, 4) at the frame's stamp.
            T_scan_lidar: (4, 4) of the LiDAR at the stamp, in the frame of the scan's points.
        """
        if not registration.ok:
            self._trace.clear()  # the motion is unknown
            self._fix = None
            return None
        self._trace_fix(frame, T_odom_lidar)
        # An uncertain scan enters the local map, and the next scan fits there, however large the error is.
        if self._weakest is None or registration.worst_sigma > self._weakest.worst_sigma:
            self._weakest = registration
        s, last, edge = self._settings, self._last, None
        if s.residual:
            self._spacing.registered(registration.rmse)
        if last is not None:
            if self._is_known(T_odom_lidar) and not self._requested:
                return None
            T_last_this = se3.inverse(last.T_odom_kf) @ T_odom_lidar
            distance = max(se3.magnitude(T_last_this)[0], 1.0)
            drift = isotropic(_DRIFT_RAD * distance, _DRIFT * distance)
            covariance = self._weakest.covariance + drift + self._uncertainty
            covariance[3:, 3:] += self._open_sigma @ self._open_sigma
            edge = replace(registration, T_target_source=T_last_this, covariance=covariance)
        cloud = scan.points[voxel_first(scan.points, s.voxel, far=s.range)]
        descriptors = scan.descriptors if scan.description is not None and scan.description.made else None
        if (T_scan_lidar != _IDENTITY).any():
            T_lidar_scan = se3.inverse(T_scan_lidar)
            cloud = se3.transform(T_lidar_scan, cloud)
            descriptors = None if descriptors is None else descriptors.moved(T_lidar_scan)
        keyframe = Keyframe(
            self.next_id, frame.stamp, frame.index, T_odom_lidar, cloud, edge, self._robot, descriptors, up=frame.up
        )
        if self._fix is not None:
            fix, T_odom_then = self._fix
            keyframe = replace(keyframe, fix=fix.moved(se3.inverse(T_odom_lidar) @ T_odom_then))
        self._last, self._uncertainty, self._requested, self._fix = keyframe, np.zeros((6, 6)), False, None
        self._weakest, self._open_sigma = None, np.zeros((3, 3))
        # Replace keyframes with a similar view: at a halt one may be requested per second, and each frame compares all.
        self._near = [T for T, degrees in self._still_near(T_odom_lidar) if degrees >= s.angle] + [T_odom_lidar]
        return keyframe

    def _is_known(self, T_odom_lidar: Array) -> bool:
        """Whether a keyframe shows this view already: a robot turning on the spot sees the same in each revolution."""
        near = self._still_near(T_odom_lidar)
        self._near = [T for T, _ in near]
        return any(degrees < self._settings.angle for _, degrees in near)

    def _still_near(self, T_odom_lidar: Array) -> list[tuple[Array, float]]:
        """Keyframes of `_near` that are still near this pose (4, 4), and the angle to each, degrees."""
        moved = [(T, *se3.apart(T, T_odom_lidar)) for T in self._near]
        return [(T, degrees) for T, meters, degrees in moved if meters < self._spacing.meters]

    def _trace_fix(self, frame: Frame, T_odom_lidar: Array) -> None:
        """Record the trajectory, and where on it a fix was measured: a fix arrives late, and between two scans."""
        trace, fix = self._trace, frame.fix
        if trace and frame.stamp <= trace[-1][0]:
            trace.clear()
        trace.append((frame.stamp, T_odom_lidar))
        if fix is None or not trace[0][0] <= fix.stamp <= frame.stamp:
            return
        after = next(i for i, (stamp, _) in enumerate(trace) if stamp >= fix.stamp)
        (t0, T0), (t1, T1) = trace[max(after - 1, 0)], trace[after]
        fraction = (fix.stamp - t0) / (t1 - t0) if t1 > t0 else 0.0
        self._fix = fix, se3.interpolated(T0, T1, fraction)
