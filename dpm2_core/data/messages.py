# SPDX-License-Identifier: Apache-2.0
"""ROS sensor messages to numpy and back, by duck typing: rclpy's (array.array data) and rosbags' (numpy data) alike.

Nothing here imports ROS. Message fields are those of sensor_msgs; `transforms.TransformTree` reads tf2_msgs likewise.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from typing import Any, Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from dpm2_core.data.compressed import decode_compressed
from dpm2_core.errors import UsageError
from dpm2_core.frame import Array, Camera, Points

TimeUnit = Literal["auto", "s", "ms", "us", "ns"]

# sensor_msgs/PointField datatype to numpy, without byte order.
_POINT_TYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}
_INTENSITY_NAMES = ("intensity", "intensities", "i", "reflectivity", "reflectance", "signal")
_TIME_NAMES = (
    "t",
    "time",
    "timestamp",
    "time_stamp",
    "offset_time",
    "time_offset",
    "timeoffset",
    "stamp",
    "timestamps",
)
_XYZ = ("x", "y", "z")
_SECONDS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
# No sweep is longer, no useful one a thousand times shorter: so exactly one unit puts the span of a scan in this range.
_LONGEST_SCAN = 2.0

# Encoding to (numpy type, channels, OpenCV conversion to RGB). 8UC3 and 8UC4 are BGR(A), as in cv_bridge.
_IMAGE_ENCODINGS: dict[str, tuple[str, int, int | None]] = {
    "rgb8": ("u1", 3, None),
    "bgr8": ("u1", 3, cv2.COLOR_BGR2RGB),
    "8uc3": ("u1", 3, cv2.COLOR_BGR2RGB),
    "rgba8": ("u1", 4, cv2.COLOR_RGBA2RGB),
    "bgra8": ("u1", 4, cv2.COLOR_BGRA2RGB),
    "8uc4": ("u1", 4, cv2.COLOR_BGRA2RGB),
    "mono8": ("u1", 1, cv2.COLOR_GRAY2RGB),
    "8uc1": ("u1", 1, cv2.COLOR_GRAY2RGB),
    "mono16": ("u2", 1, cv2.COLOR_GRAY2RGB),
    "16uc1": ("u2", 1, cv2.COLOR_GRAY2RGB),
    # OpenCV names a Bayer pattern by its second row, ROS by its first.
    "bayer_rggb8": ("u1", 1, cv2.COLOR_BayerBG2RGB),
    "bayer_bggr8": ("u1", 1, cv2.COLOR_BayerRG2RGB),
    "bayer_gbrg8": ("u1", 1, cv2.COLOR_BayerGR2RGB),
    "bayer_grbg8": ("u1", 1, cv2.COLOR_BayerGB2RGB),
    "bayer_rggb16": ("u2", 1, cv2.COLOR_BayerBG2RGB),
    "bayer_bggr16": ("u2", 1, cv2.COLOR_BayerRG2RGB),
    "bayer_gbrg16": ("u2", 1, cv2.COLOR_BayerGR2RGB),
    "bayer_grbg16": ("u2", 1, cv2.COLOR_BayerGB2RGB),
}


_LARGEST_POINT = 1 << 16
_DISTORTIONS = (0, 4, 5, 8, 12, 14)  # numbers of coefficients that OpenCV knows
_WIDEST_IMAGE = 1 << 15


class MessageError(UsageError):
    """A message that cannot be understood, in one line naming the field or encoding."""


def stamp_ns(header: Any) -> int:
    """std_msgs/Header to ns since the epoch."""
    return int(header.stamp.sec) * 1_000_000_000 + int(header.stamp.nanosec)


def cloud_view(msg: Any, names: Collection[str] | None = None) -> NDArray[np.void]:
    """The points of a sensor_msgs/PointCloud2 as an (N,) structured array, N = height * width.

    A view of the message's data unless rows are padded. A field with count > 1 becomes a sub-array.

    Args:
        msg: any byte order, field order, padding.
        names: the fields wanted; all when None. Unknown ones are left out.

    Raises:
        MessageError: the data is shorter than declared, or the layout contradicts itself.
    """
    step, width, height = int(msg.point_step), int(msg.width), int(msg.height)
    if step > _LARGEST_POINT:
        raise MessageError(f"PointCloud2: point_step {step}; at most {_LARGEST_POINT} bytes are read")
    order = ">" if msg.is_bigendian else "<"
    layout: dict[str, tuple[Any, int]] = {}
    for field in msg.fields:
        if names is not None and field.name not in names:
            continue
        if field.datatype not in _POINT_TYPES:
            raise MessageError(f"PointCloud2 field {field.name}: unknown datatype {field.datatype}")
        one = np.dtype(order + _POINT_TYPES[field.datatype])
        count = max(1, int(field.count))  # some drivers leave count at 0
        if field.offset + count * one.itemsize > step:
            raise MessageError(f"PointCloud2 field {field.name} ends beyond point_step {step}")
        layout[field.name] = ((one, (count,)) if count > 1 else one, int(field.offset))
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
    """Raises MessageError unless a sensor_msgs/PointCloud2 has points that can be read; takes microseconds."""
    available = [field.name for field in msg.fields]
    if missing := [name for name in _XYZ if name not in available]:
        named = ", ".join(available[:20]) or "none"
        raise MessageError(f"PointCloud2 has no field {', '.join(missing)}; fields: {named[:200]}")
    cloud_view(msg, _XYZ)


def decode_points(
    msg: Any, time_field: str | None = None, time_unit: TimeUnit = "auto", intensity_max: float | None = None
) -> tuple[Points, Points | None]:
    """sensor_msgs/PointCloud2 to points and their capture times. Invalid points stay where they are, as NaN or zeros.

    Intensity becomes 0..1 as `scale_intensity` says, and is 0 where the cloud has none.

    Time is looked for under its usual names. The unit is the one in which the points span 2 ms to 2 s (integers: us
    or ns). Values beyond 2 s are absolute and become relative to `msg.header.stamp`, or to the earliest point if that
    is another clock's.

    Args:
        msg: the message.
        time_field: field with the time of each point; None looks for a usual name, "" takes none.
        time_unit: unit of that field.
        intensity_max: intensity that becomes 1, as in `scale_intensity`.

    Returns:
        points: (N, 4) float32 [x, y, z in m, intensity 0..1]; a view of the message where its layout allows.
        time_offset: (N,) float32 s relative to the header's stamp; None without the field or where it is constant.

    Raises:
        MessageError: x, y or z, or the time field asked for, is missing (the message lists the fields there are), or
            `cloud_view` refused the layout.
    """
    check_cloud(msg)
    available = [field.name for field in msg.fields]
    if time_field and time_field not in available:
        raise MessageError(f"PointCloud2 has no time field {time_field}; fields: {', '.join(available)}")
    intensity = _usual(available, _INTENSITY_NAMES)
    time = _usual(available, _TIME_NAMES) if time_field is None else time_field
    view = cloud_view(msg, [name for name in (*_XYZ, intensity, time) if name])
    points = _points(view, intensity, intensity_max)
    return points, _time_offset(view[time], points, stamp_ns(msg.header), time_unit) if time else None


def _usual(available: list[str], names: tuple[str, ...]) -> str | None:
    return next((field for name in names for field in available if field.lower() == name), None)


def _first(column: NDArray[Any]) -> NDArray[Any]:
    """(N,) of a field that may have count > 1."""
    return column if column.ndim == 1 else column[:, 0]


def _points(view: NDArray[np.void], intensity: str | None, intensity_max: float | None) -> Points:
    wanted = ["x", "y", "z", *([intensity] if intensity else [])]
    fields = [view.dtype.fields[name] for name in wanted] if view.dtype.fields else []
    packed = [(np.dtype("<f4"), 4 * i) for i in range(4)]
    if [field[:2] for field in fields] == packed and view.dtype.itemsize == 16 and view.flags.c_contiguous:
        points = view.view("<f4").reshape(-1, 4)
    else:
        points = np.zeros((len(view), 4), np.float32)
        with np.errstate(over="ignore"):  # a double beyond float32 becomes inf, and an invalid point
            for i, name in enumerate(wanted):
                points[:, i] = _first(view[name])
    if not intensity:
        return points
    return scale_intensity(points, intensity_max, integer=view.dtype[intensity].base.kind != "f")


def scale_intensity(points: Points, intensity_max: float | None = None, integer: bool = False) -> Points:
    """(N, 4) points with intensity in 0..1: the same array if it is already, else a copy. Unknown (NaN) becomes 0.

    Args:
        intensity_max: value that becomes 1; None takes the first of 1 (unless `integer`), 255 and 65535 that is not
            below the largest value here.
        integer: whether 1 is the least value above 0.
    """
    value = points[:, 3]
    if not len(points) or (intensity_max is None and not integer and value.min() >= 0 and value.max() <= 1):
        return points  # as NaN compares false, these are clean
    value = np.nan_to_num(value, nan=0.0, posinf=0.0, neginf=0.0)
    limits = (255.0,) if integer else (1.0, 255.0)
    scale = intensity_max or next((limit for limit in limits if value.max() <= limit), 65535.0)
    points = points.copy()
    points[:, 3] = np.clip(value / np.float32(scale), 0, 1)
    return points


def _time_offset(time: NDArray[Any], points: Points, stamp: int, unit: TimeUnit) -> Points | None:
    seen = np.isfinite(points[:, :3]).all(1) & points[:, :3].any(1)  # drivers often zero the time of a missing return
    value = _first(time).astype(np.float64)
    seen &= np.isfinite(value)
    if not seen.any():
        return None
    first, last = value[seen].min(), value[seen].max()
    if first == last:
        return None
    scale = _SECONDS[unit] if unit != "auto" else _time_scale(first, last, time.dtype.kind == "f")
    origin = 0.0
    if max(abs(first), abs(last)) * scale > _LONGEST_SCAN:
        origin = stamp * 1e-9 / scale
        if max(abs(first - origin), abs(last - origin)) * scale > _LONGEST_SCAN:
            origin = first  # the sensor's clock is not that of the stamps: the first point is all that can be known
    with np.errstate(invalid="ignore", over="ignore"):
        offset = (value - origin) * scale
    return np.where(seen & (np.abs(offset) <= _LONGEST_SCAN), offset, 0.0).astype(np.float32)  # else it means nothing


def _time_scale(first: float, last: float, floating: bool) -> float:
    """Seconds per unit: by the span, else (a few points only) by size as an epoch, else by type."""
    for scale in [_SECONDS[unit] for unit in (("s", "ms") if floating else ()) + ("us", "ns")]:
        if _LONGEST_SCAN / 1000 < (last - first) * scale <= _LONGEST_SCAN:
            return scale
    for scale in _SECONDS.values():
        if 1e8 < abs(last) * scale < 1e11:  # 1973 to 5138
            return scale
    return 1.0 if floating else 1e-9


def cloud_fields(columns: Mapping[str, NDArray[Any]], point_field: Callable[..., Any]) -> dict[str, Any]:
    """Everything but the header of a sensor_msgs/PointCloud2, as keyword arguments for its constructor.

    Args:
        columns: field name to (N,) or (N, count) array, in order, of a type that PointField knows.
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


