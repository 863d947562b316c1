# SPDX-License-Identifier: Apache-2.0
"""Data that the sensors deliver. A transform is `T_target_source`: p_target = T_target_source @ p_source."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Points = NDArray[np.float32]
Up = tuple[float, float, float]
_LONGEST_SWEEP = 10.0  # s: times in ms span at least 20
NO_POINTS: Points = np.zeros((0, 4), np.float32)
R_AHEAD: Array = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])
"""(3, 3) R_lidar_cam of a camera that looks along the LiDAR's x axis; the camera's axes: x right, y down, z ahead."""


def is_rigid(T: Array, tolerance: float = 1e-3) -> bool:
    """Whether (4, 4) is a finite rigid transform; deviations above `tolerance` are damage, not rounding."""
    if T.shape != (4, 4) or not np.isfinite(T).all() or np.abs(T[:3, :3]).max() > 2:
        return False
    R = T[:3, :3]
    deviation = np.abs(R @ R.T - np.eye(3)).max() + np.abs(T[3] - [0, 0, 0, 1]).max()
    return bool(deviation < tolerance and np.linalg.det(R) > 0)


@dataclass(frozen=True, eq=False)
class Camera:
    """A calibrated camera.

    Attributes:
        K: (3, 3) float64 intrinsics, pixels.
        T_lidar_cam: (4, 4) float64, camera (x right, y down, z forward) to LiDAR frame, m.
        size: (width, height) of the image, pixels.
        distortion: plumb-bob coefficients k1, k2, p1, p2[, k3]; empty for a rectified image.
        name: used in messages, and to distinguish the cameras of a drive; with topics, the name of the image topic.
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

    def resized(self, width: int, height: int) -> Camera:
        """The camera for its image at another size, pixels; the center of the first pixel is (0, 0) in both."""
        scale = np.array([width / self.size[0], height / self.size[1]])
        K = self.K.copy()
        K[:2] *= scale[:, None]
        K[:2, 2] += (scale - 1) / 2
        return replace(self, K=K, size=(width, height))


@dataclass(frozen=True, eq=False)
class Image:
    """One image.

    Attributes:
        pixels: (H, W, 3) uint8 RGB. camera: the camera that took it.
        time_offset: s, capture time relative to the stamp of its frame.
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
    """Pose of the LiDAR by another odometry. Only the relative motion between two such poses is used.

    Attributes:
        T_other_lidar: (4, 4) in the other odometry's own frame, which may drift without limit.
        covariance: (6, 6) as in `Registration`, of that pose, as the odometry reports it; None if it reports none.
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
    """IMU measurements around a scan, in the LiDAR's axes.

    Attributes:
        stamps: (K,) int64 ns, increasing.
        rates: (K, 3) rad/s. forces: (K, 3) m/s2, accelerometer readings: 9.8 upwards at rest; NaN where unknown.
        up: (3,) unit vector in the LiDAR's axes at the start; this direction becomes upwards in the odometry frame if
            the drive starts at rest. None: the odometry frame is the LiDAR's first pose, however it is tilted.
    """

    stamps: NDArray[np.int64]
    rates: Array
    forces: Array
    up: Up | None = (0.0, 0.0, 1.0)

    def __post_init__(self) -> None:
        shape = (len(self.stamps), 3)
        if self.rates.shape != shape or self.forces.shape != shape:
            raise ValueError(f"{shape[0]} samples of an IMU: rates {self.rates.shape}, forces {self.forces.shape}")

    def __len__(self) -> int:
        return len(self.stamps)

    def __getitem__(self, which: NDArray[np.bool_]) -> Inertial:
        """The samples for which `which` (K,) is true."""
        return replace(self, stamps=self.stamps[which], rates=self.rates[which], forces=self.forces[which])

    def then(self, later: Inertial) -> Inertial:
        """These samples, followed by those of `later`."""
        stamps = np.concatenate([self.stamps, later.stamps])
        rates, forces = np.concatenate([self.rates, later.rates]), np.concatenate([self.forces, later.forces])
        return Inertial(stamps, rates, forces, later.up)


