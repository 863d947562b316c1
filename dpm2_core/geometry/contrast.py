# SPDX-License-Identifier: Apache-2.0
"""Extracts the texture of an image: its brightness, independent of the illumination."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

_MIN_CONTRAST = 2.0  # gray levels: lower contrast is noise


def local_contrast(gray: NDArray[np.uint8], local: float) -> NDArray[np.float32]:
    """Brightness (H, W) without changes over more than `local` pixels, divided by the contrast of the surroundings."""
    detail = gray.astype(np.float32)
    detail -= cv2.GaussianBlur(detail, (0, 0), local)
    detail /= np.sqrt(cv2.GaussianBlur(detail * detail, (0, 0), 2 * local)) + _MIN_CONTRAST
    return detail
