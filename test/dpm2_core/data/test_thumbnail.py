# SPDX-License-Identifier: Apache-2.0
"""A thumbnail is an ordinary JPEG that contains the calibration of its camera. This calibration is checked."""

from __future__ import annotations

import json
import struct
from typing import Any

import cv2
import numpy as np
import pytest

from dpm2_core.data.thumbnail import image_of, thumbnail
from dpm2_core.frame import Camera, Image
from dpm2_core.geometry import se3

CAMERA = Camera(
    np.array([[300, 0, 319.5], [0, 310, 119.5], [0, 0, 1.0]]),
    se3.exp(np.array([0.1, -0.2, 0.3, 1, 2, 3])),
    (640, 240),
    (0.1, -0.05, 0.001, 0.002, 0.0),
    "/front/image",
)


def picture() -> Image:
    """A red image, brighter to the right."""
    pixels = np.zeros((240, 640, 3), np.uint8)
    pixels[..., 0] = np.linspace(0, 255, 640)
    return Image(pixels, CAMERA)


def with_comment(text: bytes) -> bytes:
    """A thumbnail with another comment."""
    jpeg = thumbnail(picture(), 320)
    (length,) = struct.unpack_from(">H", jpeg, 4)
    return jpeg[:4] + struct.pack(">H", len(text) + 2) + text + jpeg[4 + length :]


def changed(**fields: Any) -> bytes:
    jpeg = thumbnail(picture(), 320)
    (length,) = struct.unpack_from(">H", jpeg, 4)
    return with_comment(json.dumps({**json.loads(jpeg[6 : 4 + length]), **fields}).encode())


def test_image_and_camera_come_back() -> None:
    """Pixels up to JPEG's loss, the camera exactly, for the smaller size."""
    jpeg = thumbnail(picture(), 320)
    back = image_of(jpeg)
    small = cv2.resize(picture().pixels, (320, 120), interpolation=cv2.INTER_AREA)
    assert np.abs(back.pixels.astype(int) - small).mean() < 3
    np.testing.assert_array_equal(back.camera.K, CAMERA.resized(320, 120).K)
    np.testing.assert_array_equal(back.camera.T_lidar_cam, CAMERA.T_lidar_cam)
    assert (back.camera.size, back.camera.distortion, back.camera.name) == ((320, 120), CAMERA.distortion, CAMERA.name)
    shown = cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_COLOR)
    np.testing.assert_array_equal(shown[..., ::-1], back.pixels)


@pytest.mark.parametrize(
    "data", [b"", b"\xff\xd8\xff\xfe", b"jpeg", with_comment(b"by a camera"), with_comment(b"[1]")]
)
def test_a_foreign_image_has_no_camera(data: bytes) -> None:
    """Such as those of older maps."""
    assert image_of(data) is None
    jpeg = bytes(cv2.imencode(".jpg", np.zeros((8, 8, 3), np.uint8))[1])
    assert image_of(jpeg) is None
    endless = b"[" * 60_000  # JSON that is deeper than Python's stack
    assert image_of(jpeg[:2] + b"\xff\xfe" + struct.pack(">H", len(endless) + 2) + endless + jpeg[2:]) is None


@pytest.mark.parametrize(
    ("fields", "why"),
    [
        ({"K": [[0, 0, 0]] * 3}, "K is no matrix of intrinsics"),
        ({"K": [[1, 2], [3]]}, "camera is invalid"),
        ({"K": "x"}, "camera is invalid"),
        ({"K": None}, r"K is \(\)"),
        ({"T_lidar_cam": (2 * np.eye(4)).tolist()}, "T_lidar_cam is no rigid transform"),
        ({"T_lidar_cam": [[float("nan")] * 4] * 4}, "T_lidar_cam is no rigid transform"),
        ({"size": [10**9, 10**9]}, "size of"),
        ({"size": [320, 121]}, "the camera has 320 x 121"),
        ({"distortion": [1.0]}, "distortion is not"),
        ({"distortion": {"a": 1}}, "camera is invalid"),
    ],
)
def test_an_invalid_camera_is_named(fields: dict[str, Any], why: str) -> None:
    with pytest.raises(ValueError, match=why):
        image_of(changed(**fields))


def test_a_damaged_image_is_an_error() -> None:
    jpeg = thumbnail(picture(), 320)
    (length,) = struct.unpack_from(">H", jpeg, 4)
    with pytest.raises(ValueError, match="cut off"):
        image_of(jpeg[: 8 + length])