def point_columns(points: Points) -> dict[str, Points]:
    """(N, 4) points as the x, y, z, intensity columns that `cloud_fields` takes."""
    return {name: points[:, i] for i, name in enumerate(("x", "y", "z", "intensity"))}


def decode_image(msg: Any, size: tuple[int, int] | None = None) -> NDArray[np.uint8]:
    """sensor_msgs/Image or CompressedImage to (H, W, 3) uint8 RGB; of 16 bits the upper 8 count.

    Args:
        msg: the message.
        size: width and height of the camera: a JPEG or PNG of another size is not decoded.

    Raises:
        MessageError: an encoding that is not supported, data shorter than declared, or a JPEG or PNG that is damaged.
    """
    if not hasattr(msg, "encoding"):
        return _decode_compressed(msg, size)
    encoding = str(msg.encoding)
    if encoding.lower() not in _IMAGE_ENCODINGS:
        raise MessageError(
            f"image encoding {encoding[:40]!r} is not supported; supported: {', '.join(_IMAGE_ENCODINGS)}"
        )
    kind, channels, conversion = _IMAGE_ENCODINGS[encoding.lower()]
    dtype = np.dtype((">" if msg.is_bigendian else "<") + kind)
    height, width, pixel = int(msg.height), int(msg.width), channels * dtype.itemsize
    step = int(msg.step) or width * pixel
    need, have = (height - 1) * step + width * pixel, len(msg.data)
    if not height * width or step < width * pixel or have < need:
        raise MessageError(f"image of {width} x {height} {encoding}, step {step}: {have} bytes of data, {need} needed")
    shape, strides = (height, width, channels), (step, pixel, dtype.itemsize)
    pixels = np.ndarray(shape, dtype, memoryview(msg.data), strides=strides)
    if dtype.itemsize == 2:
        pixels = (pixels >> 8).astype(np.uint8)
    pixels = np.ascontiguousarray(pixels)
    return pixels if conversion is None else cv2.cvtColor(pixels, conversion)


