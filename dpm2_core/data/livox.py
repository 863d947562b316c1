# SPDX-License-Identifier: Apache-2.0
"""CustomMsg of Livox' drivers without their packages: its serialized points have the layout of a PointCloud2.

livox_ros_driver2/msg/CustomMsg.msg and CustomPoint.msg, and the identical ones of livox_ros_driver:

    std_msgs/Header header; uint64 timebase; uint32 point_num; uint8 lidar_id; uint8[3] rsvd; CustomPoint[] points
    CustomPoint: uint32 offset_time (ns); float32 x, y, z (m); uint8 reflectivity, tag, line
"""

from __future__ import annotations

import struct
from types import SimpleNamespace
from typing import Any

import numpy as np

from dpm2_core.data.messages import MessageError

LIVOX = ("livox_ros_driver2/msg/CustomMsg", "livox_ros_driver/msg/CustomMsg")
"""Message types."""

_POINT_BYTES, _POINT_STEP = 19, 20  # bytes of a point, and from one point to the next as ROS 2 aligns them
_FIELDS = (("offset_time", 0, 6), ("x", 4, 7), ("y", 8, 7), ("z", 12, 7), ("reflectivity", 16, 2), ("tag", 17, 2),
           ("line", 18, 2))  # fmt: skip


def cloud_of_custom(data: bytes | memoryview) -> Any:
    """A serialized CustomMsg (CDR) as a sensor_msgs/PointCloud2: header, layout, and the bytes of its points.

    Raises:
        MessageError: the data ends before its points do, or is no such message.
    """
    data = bytes(data)
    try:
        if data[0] or data[1] > 1:
            raise MessageError("Livox CustomMsg: serialized in another way than CDR")
        order = "<" if data[1] else ">"
        body = data[4:]
        sec, nanosec, length = struct.unpack_from(f"{order}iII", body)
        frame = body[12 : 12 + length].rstrip(b"\0").decode()
        at = (12 + length + 7) // 8 * 8 + 16  # timebase, point_num, lidar_id, rsvd
        (count,) = struct.unpack_from(f"{order}I", body, at)
    except (struct.error, IndexError, UnicodeDecodeError):
        raise MessageError(f"Livox CustomMsg of {len(data)} bytes ends before its points") from None
    points = body[at + 4 :]
    if len(points) < count * _POINT_STEP - 1:
        raise MessageError(f"Livox CustomMsg: {len(points)} bytes of points, {count} points of {_POINT_STEP} declared")
    fields = [SimpleNamespace(name=name, offset=offset, datatype=kind, count=1) for name, offset, kind in _FIELDS]
    stamp = SimpleNamespace(sec=sec, nanosec=nanosec)
    return SimpleNamespace(
        header=SimpleNamespace(stamp=stamp, frame_id=frame), height=1, width=count, fields=fields,
        is_bigendian=order == ">", point_step=_POINT_STEP, row_step=count * _POINT_STEP,
        data=points + b"\0", is_dense=False,
    )  # fmt: skip


def custom_of_ros1(data: bytes | memoryview) -> bytes:
    """Convert a CustomMsg from ROS 1's serialization, which has no padding, to ROS 2's (CDR).

    Raises:
        struct.error, ValueError: the data ends before its points do.
    """
    _, sec, nanosec, length = struct.unpack_from("<IIII", data)
    frame, at = bytes(data[16 : 16 + length]) + b"\0", 16 + length
    head = struct.pack("<iII", sec, nanosec, len(frame)) + frame
    head += bytes(-len(head) % 8) + bytes(data[at : at + 16])
    (count,) = struct.unpack_from("<I", data, at + 16)
    if count * _POINT_BYTES > len(data):
        raise ValueError(f"{count} points in {len(data)} bytes")
    points = np.zeros((count, _POINT_STEP), np.uint8)
    points[:, :_POINT_BYTES] = np.frombuffer(data, np.uint8, count * _POINT_BYTES, at + 20).reshape(count, _POINT_BYTES)
    return b"\0\1\0\0" + head + struct.pack("<I", count) + points.tobytes()
