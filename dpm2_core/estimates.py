# SPDX-License-Identifier: Apache-2.0
"""Estimates made from frames: registrations, poses, keyframes and the edges between them."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from enum import StrEnum
from typing import Literal

import numpy as np

from dpm2_core.descriptors import Descriptors
from dpm2_core.frame import Array, Fix, Points, Up


def isotropic(rad: float, m: float) -> Array:
    """(6, 6) covariance of a pose with these standard deviations in every direction, rotation and translation."""
    return np.diag(np.repeat([rad, m], 3) ** 2)


BETWEEN = "between"
"""Method of a pose that is only predicted because the frame is a part of a sweep that is not complete yet."""


@dataclass(frozen=True, eq=False)
class Registration:
    """The result of any registration, geometric or neural.

    Attributes:
        T_target_source: (4, 4) float64.
        covariance: (6, 6) [rotation rad, translation m] of xi in T = T_target_source @ Exp(xi), if the pose is right.
        confidence: 0..1, 0 for a guess. Of the network: the probability that the pose is right. Of a registration of
            points: the fraction of the points that fit.
        rmse: root mean square residual of the inliers, m.
        method: how it was found.
        ok: False: do not use it; `reason` states why in words.
        overlap: probability that both scans show the same place, 0..1; NaN where it was not estimated.
        floor: standard deviations, rad and m, in every direction, which grow with the motion between the scans. They
            are part of `covariance`, and common to all registrations over the same motion.
    """

    T_target_source: Array
    covariance: Array
    confidence: float = 1.0
    rmse: float = 0.0
    method: str = ""
    ok: bool = True
    reason: str = ""
    overlap: float = float("nan")
    floor: tuple[float, float] = (0.0, 0.0)

    def because(self, why: str) -> Registration:
        """The same registration, with one more reason in words."""
        return replace(self, reason="; ".join(part for part in (self.reason, why) if part))

    def rejected(self, reason: str) -> Registration:
        """The same registration, rejected for that reason."""
        return replace(self, ok=False, reason=reason)

    def doubted(self, way: Array) -> Registration:
        """The same pose with a covariance that also covers a second pose, `way` (6,) away from it.

        For two candidate poses of which the data does not show the right one.
        """
        return replace(self, covariance=self.covariance + np.outer(way, way))

    @classmethod
    def failed(cls, method: str, reason: str, T_guess: Array | None = None) -> Registration:
        """A failed registration with its reason: its pose is a guess (4, 4) or, without a guess, unknown."""
        if T_guess is None:
            return cls(np.eye(4), 1e6 * np.eye(6), 0.0, np.inf, method, False, reason)
        return cls(T_guess, np.diag(np.repeat([0.1, 1.0], 3)), 0.0, np.inf, method, False, reason)

    @property
    def of_scene(self) -> Array:
        """(6, 6) `covariance` without `floor`: how well the scans determine the pose."""
        return self.covariance - isotropic(*self.floor)

    @property
    def worst_sigma(self) -> float:
        """Standard deviation of the position in the direction that the scene constrains least, m."""
        return float(np.sqrt(max(np.linalg.eigvalsh(self.of_scene[3:, 3:])[-1], 0.0)))

    @property
    def open_direction(self) -> Array:
        """(3,) unit vector in the source's axes: the direction in which the scene constrains the position least."""
        return np.linalg.eigh(self.of_scene[3:, 3:])[1][:, -1]


class State(StrEnum):
    """Health of the odometry and of the localization in a map, as published in /diagnostics."""

    INITIALIZING = "initialising"
    TRACKING = "tracking"
    DEGRADED = "degraded"
    LOST = "lost"
    RELOCALIZING = "relocalising"
    RELOCALIZED = "relocalised"

    @property
    def located(self) -> bool:
        """Whether the pose in a map is known in this state."""
        return self in (State.TRACKING, State.DEGRADED, State.RELOCALIZED)