@dataclass(frozen=True, eq=False)
class Fix:
    """A position measured by satellites (GNSS).

    Attributes:
        stamp: ns.
        geodetic: (3,) WGS84: latitude and longitude, degrees, and altitude above the ellipsoid, m.
        covariance: (3, 3) of the position, east, north, up, m^2.
        antenna: (3,) m, position of the antenna at that time in the LiDAR frame; of a keyframe: in the keyframe's.
    """

    stamp: int
    geodetic: Array
    covariance: Array
    antenna: Array

    def __post_init__(self) -> None:
        shapes = (self.geodetic.shape, self.covariance.shape, self.antenna.shape)
        if shapes != ((3,), (3, 3), (3,)) or not _is_on_earth(self.geodetic):
            raise ValueError(f"fix: latitude, longitude, altitude {self.geodetic.tolist()} are no place on Earth")
        if not np.abs(self.antenna).max() <= 1e3:
            raise ValueError(f"fix: its antenna is at {self.antenna.tolist()} m")
        C = self.covariance
        if not np.abs(C).max() <= 1e12 or not np.allclose(C, C.T) or np.linalg.eigvalsh(C)[0] <= 0:
            raise ValueError(f"fix: {C.ravel().tolist()} is no covariance")
        object.__setattr__(self, "stamp", int(self.stamp))  # see `Frame`

    def moved(self, T_new_old: Array) -> Fix:
        """The same fix with the antenna in another frame, by (4, 4) T_new_old."""
        return replace(self, antenna=T_new_old[:3, :3] @ self.antenna + T_new_old[:3, 3])


@dataclass(frozen=True, eq=False)
class Georeference:
    """Pose of a map on Earth.

    Attributes:
        origin: (3,) WGS84 of the local frame east, north, up: latitude and longitude, degrees, and altitude, m.
        T_enu_map: (4, 4).
    """

    origin: Array
    T_enu_map: Array

    def __post_init__(self) -> None:
        """Raises ValueError if the origin is not a place on Earth."""
        if not _is_on_earth(self.origin):
            raise ValueError(f"latitude, longitude, altitude {self.origin.tolist()} are no place on Earth")


def _is_on_earth(geodetic: Array) -> bool:
    return bool((np.abs(geodetic) <= (90, 360, 1e5)).all())  # NaN compares false


@dataclass(frozen=True, eq=False)
class Frame:
    """Data of all sensors at one time.

    Attributes:
        stamp: ns since the epoch of the source.
        points: (N, 4) float32 [x, y, z in m, intensity 0..1] in the LiDAR frame; N may be 0, NaN is allowed.
        time_offset: (N,) float32 s, capture time of each point relative to `stamp`; None where the source has none.
        images: zero, one or several images.
        index: position in its source (KITTI frame number, message count of a bag).
        problem: why the scan could not be read; `points` is then empty and the frame counts as failed, not as lost.
        guess: pose of the LiDAR in the middle of the sweep by another odometry; the search for the pose starts there.
        imu: samples after those of the previous frame, up to the last point; None if there is no IMU.
        fix: the latest fix before the stamp that no earlier frame had; None if there is none.
        dropped: number of scans since the previous frame that arrived, but were dropped for lack of time.
        stepped: whether less time may have passed since the previous frame than the stamps show: a clock was set.
        up: (3,) unit vector in the LiDAR's axes that points up by the LiDAR's mounting. It levels the odometry frame
            if a drive begins with this frame, and the input of the network; None: both have the LiDAR's axes, as when
            the mounting is not known.
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
    stepped: bool = False
    up: Up | None = None

    def __post_init__(self) -> None:
        if self.points.ndim != 2 or self.points.shape[1] != 4 or self.points.dtype != np.float32:
            found = f"{self.points.shape} {self.points.dtype}"
            raise ValueError(f"frame {self.index}: points are {found}, want (N, 4) float32")
        if self.time_offset is not None and self.time_offset.shape != self.points.shape[:1]:
            raise ValueError(f"frame {self.index}: {len(self.time_offset)} time offsets for {len(self.points)} points")
        first, last = self.time_range
        if not np.isfinite([first, last]).all():  # so is any other that is not finite
            raise ValueError(f"frame {self.index}: some time offsets are not finite")
        if last - first > _LONGEST_SWEEP:
            raise ValueError(f"frame {self.index}: its time offsets span {last - first:.3g}, want seconds of one sweep")
        if not isinstance(self.stamp, int | np.integer):
            raise ValueError(f"frame {self.index}: its stamp is {self.stamp!r}, want ns, an integer")
        if not isinstance(self.index, int | np.integer):
            raise ValueError(f"frame {self.index!r}: its index is no integer")
        # A map file would store NumPy integers as bytes, and unsigned ones have no negative differences.
        object.__setattr__(self, "stamp", int(self.stamp))
        object.__setattr__(self, "index", int(self.index))

    @property
    def time_range(self) -> tuple[float, float]:
        """First and last capture time of its points, s relative to `stamp`; zeros without times."""
        offset = self.time_offset
        return (0.0, 0.0) if offset is None or not len(offset) else (float(offset.min()), float(offset.max()))

    def later(self, seconds: float) -> Frame:
        """The same frame with a stamp `seconds` later; times of points and images are adapted, the points not moved."""
        if not seconds:
            return self
        offset = None if self.time_offset is None else self.time_offset - np.float32(seconds)
        images = tuple(replace(image, time_offset=image.time_offset - seconds) for image in self.images)
        return replace(self, stamp=self.stamp + round(seconds * 1e9), time_offset=offset, images=images)
