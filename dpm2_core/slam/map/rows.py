# SPDX-License-Identifier: Apache-2.0
"""Between the nouns and the rows of a map file; see schema.py."""

from __future__ import annotations

import hashlib
import struct
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from dpm2_core.descriptors import Descriptors
from dpm2_core.errors import Dpm2Error
from dpm2_core.frame import Array, Keyframe
from dpm2_core.slam.map.cloud_store import Loan
from dpm2_core.slam.map.schema import row_crc

_DESCRIPTORS = struct.Struct("<IIB")  # number, channels, whether there are axes


@dataclass(frozen=True, eq=False)
class Edge:
    """A constraint of the pose graph, or a loop that was tried and refused.

    Attributes:
        kind: "odometry" or "loop".
        from_node, to_node: positions in the map.
        T_from_to: (4, 4). covariance: (6, 6) [rotation rad, translation m] of xi in T_from_to @ Exp(xi).
        ok: False for a refused loop; `reason` says why.
        confidence, rmse, method: of the registration.
    """

    kind: Literal["odometry", "loop"]
    from_node: int
    to_node: int
    T_from_to: Array
    covariance: Array
    ok: bool = True
    confidence: float = 1.0
    rmse: float = 0.0
    method: str = ""
    reason: str = ""


@dataclass(frozen=True, eq=False)
class Pruned:
    """A keyframe that is no longer there: `T_node_kf` (4, 4) from a node that is."""

    id: int
    robot: str
    session: int
    stamp: int
    node: int
    T_node_kf: Array


@dataclass(frozen=True)
class Session:
    """One drive into a map: number from 1, version of the program, start (ISO 8601), YAML, weights (`weights_id`)."""

    number: int
    program: str
    started: str
    config: str
    weights: str


def weights_id(path: Path) -> str:
    """What identifies weights: name and the first 16 digits of the file's SHA-256.

    Raises:
        Dpm2Error: the file cannot be read.
    """
    try:
        with path.open("rb") as file:
            return f"{path.stem} {hashlib.file_digest(file, 'sha256').hexdigest()[:16]}"
    except OSError as error:
        raise Dpm2Error(f"{path}: {error.strerror}") from None


def array_bytes(array: Array) -> bytes:
    """Little-endian float64, row by row."""
    return np.ascontiguousarray(array, "<f8").tobytes()


def bytes_array(data: bytes, side: int) -> Array:
    """(side, side) float64.

    Raises:
        ValueError: not so many bytes.
    """
    if len(data) != 8 * side * side:
        raise ValueError(f"{len(data)} bytes for a {side} by {side} matrix")
    return np.frombuffer(data, "<f8").reshape(side, side).astype(np.float64)


def pack_descriptors(d: Descriptors) -> bytes:
    """xyz float32, features float16, axes float32 if there are any."""
    head = _DESCRIPTORS.pack(len(d), d.features.shape[1], d.axis is not None)
    axis = b"" if d.axis is None else np.ascontiguousarray(d.axis, "<f4").tobytes()
    xyz, features = np.ascontiguousarray(d.xyz, "<f4"), np.ascontiguousarray(d.features, "<f2")
    return head + xyz.tobytes() + features.tobytes() + axis


def unpack_descriptors(data: bytes) -> Descriptors:
    """The inverse of `pack_descriptors`.

    Raises:
        ValueError: the bytes are no descriptors.
    """
    if len(data) < _DESCRIPTORS.size:
        raise ValueError("no descriptors: too few bytes")
    n, channels, axes = _DESCRIPTORS.unpack_from(data)
    end = np.cumsum([_DESCRIPTORS.size, 12 * n, 2 * n * channels, 8 * n * bool(axes)])
    if len(data) != end[-1]:
        raise ValueError(f"no descriptors: {len(data)} bytes for {n} of {channels}")
    xyz = np.frombuffer(data, "<f4", 3 * n, end[0]).reshape(n, 3).copy()
    features = np.frombuffer(data, "<f2", n * channels, end[1]).reshape(n, channels).copy()
    axis = np.frombuffer(data, "<f4", 2 * n, end[2]).reshape(n, 2).copy() if axes else None
    return Descriptors(xyz, features, axis)


def with_crc(*values: Any) -> tuple[Any, ...]:
    """A row and its checksum."""
    return (*values, row_crc(*values))


def keyframe_row(node: int, keyframe: Keyframe, session: int, loan: Loan | None) -> tuple[Any, ...]:
    """Of table `keyframes`."""
    k = keyframe
    lent = (None, None) if loan is None else (int(loan.lender), array_bytes(loan.T_kf_lender))
    return with_crc(node, k.id, k.robot, session, k.stamp, k.index, array_bytes(k.T_odom_kf), *lent)


def edge_row(number: int, e: Edge) -> tuple[Any, ...]:
    """Of table `edges`."""
    T, covariance = array_bytes(e.T_from_to), array_bytes(e.covariance)
    # SQLite has no NaN
    numbers = (int(e.ok), *(float(x) if x == x else float("inf") for x in (e.confidence, e.rmse)))
    return with_crc(number, e.kind, int(e.from_node), int(e.to_node), T, covariance, *numbers, e.method, e.reason)


def edge_of(row: tuple[Any, ...]) -> Edge:
    """Of a row of table `edges` without its checksum."""
    _, kind, from_node, to_node, T, covariance, ok, confidence, rmse, method, reason = row
    T, covariance = bytes_array(T, 4), bytes_array(covariance, 6)
    return Edge(kind, from_node, to_node, T, covariance, bool(ok), confidence, rmse, method, reason)


def pruned_row(p: Pruned) -> tuple[Any, ...]:
    """Of table `trail`."""
    return with_crc(p.id, p.robot, p.session, p.stamp, p.node, array_bytes(p.T_node_kf))


def pruned_of(row: tuple[Any, ...]) -> Pruned:
    """Of a row of table `trail` without its checksum."""
    id, robot, session, stamp, node, T_node_kf = row
    return Pruned(id, robot, session, stamp, node, bytes_array(T_node_kf, 4))
