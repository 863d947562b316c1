# SPDX-License-Identifier: Apache-2.0
"""Messages as plain objects, as input to the decoders without ROS."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np

from dpm2_core.data import messages

STAMP = 1_700_000_000_250_000_000


def field(name: str, offset: int, datatype: int, count: int = 1) -> SimpleNamespace:
    return SimpleNamespace(name=name, offset=offset, datatype=datatype, count=count)


def header(stamp: int = STAMP) -> SimpleNamespace:
    return SimpleNamespace(stamp=SimpleNamespace(sec=stamp // 10**9, nanosec=stamp % 10**9), frame_id="velo_link")


def cloud(columns: dict[str, np.ndarray], stamp: int = STAMP) -> SimpleNamespace:
    return SimpleNamespace(header=header(stamp), **messages.cloud_fields(columns, SimpleNamespace))


def xyz(n: int = 5, **more: Any) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(0)
    return {k: rng.uniform(1, 50, n).astype(np.float32) for k in "xyz"} | {k: np.asarray(v) for k, v in more.items()}


def info(**changes: Any) -> SimpleNamespace:
    K, P = np.array([500, 0, 320, 0, 510, 240, 0, 0, 1.0]), np.array([480, 0, 310, 0, 0, 490, 230, 0, 0, 0, 1, 0.0])
    base = {"k": K, "p": P, "d": [0.0] * 5, "distortion_model": "plumb_bob", "width": 640, "height": 480}
    whole = {"binning_x": 0, "binning_y": 0, "roi": roi(0, 0, 0, 0), "header": header()}
    return SimpleNamespace(**(base | whole | changes))


def roi(x: int, y: int, width: int, height: int) -> SimpleNamespace:
    return SimpleNamespace(x_offset=x, y_offset=y, width=width, height=height)
