# SPDX-License-Identifier: Apache-2.0
"""Images as the network reads them: resized, without distortion, and in its axes. Imports no torch."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from dpm2_core.frame import Image
from dpm2_core.geometry import se3
from dpm2_core.network.settings import ImageSettings


def in_encoded_axes(image: Image, R: NDArray[np.floating], scale: float) -> Image:
    """The image with its camera pose in other axes, into which R (3, 3) rotates the LiDAR's, in a scene that is
    enlarged by `scale`."""
    T_lidar_cam = se3.make(R, np.zeros(3)) @ image.camera.T_lidar_cam
    T_lidar_cam[:3, 3] *= scale
    return replace(image, camera=replace(image.camera, T_lidar_cam=T_lidar_cam))


def small_image(image: Image, settings: ImageSettings) -> Image:
    """The image as the network reads it: resized and without distortion; the same object if it is so already."""
    camera, pixels, size = image.camera, image.pixels, settings.size[::-1]
    if not camera.distortion and camera.size == size:
        return image
    if camera.distortion:
        pixels = np.asarray(cv2.undistort(pixels, camera.K, np.array(camera.distortion)), np.uint8)
    small = np.asarray(cv2.resize(pixels, size, interpolation=cv2.INTER_AREA), np.uint8)
    return Image(small, replace(camera.resized(*size), distortion=()))
