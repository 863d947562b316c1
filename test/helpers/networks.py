# SPDX-License-Identifier: Apache-2.0
"""Networks small enough for tests."""

from __future__ import annotations

import numpy as np

from dpm2_core.config import settings_from
from dpm2_core.descriptors import Descriptors
from dpm2_core.network.model import DeepPointMap2
from dpm2_core.network.settings import NetworkSettings

TINY = {
    "preset": "tiny",
    "channels": 32,
    "points": {
        "stages": [
            {"points": 256, "radius": 2, "neighbours": 8, "channels": 16},
            {"points": 64, "radius": 6, "neighbours": 8, "channels": 32, "residual_radii": [12.0]},
        ]
    },
    "image": {"size": [32, 64], "depths": [1, 1, 1], "channels": [8, 16, 16], "pyramid": 16, "strides": [8, 16]},
    "fusion": {"points": 48, "layers": 1, "levels": [1], "alpha_image": [0.3, 1.0, 2.5, 6.0]},
    "decoder": {"width": 32, "layers": 1},
}


def tiny(**changes: dict[str, object]) -> NetworkSettings:
    """Settings of the tiny network with changed sections."""
    tree = {key: {**value, **changes.get(key, {})} if isinstance(value, dict) else value for key, value in TINY.items()}
    return settings_from(NetworkSettings, tree)


def described(model: DeepPointMap2, noise: np.random.Generator, n: int) -> Descriptors:
    """Random descriptors."""
    return Descriptors.of(
        noise.normal(0, 15, (n, 3)).astype(np.float32), noise.normal(0, 1, (n, model.settings.channels))
    )
