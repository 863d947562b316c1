# SPDX-License-Identifier: Apache-2.0
"""ROS sensor messages to numpy and back, duck-typed: for rclpy (array.array data) and rosbags (numpy data) alike.

Nothing here imports ROS. Message fields are those of sensor_msgs; `transforms.TransformTree` reads tf2_msgs likewise.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Collection, Mapping
from types import SimpleNamespace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dpm2_core.data.point_times import TimeUnit, time_field_of, time_offsets
from dpm2_core.errors import UsageError
from dpm2_core.frame import Points

# sensor_msgs/PointField datatype to numpy, without byte order.
_POINT_TYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}
_INTENSITY_NAMES = ("intensity", "intensities", "i", "reflectivity", "reflectance", "signal")
_XYZ = ("x", "y", "z")
_LARGEST_POINT = 1 << 16


class MessageError(UsageError):
    """A message that cannot be decoded; one line that names the field or encoding."""


def stamp_ns(header: Any) -> int:
    """std_msgs/Header to ns since the epoch."""
    return int(header.stamp.sec) * 1_000_000_000 + int(header.stamp.nanosec)


def rigid_parts(transform: Any) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """geometry_msgs/Transform or Pose to its quaternion (4,), x, y, z, w, and translation (3,).

    Raises:
        UsageError: the quaternion is zero or anything is not finite.
    """
    t = transform.translation if hasattr(transform, "translation") else transform.position
    q = transform.rotation if hasattr(transform, "rotation") else transform.orientation
    quaternion, translation = np.array([q.x, q.y, q.z, q.w]), np.array([t.x, t.y, t.z])
    if not (np.linalg.norm(quaternion) > 1e-6 and np.isfinite(quaternion).all() and np.isfinite(translation).all()):
        raise UsageError(f"no rigid transform: rotation {quaternion.tolist()}, translation {translation.tolist()}")
    return quaternion, translation


STAMP_END = 2**31 * 1_000_000_000
"""Upper bound of a header's stamp, ns: in 2038."""


def serialized_stamp(data: bytes, time: int) -> int:
    """Stamp in ns of a serialized message that begins with a header, without decoding the rest; `time` if it is 0."""
    if len(data) < 12:
        return time
    sec, nanosec = struct.unpack_from(_stamp_format(data), data, 4)
    return sec * 1_000_000_000 + nanosec or time


def serialized_frame(data: bytes) -> str:
    """frame_id of a serialized message that begins with a header, without decoding the rest; empty if it has none."""
    if len(data) < 16:
        return ""
    (length,) = struct.unpack_from("<I" if data[1] & 1 else ">I", data, 12)
    return bytes(data[16 : 16 + length]).rstrip(b"\0").decode(errors="replace")


def restamped(data: bytes, stamp: int) -> bytes:
    """A serialized message that begins with a header, with its stamp replaced by `stamp`, ns."""
    return data[:4] + struct.pack(_stamp_format(data), *divmod(stamp, 1_000_000_000)) + data[12:]


def _stamp_format(data: bytes) -> str:
    """Struct format of the stamp, which follows the 4 bytes with the byte order."""
    return "<iI" if data[1] & 1 else ">iI"


def cloud_view(msg: Any, names: Collection[str]) -> NDArray[np.void]:
    """The points of a sensor_msgs/PointCloud2 as an (N,) structured array, N = height * width.

    A view of the message's data unless rows are padded. A field with count > 1 becomes a sub-array.

    Args:
        msg: in any byte order, field order and padding.
        names: the requested fields. Unknown ones are left out.

    Raises:
        MessageError: the data is shorter than declared, or the layout is inconsistent.
    """
    step, width, height = int(msg.point_step), int(msg.width), int(msg.height)
    if step > _LARGEST_POINT:
        raise MessageError(f"PointCloud2: point_step {step}; at most {_LARGEST_POINT} bytes are read")
    order = ">" if msg.is_bigendian else "<"
    layout: dict[str, tuple[Any, int]] = {}
    for field in msg.fields:
        if field.name not in names:
            continue
        if field.datatype not in _POINT_TYPES:
            raise MessageError(f"PointCloud2 field {field.name}: unknown datatype {field.datatype}")
        scalar = np.dtype(order + _POINT_TYPES[field.datatype])
        count = max(1, int(field.count))  # some drivers leave count at 0
        if field.offset + count * scalar.itemsize > step:
            raise MessageError(f"PointCloud2 field {field.name} ends beyond point_step {step}")
        layout[field.name] = ((scalar, (count,)) if count > 1 else scalar, int(field.offset))
    dtype = np.dtype(
        {
            "names": list(layout),
            "formats": [kind for kind, _ in layout.values()],
            "offsets": [offset for _, offset in layout.values()],
            "itemsize": step,
        }
    )
    if width * height == 0:
        return np.empty(0, dtype)
    row = int(msg.row_step) if height > 1 else width * step  # drivers that make one row often leave row_step at 0
    if row < width * step:
        raise MessageError(f"PointCloud2: row_step {row} is less than width {width} x point_step {step}")
    need, have = (height - 1) * row + width * step, len(msg.data)
    if have < need:
        raise MessageError(f"PointCloud2: {have} bytes of data, {need} declared ({height} x {width} points of {step})")
    return np.ndarray((height, width), dtype, memoryview(msg.data), strides=(row, step)).reshape(-1)


