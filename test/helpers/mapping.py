# SPDX-License-Identifier: Apache-2.0
"""What tests of mapper_node send to it, and see of its map; `mapper` is the fixture of test/dpm2_ros."""

from __future__ import annotations

from typing import Any

import numpy as np

from dpm2_core.geometry import se3
from dpm2_core.slam.mapping.mapper import Mapper
from dpm2_ros.conversions import keyframe_name

from .diagnostics import having

S, OTHER = "5f3a9c01", "00000bad"  # sessions


def core(mapper: Any) -> Mapper:
    """What makes the map in the node."""
    return mapper.mapper.slam.mapper


def keyframes(mapper: Any) -> int:
    """In the map so far."""
    return len(core(mapper).keyframes)


def mapped(mapper: Any, count: int) -> None:
    """Until so many keyframes are in the map, and all that has to do with them is done."""
    mapper.status("mapper_node: mapper", having(keyframes=count, waiting=0))


def points(seed: int) -> np.ndarray:
    return np.random.default_rng(seed).uniform(0, 1, (500, 4)).astype(np.float32) * [20, 20, 5, 1]


def send_all(mapper: Any, *ids: int, session: str = S, shift: float = 0.0) -> None:
    for id in ids:
        T = se3.exp([0, 0, 0, 5.0 * id + shift, 0, 0])
        mapper.send(id, T, points(id), name=keyframe_name("", id, session))


def rejections(mapper: Any) -> dict[str, int]:
    """As they are published."""
    for message in reversed(mapper.diagnostics):
        for status in message.status:
            if status.name == "mapper_node: messages":
                return {value.key: int(value.value) for value in status.values if value.value != "0"}
    return {}
