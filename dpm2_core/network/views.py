# SPDX-License-Identifier: Apache-2.0
"""The images of frames, as the network reads them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from dpm2_core.frame import Image
from dpm2_core.geometry import se3
from dpm2_core.network.settings import ImageSettings


class Views(NamedTuple):
    """The images of a batch, resized.

    Attributes:
        pixels: (B, V, 3, H, W) uint8.
        K: (B, V, 3, 3) intrinsics of the resized image, pixels.
        T_lidar_cam: (B, V, 4, 4).
        present: (B, V) False where an image is missing.
    """

    pixels: Tensor
    K: Tensor
    T_lidar_cam: Tensor
    present: Tensor


def in_encoded_axes(image: Image, R: NDArray[np.float32], scale: float) -> Image:
    """An image whose camera stands in other axes, into which R (3, 3) turns the LiDAR's, in a scene that is enlarged by
    `scale`."""
    T_lidar_cam = se3.make(R, np.zeros(3)) @ image.camera.T_lidar_cam
    T_lidar_cam[:3, 3] *= scale
    return replace(image, camera=replace(image.camera, T_lidar_cam=T_lidar_cam))


def collate_views(images: Sequence[Sequence[Image]], settings: ImageSettings) -> Views | None:
    """Resize and stack the images of each frame; absent ones are masked, None if no frame has any."""
    most = max((len(frame) for frame in images), default=0)
    if most == 0:
        return None
    height, width = settings.size
    pixels = np.zeros((len(images), most, 3, height, width), np.uint8)
    K = np.tile(np.eye(3, dtype=np.float32), (len(images), most, 1, 1))
    T = np.tile(np.eye(4, dtype=np.float32), (len(images), most, 1, 1))
    present = np.zeros((len(images), most), bool)
    for b, frame in enumerate(images):
        for v, image in enumerate(frame):
            small = small_image(image, settings)
            pixels[b, v], K[b, v] = small.pixels.transpose(2, 0, 1), small.camera.K
            T[b, v] = image.camera.T_lidar_cam
            present[b, v] = True
    return Views(*(torch.from_numpy(array) for array in (pixels, K, T, present)))


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
