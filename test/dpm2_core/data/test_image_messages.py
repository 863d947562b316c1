# SPDX-License-Identifier: Apache-2.0
"""Decoding of Image and CameraInfo: compared with OpenCV, and for damaged messages."""

from __future__ import annotations

import array
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest

from dpm2_core.data import frames, image_messages
from dpm2_core.data.frames import Calibration, CameraTopic, FrameBuilder
from dpm2_core.data.messages import MessageError
from dpm2_core.data.settings import InputSettings
from dpm2_core.frame import Camera
from test.helpers.messages import cloud, header, info, roi, xyz


def picture(height: int = 6, width: int = 8) -> np.ndarray:
    return np.random.default_rng(2).integers(0, 256, (height, width, 3), dtype=np.uint8)


def image(pixels: np.ndarray, encoding: str, padding: int = 0, big: bool = False) -> SimpleNamespace:
    rows = pixels.astype(pixels.dtype.newbyteorder(">" if big else "<")).reshape(len(pixels), -1).view(np.uint8)
    data = np.pad(rows, ((0, 0), (0, padding)), constant_values=99)
    return SimpleNamespace(
        header=header(), height=pixels.shape[0], width=pixels.shape[1], encoding=encoding, is_bigendian=big,
        step=data.shape[1], data=array.array("B", data.tobytes()),
    )  # fmt: skip


RGB = picture()
GRAY = RGB[..., 0].copy()


@pytest.mark.parametrize("padding", [0, 5])
@pytest.mark.parametrize(
    ("encoding", "pixels", "want"),
    [
        ("rgb8", RGB, RGB),
        ("bgr8", RGB[..., ::-1], RGB),
        ("8UC3", RGB[..., ::-1], RGB),
        ("rgba8", np.dstack([RGB, GRAY]), RGB),
        ("bgra8", np.dstack([RGB[..., ::-1], GRAY]), RGB),
        ("mono8", GRAY, np.dstack([GRAY] * 3)),
        ("mono16", GRAY.astype(np.uint16) * 256 + 17, np.dstack([GRAY] * 3)),
    ],
)
def test_image_encodings(encoding: str, pixels: np.ndarray, want: np.ndarray, padding: int) -> None:
    for big in (False, True):
        decoded = image_messages.decode_image(image(pixels, encoding, padding, big))
        assert decoded.dtype == np.uint8
        np.testing.assert_array_equal(decoded, want)


