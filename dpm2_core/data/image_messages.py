# SPDX-License-Identifier: Apache-2.0
"""Image, CompressedImage and CameraInfo messages to arrays, duck-typed for rclpy and rosbags."""

from __future__ import annotations

from functools import lru_cache
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from dpm2_core.data.compressed import decode_compressed, upper_eight
from dpm2_core.data.messages import MessageError
from dpm2_core.frame import Array, Camera

DISTORTIONS = (0, 4, 5, 8, 12, 14)
"""Numbers of distortion coefficients that OpenCV supports."""
_WIDEST_IMAGE = 1 << 15
# Encoding to (numpy type, channels, OpenCV conversion to RGB). 8UC3 and 8UC4 are BGR(A), as in cv_bridge.
_IMAGE_ENCODINGS: dict[str, tuple[str, int, int | None]] = {
    "rgb8": ("u1", 3, None),
    "bgr8": ("u1", 3, cv2.COLOR_BGR2RGB),
    "8uc3": ("u1", 3, cv2.COLOR_BGR2RGB),
    "rgba8": ("u1", 4, cv2.COLOR_RGBA2RGB),
    "bgra8": ("u1", 4, cv2.COLOR_BGRA2RGB),
    "8uc4": ("u1", 4, cv2.COLOR_BGRA2RGB),
    "mono8": ("u1", 1, cv2.COLOR_GRAY2RGB),
    "8uc1": ("u1", 1, cv2.COLOR_GRAY2RGB),
    "mono16": ("u2", 1, cv2.COLOR_GRAY2RGB),
    "uyvy": ("u1", 2, cv2.COLOR_YUV2RGB_UYVY),
    "yuv422": ("u1", 2, cv2.COLOR_YUV2RGB_UYVY),
    "yuyv": ("u1", 2, cv2.COLOR_YUV2RGB_YUY2),
    "yuv422_yuy2": ("u1", 2, cv2.COLOR_YUV2RGB_YUY2),
    "yvyu": ("u1", 2, cv2.COLOR_YUV2RGB_YVYU),
    # Half as many rows of color follow the rows of brightness.
    "nv12": ("u1", 1, cv2.COLOR_YUV2RGB_NV12),
    "nv21": ("u1", 1, cv2.COLOR_YUV2RGB_NV21),
    # OpenCV names a Bayer pattern by its second row, ROS by its first.
    "bayer_rggb8": ("u1", 1, cv2.COLOR_BayerBG2RGB),
    "bayer_bggr8": ("u1", 1, cv2.COLOR_BayerRG2RGB),
    "bayer_gbrg8": ("u1", 1, cv2.COLOR_BayerGR2RGB),
    "bayer_grbg8": ("u1", 1, cv2.COLOR_BayerGB2RGB),
    "bayer_rggb16": ("u2", 1, cv2.COLOR_BayerBG2RGB),
    "bayer_bggr16": ("u2", 1, cv2.COLOR_BayerRG2RGB),
    "bayer_gbrg16": ("u2", 1, cv2.COLOR_BayerGR2RGB),
    "bayer_grbg16": ("u2", 1, cv2.COLOR_BayerGB2RGB),
}

_DEPTH_ENCODINGS = ("16uc1", "32fc1")  # mm, m (REP 118)
_YUV420_ENCODINGS = ("nv12", "nv21")
_FISHEYE_MODELS = ("equidistant", "fisheye")
_FISHEYE_COEFFICIENTS = 4


