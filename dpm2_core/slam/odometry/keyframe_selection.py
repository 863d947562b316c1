# SPDX-License-Identifier: Apache-2.0
"""Which scans become places of the map, and how well each is tied to the one before."""

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

_SAME = np.eye(4)
_TRACE = 30  # frames that a fix may be older than the one that it comes with
_DRIFT, _DRIFT_RAD = 0.01, np.radians(0.03)  # m and rad per m of motion, standard deviations beside the registration's
_FAR = 1e5  # m: farther off than so no way is


class KeyframeSettings(Settings):
    """Spacing of keyframes, and what they keep of their scans."""

    distance: float = Field(5.0, ge=0)
    """Motion after which a scan becomes a keyframe, m."""
    angle: float = Field(25.0, ge=0)
    """Turn after which a scan becomes a keyframe, degrees, unless one that was taken near by looks the same way."""
    residual: float = Field(0.0, ge=0)
    """Residual of registrations, m, at which `distance` shrinks to 1 m; without one it grows to twice its value, as in
    DeepPointMap. 0: it stays as it is."""
    voxel: float = Field(0.3, gt=0)
    """Spacing of the points of a keyframe, m."""
    range: float = Field(60.0, gt=0)
    """Points farther than this do not enter the map, m."""


class KeyframeSelector:
    """Makes a keyframe of the first registered scan and then by motion."""

    def __init__(self, settings: KeyframeSettings, robot: str = "") -> None:
        self._robot = robot
        self.use(settings)
        self.reset()

    def use(self, settings: KeyframeSettings) -> None:
        """From now on; the keyframes so far stay."""
        self._settings, self._spacing = settings, Spacing(settings.distance, settings.residual)

    def reset(self) -> None:
        """Forget everything."""
        self.use(self._settings)
        self._last: Keyframe | None = None
        self._near: list[Array] = []  # T_odom_kf of those that the robot has not left since
        self._uncertainty = np.zeros((6, 6))
        self._left_open = np.zeros((3, 3))  # root of the covariance, m, of the way since along what scenes left open
        self._weakest: Registration | None = None  # the least certain one since the last keyframe
        self._requested = False
        self._trace: deque[tuple[int, Array]] = deque(maxlen=_TRACE)  # of the frames before, without a break
        self._fix: tuple[Fix, Array] | None = None  # the last one, and T_odom_lidar when it was measured

    @property
    def next_id(self) -> int:
        """Of the next keyframe."""
        return 0 if self._last is None else self._last.id + 1

    def request(self) -> None:
        """Make a keyframe of the next registered scan at any distance: relocalization needs one even at standstill."""
        self._requested = True

    def add_uncertainty(self, covariance: Array) -> None:
        """The odometry was broken by that much (6, 6): the next edge is to be no firmer."""
        self._uncertainty = self._uncertainty + covariance
        self._near = [] if self._last is None else [self._last.T_odom_kf]  # where others are from here is not known

    def leave_open(self, step: Array) -> None:
        """A step was registered whose covariance (3, 3), m, is this much along what the scene leaves open.

        It is the velocity that is not known there, and lasts: errors of steps add up, not their squares.
        """
        variances, axes = np.linalg.eigh(step)
        if np.trace(self._left_open) < _FAR:
            self._left_open = self._left_open + (axes * np.sqrt(np.maximum(variances, 0))) @ axes.T

    def select(
        self, frame: Frame, scan: Scan, T_odom_lidar: Array, registration: Registration, T_scan_lidar: Array = _SAME
    ) -> Keyframe | None:
        """The keyframe that this scan makes, or None. A scan that was not registered never makes one.

        Args:
            T_odom_lidar: (4, 4) at the frame's stamp.
            T_scan_lidar: (4, 4) of the LiDAR at the stamp, in the frame of the scan's points.
        """
        if not registration.ok:
            self._trace.clear()  # the way is not known
            self._fix = None
            return None
        self._trace_fix(frame, T_odom_lidar)
        # What is registered with a doubt enters the map, and the next scan fits there however far that is off.
        if self._weakest is None or registration.worst_sigma > self._weakest.worst_sigma:
            self._weakest = registration
        s, last, edge = self._settings, self._last, None
        if s.residual:
            self._spacing.registered(registration.rmse)
        if last is not None:
            if self._is_known(T_odom_lidar) and not self._requested:
                return None
            T_last_this = se3.inverse(last.T_odom_kf) @ T_odom_lidar
            way = max(se3.magnitude(T_last_this)[0], 1.0)
            drift = isotropic(_DRIFT_RAD * way, _DRIFT * way)
            covariance = self._weakest.covariance + drift + self._uncertainty
            covariance[3:, 3:] += self._left_open @ self._left_open
            edge = replace(registration, T_target_source=T_last_this, covariance=covariance)
        cloud = scan.points[voxel_first(scan.points, s.voxel, far=s.range)]
        known = scan.descriptors if scan.description is not None and scan.description.made else None
        if (T_scan_lidar != _SAME).any():
            T_lidar_scan = se3.inverse(T_scan_lidar)
            cloud = se3.transform(T_lidar_scan, cloud)
            known = None if known is None else known.moved(T_lidar_scan)
        keyframe = Keyframe(
            self.next_id, frame.stamp, frame.index, T_odom_lidar, cloud, edge, self._robot, known, up=frame.up
        )
        if self._fix is not None:
            fix, T_odom_then = self._fix
            keyframe = replace(keyframe, fix=fix.moved(se3.inverse(T_odom_lidar) @ T_odom_then))
        self._last, self._uncertainty, self._requested, self._fix = keyframe, np.zeros((6, 6)), False, None
        self._weakest, self._left_open = None, np.zeros((3, 3))
        # In place of those that it looks like: at a halt one may be requested each second, and each frame asks all.
        self._near = [T for T, degrees in self._near_by(T_odom_lidar) if degrees >= s.angle] + [T_odom_lidar]
        return keyframe

    def _is_known(self, T_odom_lidar: Array) -> bool:
        """Whether a keyframe shows what is seen there: one that turns on the spot sees the same with each turn."""
        near = self._near_by(T_odom_lidar)
        self._near = [T for T, _ in near]
        return any(degrees < self._settings.angle for _, degrees in near)

    def _near_by(self, T_odom_lidar: Array) -> list[tuple[Array, float]]:
        """Of `_near` those that the robot has not left there (4, 4), and how many degrees it is turned from each."""
        moved = [(T, *se3.apart(T, T_odom_lidar)) for T in self._near]
        return [(T, degrees) for T, meters, degrees in moved if meters < self._spacing.meters]

    def _trace_fix(self, frame: Frame, T_odom_lidar: Array) -> None:
        """Note the way, and where on it a fix was measured: it comes late, and between two scans."""
        trace, fix = self._trace, frame.fix
        if trace and frame.stamp <= trace[-1][0]:
            trace.clear()
        trace.append((frame.stamp, T_odom_lidar))
        if fix is None or not trace[0][0] <= fix.stamp <= frame.stamp:
            return
        after = next(i for i, (stamp, _) in enumerate(trace) if stamp >= fix.stamp)
        (t0, T0), (t1, T1) = trace[max(after - 1, 0)], trace[after]
        part = (fix.stamp - t0) / (t1 - t0) if t1 > t0 else 0.0
        self._fix = fix, se3.interpolated(T0, T1, part)