def _decode_compressed(msg: Any, size: tuple[int, int] | None) -> NDArray[np.uint8]:
    if "compresseddepth" in msg.format.lower():
        raise MessageError(f"compressed image format {msg.format[:40]!r} is not supported; supported: jpeg, png")
    try:
        return decode_compressed(bytes(msg.data), size)
    except ValueError as error:
        what = f"compressed image of format {msg.format[:40]!r} and {len(msg.data)} bytes"
        raise MessageError(f"{what} cannot be decoded: {error}") from None


def decode_camera(info: Any, T_lidar_cam: Array, name: str) -> Camera:
    """sensor_msgs/CameraInfo to `Camera`: K and D as they are; P's left block where D is zero, the image rectified.

    Args:
        info: with model plumb_bob or rational_polynomial (whose 8 coefficients stay in OpenCV's order).
        T_lidar_cam: (4, 4) optical frame of the camera to LiDAR frame.
        name: what messages call it.

    Raises:
        MessageError: another distortion model, no focal length, or no size.
    """
    K, P, D = (np.array(x, np.float64) for x in (info.k, info.p, info.d))
    K, P = K.reshape(3, 3), P.reshape(3, 4)
    if not D.any():
        D, K = D[:0], P[:, :3].copy() if P[0, 0] else K
    elif info.distortion_model not in ("plumb_bob", "rational_polynomial"):
        raise MessageError(f"{name}: distortion model {info.distortion_model[:40]!r} is not supported; "
                           "supported: plumb_bob, rational_polynomial")  # fmt: skip
    if not (K[0, 0] > 0 and K[1, 1] > 0 and np.isfinite(K).all()):
        raise MessageError(f"{name}: CameraInfo has no focal length (the camera is not calibrated)")
    if len(D) not in _DISTORTIONS or not np.isfinite(D).all():
        raise MessageError(f"{name}: CameraInfo has {len(D)} distortion coefficients, or some that are not finite")
    if not (0 < info.width <= _WIDEST_IMAGE and 0 < info.height <= _WIDEST_IMAGE):
        raise MessageError(f"{name}: CameraInfo has no image size, or one beyond {_WIDEST_IMAGE} pixels")
    return Camera(K, T_lidar_cam, (int(info.width), int(info.height)), tuple(D.tolist()), name)
