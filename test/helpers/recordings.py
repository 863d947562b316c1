# SPDX-License-Identifier: Apache-2.0
"""Messages of a recording for the tests of bags, and what a source makes of them."""

from __future__ import annotations

from typing import Any

from dpm2_core.data.bags import BagSource

POINTS, IMAGE, INFO = "/points", "/cam/image_raw", "/cam/camera_info"
Message = tuple[float, str, Any]


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
