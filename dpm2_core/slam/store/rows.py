# SPDX-License-Identifier: Apache-2.0
"""Conversion between objects and the rows of a map file; see schema.py.

A row may come from an untrusted source, with a correct checksum: all types, finiteness and ranges are checked.
"""

from __future__ import annotations

import struct
from collections.abc import Container
from dataclasses import dataclass
from itertools import accumulate
from typing import Any

import numpy as np

from dpm2_core.descriptors import Descriptors
from dpm2_core.estimates import Edge, Keyframe, Registration
from dpm2_core.frame import NO_POINTS, Array, Fix, Georeference
from dpm2_core.geometry import se3
from dpm2_core.slam.store.cloud_store import Loan
from dpm2_core.slam.store.schema import row_crc

FARTHEST = 1e7
"""m from the origin: beyond, float32 clouds are meters off. All poses of a map are nearer."""
MAX_ID = 2**31 - 1
"""Largest id of a keyframe, and of any other count: the next one still fits into all formats."""
_MAX_NAME_LENGTH = 255
_DESCRIPTORS_HEADER = struct.Struct("<IIB")  # number, channels, sum of the bits of the arrays that follow
_HAS_AXES, _HAS_UP, _HAS_SCALE, _HAS_STEPS = 1, 2, 4, 8  # there are always steps


@dataclass(frozen=True, eq=False)
class RemovedKeyframe:
    """A removed keyframe: `T_node_kf` (4, 4) is its pose relative to an existing node."""

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


def array_bytes(array: Array) -> bytes:
    """Little-endian float64, row by row."""
    return np.ascontiguousarray(array, "<f8").tobytes()


def bytes_array(data: Any, side: int) -> Array:
    """(side, side) float64.

    Raises:
        ValueError: wrong number of bytes, or no bytes.
    """
    if not isinstance(data, bytes) or len(data) != 8 * side * side:
        size = len(data) if isinstance(data, bytes) else "no"
        raise ValueError(f"{size} bytes for a {side} by {side} matrix")
    return np.frombuffer(data, "<f8").reshape(side, side).astype(np.float64)


def pose_of(data: Any) -> Array:
    """(4, 4) pose from its bytes.

    Raises:
        ValueError: not a finite rigid transform, or too far from the origin.
    """
    T = bytes_array(data, 4)
    if why := why_no_pose(T):
        raise ValueError(why)
    return T


def why_no_pose(T: Array) -> str:
    """Why (4, 4) cannot be the pose of a keyframe, in words; empty if it can."""
    if not se3.is_rigid(T):
        return "not a finite rigid transform"
    return f"farther than {FARTHEST / 1000:.0f} km from the origin" if np.abs(T[:3, 3]).max() > FARTHEST else ""


def pack_descriptors(d: Descriptors) -> bytes:
    """xyz float32, features int8, steps float32; axes, up, and a scale other than 1, float32, if available."""
    scale = None if d.scale == 1 else np.array([d.scale])
    others = {_HAS_AXES: d.axis, _HAS_UP: d.up, _HAS_SCALE: scale}
    parts = _HAS_STEPS + sum(bit for bit, part in others.items() if part is not None)
    head = _DESCRIPTORS_HEADER.pack(len(d), d.features.shape[1], parts)
    rest = [np.ascontiguousarray(part, "<f4") for part in (d.step, *others.values()) if part is not None]
    arrays = np.ascontiguousarray(d.xyz, "<f4"), np.ascontiguousarray(d.features, "i1"), *rest
    return head + b"".join(array.tobytes() for array in arrays)


