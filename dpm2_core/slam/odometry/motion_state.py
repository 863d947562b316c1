# SPDX-License-Identifier: Apache-2.0
"""Motion of the LiDAR by the registered scans, an IMU and another odometry, and the prediction of its next pose."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from dpm2_core.estimates import BETWEEN, OdometryResult, Registration
from dpm2_core.frame import Array, Frame, Up
from dpm2_core.geometry import se3
from dpm2_core.geometry.motion import OPEN, along_open, combined, covariance, predicted, spread, turned_open
from dpm2_core.geometry.turning import leveled
from dpm2_core.slam.odometry.inertial import InertialMotion, Reckoned
from dpm2_core.slam.odometry.open_way import OpenWay
from dpm2_core.slam.odometry.other import OtherMotion, Step
from dpm2_core.slam.odometry.settings import OdometrySettings
from dpm2_core.slam.registration.swept import SweepPrior, Swept, begun_steadily

_GYROSCOPE_SIGMA = np.radians(0.4)
"""Standard deviation of a measured rotation next to the points, rad; points that determine the heading outweigh it. At
0.1 deg, the accuracy of a good gyroscope, the map took over its bias, scale error or delay with each rotation: 7 deg in
5 s by a bias of 3 deg/s."""
ANY_VELOCITY = 15.0**2 * np.eye(3)
"""Covariance (3, 3) of the velocity, m/s, until two scans are registered."""

_MAX_ACCELERATION = 40.0  # m/s2 off the predicted motion, in addition to 0.5 m: no vehicle accelerates more
_MIN_RIDE = 3.0  # s: no lift reaches another storey sooner, and in less time a crowd or a narrow place is passed
_RIDE_UP, _RIDE_ASIDE = 30.0, 2.0  # m, standard deviations of the distance that an enclosure may have moved the LiDAR


class MotionState:
    """Pose and motion; poses are of the LiDAR in the odometry frame, at the middle of a sweep.

    Attributes:
        settings: limits of a vehicle's motion.
        T, covariance: the last frame's pose (4, 4), registered or predicted, and its covariance (6, 6) [rad, m].
        T_start: (4, 4) the pose of the first frame, level by its `Frame.up`.
        twist: (6,) [rad/s, m/s] in the middle of the sweep of the last registered frame, or else the average from the
            registered frame before to it; None until there are two.
        sweep: the motion during the sweep of the last registered frame, if its points have shown it.
        change: (6,) change of the twist from one registered frame to the next.
        velocity_covariance: (3, 3) of the twist's velocity, m/s.
        open_covariance: (3, 3), m, of the last step in directions that the scene does not constrain; else zero.
        T_registered, seconds: the last registered pose (4, 4), and the time from it to the last frame.
        inertial: the IMU, once a frame had samples. reckoned: the motion to the current frame by the IMU, if it is
            known. other: another odometry, once a frame had a guess.
    """

    def __init__(self, settings: OdometrySettings) -> None:
        self.settings = settings
        self.T, self.covariance = np.eye(4), np.zeros((6, 6))
        self.T_start = self.T
        self.twist: Array | None = None
        self.sweep: Swept | None = None
        self.change = np.zeros(6)
        self.velocity_covariance, self.open_covariance = ANY_VELOCITY, np.zeros((3, 3))
        self.T_registered, self.seconds = np.eye(4), 0.0
        self.inertial: InertialMotion | None = None
        self.reckoned: Reckoned | None = None
        self._open_way: OpenWay | None = None
        self._speed_shown = True  # in unconstrained directions, when the IMU began to estimate the motion there
        self.other: OtherMotion | None = None
        self._open_seconds = 0.0  # s, for which the scene has not constrained a direction
        self._started = False
        self._enclosed_since: float | None = None  # s, time since which all returns are near

    def start(self, up: Up | None) -> None:
        """Set the pose of the first frame: `up` (3,), of `Frame`, points up. Later calls have no effect."""
        if not self._started and up is not None:
            self.T = self.T_registered = self.T_start = se3.make(leveled(up), np.zeros(3))
        self._started = True

    def look(self, frame: Frame, starts: bool) -> Frame:
        """Process the IMU samples of a new frame, and return it as `InertialMotion.look` does; `starts`: the drive
        begins with it."""
        if frame.imu is not None and self.inertial is None:
            self.inertial = InertialMotion(starts)
        self.reckoned = None
        if self.inertial is None:
            return frame
        frame = self.inertial.look(frame)
        if self.twist is not None:
            R = self.T_registered[:3, :3]
            self.reckoned = self.inertial.step(frame.stamp, R, self.twist[3:], self.velocity_covariance)
        return frame

    def begin(self, T: Array) -> None:
        """A new map begins with a frame at T (4, 4), reached by an unknown motion and registered next."""
        self.T, self.twist, self.velocity_covariance, self._speed_shown = T, None, ANY_VELOCITY, False

    @property
    def known_twist(self) -> Array:
        """(6,); zeros while it is unknown."""
        return np.zeros(6) if self.twist is None else self.twist

    @property
    def ahead(self) -> Array:
        """The twist (6,) that predicts the next frame; zeros while it is unknown. At constant acceleration the twist
        would change twice as much."""
        return self.known_twist if self.sweep is None else self.known_twist + self.sweep.half / 2 * self.sweep.motion[1]

    @property
    def during(self) -> Array | None:
        """The motion during the last sweep, (6,) or (K, 6), see `curve.poses`; None while it is unknown."""
        return self.twist if self.sweep is None else self.sweep.motion

    @property
    def turn(self) -> Array | None:
        """R_before_now (3, 3) since the last registered frame, measured by an IMU."""
        return None if self.inertial is None else self.inertial.turn

    @property
    def turning(self) -> Array | None:
        """Rotations in the parts of that time: see `InertialMotion`."""
        return None if self.inertial is None else self.inertial.turning

    def _rotation_covariance(self, seconds: float) -> Array | None:
        """Covariance (3, 3) rad2 of `turn` over `seconds`."""
        return None if self.inertial is None else self.inertial.covariance(seconds)

    @property
    def step(self) -> Step | None:
        """The motion since the last registered frame by another odometry, or else by an IMU."""
        step = None if self.other is None else self.other.step
        return self.reckoned if step is None else step

    def turned(self, twist: Array, seconds: float) -> Array:
        """A twist (6,) with the measured rotation since the last registered frame, if it was measured."""
        if self.turn is None:
            return twist
        return np.concatenate([se3.rotation_vector(self.turn) / seconds, twist[3:]])

    def predicted(self, twist: Array, dt: float) -> Array:
        """Pose (4, 4) of a frame, `dt` s after the previous one, by the IMU's dead reckoning if available."""
        return self.at_constant_velocity(twist, dt) if self.reckoned is None else self.T_registered @ self.reckoned.T

    def at_constant_velocity(self, twist: Array, dt: float) -> Array:
        """Pose (4, 4) at a constant velocity; if an IMU measured the rotation, from the last registered frame on."""
        if self.turning is None:
            return predicted(self.T, twist, dt)
        return predicted(self.T_registered, twist, self.seconds + dt, self.turning)

    def prediction_covariance(self, seconds: float) -> Array:
        """Covariance (6, 6) [rad, m] of a pose that is predicted from one registered `seconds` before."""
        result = spread(self.settings.steadiness * seconds * seconds, seconds, self.velocity_covariance)
        if (rotation_covariance := self._rotation_covariance(seconds)) is not None:
            result[:3, :3] = rotation_covariance
        return result

    def information(self, seconds: float) -> Array:
        """Information (6, 6) of a pose that is predicted from one registered `seconds` before."""
        covariance = self.prediction_covariance(seconds)
        if self.turn is not None:
            covariance[:3, :3] += _GYROSCOPE_SIGMA**2 * np.eye(3)
        return np.linalg.inv(covariance).astype(np.float64)

    def sweep_prior(self, T: Array, seconds: float, half: float) -> SweepPrior:
        """Prior for the sweep of a frame at T (4, 4), `seconds` after the last registered one.

        The sweep began `half` s before.
        """
        if self.sweep is not None:
            return self.sweep.next(seconds, half, self.settings.steadiness)
        before, steadiness = self.T_registered, self.settings.steadiness
        return begun_steadily(before, se3.way(before, T) / seconds, seconds, half, steadiness)

    def unknown(self, dt: float) -> Array:
        """Covariance (6, 6) of a frame's pose, `dt` s after the previous one, that is only predicted."""
        speed, rate_change = float(np.linalg.norm(self.known_twist[3:])), float(np.linalg.norm(self.change[:3]))
        seconds = self.seconds + dt
        # A rotation rate that has changed may change again.
        return covariance(
            speed,
            seconds,
            self.settings.steadiness,
            self.velocity_covariance,
            rate_change,
            self._rotation_covariance(seconds),
        )

    def gated(self, result: Registration, T_predicted: Array, dt: float) -> Registration:
        """Reject a motion that no vehicle can make; the allowance grows while nothing is registered."""
        time = self.seconds + dt
        meters, degrees = se3.apart(T_predicted, result.T_target_source)
        uncertainty = 3 * float(np.linalg.eigvalsh(self.velocity_covariance)[-1]) ** 0.5 * time
        if result.ok and meters > 0.5 + uncertainty + _MAX_ACCELERATION * time * time:
            return result.rejected(f"{meters:.1f} m from the prediction")
        if result.ok and degrees > 3 + self.settings.max_turn * time:
            return result.rejected(f"{degrees:.0f} deg from the prediction")
        return result

    def advance(
        self, registration: Registration, dt: float, stamp: int | None, led: bool, swept: Swept | None = None
    ) -> None:
        """Continue from the pose of a frame that was registered `dt` s after the previous one, by its motion.

        Args:
            registration: for the first frame of a map it shows no motion. led: started from another odometry.
            swept: the motion during its sweep, if known.
        """
        seconds, moved = self.seconds + dt, registration.method != "first"
        by_imu = False
        if moved:
            registration, swept, by_imu = self._correct_open_directions(registration, swept, seconds, led)
            self._update_motion(registration, seconds, led, swept)
        self.register(registration, stamp, moved, by_imu)
        self.sweep = swept
        self._open_seconds = self._open_seconds + seconds if registration.worst_sigma >= OPEN else 0.0
        self.open_covariance = np.zeros((3, 3))
        if moved and self._open_seconds:
            total, self.open_covariance = self._open_covariances(registration.of_scene[3:, 3:], seconds)
            self.covariance[3:, 3:] += total

    def _open_covariances(self, of_scene: Array, seconds: float) -> tuple[Array, Array]:
        """Covariances (3, 3), m, of the motion in unconstrained directions: in all that time, and in `seconds`.

        The covariance of a scan is limited to 1 m there; that of the motion is not, as each pose follows from the last.
        """
        open_velocity, open_way = along_open(of_scene, self.velocity_covariance), self._open_way
        total, step = open_velocity * self._open_seconds**2, open_velocity * seconds**2
        if open_way is None or not self._speed_shown:
            return total, step
        projection = along_open(of_scene, np.eye(3))
        return min(total, projection * open_way.sigma**2, key=np.trace), min(
            step, projection * open_way.gained**2, key=np.trace
        )

    def _correct_open_directions(
        self, registration: Registration, swept: Swept | None, seconds: float, led: bool
    ) -> tuple[Registration, Swept | None, bool]:
        """A registration and the motion during its sweep, and whether an IMU has corrected them. It does so in the
        directions that the scene does not constrain, if it contradicts the scan there."""
        shown = led or registration.worst_sigma < OPEN
        if shown or self.reckoned is None:
            # If an IMU stops and starts again, only scans, which may be wrong, have shown the speed by then.
            self._open_way, self._speed_shown = None, shown or (self._speed_shown and self.twist is None)
            return registration, swept, False
        if self._open_way is None:
            self._open_way = OpenWay(self.T_registered, self.known_twist[3:])
        T, projection = registration.T_target_source.copy(), along_open(registration.of_scene[3:, 3:], np.eye(3))
        offset = self._open_way.follow(self.T_registered, T, projection, self.reckoned, seconds)
        if not self._open_way.leads:
            return registration, swept, False
        T[:3, 3] += offset
        if swept is not None:
            motion = swept.motion.copy()
            motion[0, 3:] += projection @ (T[:3, :3].T @ self._open_way.velocity - motion[0, 3:])
            swept = replace(swept, T=T, motion=motion)
        return replace(registration, T_target_source=T), swept, True

    def _update_motion(self, registration: Registration, seconds: float, led: bool, swept: Swept | None) -> None:
        """Update the motion from the last registered frame to the one `seconds` later."""
        step = self.other.step if led and self.other is not None else None
        prediction_covariance = self.prediction_covariance(seconds) if step is None else step.covariance
        of_scene = turned_open(registration.of_scene[3:, 3:], prediction_covariance[3:, 3:])
        of_motion = combined(of_scene, prediction_covariance[3:, 3:])
        self.velocity_covariance = of_motion / seconds**2
        # Not from the predicted pose of the previous frame: its error would count as motion in one period.
        T_step = se3.inverse(self.T_registered) @ registration.T_target_source
        twist = se3.log(T_step) / seconds if swept is None else swept.motion[0]
        self.change = np.zeros(6) if self.twist is None else twist - self.twist
        self.twist = twist
        if self.other is not None:
            self.other.compare(T_step, registration.of_scene, seconds, led)

    def leaves_enclosure(self, enclosed: bool, now: float) -> bool:
        """Whether a registered frame, at `now` s, is the first outside of an enclosure that may have moved (a lift)."""
        since = self._enclosed_since
        self._enclosed_since = None if not enclosed else now if since is None else since
        return not enclosed and since is not None and now - since >= _MIN_RIDE

    def add_ride_uncertainty(self) -> None:
        """Add the unknown motion with an enclosure, such as a lift, to the covariance."""
        R = self.T[:3, :3]
        added = np.zeros((6, 6))
        added[3:, 3:] = R.T @ np.diag([_RIDE_ASIDE, _RIDE_ASIDE, _RIDE_UP]) ** 2 @ R
        self.covariance = self.covariance + added

    def register(self, registration: Registration, stamp: int | None, moved: bool, by_imu: bool = False) -> None:
        """Continue from a registered pose. `moved`: the twist led there, else the motion is unknown. `by_imu`: the
        twist is that of an IMU in the directions that the scene does not constrain."""
        T_before, self.T = self.T_registered, registration.T_target_source
        if not moved:
            self._open_way = None
        if self.inertial is not None and stamp is not None:
            self.inertial.registered(T_before, self.T, stamp, self.twist if moved else None, by_imu)
        self.T_registered, self.seconds, self.sweep, self.reckoned = self.T, 0.0, None, None
        if self.other is not None:
            self.other.keep()
        self.covariance = registration.covariance.copy()

    def coast(self, dt: float) -> None:
        """Follow the prediction for a frame, `dt` s after the previous one, that was not registered; sigma grows."""
        self.covariance = self.unknown(dt)
        self.seconds += dt
        if (step := self.step) is not None:
            self.T, self.covariance = self.T_registered @ step.T, step.covariance
        elif self.twist is not None:
            self.T = predicted(self.T_registered, self.ahead, self.seconds, self.turning)

    def between(self, last: OdometryResult, frame: Frame) -> OdometryResult:
        """The pose of a frame that is a part of a sweep, predicted from `last`, the result of the last sweep."""
        dt, turns = max((frame.stamp - last.stamp) * 1e-9, 0.0), None
        if self.inertial is not None:
            self.inertial.add(frame.imu)
            turns = self.inertial.turning_after(last.stamp, frame.stamp)
        T, covariance = predicted(last.T_odom_lidar, self.ahead, dt, turns), self.unknown(dt)
        if not last.registration.ok:  # after a pause, `unknown` lacks the motion during it
            covariance = max(covariance, last.covariance, key=np.trace)
        registration = replace(last.registration, T_target_source=T, method=BETWEEN, ok=False)
        return replace(
            last,
            stamp=frame.stamp,
            index=frame.index,
            T_odom_lidar=T,
            covariance=covariance,
            registration=registration if frame.problem is None else registration.because(frame.problem),
            keyframe=None,
            seconds={},
            comparison=None,
            repeated=frozenset(),
        )