def decode_image(msg: Any, size: tuple[int, int] | None = None) -> NDArray[np.uint8]:
    """sensor_msgs/Image or CompressedImage to (H, W, 3) uint8 RGB; of 10 to 16 bits the upper 8 are kept.

    Args:
        msg: the message.
        size: width and height of the camera: a JPEG or PNG of another size is not decoded.

    Raises:
        MessageError: an unsupported encoding, data shorter than declared, or a damaged JPEG or PNG.
    """
    if not hasattr(msg, "encoding"):
        return _decode_compressed(msg, size)
    encoding = str(msg.encoding)
    if encoding.lower() not in _IMAGE_ENCODINGS:
        raise MessageError(
            f"image encoding {encoding[:40]!r} is not supported; supported: {', '.join(_IMAGE_ENCODINGS)}"
        )
    kind, channels, conversion = _IMAGE_ENCODINGS[encoding.lower()]
    dtype = np.dtype((">" if msg.is_bigendian else "<") + kind)
    height, width, pixel = int(msg.height), int(msg.width), channels * dtype.itemsize
    _check_even(encoding, width, height)
    if encoding.lower() in _YUV420_ENCODINGS:
        height += height // 2
    step = int(msg.step) or width * pixel
    need, have = (height - 1) * step + width * pixel, len(msg.data)
    if not height * width or step < width * pixel or have < need:
        raise MessageError(f"image of {width} x {height} {encoding}, step {step}: {have} bytes of data, {need} needed")
    shape, strides = (height, width, channels), (step, pixel, dtype.itemsize)
    pixels = np.ndarray(shape, dtype, memoryview(msg.data), strides=strides)
    if dtype.itemsize == 2:
        pixels = upper_eight(pixels)
    pixels = np.ascontiguousarray(pixels)
    return pixels if conversion is None else cv2.cvtColor(pixels, conversion)


def _check_even(encoding: str, width: int, height: int) -> None:
    """Raise MessageError if an encoding in which neighboring pixels share a color is used with an odd size."""
    yuv420 = encoding.lower() in _YUV420_ENCODINGS
    if (yuv420 or "yu" in encoding.lower() or "yv" in encoding.lower()) and (width % 2 or (yuv420 and height % 2)):
        raise MessageError(
            f"image of {width} x {height} {encoding}: pixels share their color in pairs, want even sizes"
        )


def _decode_compressed(msg: Any, size: tuple[int, int] | None) -> NDArray[np.uint8]:
    if is_depth(msg):
        raise MessageError(f"compressed image format {msg.format[:40]!r} is not supported; supported: jpeg, png")
    try:
        pixels = decode_compressed(bytes(msg.data), size)
    except ValueError as error:
        what = f"compressed image of format {msg.format[:40]!r} and {len(msg.data)} bytes"
        raise MessageError(f"{what} cannot be decoded: {error}") from None
    encoding, _, compression = msg.format.lower().partition(";")  # "bayer_rggb8; jpeg compressed "
    _, _, conversion = _IMAGE_ENCODINGS.get(encoding, ("", 0, None))
    if conversion is None or not encoding.startswith("bayer_") or "compressed bgr" in compression:
        return pixels
    # image_transport compresses the raw Bayer mosaic.
    return np.asarray(cv2.cvtColor(np.ascontiguousarray(pixels[..., 0]), conversion), np.uint8)


def is_depth(msg: Any) -> bool:
    """Whether an image contains depth."""
    encoding = str(getattr(msg, "encoding", getattr(msg, "format", ""))).lower()  # "16UC1; png compressed "
    return encoding.startswith(_DEPTH_ENCODINGS) or "compresseddepth" in encoding