def test_an_image_of_several_clouds_is_decoded_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each of ten parts of a sweep has the same one: of a large camera, decoding takes longer than the sweep."""
    decoded = list[Any]()
    monkeypatch.setattr(frames, "decode_image", lambda message, size: decoded.append(message) or RGB)
    camera = CameraTopic("/image", info())
    builder = FrameBuilder(InputSettings(), Calibration("/points", camera=camera), pytest.fail)
    known = Camera(np.array([[10.0, 0, 4], [0, 10, 3], [0, 0, 1]]), np.eye(4), (8, 6))
    monkeypatch.setattr(builder, "camera", lambda *_: known)
    messages = [image(RGB, "rgb8") for _ in range(2)]
    found = [builder.frame(i * 10**7, cloud(xyz()), i, {"/image": (10**8, messages[i // 10])}) for i in range(20)]
    assert [frame.images[0].time_offset for frame in found] == pytest.approx([0.1 - 0.01 * i for i in range(20)])
    assert decoded == messages
    camera.info = info()  # another calibration may want another size
    builder.frame(2 * 10**8, cloud(xyz()), 20, {"/image": (10**8, messages[1])})
    assert len(decoded) == 3


@pytest.mark.parametrize("bits", [10, 12, 14, 16])
def test_the_upper_bits_that_a_camera_uses_count(bits: int) -> None:
    """Many cameras leave the bits above zero: with 12 bits, the upper 8 of 16 are nearly black."""
    pixels = GRAY.astype(np.uint16) << (bits - 8)
    pixels[0, 0] = (1 << bits) - 1
    decoded = image_messages.decode_image(image(pixels, "mono16"))[..., 0]
    assert decoded[0, 0] == 255
    np.testing.assert_array_equal(decoded[1:], GRAY[1:])
    assert not image_messages.decode_image(image(np.zeros_like(pixels), "mono16")).any()


@pytest.mark.parametrize("padding", [0, 6])
@pytest.mark.parametrize("encoding", ["uyvy", "yuv422", "yuyv", "yuv422_yuy2", "yvyu", "nv12", "nv21"])
def test_yuv_gives_the_color_it_was_made_from(encoding: str, padding: int) -> None:
    """ITU-R BT.601 by its definition, with video range, as cameras and their drivers send it."""
    r, g, b = 200.0, 120.0, 40.0
    y = np.full((4, 6), round(16 + (65.481 * r + 128.553 * g + 24.966 * b) / 255), np.uint8)
    u = round(128 + (-37.797 * r - 74.203 * g + 112.0 * b) / 255)
    v = round(128 + (112.0 * r - 93.786 * g - 18.214 * b) / 255)
    if encoding.startswith("nv"):
        pair = (u, v) if encoding == "nv12" else (v, u)
        pixels = np.vstack([y, np.tile(np.uint8(pair), (2, 3))])
    else:
        u_first = encoding in ("uyvy", "yuv422", "yuyv", "yuv422_yuy2")
        color = np.tile(np.uint8((u, v) if u_first else (v, u)), (4, 3))
        pixels = np.dstack([color, y] if encoding in ("uyvy", "yuv422") else [y, color])
    msg = image(pixels, encoding, padding)
    msg.height = 4
    assert np.abs(image_messages.decode_image(msg).astype(int) - [r, g, b]).max() <= 3


@pytest.mark.parametrize(("encoding", "size"), [("uyvy", (4, 5)), ("nv12", (5, 6)), ("nv21", (4, 5))])
def test_colors_that_are_not_shared_in_pairs(encoding: str, size: tuple[int, int]) -> None:
    with pytest.raises(MessageError, match="in pairs"):
        image_messages.decode_image(image(np.zeros((*size, 3), np.uint8), encoding))


@pytest.mark.parametrize("bits", [8, 16])
@pytest.mark.parametrize("pattern", ["rggb", "bggr", "gbrg", "grbg"])
def test_bayer_patterns_give_the_color_they_were_made_from(pattern: str, bits: int) -> None:
    """A uniformly colored scene survives the mosaic exactly, and only with the right pattern."""
    color = np.array([200, 120, 40], np.uint8)
    mosaic = np.empty((8, 8), np.uint8)
    for i, letter in enumerate(pattern):
        mosaic[i // 2 :: 2, i % 2 :: 2] = color["rgb".index(letter)]
    pixels = mosaic if bits == 8 else mosaic.astype(np.uint16) << 8
    decoded = image_messages.decode_image(image(pixels, f"bayer_{pattern}{bits}"))
    np.testing.assert_array_equal(decoded[2:-2, 2:-2], np.broadcast_to(color, (4, 4, 3)))


def test_a_compressed_mosaic_gets_its_color() -> None:
    """image_transport compresses a Bayer image as it is. An image whose format contains bgr8 is already in color."""
    color = np.array([200, 120, 40], np.uint8)
    mosaic = np.empty((8, 8), np.uint8)
    for i, letter in enumerate("gbrg"):
        mosaic[i // 2 :: 2, i % 2 :: 2] = color["rgb".index(letter)]
    for form, pixels in (
        ("bayer_gbrg8; png compressed ", mosaic),
        ("bayer_gbrg8; png compressed bgr8", np.broadcast_to(color[::-1], (8, 8, 3))),
    ):
        data = cv2.imencode(".png", pixels)[1].reshape(-1)
        decoded = image_messages.decode_image(SimpleNamespace(header=header(), format=form, data=data))
        np.testing.assert_array_equal(decoded[2:-2, 2:-2], np.broadcast_to(color, (4, 4, 3)))


def test_compressed_images() -> None:
    smooth = cv2.resize(picture(4, 4), (64, 48), interpolation=cv2.INTER_CUBIC)
    for form, tolerance in (("png", 0), ("jpeg", 30)):  # JPEG of a smooth image, quality 95
        data = cv2.imencode(f".{form}", cv2.cvtColor(smooth, cv2.COLOR_RGB2BGR))[1].reshape(-1)
        decoded = image_messages.decode_image(SimpleNamespace(header=header(), format=form, data=data))
        assert np.abs(decoded.astype(int) - smooth).max() <= tolerance


@pytest.mark.parametrize("bits", [10, 12, 16])
def test_the_upper_bits_of_a_png_count_as_those_of_an_image(bits: int) -> None:
    """In the upper eight of its 16 bits, an image of a 12-bit camera is nearly black."""
    pixels = np.linspace(0, 2**bits - 1, 48).astype(np.uint16).reshape(6, 8)
    data = cv2.imencode(".png", pixels)[1].reshape(-1)
    decoded = image_messages.decode_image(SimpleNamespace(header=header(), format="mono16; png compressed ", data=data))
    np.testing.assert_array_equal(decoded, image_messages.decode_image(image(pixels, "mono16")))


@pytest.mark.parametrize(
    ("msg", "message"),
    [
        (image(RGB, "yuv411"), "encoding 'yuv411' is not supported; supported: rgb8, bgr8"),
        (SimpleNamespace(**(vars(image(RGB, "rgb8")) | {"height": 7})), "144 bytes of data, 168 needed"),
        (SimpleNamespace(**(vars(image(RGB, "rgb8")) | {"step": 5})), "step 5"),
        (SimpleNamespace(**(vars(image(RGB, "rgb8")) | {"width": 0})), "0 x 6"),
        (SimpleNamespace(format="jpeg", data=b"\xff\xd8garbage"), "'jpeg' and 9 bytes cannot be decoded"),
        (SimpleNamespace(format="png", data=b""), "0 bytes cannot be decoded"),
        (image(GRAY.astype(np.uint16), "16UC1"), "encoding '16UC1' is not supported"),  # depth in mm, by REP 118
        (SimpleNamespace(format="16UC1; compressedDepth png", data=b"12345"), "compressedDepth"),
        (SimpleNamespace(format="16UC1; png compressed ", data=b"12345"), "format '16UC1; png compressed ' is not sup"),
    ],
)
def test_images_that_cannot_be_used_are_named(msg: SimpleNamespace, message: str) -> None:
    with pytest.raises(MessageError, match=message):
        image_messages.decode_image(msg)


def test_camera_of_a_rectified_image_has_the_rectified_intrinsics() -> None:
    camera = image_messages.decode_camera(info(), np.eye(4), "left")
    np.testing.assert_array_equal(camera.K, [[480, 0, 310], [0, 490, 230], [0, 0, 1]])
    assert (camera.size, camera.distortion, camera.name) == ((640, 480), (), "left")
    unrectified = image_messages.decode_camera(info(p=np.zeros(12), d=[]), np.eye(4), "left")
    assert unrectified.K[0, 0] == 500


@pytest.mark.parametrize("model", ["plumb_bob", "equidistant"])
def test_the_info_of_a_raw_image_beside_its_rectified_one(model: str) -> None:
    """image_proc publishes image_rect with the CameraInfo of the raw image: P applies, without distortion."""
    raw = info(d=[0.1, 0.0, 0.0, 0.01], distortion_model=model, header=header())
    for topic in ("/front/image_rect", "/front/image_rect_color/compressed", "/kitti/camera_color_left/image_raw"):
        of_topic = image_messages.info_of(topic, raw)
        camera = image_messages.decode_camera(of_topic, np.eye(4), "front")
        assert (camera.K[0, 0], camera.distortion) == (480, ())
        assert not image_messages.is_fisheye(of_topic)
    for topic, of in (("/front/image_raw", raw), ("/front/image_rect", info(p=np.zeros(12), header=header()))):
        assert image_messages.info_of(topic, of) is of


@pytest.mark.parametrize(
    ("changes", "size"),
    [
        ({"binning_x": 2, "binning_y": 4}, (320, 120)),
        ({"roi": roi(100, 40, 200, 300)}, (200, 300)),
        ({"roi": roi(100, 40, 200, 300), "binning_x": 2, "binning_y": 2}, (100, 150)),
        ({"roi": roi(0, 0, 640, 480), "binning_x": 1, "binning_y": 1}, (640, 480)),
    ],
)
@pytest.mark.parametrize("topic", ["/front/image_raw", "/front/image_rect"])
def test_the_info_of_a_part_of_the_sensor(changes: dict[str, Any], size: tuple[int, int], topic: str) -> None:
    """A ray falls on the pixel of the whole sensor, minus the corner of the part, in pixels of the binned image."""
    D, ray = [0.1, 0.0, 0.0, 0.01, 0.0], np.array([0.1, -0.2, 1.0])
    whole, part = (
        image_messages.decode_camera(image_messages.info_of(topic, one), np.eye(4), "front")
        for one in (info(d=D), info(d=D, **changes))
    )
    of = info(**changes)
    corner, pixel = [of.roi.x_offset, of.roi.y_offset], [of.binning_x or 1, of.binning_y or 1]
    np.testing.assert_allclose((part.K @ ray)[:2], ((whole.K @ ray)[:2] - corner) / pixel, rtol=1e-12)
    assert (part.size, part.distortion) == (size, whole.distortion)


def test_an_ideal_fisheye_has_no_coefficients() -> None:
    """From a simulator: a light is where its angle says, not where a pinhole camera would have it."""
    k = [200.0, 0, 320, 0, 200, 240, 0, 0, 1]
    msg = info(distortion_model="equidistant", d=[0.0] * 4, k=k, p=np.zeros(12))
    pixels = np.zeros((480, 640, 3), np.uint8)
    cv2.circle(pixels, (round(320 + 200 * np.radians(50)), 240), 3, (255, 255, 255), -1)
    assert image_messages.is_fisheye(msg)
    camera = image_messages.decode_camera(msg, np.eye(4), "front")
    u = np.argwhere(image_messages.rectified(pixels, msg)[..., 0] > 128).mean(0)[1]
    assert u == pytest.approx((camera.K @ [np.tan(np.radians(50)), 0, 1])[0], abs=1.5)  # a spot of 7 pixels, spread
    assert not image_messages.is_fisheye(info(distortion_model="equidistant", d=[]))


def test_a_fisheye_becomes_a_pinhole_camera() -> None:
    """In the rectified image, a light in a known direction is at its pinhole projection, to a pixel. In the fisheye
    image it was elsewhere."""
    d = (0.05, -0.01, 0.002, -0.0005)
    msg = info(distortion_model="equidistant", d=list(d), p=np.zeros(12), k=[300.0, 0, 320, 0, 300, 240, 0, 0, 1])
    ray = np.array([0.6, -0.4, 1.0])
    angle = np.arctan(np.hypot(*ray[:2]))
    radius = 300 * angle * (1 + sum(c * angle ** (2 * i + 2) for i, c in enumerate(d)))
    u, v = np.array([320, 240]) + radius * ray[:2] / np.hypot(*ray[:2])
    pixels = np.zeros((480, 640, 3), np.uint8)
    cv2.circle(pixels, (round(u), round(v)), 3, (255, 255, 255), -1)
    assert image_messages.is_fisheye(msg)
    camera = image_messages.decode_camera(msg, np.eye(4), "front")
    assert camera.distortion == ()
    spot = np.argwhere(image_messages.rectified(pixels, msg)[..., 0] > 128).mean(0)[::-1]
    want = (camera.K @ ray)[:2]
    np.testing.assert_allclose(spot, want, atol=1.0)
    assert np.linalg.norm(np.array([u, v]) - want) > 10
    assert not image_messages.is_fisheye(info())
    with pytest.raises(MessageError, match="5 distortion coefficients"):
        image_messages.decode_camera(info(distortion_model="equidistant", d=[0.1] * 5), np.eye(4), "front")


@pytest.mark.parametrize(("model", "count"), [("plumb_bob", 5), ("rational_polynomial", 8)])
def test_camera_with_distortion_keeps_it(model: str, count: int) -> None:
    D = [-0.3, 0.1, 0.001, -0.002, 0.01, 0.02, 0.03, 0.04][:count]
    camera = image_messages.decode_camera(info(d=D, distortion_model=model), np.eye(4), "left")
    assert camera.distortion == tuple(D)
    assert camera.K[0, 0] == 500


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"d": [0.1] * 4, "distortion_model": "omni"}, "left: distortion model 'omni' is not supported"),
        ({"k": np.zeros(9), "p": np.zeros(12)}, "left: CameraInfo has no focal length"),
        (
            {"k": np.array([500.0, 0, 320, 0, 500, 240, 0, 0, 0]), "p": np.zeros(12)},
            "left: the last row of CameraInfo's",
        ),
        ({"width": 0}, "left: CameraInfo has no image size"),
    ],
)
def test_camera_that_cannot_be_used(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(MessageError, match=message):
        image_messages.decode_camera(info(**changes), np.eye(4), "left")


@pytest.mark.parametrize(
    "changes",
    [
        {"d": [np.nan] * 5},
        {"d": [0.1] * 7},
        {"d": [0.1] * 100_000},
        {"width": 2**32 - 1},
        {"k": [np.nan] * 9, "p": [np.nan] * 12},
    ],
)
def test_a_calibration_that_no_camera_has_is_rejected(changes: dict[str, Any]) -> None:
    with pytest.raises(MessageError) as error:
        image_messages.decode_camera(info(distortion_model="plumb_bob", **changes), np.eye(4), "camera")
    assert len(str(error.value)) < 300
