# SPDX-License-Identifier: Apache-2.0
"""A keyframe as three messages: pose, descriptors, packed cloud with fix and thumbnail; and the acknowledgment."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from nav_msgs.msg import Odometry
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.serialization import deserialize_message, serialize_message
from sensor_msgs.msg import PointCloud2, PointField
from std_msgs.msg import MultiArrayDimension, MultiArrayLayout, UInt8MultiArray, UInt32MultiArray

from dpm2_core.data.thumbnail import image_of, within
from dpm2_core.descriptors import Descriptors
from dpm2_core.estimates import Keyframe
from dpm2_core.frame import Fix
from dpm2_core.geometry.voxel import voxel_first
from dpm2_core.slam.mapping.admission import RejectedError
from dpm2_core.slam.store.cloud_codec import pack_cloud
from dpm2_ros.conversions import EARLIER, bytes_to_array, columns_to_msg

WIRE = QoSProfile(depth=64, reliability=ReliabilityPolicy.RELIABLE)
"""QoS of keyframes; messages that drop out of the queue are sent again."""
BUDGET = 99_000
"""Largest size of a keyframe's payload and descriptors on the wire, bytes; pose and protocol use the rest of 100 kB.
Descriptors may use half of it, 325 of 128 channels: with more, the cloud would have too few points for loop
verification."""

_FIX_FORMAT = struct.Struct("<q15d")  # stamp, ns; position, covariance, antenna, as in `Fix`
_FIX_LABEL, _THUMBNAIL_LABEL = "fix", "thumbnail"
_MAX_THUMBNAIL_SIZE = 20_000  # bytes: a larger one would replace points of the cloud; 320 pixels have 6000 to 25 000
_FEATURE_FIELD = "feature"
_MAX_CHANNELS = 4096


def of_earlier_drive(parts: Sequence[bytes]) -> list[bytes]:
    """The serialized messages of a keyframe, with a name that marks its drive as over.

    Raises:
        RuntimeError: they are not the messages of a keyframe.
    """
    kinds = (Odometry, PointCloud2, UInt8MultiArray)
    pose, descriptors, cloud = (deserialize_message(part, kind) for part, kind in zip(parts, kinds, strict=True))
    if not cloud.layout.dim:
        raise RuntimeError("a cloud without the name of its keyframe")
    name = pose.child_frame_id + EARLIER
    pose.child_frame_id = descriptors.header.frame_id = cloud.layout.dim[0].label = name
    return [bytes(serialize_message(part)) for part in (pose, descriptors, cloud)]


def received_to_msg(session: str, below: int, above: Sequence[int]) -> UInt32MultiArray:
    """The acknowledgment of a session's keyframes: all ids below a number, in the map file, and some above."""
    dimension = MultiArrayDimension(label=session, size=1 + len(above), stride=1 + len(above))
    return UInt32MultiArray(layout=MultiArrayLayout(dim=[dimension]), data=[below, *above])


class Payload(NamedTuple):
    """A keyframe's packed cloud, with its fix and its thumbnail, if it has them."""

    cloud: bytes
    fix: Fix | None = None
    thumbnail: bytes | None = None


def payload_to_msgs(keyframe: Keyframe, name: str, weights: str = "") -> tuple[PointCloud2, UInt8MultiArray]:
    """Descriptors and payload of a keyframe, the cloud downsampled until both are within `BUDGET`.

    The fix and the thumbnail, if any, follow the cloud as further dimensions; a large thumbnail is made smaller.
    """
    d, fix, thumbnail = keyframe.descriptors, keyframe.fix, keyframe.thumbnail
    descriptors = descriptors_to_msg(d, keyframe.stamp, name, weights)
    extras = {}
    if fix is not None:
        extras[_FIX_LABEL] = _FIX_FORMAT.pack(fix.stamp, *fix.geodetic, *fix.covariance.ravel(), *fix.antenna)
    if thumbnail is not None and (reduced := within(thumbnail, _MAX_THUMBNAIL_SIZE)) is not None:
        extras[_THUMBNAIL_LABEL] = reduced
    max_size = BUDGET - len(descriptors.data) - sum(map(len, extras.values()))
    cloud, voxel = keyframe.cloud, 0.3
    while len(packed := pack_cloud(cloud, keyframe.origin)) > max_size:
        voxel *= 1.15
        cloud = keyframe.cloud[voxel_first(keyframe.cloud, voxel)]
    parts = {name: packed, **extras}
    dimensions = [MultiArrayDimension(label=key, size=len(part), stride=len(part)) for key, part in parts.items()]
    data = bytes_to_array(b"".join(parts.values()))
    return descriptors, UInt8MultiArray(layout=MultiArrayLayout(dim=dimensions), data=data)


