# SPDX-License-Identifier: Apache-2.0
"""A cloud and an image that look like a street."""

from __future__ import annotations

import numpy as np

from dpm2_core.frame import R_AHEAD, Camera, Image
from dpm2_core.geometry import se3


def boxes(noise: np.random.Generator, points: int = 4000) -> np.ndarray:
    """Points (points, 3) float32 on the ground and on the faces of boxes, 1.7 m below to 8 m above the sensor."""
    ground = np.column_stack([noise.uniform(-40, 40, (points // 2, 2)), np.full(points // 2, -1.7)])
    parts = [ground]
    count = 25
    for _ in range(count):
        center = np.append(noise.uniform(-35, 35, 2), -1.7)
        half = noise.uniform([1, 1, 1], [5, 5, 8])
        side = noise.uniform(-1, 1, (points // 2 // count, 3))
        axis = noise.integers(0, 2, len(side))
        side[np.arange(len(side)), axis] = np.sign(side[np.arange(len(side)), axis])
        parts.append(center + side * half)
    return np.concatenate(parts).astype(np.float32)


def make_image(noise: np.random.Generator, size: tuple[int, int] = (128, 64)) -> Image:
    """Random image of a forward-looking camera; `size` is (width, height)."""
    K = np.array([[60.0, 0, size[0] / 2 - 0.5], [0, 60.0, size[1] / 2 - 0.5], [0, 0, 1]])
    T_lidar_cam = se3.make(R_AHEAD, [0.3, 0.05, -0.1])
    pixels = noise.integers(0, 255, (size[1], size[0], 3), dtype=np.uint8)
    return Image(pixels, Camera(K, T_lidar_cam, size))