def check_cloud(msg: Any) -> None:
    """Raise MessageError unless a sensor_msgs/PointCloud2 has readable points; takes microseconds."""
    available = [field.name for field in msg.fields]
    if missing := [name for name in _XYZ if name not in available]:
        named = ", ".join(available[:20]) or "none"
        raise MessageError(f"PointCloud2 has no field {', '.join(missing)}; fields: {named[:200]}")
    cloud_view(msg, _XYZ)


def decode_points(
    msg: Any, time_field: str | None = None, time_unit: TimeUnit = "auto", intensity_max: float | None = None
) -> tuple[Points, Points | None]:
    """sensor_msgs/PointCloud2 to points and their capture times. Invalid points keep their index, as NaN or zeros.

    Intensity is scaled to 0..1 as in `scale_intensity`, and is 0 if the cloud has none.

    The time field is found by its usual names. Its unit is the one that the name ends in (time_offset_ns), else the one
    in which the points span 2 ms to 2 s (integers: us or ns). Values beyond 2 s are absolute: they are made relative to
    `msg.header.stamp`, or to the earliest point if they are of another clock.

    Args:
        msg: the message.
        time_field: field with the time of each point; None looks for a usual name, "" takes none.
        time_unit: unit of that field.
        intensity_max: intensity that is scaled to 1, as in `scale_intensity`.

    Returns:
        points: (N, 4) float32 [x, y, z in m, intensity 0..1]; a view of the message where its layout allows.
        time_offset: (N,) float32 s relative to the header's stamp; None without the field or if it is constant.

    Raises:
        MessageError: x, y or z, or the requested time field, is missing (the message lists the available fields), or
            `cloud_view` rejected the layout.
    """
    check_cloud(msg)
    available = [field.name for field in msg.fields]
    if time_field and time_field not in available:
        raise MessageError(f"PointCloud2 has no time field {time_field}; fields: {', '.join(available)}")
    intensity = _find_field(available, _INTENSITY_NAMES)
    time_name, unit = time_field_of(available) if time_field is None else (time_field, "auto")
    if time_unit == "auto":
        time_unit = unit
    view = cloud_view(msg, [name for name in (*_XYZ, intensity, time_name) if name])
    points = _points(view, intensity, intensity_max)
    if not time_name:
        return points, None
    return points, time_offsets(_first_column(view[time_name]), returned(points), stamp_ns(msg.header), time_unit)


def why_untimed(msg: Any) -> str:
    """Reason, in words, why `decode_points` found no times in a PointCloud2."""
    time, _ = time_field_of([field.name for field in msg.fields])
    if time is None:
        return "no time field"
    values = _first_column(cloud_view(msg, [time])[time])
    known = values[np.isfinite(values) & (values != 0)]
    constant = bool((known == known[:1]).all())  # also true if there are none
    return f"all points have the same {time}" if constant else f"{time} is no possible time of most points"


def _find_field(available: list[str], names: tuple[str, ...]) -> str | None:
    return next((field for name in names for field in available if field.lower() == name), None)


def _first_column(column: NDArray[Any]) -> NDArray[Any]:
    """(N,) of a field that may have count > 1."""
    return column if column.ndim == 1 else column[:, 0]


