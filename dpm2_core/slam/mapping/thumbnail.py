# SPDX-License-Identifier: Apache-2.0
"""A small image of each keyframe for the map file."""

from __future__ import annotations

from dpm2_core.frame import Frame


def thumbnail(frame: Frame, width: int) -> bytes | None:
    """JPEG of the frame's first image, `width` pixels wide; None without an image, or for a width of 0.

    It is a second camera's where the first one has none.
    """
    if not frame.images or not width:
        return None
    import cv2

    pixels = frame.images[0].pixels
    height = max(1, round(width * pixels.shape[0] / pixels.shape[1]))
    small = cv2.resize(pixels, (width, height), interpolation=cv2.INTER_AREA)
    return bytes(cv2.imencode(".jpg", cv2.cvtColor(small, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, 80])[1])
