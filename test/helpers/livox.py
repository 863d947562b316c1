# SPDX-License-Identifier: Apache-2.0
"""Livox' CustomMsg, serialized by rosbags from its definition."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np

_CUSTOM = """std_msgs/Header header
uint64 timebase
uint32 point_num
uint8 lidar_id
uint8[3] rsvd
livox_ros_driver2/CustomPoint[] points
"""
_POINT = """uint32 offset_time
float32 x
float32 y
float32 z
uint8 reflectivity
uint8 tag
uint8 line
"""


@cache
def livox_store(ros1: bool = False) -> Any:
    """A type store that contains the message."""
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.ROS1_NOETIC if ros1 else Stores.ROS2_JAZZY)
    store.register(get_types_from_msg(_POINT, "livox_ros_driver2/msg/CustomPoint"))
    store.register(get_types_from_msg(_CUSTOM, "livox_ros_driver2/msg/CustomMsg"))
    return store


def custom_object(stamp: int, points: np.ndarray, seconds: np.ndarray, frame: str, ros1: bool) -> Any:
    """Message of points (N, 3), m, at (N,) s after the stamp (ns)."""
    types = livox_store(ros1).types
    time = types["builtin_interfaces/msg/Time"](sec=stamp // 10**9, nanosec=stamp % 10**9)
    head = {"seq": 0} if ros1 else {}
    header = types["std_msgs/msg/Header"](stamp=time, frame_id=frame, **head)
    point = types["livox_ros_driver2/msg/CustomPoint"]
    rows = [point(offset_time=round(t * 1e9), x=float(p[0]), y=float(p[1]), z=float(p[2]), reflectivity=i % 256,
                  tag=16, line=i % 4) for i, (p, t) in enumerate(zip(points, seconds, strict=True))]  # fmt: skip
    return types["livox_ros_driver2/msg/CustomMsg"](
        header=header, timebase=stamp, point_num=len(rows), lidar_id=1, rsvd=np.zeros(3, np.uint8), points=rows
    )


def custom_message(
    stamp: int, points: np.ndarray, seconds: np.ndarray, frame: str = "livox", ros1: bool = False
) -> bytes:
    """The same message serialized: CDR, or the format of ROS 1."""
    store, message = livox_store(ros1), custom_object(stamp, points, seconds, frame, ros1)
    serialize = store.serialize_ros1 if ros1 else store.serialize_cdr
    return bytes(serialize(message, "livox_ros_driver2/msg/CustomMsg"))
