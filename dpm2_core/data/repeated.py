# SPDX-License-Identifier: Apache-2.0
"""Detects a driver or relay that repeats a scan, a part of it or an image with a new stamp. It looks like a halt.

Clouds are copied where needed: a caller may reuse its arrays.
"""

from __future__ import annotations

from dataclasses import replace
from zlib import crc32

import numpy as np
from numba import int64, types, uint32
from numpy.typing import NDArray

from dpm2_core.data.messages import returned
from dpm2_core.frame import Array, Frame, Guess, Image, Points
from dpm2_core.geometry import se3
from dpm2_core.geometry.compiled import compiled

REPEATED = "the same cloud as before: the LiDAR or its driver repeats itself"
PART_PROBLEM = "a part of the cloud is the same as before: one of several LiDARs in one cloud repeats itself"
_MIN_SPEED = 1.5  # m/s: slower robots may stop at once and, in simulations without noise, measure the same cloud again
_MIN_TRANSLATION, _MIN_ROTATION = 0.3, 3.0  # m, degrees
# m, clouds: a robot within that distance is at rest; if so many clouds differ, there is noise.
_MAX_REST_MOTION, _MIN_REST_CLOUDS = 0.02, 30
# Smallest share of points that repeat, and of points that do not; coarse noise leaves at most 0.2 unchanged.
_MIN_SHARE = 0.3
_MIN_POINTS = 100  # points that are compared
_CHECKSUM_POINTS = 8192  # points in the checksum: noise changes any sample of them
_ROW_STEP = 8  # every 8th row of an image is compared: noise changes every row
_CloudRecord = tuple[int, Guess | None, Array]  # checksum; guess when the cloud was new; rotation R (3, 3) since then


class RepeatedCloud:
    """Stores the last registered cloud, and the motion of the sensor since that cloud was new."""

    def __init__(self) -> None:
        self._registered: _CloudRecord | None = None
        self._current: _CloudRecord | None = None
        self._is_repeated = False
        self._T_rest, self._n_different = np.eye(4), 0  # pose at rest, and number of clouds that differed there
        self._has_noise = False  # then two equal clouds are always a repetition, also of a robot at rest

    def repeats(self, frame: Frame, speed: float, turn: Array | None = None) -> bool:
        """Whether a cloud is bit-identical to the registered one although the sensor should have moved since.

        Args:
            speed: m/s, from the motion before. A repetition that was taken for a halt has ended that motion; the
                frame's guess and `turn` are relative to the time when the cloud was new.
            turn: R_before_now (3, 3) since the last registered frame, from an IMU; None if the IMU gives none.
        """
        registered, checksum = self._registered, _checksum(frame.points)
        if not len(frame.points) or registered is None or registered[0] != checksum:
            self._current, self._is_repeated = (checksum, frame.guess, np.eye(3)), False
            return False
        _, guess, R = registered
        R = R if turn is None else R @ turn
        self._current, motions = (checksum, guess, R), [se3.make(R, np.zeros(3))]
        if guess is not None and frame.guess is not None:
            motions.append(se3.inverse(guess.T_other_lidar) @ frame.guess.T_other_lidar)
        self._is_repeated |= (
            self._has_noise
            or speed > _MIN_SPEED
            or any((np.array(se3.magnitude(T)) > (_MIN_TRANSLATION, _MIN_ROTATION)).any() for T in motions)
        )
        return self._is_repeated

    def keep(self, T_odom_lidar: Array, same: float) -> None:
        """Keep the current cloud, registered at a pose (4, 4); `same`: see `RepeatedPart`."""
        self._registered = self._current
        is_at_rest = np.linalg.norm(T_odom_lidar[:3, 3] - self._T_rest[:3, 3]) < _MAX_REST_MOTION
        if not is_at_rest or same > _MIN_SHARE:  # in a simulation without noise all static points repeat
            self._T_rest, self._n_different = T_odom_lidar, 0
        self._n_different += 1
        self._has_noise |= self._n_different > _MIN_REST_CLOUDS


