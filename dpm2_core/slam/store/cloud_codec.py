# SPDX-License-Identifier: Apache-2.0
"""Compact cloud format: centimeters and 8-bit intensities, differences between consecutive points, deflated.

A keyframe cloud of 18 thousand points takes 64 kB instead of 280: 3.6 bytes per point. Points keep their order, in
which neighbors in a LiDAR's beam follow each other, so that the differences are small.

The position of the LiDAR is stored with its cloud, unless it is the origin of the cloud's frame: rays start there.

Packed clouds come from a file or over a network: their size is limited before they are inflated.
"""

from __future__ import annotations

import struct
import zlib

import numpy as np
from numpy.typing import NDArray

from dpm2_core.errors import UsageError
from dpm2_core.frame import Array, Points

QUANTUM = 0.01
"""Step of the coordinates, m: half the noise of a good LiDAR, so that rounding (sigma 3 mm) is insignificant."""
COARSEST = 1.0
"""Largest step, m: no LiDAR's cloud reaches beyond 32 km."""
_MIN_QUANTUM = 1e-4
MAX_POINTS = 1 << 21
"""Maximum per cloud: eight sensors with 128 beams of 2,048 points together."""
_HEADER = struct.Struct("<If")  # points, quantum
_ORIGIN, _HAS_ORIGIN = struct.Struct("<3f"), 1 << 31  # after the header if this bit of the number of points is set
_BYTES_PER_POINT = 7  # of a point, inflated
_INT16_MAX = 32767


class CodecError(UsageError, ValueError):
    """Invalid bytes, or a cloud that cannot be packed; the text is one line."""


def pack_cloud(points: Points, origin: Array | None = None) -> bytes:
    """(M, 4) [x, y, z in m, intensity 0..1] as bytes; a cloud beyond 327 m is rounded more coarsely.

    Args:
        origin: (3,) m, position of the LiDAR in the same frame; None: at its origin.

    Raises:
        CodecError: values that are not finite, points or LiDAR beyond 32 km, or more than `MAX_POINTS`.
    """
    if not np.isfinite(points).all():
        raise CodecError("a cloud with coordinates that are not finite")
    reach = float(np.abs(points[:, :3]).max(initial=0.0))
    quantum = float(np.float32(max(QUANTUM, reach * 1.0001 / _INT16_MAX)))
    if quantum > COARSEST or len(points) > MAX_POINTS:
        raise CodecError(f"a cloud of {len(points)} points that reaches {reach:.0f} m: too large")
    seen_from = [0.0] * 3 if origin is None else origin.tolist()
    if not np.abs(seen_from).max() <= _INT16_MAX:
        raise CodecError(f"a cloud seen from {seen_from} m: too far away")
    steps = np.rint(points[:, :3].astype(np.float64) / quantum).astype(np.int64)
    # Differences wrap around at 16 bits, and unwrap when they are summed with 16 bits.
    delta = np.diff(steps, axis=0, prepend=0).astype("<i2")
    planes = np.ascontiguousarray(delta.T).view(np.uint8).reshape(3, -1, 2).transpose(0, 2, 1)  # low bytes, high bytes
    intensity = np.rint(np.clip(points[:, 3], 0, 1) * 255).astype(np.uint8)
    head = _HEADER.pack(len(points), quantum)
    if any(seen_from):
        head = _HEADER.pack(len(points) | _HAS_ORIGIN, quantum) + _ORIGIN.pack(*seen_from)
    return head + zlib.compress(planes.tobytes() + intensity.tobytes(), 4)


def unpack_cloud(data: bytes) -> Points:
    """(M, 4) float32 of `pack_cloud`, finite, a new array.

    Raises:
        CodecError: the bytes are not a packed cloud.
    """
    count, quantum, _, deflated = _split(data)
    if count > MAX_POINTS:
        raise CodecError(f"not a packed cloud: {count} points, at most {MAX_POINTS} are allowed")
    if not _MIN_QUANTUM <= quantum <= COARSEST:  # neither is NaN
        raise CodecError(f"not a packed cloud: a step of {quantum:g} m, {_MIN_QUANTUM:g} to {COARSEST:g} are allowed")
    raw = _inflate(deflated, _BYTES_PER_POINT * count, f"packed cloud of {count} points")
    planes = np.frombuffer(raw, np.uint8, 6 * count).reshape(3, 2, count)
    delta = np.ascontiguousarray(planes.transpose(0, 2, 1)).view("<i2")[..., 0]
    points = np.empty((count, 4), np.float32)
    points[:, :3] = np.cumsum(delta, axis=1, dtype=np.int16).T * np.float64(quantum)
    points[:, 3] = np.frombuffer(raw, np.uint8, count, 6 * count) * np.float32(1 / 255)
    return points


def origin_of(data: bytes) -> Array:
    """(3,) m, position of the LiDAR of a packed cloud, in the cloud's frame.

    Raises:
        CodecError: the bytes are not a packed cloud.
    """
    return _split(data)[2]


def _split(data: bytes) -> tuple[int, float, Array, bytes]:
    """Number of points, quantum, position of the LiDAR, and the deflated bytes."""
    if len(data) < _HEADER.size:
        raise CodecError(f"not a packed cloud: {len(data)} bytes")
    count, quantum = _HEADER.unpack_from(data)
    if not count & _HAS_ORIGIN:
        return count, quantum, np.zeros(3), data[_HEADER.size :]
    end = _HEADER.size + _ORIGIN.size
    if len(data) < end:
        raise CodecError(f"not a packed cloud: {len(data)} bytes")
    origin = np.array(_ORIGIN.unpack_from(data, _HEADER.size))
    if not np.abs(origin).max() <= _INT16_MAX:  # false for NaN
        raise CodecError(f"not a packed cloud: seen from {origin.tolist()} m")
    return count & ~_HAS_ORIGIN, quantum, origin, data[end:]


def pack_mask(mask: NDArray[np.bool_]) -> bytes:
    """(M,) booleans as bytes: one bit each, deflated."""
    return zlib.compress(np.packbits(mask).tobytes(), 6)


def unpack_mask(data: bytes, count: int) -> NDArray[np.bool_]:
    """(count,) booleans of `pack_mask`.

    Raises:
        CodecError: the bytes are not a mask of this size.
    """
    raw = _inflate(data, (count + 7) // 8, f"packed mask of {count} points")
    return np.unpackbits(np.frombuffer(raw, np.uint8))[:count].astype(bool)


def _inflate(data: bytes, size: int, what: str) -> bytes:
    """Exactly `size` bytes; at most one more is ever in memory."""
    inflater = zlib.decompressobj()
    try:
        raw = inflater.decompress(data, size + 1)
    except zlib.error as error:
        raise CodecError(f"not a {what}: {error}") from None
    if len(raw) > size:
        raise CodecError(f"not a {what}: more than its {size} bytes")
    if len(raw) < size or not inflater.eof or inflater.unused_data:
        raise CodecError(f"not a {what}: {len(raw)} of {size} bytes, cut off or followed by others")
    return raw
