# SPDX-License-Identifier: Apache-2.0
"""Message classes by names from recordings and publishers. Only packages of ROS and Livox, since names are imported."""

from __future__ import annotations

import importlib
import re
from typing import Any

PACKAGES = (
    "actionlib_msgs", "builtin_interfaces", "diagnostic_msgs", "geometry_msgs", "livox_ros_driver",
    "livox_ros_driver2", "nav_msgs", "rcl_interfaces", "rosgraph_msgs", "sensor_msgs", "shape_msgs", "std_msgs",
    "stereo_msgs", "tf2_msgs", "trajectory_msgs", "unique_identifier_msgs", "visualization_msgs",
)  # fmt: skip
_NAME = re.compile(r"(\w+)/(?:msg/)?([A-Z]\w*)")


def message_type(kind: str) -> Any | None:
    """The class of a type such as sensor_msgs/msg/PointCloud2; None if it is not in `PACKAGES`, or not installed."""
    name = _NAME.fullmatch(kind)
    if name is None or name[1] not in PACKAGES:
        return None
    try:
        return getattr(importlib.import_module(f"{name[1]}.msg"), name[2], None)
    except ImportError:
        return None
