# SPDX-License-Identifier: Apache-2.0
"""What is estimated from frames: registrations, poses, places and the edges between them."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from enum import StrEnum
from typing import Literal

import numpy as np

from dpm2_core.descriptors import Descriptors
from dpm2_core.frame import Array, Fix, Points, Up


def isotropic(rad: float, m: float) -> Array:
    """(6, 6) covariance of a pose with these standard deviations in every direction."""
    return np.diag(np.repeat([rad, m], 3) ** 2)


BETWEEN = "between"
"""Method of a pose that is only predicted because the frame is a part of a sweep that is not complete yet."""


@dataclass(frozen=True, eq=False)
class Registration:
    """The result of every registration, geometric or neural.

    Attributes:
        T_target_source: (4, 4) float64.
        covariance: (6, 6) [rotation rad, translation m] of xi in T = T_target_source @ Exp(xi), if the pose is right.
        confidence: 0..1, 0 for a guess; of the network the probability that the pose is right, of the points the share
            of them that fit.
        rmse: root mean square residual of the inliers, m.
        method: how it was found.
        ok: False: do not use it; `reason` says why in words.
        overlap: probability that both saw the same place, 0..1; NaN where it was not estimated.
        floor: standard deviations, rad and m, in every direction, that grew with the motion between the scans: part of
            `covariance`, and common to all registrations over the same way.
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
        """The same, with one more reason in words."""
        return replace(self, reason="; ".join(part for part in (self.reason, why) if part))

    def rejected(self, reason: str) -> Registration:
        """The same, not to be used for that reason."""
        return replace(self, ok=False, reason=reason)

    def doubted(self, way: Array) -> Registration:
        """As uncertain as another pose is away, to which `way` (6,) leads: which of the two is right nothing shows."""
        return replace(self, covariance=self.covariance + np.outer(way, way))

    @classmethod
    def failed(cls, method: str, reason: str, T_guess: Array | None = None) -> Registration:
        """No pose was found, and why: near a guess (4, 4) all the same or, without one, anywhere."""
        if T_guess is None:
            return cls(np.eye(4), 1e6 * np.eye(6), 0.0, np.inf, method, False, reason)
        return cls(T_guess, np.diag(np.repeat([0.1, 1.0], 3)), 0.0, np.inf, method, False, reason)

    @property
    def of_scene(self) -> Array:
        """(6, 6) `covariance` without `floor`: how well the scans determine the pose."""
        return self.covariance - isotropic(*self.floor)

    @property
    def worst_sigma(self) -> float:
        """Standard deviation of the position in the direction that the scene leaves most open, m."""
        return float(np.sqrt(max(np.linalg.eigvalsh(self.of_scene[3:, 3:])[-1], 0.0)))

    @property
    def open_direction(self) -> Array:
        """(3,) unit vector in the source's axes: where the scene determines the position least."""
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
        """Whether a place in a map goes with it."""
        return self in (State.TRACKING, State.DEGRADED, State.RELOCALIZED)


@dataclass(frozen=True, eq=False)
class Keyframe:
    """A place of the map.

    Attributes:
        id: count within its robot. robot: namespace, "" for the only one. stamp: ns. index: `Frame.index`.
        T_odom_kf: (4, 4) pose when it was made, in the odometry frame; the pose graph holds the optimized one.
        cloud: (M, 4) float32 sub-sampled points in its own frame, that of the LiDAR or of the base: the map and later
            refinement.
        edge: registration of this keyframe to the one before, T_before_this; None for the first.
        descriptors: neural ones, in its own LiDAR frame; None where the registration makes none.
        thumbnail: JPEG for the map file, or None.
        fix: the last one on the way here from the keyframe before, or None.
        origin: (3,) m, where in its own frame the LiDAR was, of several the first: from there `cloud` was seen. It goes
            with the cloud, also into the map file.
        up: see `Frame`, in its own frame.
        session: of its map, from 1; 0: the one that is being written.
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
    """A constraint between two keyframes: of the odometry, or a loop from its proposal to its row in the map file.

    Attributes:
        kind: "odometry" or "loop".
        from_node, to_node: positions among the keyframes of the map.
        registration: its `T_target_source` is T_from_to; `ok` False: rejected, `reason` says why.
    """

    kind: Literal["odometry", "loop"]
    from_node: int
    to_node: int
    registration: Registration

    @property
    def T_from_to(self) -> Array:
        """(4, 4)."""
        return self.registration.T_target_source

    @property
    def covariance(self) -> Array:
        """(6, 6) [rotation rad, translation m] of xi in T_from_to @ Exp(xi)."""
        return self.registration.covariance

    @property
    def ok(self) -> bool:
        """Whether it constrains the poses."""
        return self.registration.ok

    def between(self, from_node: int, to_node: int) -> Edge:
        """The same edge where its ends have other numbers."""
        return replace(self, from_node=from_node, to_node=to_node)

    def shifted(self, first: int) -> Edge:
        """The same edge where node 0 is number `first`."""
        return self.between(self.from_node + first, self.to_node + first)

    def rejected(self, reason: str) -> Edge:
        """The same edge, which does not constrain the poses."""
        return replace(self, registration=self.registration.rejected(reason))


@dataclass(frozen=True, eq=False)
class Comparison:
    """Another odometry (`Frame.guess`) beside the scans, over the way since the last registered frame.

    Attributes:
        T_other, T_scans: (4, 4) T_before_now, as each of the two has it.
        used: whether the pose was searched from where the other one leads; else it was outweighed, or is `unsure`.
        doubt: so many times as far as assumed it has been off of late; 1: as assumed, or better.
        unsure: it was not used, since by its own covariance it knows less than the motion before; nothing contradicts
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
        stamp: ns, that of the cloud. index: `Frame.index`.
        T_odom_lidar: (4, 4), always finite; the prediction where `registration.ok` is False.
        covariance: (6, 6) as in `Registration`, of T_odom_lidar relative to the last frame before that was registered.
        twist: (6,) [rad/s, m/s] in the LiDAR frame.
        registration: how it was found; `BETWEEN` is not a failure.
        keyframe: set when this frame became one.
        breaks: pauses and lifts so far across which the way is not known; since the last one the pose is a guess,
            `covariance` of the frame in which it was given up says how good.
        seconds: wall time of each stage.
        comparison: with another odometry, where there is one and the frame was registered.
        imu: why the IMU was of no use, in words, empty where it was; None while there has been none.
        repeated: names of the cameras whose image is left out, as it is that of before.
        times: why the times of the points are not used, in words; empty where they are.
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
        """Why an image of the frame was left out, in words; empty where none was."""
        return "the same image as before: the camera or its driver repeats itself" if self.repeated else ""
