# SPDX-License-Identifier: Apache-2.0
"""Decodes JPEG and PNG. The size is read from the header first: 100 kB of data can decode to 3 GB of pixels."""

from __future__ import annotations

import struct

import cv2
import numpy as np
from numpy.typing import NDArray

MAX_PIXELS = 1 << 26
"""Limit for an image whose camera is not known: 67 million."""
_SENSOR_BITS = (10, 12, 14, 16)
_PNG = b"\x89PNG\r\n\x1a\n"
_JPEG = b"\xff\xd8"
_SIZE_SEGMENTS = set(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}  # JPEG segments that contain the size
_SOS, _EOI = b"\xff\xda", b"\xff\xd9"  # start of scan, end of image; both are escaped within the data of a scan
_NO_LENGTH = {0x01, *range(0xD0, 0xD8)}  # segments without a length


def compressed_size(data: bytes) -> tuple[int, int] | None:
    """Width and height of a JPEG or PNG; None for other formats, and if the data is cut off before the size."""
    if data.startswith(_PNG) and data[12:16] == b"IHDR" and len(data) >= 24:
        width, height = struct.unpack_from(">II", data, 16)
        return int(width), int(height)
    position = 2 if data.startswith(_JPEG) else len(data)
    while position + 9 <= len(data) and data[position] == 0xFF:
        marker = data[position + 1]
        if marker in _SIZE_SEGMENTS:
            height, width = struct.unpack_from(">HH", data, position + 5)
            return int(width), int(height)
        if marker == 0xFF:  # fill byte
            position += 1
        else:
            position += 2 + (0 if marker in _NO_LENGTH else struct.unpack_from(">H", data, position + 2)[0])
    return None


def decode_compressed(data: bytes, size: tuple[int, int] | None = None) -> NDArray[np.uint8]:
    """A JPEG or PNG to (H, W, 3) uint8 RGB.

    Args:
        size: required width and height; None accepts any size up to `MAX_PIXELS`.

    Raises:
        ValueError: another format, another size, too large, or damaged.
    """
    actual = compressed_size(data)
    if actual is None:
        raise ValueError("neither JPEG nor PNG, or cut off")
    if size is not None and actual != size:
        raise ValueError(f"{actual[0]} x {actual[1]} pixels, the camera has {size[0]} x {size[1]}")
    if not 0 < actual[0] * actual[1] <= MAX_PIXELS:
        raise ValueError(f"{actual[0]} x {actual[1]} pixels, at most {MAX_PIXELS} are decoded")
    if data.startswith(_JPEG) and data.rfind(_EOI) < data.rfind(_SOS):  # OpenCV 4 fills the missing part with gray
        raise ValueError("cut off")
    try:
        flags = cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION | cv2.IMREAD_ANYDEPTH
        pixels = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
    except cv2.error:
        pixels = None
    if pixels is None:
        raise ValueError("damaged")
    if pixels.dtype == np.uint16:
        pixels = upper_eight(pixels)
    return np.asarray(cv2.cvtColor(pixels, cv2.COLOR_BGR2RGB, dst=pixels), np.uint8)


def upper_eight(pixels: NDArray[np.uint16]) -> NDArray[np.uint8]:
    """The upper 8 of the bits in use: a camera of 10, 12 or 14 bits leaves the upper bits of its 16 zero."""
    used = int(pixels.max()).bit_length()
    return (pixels >> (next(bits for bits in _SENSOR_BITS if used <= bits) - 8)).astype(np.uint8)
