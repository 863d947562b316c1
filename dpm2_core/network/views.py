# SPDX-License-Identifier: Apache-2.0
"""The images of a batch of frames."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from dpm2_core.frame import Image
from dpm2_core.network.images import small_image
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


def collate_views(images: Sequence[Sequence[Image]], settings: ImageSettings) -> Views | None:
    """Resize and stack the images of each frame; absent ones are masked, None if no frame has any."""
    max_images = max((len(frame) for frame in images), default=0)
    if max_images == 0:
        return None
    height, width = settings.size
    pixels = np.zeros((len(images), max_images, 3, height, width), np.uint8)
    K = np.tile(np.eye(3, dtype=np.float32), (len(images), max_images, 1, 1))
    T = np.tile(np.eye(4, dtype=np.float32), (len(images), max_images, 1, 1))
    present = np.zeros((len(images), max_images), bool)
    for b, frame in enumerate(images):
        for v, image in enumerate(frame):
            small = small_image(image, settings)
            pixels[b, v], K[b, v] = small.pixels.transpose(2, 0, 1), small.camera.K
            T[b, v] = image.camera.T_lidar_cam
            present[b, v] = True
    return Views(*(torch.from_numpy(array) for array in (pixels, K, T, present)))