def unpack_descriptors(data: bytes) -> Descriptors:
    """The inverse of `pack_descriptors`.

    Raises:
        ValueError: the bytes are not descriptors.
    """
    if len(data) < _DESCRIPTORS_HEADER.size:
        raise ValueError("no descriptors: too few bytes")
    n, channels, parts = _DESCRIPTORS_HEADER.unpack_from(data)
    has_axes, has_up, has_scale = (bool(parts & bit) for bit in (_HAS_AXES, _HAS_UP, _HAS_SCALE))
    sizes = 12 * n, n * channels, 4 * n, 8 * n * has_axes, 12 * has_up, 4 * has_scale
    end = list(accumulate(sizes, initial=_DESCRIPTORS_HEADER.size))
    if (
        len(data) != end[-1]
        or not n
        or not channels
        or not _HAS_STEPS <= parts <= _HAS_STEPS + _HAS_SCALE + _HAS_UP + _HAS_AXES
    ):
        raise ValueError(f"no descriptors: {len(data)} bytes for {n} of {channels}")
    xyz = np.frombuffer(data, "<f4", 3 * n, end[0]).reshape(n, 3).copy()
    features = np.frombuffer(data, "i1", n * channels, end[1]).reshape(n, channels).copy()
    step = np.frombuffer(data, "<f4", n, end[2]).copy()
    axis = np.frombuffer(data, "<f4", 2 * n, end[3]).reshape(n, 2).copy() if has_axes else None
    up = np.frombuffer(data, "<f4", 3, end[4]).copy() if has_up else None
    scale = float(np.frombuffer(data, "<f4", 1, end[5])[0]) if has_scale else 1.0
    if not 1e-2 < scale < 1e2:  # False for NaN
        raise ValueError(f"no descriptors: a scale of {scale:g}")
    if not all(np.isfinite(part).all() for part in (xyz, step, axis, up) if part is not None):
        raise ValueError("no descriptors: values that are not finite")
    if up is not None and not abs(np.linalg.norm(up) - 1) < 1e-3:
        raise ValueError("no descriptors: the up direction is not a unit vector")
    return Descriptors(xyz, features, step, axis, up, scale)


def with_crc(*values: Any) -> tuple[Any, ...]:
    """A row and its checksum."""
    return (*values, row_crc(*values))


def keyframe_row(node: int, keyframe: Keyframe, session: int, loan: Loan | None) -> tuple[Any, ...]:
    """A row of table `keyframes`; `session`: the one that is being written."""
    k = keyframe
    loan_columns = (None, None) if loan is None else (int(loan.lender), array_bytes(loan.T_kf_lender))
    return with_crc(
        node, k.id, k.robot, k.session or session, k.stamp, k.index, array_bytes(k.T_odom_kf), *loan_columns
    )


def keyframe_of(row: tuple[Any, ...]) -> tuple[int, Keyframe, Loan | None]:
    """Node, keyframe without cloud and descriptors, and its loan, from a row of `keyframes`.

    Raises:
        ValueError: an invalid value.
    """
    node, id, robot, session, stamp, frame, T, lender, T_lent = row
    _check_types((stamp, frame), robot)
    _check_counts(node, id, session)
    keyframe = Keyframe(id, stamp, frame, pose_of(T), NO_POINTS, None, robot, session=session)
    if lender is None:
        return node, keyframe, None
    _check_counts(lender)
    return node, keyframe, Loan(lender, pose_of(T_lent))


def edge_row(number: int, edge: Edge) -> tuple[Any, ...]:
    """A row of table `edges`."""
    r = edge.registration
    T, covariance = array_bytes(r.T_target_source), array_bytes(r.covariance)
    # SQLite has no NaN
    numbers = (int(r.ok), *(float(x) if x == x else float("inf") for x in (r.confidence, r.rmse)))
    ends = int(edge.from_node), int(edge.to_node)
    return with_crc(number, edge.kind, *ends, T, covariance, *numbers, r.method, r.reason)