def decode_camera(info: Any, T_lidar_cam: Array, name: str) -> Camera:
    """sensor_msgs/CameraInfo to `Camera`: K and D unchanged, or the left block of P if D is zero (rectified image).

    A fisheye (equidistant with 4 coefficients, also zeros) is returned as the pinhole camera of the same focal length
    to which `rectified` converts its images.

    Args:
        info: its model is plumb_bob, rational_polynomial (8 coefficients, in OpenCV's order) or equidistant.
        T_lidar_cam: (4, 4) optical frame of the camera to LiDAR frame.
        name: name used in messages.

    Raises:
        MessageError: another distortion model, no focal length, or no size.
    """
    K, P, D = (np.array(x, np.float64) for x in (info.k, info.p, info.d))
    K, P = K.reshape(3, 3), P.reshape(3, 4)
    if not D.any() and not is_fisheye(info):
        D, K = D[:0], P[:, :3].copy() if P[0, 0] else K
    elif info.distortion_model not in ("plumb_bob", "rational_polynomial", *_FISHEYE_MODELS):
        raise MessageError(f"{name}: distortion model {info.distortion_model[:40]!r} is not supported; "
                           "supported: plumb_bob, rational_polynomial, equidistant")  # fmt: skip
    if not (K[0, 0] > 0 and K[1, 1] > 0 and np.isfinite(K).all()):
        raise MessageError(f"{name}: CameraInfo has no focal length (the camera is not calibrated)")
    if (K[2] != (0, 0, 1)).any():
        raise MessageError(f"{name}: the last row of CameraInfo's matrix is {K[2].tolist()}, not 0 0 1")
    allowed = (0, _FISHEYE_COEFFICIENTS) if info.distortion_model in _FISHEYE_MODELS else DISTORTIONS
    if len(D) not in allowed or not np.isfinite(D).all():
        raise MessageError(f"{name}: CameraInfo has {len(D)} distortion coefficients, or some that are not finite")
    if not (0 < info.width <= _WIDEST_IMAGE and 0 < info.height <= _WIDEST_IMAGE):
        raise MessageError(f"{name}: CameraInfo has no image size, or one beyond {_WIDEST_IMAGE} pixels")
    distortion = () if is_fisheye(info) else tuple(D.tolist())
    return Camera(K, T_lidar_cam, (int(info.width), int(info.height)), distortion, name)


def info_of(topic: str, info: Any) -> Any:
    """The CameraInfo for a topic's images: cropped and scaled to the part of the sensor that they show (roi, binning).
    Distortion is removed, so that P is used, for rectified images: image_rect and the like, which image_proc publishes
    next to the CameraInfo of the raw image, and KITTI's from kitti2bag."""
    name = topic.removesuffix("/compressed").rpartition("/")[2]
    is_rectified = bool((name.startswith("image_rect") or topic.startswith("/kitti/")) and info.p[0])
    roi, x, y = info.roi, max(info.binning_x, 1), max(info.binning_y, 1)
    size = (roi.width or info.width) // x, (roi.height or info.height) // y  # zeros mean all pixels, and no binning
    T_part_full = np.array([[1 / x, 0, -roi.x_offset / x], [0, 1 / y, -roi.y_offset / y], [0, 0, 1]])
    if not is_rectified and size == (info.width, info.height) and (T_part_full == np.eye(3)).all():
        return info
    k, p = ((T_part_full @ np.reshape(matrix, (3, -1))).ravel() for matrix in (info.k, info.p))
    return SimpleNamespace(header=info.header, width=size[0], height=size[1], k=k, p=p,
                           d=[] if is_rectified else info.d, distortion_model=info.distortion_model)  # fmt: skip


def info_topic_beside(image_topic: str) -> str:
    """The CameraInfo topic in the same namespace as an image topic; relative for a relative topic."""
    folder = image_topic.removesuffix("/compressed").rpartition("/")[0]
    return f"{folder}/camera_info".removeprefix("" if folder or image_topic.startswith("/") else "/")


def is_fisheye(info: Any) -> bool:
    """Whether images of a CameraInfo that `decode_camera` accepts must be `rectified`."""
    return info.distortion_model in _FISHEYE_MODELS and len(info.d) == _FISHEYE_COEFFICIENTS


def rectified(pixels: NDArray[np.uint8], info: Any) -> NDArray[np.uint8]:
    """(H, W, 3) of an equidistant fisheye as seen by a pinhole camera with the same K, black outside its view.

    Directions 90 degrees and more off the axis are lost, and so are those outside the pinhole image's border.
    J. Kannala, S. Brandt, "A generic camera model and calibration method", PAMI 2006, with 4 coefficients.
    """
    maps = _fisheye_maps(tuple(map(float, info.k)), tuple(map(float, info.d)), pixels.shape[1::-1])
    return np.asarray(cv2.remap(pixels, *maps, cv2.INTER_LINEAR), np.uint8)


@lru_cache(maxsize=4)
def _fisheye_maps(k: tuple[float, ...], d: tuple[float, ...], size: tuple[int, int]) -> tuple[Any, Any]:
    K = np.array(k).reshape(3, 3)
    maps = cv2.fisheye.initUndistortRectifyMap(K, np.array(d), np.eye(3), K, size, cv2.CV_16SC2)
    return maps[0], maps[1]
