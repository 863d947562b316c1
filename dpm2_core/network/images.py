# SPDX-License-Identifier: Apache-2.0
"""Images at the size, without the distortion and in the axes in which the network reads them. Imports no torch."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from dpm2_core.frame import Image
from dpm2_core.geometry import se3
from dpm2_core.network.settings import ImageSettings


def in_encoded_axes(image: Image, R: NDArray[np.float32], scale: float) -> Image:
    """An image whose camera stands in other axes, into which R (3, 3) turns the LiDAR's, in a scene that is enlarged by
    `scale`."""
    T_lidar_cam = se3.make(R, np.zeros(3)) @ image.camera.T_lidar_cam
    T_lidar_cam[:3, 3] *= scale
    return replace(image, camera=replace(image.camera, T_lidar_cam=T_lidar_cam))


def small_image(image: Image, settings: ImageSettings) -> Image:
    """The image as the network reads it: at its size, without distortion; itself, if it is so."""
    camera, pixels, size = image.camera, image.pixels, settings.size[::-1]
    if not camera.distortion and camera.size == size:
        return image
    if camera.distortion:
        pixels = np.asarray(cv2.undistort(pixels, camera.K, np.array(camera.distortion)), np.uint8)
    small, K = resize(pixels, camera.K, settings.size)
    return Image(np.ascontiguousarray(small.transpose(1, 2, 0)), replace(camera, K=K, size=size, distortion=()))


def resize(pixels: np.ndarray, K: np.ndarray, size: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """Resize (H, W, 3) to (3, *size) and scale the intrinsics, pixel centers being at integers."""
    height, width = pixels.shape[:2]
    out = cv2.resize(pixels, size[::-1], interpolation=cv2.INTER_AREA)
    scale = np.diag([size[1] / width, size[0] / height, 1.0])
    shift = np.eye(3)
    shift[:2, 2] = 0.5
    return out.transpose(2, 0, 1), np.linalg.inv(shift) @ scale @ shift @ K