@dataclass(frozen=True, eq=False)
class Keyframe:
    """A keyframe of the map.

    Attributes:
        id: count within its robot. robot: namespace, "" for a single robot. stamp: ns. index: `Frame.index`.
        T_odom_kf: (4, 4) pose when it was made, in the odometry frame; the pose graph stores the optimized pose.
        cloud: (M, 4) float32 sub-sampled points in its own frame, that of the LiDAR or of the base: for the map and
            refinement.
        edge: registration of this keyframe to the previous one, T_before_this; None for the first.
        descriptors: neural descriptors in its own LiDAR frame; None if the registration makes none.
        thumbnail: JPEG for the map file, or None.
        fix: the last fix between the previous keyframe and this one, or None.
        origin: (3,) m, position of the LiDAR (of the first, if there are several) in the keyframe's frame, from which
            `cloud` was seen. It is stored together with the cloud, also in the map file.
        up: see `Frame`, in its own frame.
        session: number of the session of its map, from 1; 0: the one that is being written.
    """

    id: int
    stamp: int
    index: int
    T_odom_kf: Array
    cloud: Points
    edge: Registration | None = None
    robot: str = ""
    descriptors: Descriptors | None = None
    thumbnail: bytes | None = None
    fix: Fix | None = None
    origin: Array = field(default_factory=lambda: np.zeros(3))
    up: Up | None = None
    session: int = 0


@dataclass(frozen=True, eq=False)
class Edge:
    """A constraint between two keyframes: of the odometry, or a loop, from its proposal to its row in the map file.

    Attributes:
        kind: "odometry" or "loop".
        from_node, to_node: positions among the keyframes of the map.
        registration: its `T_target_source` is T_from_to; if `ok` is False, it is rejected and `reason` states why.
    """

    kind: Literal["odometry", "loop"]
    from_node: int
    to_node: int
    registration: Registration

    @property
    def T_from_to(self) -> Array:
        """(4, 4) pose of the to-node in the frame of the from-node."""
        return self.registration.T_target_source

    @property
    def covariance(self) -> Array:
        """(6, 6) [rotation rad, translation m] of xi in T_from_to @ Exp(xi)."""
        return self.registration.covariance

    @property
    def ok(self) -> bool:
        """Whether the edge constrains the poses."""
        return self.registration.ok

    def between(self, from_node: int, to_node: int) -> Edge:
        """The same edge with other node numbers."""
        return replace(self, from_node=from_node, to_node=to_node)

    def shifted(self, first: int) -> Edge:
        """The same edge with node 0 renumbered to `first`."""
        return self.between(self.from_node + first, self.to_node + first)

    def rejected(self, reason: str) -> Edge:
        """The same edge, rejected: it does not constrain the poses."""
        return replace(self, registration=self.registration.rejected(reason))


@dataclass(frozen=True, eq=False)
class Comparison:
    """Another odometry (`Frame.guess`) compared with the scans, over the motion since the last registered frame.

    Attributes:
        T_other, T_scans: (4, 4) T_before_now by each of the two.
        used: whether the search for the pose started from the other odometry; else it was outweighed, or is `unsure`.
        doubt: its recent error relative to the assumed one; 1: as assumed, or better.
        unsure: it was not used, since its own covariance is larger than that of the motion before; no data contradicts
            it.
    """

    T_other: Array
    T_scans: Array
    used: bool
    doubt: float
    unsure: bool = False


@dataclass(frozen=True, eq=False)
class OdometryResult:
    """The state of the odometry after one frame.

    Attributes:
        stamp: ns, of the cloud. index: `Frame.index`.
        T_odom_lidar: (4, 4), always finite; the predicted pose where `registration.ok` is False.
        covariance: (6, 6) as in `Registration`, of T_odom_lidar relative to the nearest scan of the local map, which is
            the frame before or one some meters back; of a predicted pose, relative to the last frame that was
            registered.
        twist: (6,) [rad/s, m/s] in the LiDAR frame.
        registration: how it was found; `BETWEEN` is not a failure.
        keyframe: set when this frame became one.
        breaks: number of pauses and lifts so far across which the motion is unknown. After the last one the pose is a
            guess, as good as the `covariance` of the frame in which the motion was given up.
        seconds: wall time of each stage.
        comparison: with another odometry, if there is one and the frame was registered.
        imu: why the IMU could not be used, in words; empty if it was used; None while there has been no IMU.
        repeated: names of the cameras whose image is left out, since it is the same as the previous one.
        times: why the times of the points are not used, in words; empty if they are used.
    """

    stamp: int
    index: int
    T_odom_lidar: Array
    covariance: Array
    twist: Array
    state: State
    registration: Registration
    keyframe: Keyframe | None = None
    breaks: int = 0
    seconds: dict[str, float] = field(default_factory=dict)
    comparison: Comparison | None = None
    imu: str | None = None
    repeated: frozenset[str] = frozenset()
    times: str = ""

    @property
    def failed(self) -> bool:
        """Whether the frame could not be registered, though it was to be."""
        return not self.registration.ok and self.registration.method != BETWEEN

    @property
    def camera(self) -> str:
        """Why an image of the frame was left out, in words; empty if none was."""
        return "the same image as before: the camera or its driver repeats itself" if self.repeated else ""