def edge_of(row: tuple[Any, ...]) -> Edge:
    """The edge of a row of table `edges` without its checksum.

    Raises:
        ValueError: an invalid value; the nodes are not checked.
    """
    _, kind, from_node, to_node, T, covariance, ok, confidence, rmse, method, reason = row
    _check_types((from_node, to_node, ok), kind)
    if kind not in ("odometry", "loop") or not all(isinstance(text, str) for text in (method, reason)):
        raise ValueError(f"{kind!r} is not a kind of edge")
    if not all(isinstance(x, float) and x == x for x in (confidence, rmse)):
        raise ValueError("its confidence or rmse is no number")
    try:
        T, covariance = pose_of(T), bytes_array(covariance, 6)
        if not np.isfinite(covariance).all() or (ok and not se3.is_covariance(covariance)):
            raise ValueError
    except ValueError:
        raise ValueError("not a finite rigid transform with a positive covariance") from None
    return Edge(kind, from_node, to_node, Registration(T, covariance, confidence, rmse, method, bool(ok), reason))


def check_ends(edge: Edge, nodes: Container[int]) -> None:
    """Raises ValueError unless both ends of an edge are among the nodes."""
    if edge.from_node not in nodes or edge.to_node not in nodes or edge.from_node == edge.to_node:
        raise ValueError(f"leads from {edge.from_node} to {edge.to_node}, which do not both exist")


def removed_row(p: RemovedKeyframe) -> tuple[Any, ...]:
    """A row of table `trail`."""
    return with_crc(p.id, p.robot, p.session, p.stamp, p.node, array_bytes(p.T_node_kf))


def removed_of(row: tuple[Any, ...]) -> RemovedKeyframe:
    """The removed keyframe of a row of table `trail` without its checksum.

    Raises:
        ValueError: an invalid value; the node is not checked.
    """
    id, robot, session, stamp, node, T_node_kf = row
    _check_types((stamp, node), robot)
    _check_counts(id, session)
    return RemovedKeyframe(id, robot, session, stamp, node, pose_of(T_node_kf))


def fix_row(node: int, fix: Fix) -> tuple[Any, ...]:
    """A row of table `fixes`."""
    return with_crc(node, fix.stamp, *fix.geodetic.tolist(), array_bytes(fix.covariance), *fix.antenna.tolist())


def fix_of(row: tuple[Any, ...]) -> tuple[int, Fix]:
    """Node and fix from a row of table `fixes`.

    Raises:
        ValueError: an invalid value; the node is not checked.
    """
    node, stamp, *place, covariance, x, y, z = row
    _check_types((node, stamp))
    return node, Fix(stamp, _numbers(place), bytes_array(covariance, 3), _numbers([x, y, z]))


def georeference_row(georeference: Georeference) -> tuple[Any, ...]:
    """A row of table `georeference`."""
    return with_crc(0, *georeference.origin.tolist(), array_bytes(georeference.T_enu_map))


def georeference_of(row: tuple[Any, ...]) -> Georeference:
    """The georeference of a row of table `georeference`.

    Raises:
        ValueError: an invalid value.
    """
    _, *place, T = row
    return Georeference(_numbers(place), pose_of(T))


def _numbers(values: list[Any]) -> Array:
    """The values as an array. Raises ValueError unless they are floating-point numbers."""
    if not all(isinstance(value, float) for value in values):
        raise ValueError("not a number where one is expected")
    return np.array(values)


def session_of(row: tuple[Any, ...]) -> Session:
    """The session of a row of table `sessions`.

    Raises:
        ValueError: an invalid value.
    """
    number, *texts = row
    _check_counts(number)
    if not all(isinstance(text, str) for text in texts):
        raise ValueError("a session that is not in words")
    return Session(number, *texts)


def _check_types(numbers: tuple[Any, ...], name: Any = "") -> None:
    """Raises ValueError unless they are integers and a name of limited length: SQLite columns accept any type."""
    if not all(isinstance(number, int) for number in numbers):
        raise ValueError("not a whole number where one is expected")
    if not isinstance(name, str) or len(name) > _MAX_NAME_LENGTH:
        raise ValueError(f"no name, or one of more than {_MAX_NAME_LENGTH} characters")


def _check_counts(*numbers: Any) -> None:
    """Raises ValueError unless they are whole numbers from 0 to `MAX_ID`."""
    _check_types(numbers)
    if not all(0 <= number <= MAX_ID for number in numbers):
        raise ValueError(f"a number that is not from 0 to {MAX_ID}")
