# SPDX-License-Identifier: Apache-2.0
"""Recordings and their messages for the tests of bags, and what a source reads from them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from dpm2_core.data.bags import BagSource

POINTS, IMAGE, INFO = "/points", "/cam/image_raw", "/cam/camera_info"
Message = tuple[float, str, Any]


def write_bag(
    folder: Path, kinds: Mapping[str, str], messages: Iterable[tuple[int, str, bytes]], types: Any = None
) -> Path:
    """Write a recording of serialized messages, each with its log time (ns) and topic; `kinds`: the type of each
    topic."""
    types = types or get_typestore(Stores.ROS2_JAZZY)
    with Writer(folder, version=Writer.VERSION_LATEST, storage_plugin=StoragePlugin.MCAP) as writer:
        connections = {topic: writer.add_connection(topic, kind, typestore=types) for topic, kind in kinds.items()}
        for log_time, topic, data in sorted(messages, key=lambda message: message[0]):
            writer.write(connections[topic], log_time, data)
    return folder


def clouds(bags: Any, times: list[float], topic: str = POINTS) -> list[Message]:
    return [(t, topic, bags.cloud(t, x=float(i))) for i, t in enumerate(times)]


def rig(bags: Any) -> list[Message]:
    """Calibration of a camera 0.2 m in front of the LiDAR."""
    return [(1, "/tf_static", bags.transform("velo_link", "cam", (0.2, 0, 0))), (1, INFO, bags.info(1))]


def by_time(messages: list[Message]) -> list[Message]:
    return sorted(messages, key=lambda message: message[0])


def seen(source: BagSource) -> list[int | None]:
    """The gray value of each frame's image."""
    return [int(frame.images[0].pixels[0, 0, 0]) if frame.images else None for frame in source.frames()]
