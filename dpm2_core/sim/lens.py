# SPDX-License-Identifier: Apache-2.0
"""Water on a lens: spots at fixed pixels, behind which the image is blurred."""

from __future__ import annotations

from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from dpm2_core.sim.settings import CameraConfig


def through_lens(image: NDArray[np.uint8], config: CameraConfig) -> NDArray[np.uint8]:
    """(H, W, 3) uint8 as seen through a lens of which `config.wet` is wet; the drops do not depend on the image."""
    if not config.wet:
        return image
    mask = _drops(config)[..., None]
    blurred = cv2.GaussianBlur(image, (0, 0), config.width / 60)
    return (image * (1 - mask) + blurred * mask + np.float32(0.5)).astype(np.uint8)


@lru_cache(maxsize=8)
def _drops(config: CameraConfig) -> NDArray[np.float32]:
    """(H, W) 0..1, share of each pixel's light that passes through a drop."""
    rng = np.random.default_rng([config.lens, 80])
    mask = np.zeros((config.height, config.width), np.float32)
    while (mask > 0.5).mean() < config.wet:
        center = rng.uniform((0, 0), (config.width, config.height))
        radius = config.width * np.exp(rng.uniform(np.log(0.006), np.log(0.03)))
        spot = np.zeros_like(mask)
        axes = np.array([radius, radius * rng.uniform(1.0, 1.6)])
        cv2.ellipse(spot, center.astype(int).tolist(), np.ceil(axes).astype(int).tolist(), 0, 0, 360, 1.0, -1)
        mask = np.maximum(mask, cv2.GaussianBlur(spot, (0, 0), max(0.25 * radius, 0.6)))
    return mask