def payload_from_msg(message: UInt8MultiArray) -> Payload:
    """The payload of a keyframe, its cloud not unpacked yet.

    Raises:
        RejectedError: the parts do not have the stated lengths, or the fix or the thumbnail is invalid.
    """
    data, dimensions = bytes(message.data), message.layout.dim
    if len(dimensions) < 2:
        return Payload(data)
    ends = np.cumsum([dimension.size for dimension in dimensions]).tolist()
    if ends[-1] != len(data):
        raise RejectedError("size", f"{len(data)} bytes for parts of {ends[-1]}")
    extras = {d.label: data[end - d.size : end] for d, end in zip(dimensions[1:], ends[1:], strict=True)}
    fix, thumbnail = extras.get(_FIX_LABEL), extras.get(_THUMBNAIL_LABEL)
    try:
        if thumbnail is not None:
            image_of(thumbnail)
    except ValueError as error:
        raise RejectedError("thumbnail", str(error)) from None
    return Payload(data[: ends[0]], None if fix is None else _unpack_fix(fix), thumbnail)


def _unpack_fix(data: bytes) -> Fix:
    if len(data) != _FIX_FORMAT.size:
        raise RejectedError("fix", f"a fix of {len(data)} bytes")
    stamp, *numbers = _FIX_FORMAT.unpack(data)
    values = np.array(numbers)
    try:
        return Fix(stamp, values[:3], values[3:12].reshape(3, 3), values[12:])
    except ValueError as error:
        raise RejectedError("fix", str(error)) from None


def descriptors_to_msg(d: Descriptors | None, stamp: int, name: str, weights: str = "") -> PointCloud2:
    """A cloud of points x, y, z, axis_x, axis_y, step and 128 int8 `feature:WEIGHTS`, in units of step; empty for None.

    Only the first ones are sent, within half of `BUDGET`: any number of the first is as evenly spread as all.
    Those of a tilted LiDAR whose base is not known, and those of a room, are not sent: the receiver computes its own
    from the cloud.
    """
    d = None if d is not None and (d.up is not None or d.scale != 1) else d
    values, features = np.zeros((0, 6), np.float32), np.zeros((0, 1), np.int8)
    if d is not None:
        values, features = np.column_stack([d.xyz, d.axes, d.step]), d.features
    max_count = BUDGET // 2 // _row_dtype(features.shape[1]).itemsize
    columns = dict(zip(("x", "y", "z", "axis_x", "axis_y", "step"), values[:max_count].T, strict=True))
    feature = f"{_FEATURE_FIELD}:{weights}" if weights else _FEATURE_FIELD
    message = columns_to_msg({**columns, feature: features[:max_count]}, stamp, name)
    message.is_dense = True
    return message


def descriptors_from_msg(message: PointCloud2) -> tuple[Descriptors | None, str]:
    """The inverse of `descriptors_to_msg`: descriptors, and the identity of the weights that made them.

    Raises:
        RejectedError: it does not contain descriptors.
    """
    if not message.width:
        return None, ""
    feature = next((f for f in message.fields if f.name.partition(":")[0] == _FEATURE_FIELD), None)
    channels = 0 if feature is None or feature.datatype != PointField.INT8 else feature.count
    if not 0 < channels <= _MAX_CHANNELS:
        raise RejectedError("descriptors", f"a cloud that holds descriptors of {channels} channels of int8")
    dtype = _row_dtype(channels)
    if message.point_step != dtype.itemsize or len(message.data) != dtype.itemsize * message.width:
        raise RejectedError(
            "descriptors", f"{len(message.data)} bytes for {message.width} descriptors of {channels} channels"
        )
    rows = np.frombuffer(message.data, dtype)
    xyz, features, step, axis = (np.ascontiguousarray(rows[name]) for name in ("xyz", "feature", "step", "axis"))
    return Descriptors(xyz, features, step, axis), "" if feature is None else feature.name.partition(":")[2][:64]


def _row_dtype(channels: int) -> np.dtype[np.void]:
    return np.dtype([("xyz", "<f4", 3), ("axis", "<f4", 2), ("step", "<f4"), ("feature", "i1", channels)])
