# SPDX-License-Identifier: Apache-2.0
"""Complete JPEG and PNG images, and damaged ones."""

from __future__ import annotations

import struct

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dpm2_core.data.compressed import decode_compressed

PIXELS = cv2.GaussianBlur(np.random.default_rng(0).integers(0, 255, (48, 64, 3), np.uint8), (0, 0), 2)
SMALL = cv2.imencode(".jpg", PIXELS[:16, :16])[1].tobytes()
JPEGS = {
    name: cv2.imencode(".jpg", PIXELS, flags)[1].tobytes()
    for name, flags in (
        ("plain", []),
        ("progressive", [cv2.IMWRITE_JPEG_PROGRESSIVE, 1]),
        ("restarting", [cv2.IMWRITE_JPEG_RST_INTERVAL, 2]),
    )
}
# With an embedded smaller JPEG, whose end is not that of the image, and with padding at the end, as from some drivers.
JPEGS["within"] = JPEGS["plain"][:2] + b"\xff\xe1" + struct.pack(">H", len(SMALL) + 2) + SMALL + JPEGS["plain"][2:]
JPEGS["filled"] = JPEGS["plain"] + bytes(16)


@pytest.mark.parametrize("jpeg", JPEGS.values(), ids=JPEGS)
def test_a_whole_jpeg_is_decoded(jpeg: bytes) -> None:
    decoded = decode_compressed(jpeg, (64, 48))
    assert np.abs(decoded[:, :, ::-1].astype(int) - PIXELS).mean() < 4  # of 256: the loss of JPEG


@given(st.sampled_from(list(JPEGS)), st.floats(0, 1))
def test_a_jpeg_that_is_cut_off_is_an_error(name: str, part: float) -> None:
    """OpenCV 4 fills the missing part with gray, without an error. Previously, half an image counted as an image of a
    place."""
    jpeg = JPEGS[name].rstrip(b"\0")
    with pytest.raises(ValueError, match=r"cut off|damaged"):
        decode_compressed(jpeg[: int(part * (len(jpeg) - 1))])


@given(st.floats(0, 1))
def test_a_png_that_is_cut_off_is_an_error(part: float) -> None:
    png = cv2.imencode(".png", PIXELS)[1].tobytes()
    with pytest.raises(ValueError, match=r"cut off|damaged"):
        decode_compressed(png[: int(part * (len(png) - 13))])
