# SPDX-License-Identifier: Apache-2.0
"""A small image of a keyframe: a plain JPEG that any viewer shows, with its camera in the JPEG's comment."""

from __future__ import annotations

import json
import struct
from dataclasses import replace

import cv2
import numpy as np

from dpm2_core.data.compressed import decode_compressed
from dpm2_core.data.image_messages import DISTORTIONS
from dpm2_core.frame import Array, Camera, Image

PLACE_WIDTH = 320
"""Width of an image for place recognition, pixels: 6 to 10 kB."""
_START_OF_IMAGE, _COMMENT = b"\xff\xd8", b"\xff\xfe"
_QUALITY = 80
_CAMERA_KEYS = {"K", "T_lidar_cam", "size", "distortion", "name"}
_MAX_SIDE = 4096  # pixels of width and height


def thumbnail(image: Image, width: int) -> bytes:
    """JPEG of an image, `width` pixels wide."""
    height = max(1, round(width * image.pixels.shape[0] / image.pixels.shape[1]))
    small = cv2.resize(image.pixels, (width, height), interpolation=cv2.INTER_AREA)
    jpeg = cv2.imencode(".jpg", cv2.cvtColor(small, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])[1]
    return _with_camera(image.camera.resized(width, height), bytes(jpeg)[2:])


def within(jpeg: bytes, most: int) -> bytes | None:
    """A `thumbnail`, reduced to at most `most` bytes; None for a larger JPEG without a camera."""
    if len(jpeg) <= most:
        return jpeg
    if (image := usable_image(jpeg)) is None:
        return None
    width = image.camera.size[0]
    while len(jpeg) > most:
        width = round(0.9 * width)
        jpeg = thumbnail(image, width)
    return jpeg


def moved_thumbnail(jpeg: bytes, T_new_old: Array) -> bytes:
    """A `thumbnail` whose camera pose is changed from the LiDAR frame to another frame, by (4, 4) T_new_old."""
    (length,) = struct.unpack_from(">H", jpeg, 4)
    camera = _decode_camera(json.loads(jpeg[6 : 4 + length]))
    return _with_camera(replace(camera, T_lidar_cam=T_new_old @ camera.T_lidar_cam), jpeg[4 + length :])


def _with_camera(camera: Camera, rest: bytes) -> bytes:
    """A JPEG with the camera in a comment before the rest of it."""
    fields = {key: np.asarray(value).tolist() for key, value in vars(camera).items()}
    comment = json.dumps(fields).encode()
    return _START_OF_IMAGE + _COMMENT + struct.pack(">H", len(comment) + 2) + comment + rest


def image_of(jpeg: bytes) -> Image | None:
    """The image of such a JPEG; None if it has no camera.

    Raises:
        ValueError: it is damaged, or its camera is invalid.
    """
    if jpeg[:4] != _START_OF_IMAGE + _COMMENT or len(jpeg) < 6:
        return None
    (length,) = struct.unpack_from(">H", jpeg, 4)
    try:
        fields = json.loads(jpeg[6 : 4 + length])
    except (ValueError, RecursionError):
        return None
    if not isinstance(fields, dict) or fields.keys() != _CAMERA_KEYS:
        return None
    try:
        camera = _decode_camera(fields)
    except (ValueError, TypeError, OverflowError, RecursionError) as error:
        raise ValueError(f"thumbnail: its camera is invalid: {error}") from None
    return Image(decode_compressed(jpeg, camera.size), camera)


def usable_image(jpeg: bytes | None) -> Image | None:
    """Like `image_of`, but None also without a JPEG, and for a damaged one."""
    try:
        return None if jpeg is None else image_of(jpeg)
    except ValueError:
        return None


def _decode_camera(fields: dict[str, object]) -> Camera:
    K, T, size, distortion = (np.asarray(fields[key], np.float64) for key in ("K", "T_lidar_cam", "size", "distortion"))
    if size.shape != (2,) or not ((size >= 1) & (size <= _MAX_SIDE)).all():
        raise ValueError(f"size of {size.tolist()} pixels")
    if distortion.ndim != 1 or len(distortion) not in DISTORTIONS or not np.isfinite(distortion).all():
        raise ValueError("distortion is not 4, 5, 8, 12 or 14 finite numbers")
    return Camera(K, T, (int(size[0]), int(size[1])), tuple(distortion.tolist()), str(fields["name"]))
