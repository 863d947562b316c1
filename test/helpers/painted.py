# SPDX-License-Identifier: Apache-2.0
"""A flat wall with paint on it, as seen by a LiDAR and a camera from positions along it."""

from __future__ import annotations

import cv2
import numpy as np

from dpm2_core.frame import R_AHEAD, Camera, Image, Points
from dpm2_core.geometry import se3

SIZE = (128, 416)
K = np.array([[240.0, 0, 207.5], [0, 240.0, 63.5], [0, 0, 1]])
T_LIDAR_CAM = se3.make(R_AHEAD, [0.3, 0, -0.1])
WALL = 6.0  # m to the left
_PER_M = 20  # pixels per meter of the wall's paint
_LENGTH, _LOW, _HIGH = 40.0, -2.0, 6.0


def paint(seed: int) -> np.ndarray:
    """Blotches and noise (H, W, 3) uint8, of a wall along x."""
    noise = np.random.default_rng(seed)
    shape = (round((_HIGH - _LOW) * _PER_M), round(_LENGTH * _PER_M))
    layers = [cv2.GaussianBlur(noise.standard_normal(shape).astype(np.float32), (0, 0), s) * s for s in (2, 5, 12)]
    gray = np.clip(127 + 60 * sum(layers), 0, 255).astype(np.uint8)
    return np.repeat(gray[..., None], 3, 2)


def picture(wall: np.ndarray, x: float) -> np.ndarray:
    """Image of the wall from a camera at x m."""
    T_cam_world = se3.inverse(se3.make(np.eye(3), np.array([x, 0, 0])) @ T_LIDAR_CAM)
    # A pixel (c, r) of the paint is the point (c / _PER_M, WALL, _HIGH - r / _PER_M).
    of_paint = np.array([[1 / _PER_M, 0, 0], [0, 0, WALL], [0, -1 / _PER_M, _HIGH], [0, 0, 1]])
    H = K @ T_cam_world[:3] @ of_paint
    return cv2.warpPerspective(wall, H, SIZE[::-1], flags=cv2.INTER_AREA)


def scan(x: float, seed: int) -> Points:
    """Scan of the wall by a LiDAR at x m, with 1 cm of noise."""
    noise = np.random.default_rng(seed)
    along, up = noise.uniform(0, _LENGTH, 8000), noise.uniform(_LOW, _HIGH, 8000)
    wall = np.stack([along - x, np.full(8000, WALL) + noise.normal(0, 0.01, 8000), up], 1)
    return wall.astype(np.float32)


def image(wall: np.ndarray, x: float) -> Image:
    """`picture` with its camera."""
    return Image(picture(wall, x), Camera(K, T_LIDAR_CAM, SIZE[::-1]))
