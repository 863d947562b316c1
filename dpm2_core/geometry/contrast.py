# SPDX-License-Identifier: Apache-2.0
"""What of an image is texture: its brightness, whatever light falls on it."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

_DARK = 2.0  # gray levels: less contrast is noise


def local_contrast(gray: NDArray[np.uint8], local: float) -> NDArray[np.float32]:
    """Brightness (H, W) without what changes over more than `local` pixels, over the contrast around."""
    detail = gray.astype(np.float32)
    detail -= cv2.GaussianBlur(detail, (0, 0), local)
    detail /= np.sqrt(cv2.GaussianBlur(detail * detail, (0, 0), 2 * local)) + _DARK
    return detail