class RepeatedPart:
    """Stores the last cloud.

    Attributes:
        same: share of the points of the last cloud that are bit-identical to points of the cloud before.
    """

    def __init__(self) -> None:
        self.same = 0.0
        self._buffer, self._count = np.zeros((0, 4), np.float32), 0
        self._hashes = np.zeros(0, np.uint64)

    def new(self, frame: Frame) -> Frame:
        """A frame without the points that are bit-identical to points of the frame before, if these are many.

        As many points must be new: in a simulation without noise, nearly all points repeat for a robot at rest.
        """
        last_hashes, self._hashes = self._hashes, _point_hashes(_sample(frame.points))
        self.same = float(np.isin(self._hashes, last_hashes).mean()) if len(self._hashes) >= _MIN_POINTS else 0.0
        partly = _MIN_SHARE < self.same < 1 - _MIN_SHARE
        new = ~np.isin(_point_hashes(frame.points), _point_hashes(self._buffer[: self._count])) if partly else None
        self._store(frame.points)
        if new is None:
            return frame
        offset = None if frame.time_offset is None else frame.time_offset[new]
        return replace(frame, points=frame.points[new], time_offset=offset)

    def _store(self, points: Points) -> None:
        """Copy into one buffer for all clouds: new memory for each would take longer than everything else."""
        self._count = len(points)
        if len(self._buffer) < self._count:
            self._buffer = np.empty((self._count, 4), np.float32)
        self._buffer[: self._count] = points


class RepeatedImages:
    """Stores the last image of each camera, its time, and the cloud in the same frame."""

    def __init__(self) -> None:
        self._last: dict[str, tuple[int, int, int]] = {}  # checksums of image and cloud; time, ns

    def new(self, frame: Frame) -> tuple[Image, ...]:
        """The images of a frame that do not repeat the images before under a new stamp.

        One image may be the nearest to two clouds. In a simulation without noise, a robot at rest sees the same image
        again, but then its cloud is the same too.
        """
        if not frame.images:
            return ()
        cloud, found = _checksum(frame.points), []
        for image in frame.images:
            now = crc32(image.pixels[::_ROW_STEP].tobytes()), cloud, frame.stamp + round(image.time_offset * 1e9)
            before = self._last.get(image.camera.name)
            if before is None or before[0] != now[0] or before[1] == now[1] or before[2] == now[2]:
                self._last[image.camera.name] = now
                found.append(image)
        return tuple(found)


def _checksum(points: Points) -> int:
    return crc32(points[:: max(1, len(points) // _CHECKSUM_POINTS)].tobytes())


def _sample(points: Points) -> Points:
    """About one in 64 of the measured points, selected by the bits of x: the same ones in every cloud."""
    sample = points[_sample_indices(np.ascontiguousarray(points).view(np.uint32))]
    return sample[returned(sample)]


@compiled(int64[::1](types.Array(uint32, 2, "C", readonly=True)))
def _sample_indices(bits: NDArray[np.uint32]) -> NDArray[np.int64]:
    """Indices of points for `_sample`, from their bits (N, 4)."""
    indices, count = np.empty(len(bits), np.int64), 0
    for i in range(len(bits)):
        if np.uint32(bits[i, 0] * np.uint32(2654435761)) < 2**26:
            indices[count] = i
            count += 1
    return indices[:count]


def _point_hashes(points: Points) -> NDArray[np.uint64]:
    """(N,) a hash of the bits of each position."""
    x, y, z = np.ascontiguousarray(points[:, :3].T).view(np.uint32).astype(np.uint64)
    return x * np.uint64(0x9E3779B97F4A7C15) ^ y * np.uint64(0xC2B2AE3D27D4EB4F) ^ z * np.uint64(0x165667B19E3779F9)
