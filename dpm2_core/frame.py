# SPDX-License-Identifier: Apache-2.0
"""The nouns of the project. A transform is `T_target_source`: p_target = T_target_source @ p_source."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from enum import StrEnum
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from dpm2_core.descriptors import Descriptors

Array = NDArray[np.float64]
Points = NDArray[np.float32]


def is_rigid(T: Array, tolerance: float = 1e-3) -> bool:
    """Whether (4, 4) is a finite rigid transform; what is off by more than `tolerance` is damage, not rounding."""
    if T.shape != (4, 4) or not np.isfinite(T).all() or np.abs(T[:3, :3]).max() > 2:
        return False
    R = T[:3, :3]
    off = np.abs(R @ R.T - np.eye(3)).max() + np.abs(T[3] - [0, 0, 0, 1]).max()
    return bool(off < tolerance and np.linalg.det(R) > 0)


@dataclass(frozen=True, eq=False)
class Camera:
    """A calibrated camera.

    Attributes:
        K: (3, 3) float64 intrinsics, pixels.
        T_lidar_cam: (4, 4) float64, camera (x right, y down, z forward) to LiDAR frame, m.
        size: (width, height) of the image, pixels.
        distortion: plumb-bob coefficients k1, k2, p1, p2[, k3]; empty for a rectified image.
        name: what messages call it; of topics, that of its images. It tells the cameras of a drive apart.
    """

    K: Array
    T_lidar_cam: Array
    size: tuple[int, int]
    distortion: tuple[float, ...] = ()
    name: str = "camera"

    def __post_init__(self) -> None:
        if self.K.shape != (3, 3) or self.T_lidar_cam.shape != (4, 4):
            raise ValueError(
                f"{self.name}: K is {self.K.shape}, T_lidar_cam {self.T_lidar_cam.shape}; want (3, 3), (4, 4)"
            )
        if not is_rigid(self.T_lidar_cam):
            raise ValueError(f"{self.name}: T_lidar_cam is no rigid transform (is it transposed?)")
        if not (np.isfinite(self.K).all() and self.K[0, 0] > 0 < self.K[1, 1] and (self.K[2] == (0, 0, 1)).all()):
            raise ValueError(f"{self.name}: K is no matrix of intrinsics, whose last row is 0 0 1: {self.K.tolist()}")


@dataclass(frozen=True, eq=False)
class Image:
    """One image.

    Attributes:
        pixels: (H, W, 3) uint8 RGB. camera: that took it.
        time_offset: s, when it was taken relative to the stamp of its frame.
    """

    pixels: NDArray[np.uint8]
    camera: Camera
    time_offset: float = 0.0

    def __post_init__(self) -> None:
        height, width = self.pixels.shape[:2]
        if self.pixels.shape[2:] != (3,) or (width, height) != self.camera.size:
            raise ValueError(
                f"{self.camera.name}: image of {self.pixels.shape}, calibration for {self.camera.size[::-1]}"
            )
        if self.pixels.dtype != np.uint8:
            raise ValueError(f"{self.camera.name}: pixels are {self.pixels.dtype}, want uint8, 0 to 255")


@dataclass(frozen=True, eq=False)
class Guess:
    """Where another odometry has the LiDAR. Only the way between two of them counts.

    Attributes:
        T_other_lidar: (4, 4) in a frame of its own, which may drift away from everything.
        covariance: (6, 6) as in `Registration`, of that pose, as the odometry states it; None where it states none.
    """

    T_other_lidar: Array
    covariance: Array | None = None

    def __post_init__(self) -> None:
        for name, array, shape in (("pose", self.T_other_lidar, (4, 4)), ("covariance", self.covariance, (6, 6))):
            if array is not None and (array.shape != shape or not np.isfinite(array).all()):
                raise ValueError(f"guess: its {name} is not {shape} finite numbers")
        if not is_rigid(self.T_other_lidar):
            raise ValueError("guess: its pose is no rigid transform (is it transposed?)")


@dataclass(frozen=True, eq=False)
class Inertial:
    """What an IMU measured around a scan, along the axes of the LiDAR.

    Attributes:
        stamps: (K,) int64 ns, increasing.
        rates: (K, 3) rad/s. forces: (K, 3) m/s2, what an accelerometer shows: 9.8 upwards at rest; NaN where unknown.
        up: (3,) unit vector along the LiDAR's axes at the start that is to be upwards in the odometry's frame where the
            drive starts at rest; None: the LiDAR's first pose is the frame, however it is tilted.
    """

    stamps: NDArray[np.int64]
    rates: Array
    forces: Array
    up: tuple[float, float, float] | None = (0.0, 0.0, 1.0)

    def __post_init__(self) -> None:
        shape = (len(self.stamps), 3)
        if self.rates.shape != shape or self.forces.shape != shape:
            raise ValueError(f"{shape[0]} samples of an IMU: rates {self.rates.shape}, forces {self.forces.shape}")

    def __len__(self) -> int:
        return len(self.stamps)


@dataclass(frozen=True, eq=False)
class Fix:
    """A position by satellites (GNSS).

    Attributes:
        stamp: ns.
        geodetic: (3,) WGS84: latitude and longitude, degrees, and altitude above the ellipsoid, m.
        covariance: (3, 3) of the position, east, north, up, m^2.
        antenna: (3,) m, where the antenna was at that time: in the LiDAR's frame, of a keyframe in the keyframe's.
    """

    stamp: int
    geodetic: Array
    covariance: Array
    antenna: Array

    def __post_init__(self) -> None:
        shapes = (self.geodetic.shape, self.covariance.shape, self.antenna.shape)
        if shapes != ((3,), (3, 3), (3,)) or not _on_earth(self.geodetic):
            raise ValueError(f"fix: latitude, longitude, altitude {self.geodetic.tolist()} are no place on Earth")
        if not np.abs(self.antenna).max() <= 1e3:
            raise ValueError(f"fix: its antenna is at {self.antenna.tolist()} m")
        C = self.covariance
        if not np.abs(C).max() <= 1e12 or not np.allclose(C, C.T) or np.linalg.eigvalsh(C)[0] <= 0:
            raise ValueError(f"fix: {C.ravel().tolist()} is no covariance")

    def moved(self, T_new_old: Array) -> Fix:
        """The same with its antenna in another frame, by (4, 4) T_new_old."""
        return replace(self, antenna=T_new_old[:3, :3] @ self.antenna + T_new_old[:3, 3])


@dataclass(frozen=True, eq=False)
class Georeference:
    """Where on Earth a map is.

    Attributes:
        origin: (3,) WGS84 of the local frame east, north, up: latitude and longitude, degrees, and altitude, m.
        T_enu_map: (4, 4).
    """

    origin: Array
    T_enu_map: Array

    def __post_init__(self) -> None:
        """Raises ValueError if the origin is not a place on Earth."""
        if not _on_earth(self.origin):
            raise ValueError(f"latitude, longitude, altitude {self.origin.tolist()} are no place on Earth")


def _on_earth(geodetic: Array) -> bool:
    return bool((np.abs(geodetic) <= (90, 360, 1e5)).all())  # NaN compares false


@dataclass(frozen=True, eq=False)
class Frame:
    """What the sensors saw at one time.

    Attributes:
        stamp: ns since the epoch of the source.
        points: (N, 4) float32 [x, y, z in m, intensity 0..1] in the LiDAR frame; N may be 0, NaN is allowed.
        time_offset: (N,) float32 s, capture time of each point relative to `stamp`; None where the source has none.
        images: zero, one or several images.
        index: position in its source (KITTI frame number, message count of a bag).
        problem: why the scan could not be read; `points` is then empty and the frame counts as failed, not lost.
        guess: where another odometry has the LiDAR in the middle of the sweep; the search for the pose begins there.
        imu: samples since those of the frame before, up to the last point; None where there is no IMU.
        fix: the last one before the stamp that no frame before had; None where there is none.
        dropped: scans since the frame before that came, but were left out for want of time.
    """

    stamp: int
    points: Points
    time_offset: Points | None = None
    images: tuple[Image, ...] = ()
    index: int = 0
    problem: str | None = None
    guess: Guess | None = None
    imu: Inertial | None = None
    fix: Fix | None = None
    dropped: int = 0

    def __post_init__(self) -> None:
        if self.points.ndim != 2 or self.points.shape[1] != 4 or self.points.dtype != np.float32:
            found = f"{self.points.shape} {self.points.dtype}"
            raise ValueError(f"frame {self.index}: points are {found}, want (N, 4) float32")
        if self.time_offset is not None and self.time_offset.shape != self.points.shape[:1]:
            raise ValueError(f"frame {self.index}: {len(self.time_offset)} time offsets for {len(self.points)} points")
        if self.time_offset is not None and not np.isfinite(self.time_offset).all():
            raise ValueError(f"frame {self.index}: some time offsets are not finite")
        if not isinstance(self.stamp, int | np.integer):
            raise ValueError(f"frame {self.index}: its stamp is {self.stamp!r}, want ns, an integer")

    def later(self, seconds: float) -> Frame:
        """The same, its points and images timed from a moment so much after the stamp; not moved there."""
        if not seconds:
            return self
        offset = None if self.time_offset is None else self.time_offset - np.float32(seconds)
        images = tuple(replace(image, time_offset=image.time_offset - seconds) for image in self.images)
        return replace(self, stamp=self.stamp + round(seconds * 1e9), time_offset=offset, images=images)


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

    @classmethod
    def failed(cls, method: str, reason: str, T_guess: Array | None = None) -> Registration:
        """No pose was found, and why: near a guess (4, 4) all the same or, without one, anywhere."""
        if T_guess is None:
            return cls(np.eye(4), 1e6 * np.eye(6), 0.0, np.inf, method, False, reason)
        return cls(T_guess, np.diag(np.repeat([0.1, 1.0], 3)), 0.0, np.inf, method, False, reason)

    @property
    def of_scene(self) -> Array:
        """(6, 6) `covariance` without `floor`: how well the scans determine the pose."""
        return self.covariance - np.diag(np.repeat(self.floor, 3) ** 2)

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
        cloud: (M, 4) float32 sub-sampled points in its own LiDAR frame: the map and later refinement.
        edge: registration of this keyframe to the one before, T_before_this; None for the first.
        descriptors: neural ones, in its own LiDAR frame; None where the registration makes none.
        thumbnail: JPEG for the map file, or None.
        fix: the last one on the way here from the keyframe before, or None.
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
        return replace(self, registration=replace(self.registration, ok=False, reason=reason))


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
        registration: how it was found.
        keyframe: set when this frame became one.
        breaks: pauses so far across which the way is not known; since the last one the pose is a guess, `covariance` of
            the frame in which it was given up says how good.
        seconds: wall time of each stage.
        comparison: with another odometry, where there is one and the frame was registered.
        imu: why the IMU was of no use, in words, empty where it was; None while there has been none.
        camera: why an image of the frame was left out, in words; empty where none was.
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
    camera: str = ""