def _points(view: NDArray[np.void], intensity: str | None, intensity_max: float | None) -> Points:
    requested = ["x", "y", "z", *([intensity] if intensity else [])]
    fields = [view.dtype.fields[name] for name in requested] if view.dtype.fields else []
    packed = [(np.dtype("<f4"), 4 * i) for i in range(4)]
    if [field[:2] for field in fields] == packed and view.dtype.itemsize == 16 and view.flags.c_contiguous:
        points = view.view("<f4").reshape(-1, 4)
    else:
        points = np.zeros((len(view), 4), np.float32)
        with np.errstate(over="ignore"):  # a double beyond float32 becomes inf, and an invalid point
            for i, name in enumerate(requested):
                points[:, i] = _first_column(view[name])
    if not intensity:
        return points
    return scale_intensity(points, intensity_max, integer=view.dtype[intensity].base.kind != "f")


def scale_intensity(points: Points, intensity_max: float | None, integer: bool = False) -> Points:
    """(N, 4) points with intensity in 0..1: the same array if it is so already, else a copy. Unknown (NaN) becomes 0.

    Args:
        intensity_max: value that is scaled to 1; None takes the first of 1 (unless `integer`), 255 and 65535 that is
            not below the largest value here.
        integer: whether the values are integers: then 1 is not taken for the largest possible value.
    """
    value = points[:, 3]
    if not len(points) or (intensity_max is None and not integer and value.min() >= 0 and value.max() <= 1):
        return points  # a NaN would compare false, so there is none
    value = np.nan_to_num(value, nan=0.0, posinf=0.0, neginf=0.0)
    limits = (255.0,) if integer else (1.0, 255.0)
    scale = intensity_max or next((limit for limit in limits if value.max() <= limit), 65535.0)
    points = points.copy()
    points[:, 3] = np.clip(value / np.float32(scale), 0, 1)
    return points


def returned(points: Points) -> NDArray[np.bool_]:
    """(N,) which of (N, 4) points the LiDAR has measured: drivers put NaN or zeros for a missing return."""
    return np.asarray(np.isfinite(points[:, :3]).all(1) & points[:, :3].any(1))


def cloud_fields(columns: Mapping[str, NDArray[Any]], point_field: Callable[..., Any]) -> dict[str, Any]:
    """Everything but the header of a sensor_msgs/PointCloud2, as keyword arguments for its constructor.

    Args:
        columns: field name to (N,) or (N, count) array, in order, of a type that PointField supports.
        point_field: the PointField class, called with name, offset, datatype and count.

    Returns:
        height, width, fields, is_bigendian, point_step, row_step, data ((N * point_step,) uint8), is_dense (False).
    """
    parts = {name: np.asarray(column) for name, column in columns.items()}
    dtype = np.dtype([(name, part.dtype.newbyteorder("<"), part.shape[1:]) for name, part in parts.items()])
    cloud = np.empty(len(next(iter(parts.values()))), dtype)
    codes = {kind: code for code, kind in _POINT_TYPES.items()}
    fields = []
    for name, part in parts.items():
        cloud[name] = part
        count, offset = int(np.prod(part.shape[1:])), dtype.fields[name][1]  # type: ignore[index]
        fields.append(point_field(name=name, offset=offset, datatype=codes[part.dtype.str[1:]], count=count))
    return {
        "height": 1,
        "width": len(cloud),
        "fields": fields,
        "is_bigendian": False,
        "point_step": dtype.itemsize,
        "row_step": dtype.itemsize * len(cloud),
        "data": cloud.view(np.uint8) if len(cloud) else np.empty(0, np.uint8),
        "is_dense": False,
    }


def point_cloud(columns: Mapping[str, NDArray[Any]], stamp: int, frame: str = "") -> Any:
    """An object like a sensor_msgs/PointCloud2 with a stamp, ns: other formats are then decoded like messages."""
    time = SimpleNamespace(sec=stamp // 10**9, nanosec=stamp % 10**9)
    header = SimpleNamespace(stamp=time, frame_id=frame)
    return SimpleNamespace(header=header, **cloud_fields(columns, SimpleNamespace))


def point_columns(points: Points) -> dict[str, Points]:
    """(N, 4) points as the x, y, z, intensity columns that `cloud_fields` takes."""
    return {name: points[:, i] for i, name in enumerate(("x", "y", "z", "intensity"))}
