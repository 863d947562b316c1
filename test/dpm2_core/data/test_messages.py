# SPDX-License-Identifier: Apache-2.0
"""PointCloud2, Image and CameraInfo decoding: against plain struct decoding and OpenCV, and on damaged messages."""

from __future__ import annotations

import array
import struct
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dpm2_core.data import image_messages, messages
from dpm2_core.data.messages import MessageError

CODES = {1: "b", 2: "B", 3: "h", 4: "H", 5: "i", 6: "I", 7: "f", 8: "d"}
NUMPY = {"b": "i1", "B": "u1", "h": "i2", "H": "u2", "i": "i4", "I": "u4", "f": "f4", "d": "f8"}
STAMP = 1_700_000_000_250_000_000


def field(name: str, offset: int, datatype: int, count: int = 1) -> SimpleNamespace:
    return SimpleNamespace(name=name, offset=offset, datatype=datatype, count=count)


def header(stamp: int = STAMP) -> SimpleNamespace:
    return SimpleNamespace(stamp=SimpleNamespace(sec=stamp // 10**9, nanosec=stamp % 10**9), frame_id="velo_link")


def cloud(columns: dict[str, np.ndarray], stamp: int = STAMP) -> SimpleNamespace:
    return SimpleNamespace(header=header(stamp), **messages.cloud_fields(columns, SimpleNamespace))


def xyz(n: int = 5, **more: Any) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(0)
    return {k: rng.uniform(1, 50, n).astype(np.float32) for k in "xyz"} | {k: np.asarray(v) for k, v in more.items()}


@st.composite
def raw_clouds(draw: st.DrawFn) -> tuple[SimpleNamespace, np.ndarray]:
    """A PointCloud2 of random layout, written by struct one value at a time, and the xyz it holds."""
    big, height, width = draw(st.booleans()), draw(st.integers(1, 4)), draw(st.integers(0, 6))
    names = draw(st.permutations(["x", "y", "z", "ring", "tag"]))
    fields, offset = [], draw(st.integers(0, 3))
    for name in names:
        code = draw(st.sampled_from(sorted(CODES)))
        fields.append(field(name, offset, code))
        offset += struct.calcsize(CODES[code]) + draw(st.integers(0, 5))
    step, padding = offset, draw(st.integers(0, 7))
    data = bytearray(draw(st.integers(0, 255)) for _ in range(1)) * (height * (width * step + padding))
    want = np.zeros((height * width, 3))
    for row in range(height):
        for column in range(width):
            for f in fields:
                code = CODES[f.datatype]
                if code in "fd":
                    value: float = draw(st.floats(width=32, allow_infinity=False))
                else:
                    value = draw(st.integers(0, 127))
                at = row * (width * step + padding) + column * step + f.offset
                struct.pack_into((">" if big else "<") + code, data, at, value)
                if f.name in "xyz":
                    want[row * width + column, "xyz".index(f.name)] = value
    form = draw(st.sampled_from([bytes, lambda b: array.array("B", b), lambda b: np.frombuffer(bytes(b), np.uint8)]))
    msg = SimpleNamespace(
        header=header(), height=height, width=width, fields=fields, is_bigendian=big, point_step=step,
        row_step=width * step + padding, data=form(data),
    )  # fmt: skip
    return msg, want


@settings(max_examples=80, deadline=None)
@given(raw_clouds())
def test_any_layout_decodes_as_struct_does(case: tuple[SimpleNamespace, np.ndarray]) -> None:
    msg, want = case
    points, time = messages.decode_points(msg)
    assert points.dtype == np.float32
    assert time is None
    np.testing.assert_array_equal(points[:, :3], want.astype(np.float32))
    np.testing.assert_array_equal(points[:, 3], 0)


def test_the_packed_layout_is_not_copied() -> None:
    msg = cloud(xyz(intensity=np.linspace(0, 1, 5, dtype=np.float32)))
    points, _ = messages.decode_points(msg)
    assert np.shares_memory(points, msg.data)
    np.testing.assert_array_equal(points[:, 3], np.linspace(0, 1, 5, dtype=np.float32))


@pytest.mark.parametrize(
    ("name", "value", "want"),
    [
        ("intensity", np.float32([0, 0.25, 1]), [0, 0.25, 1]),
        ("i", np.float32([0, 51, 255]), [0, 0.2, 1]),
        ("reflectivity", np.float32([0, 13107, 60000]), [0, 0.2, 60000 / 65535]),
        ("intensity", np.uint8([0, 1, 51]), [0, 1 / 255, 0.2]),  # an integer 1 is dark, not full
        ("intensity", np.uint16([0, 1, 255]), [0, 1 / 255, 1]),
        ("Intensity", np.uint16([0, 13107, 65535]), [0, 0.2, 1]),
        ("intensity", np.float64([0, np.nan, 255]), [0, 0, 1]),  # an unknown intensity does not make the point unknown
        ("intensity", np.float32([-1, np.inf, 1]), [0, 0, 1]),
        ("ring", np.uint8([1, 2, 3]), [0, 0, 0]),
    ],
)
def test_intensity_is_scaled_to_one(name: str, value: np.ndarray, want: list[float]) -> None:
    msg = cloud(xyz(3, **{name: value}))
    before = bytes(msg.data)
    points, _ = messages.decode_points(msg)
    np.testing.assert_allclose(points[:, 3], want, rtol=1e-6)
    assert bytes(msg.data) == before  # the message itself is left alone


def test_intensity_max_is_obeyed() -> None:
    points, _ = messages.decode_points(cloud(xyz(2, intensity=np.float32([0.5, 4]))), intensity_max=2.0)
    np.testing.assert_allclose(points[:, 3], [0.25, 1])


RAMP = np.linspace(0, 0.1, 5)


@pytest.mark.parametrize(
    ("name", "value", "want", "tolerance"),
    [
        ("t", (RAMP * 1e9).astype(np.uint32), RAMP, 1e-8),  # Ouster
        ("offset_time", (RAMP * 1e9).astype(np.uint32), RAMP, 1e-8),  # Livox CustomMsg
        ("time_offset_ns", (RAMP * 1e9).astype(np.int32), RAMP, 1e-8),
        ("timestamp_ns", STAMP + RAMP * 1e9, RAMP, 1e-6),
        ("ts", RAMP.astype(np.float32), RAMP, 1e-8),
        ("point_time", RAMP, RAMP, 1e-8),
        ("Time_us", (RAMP * 1e6).astype(np.uint32), RAMP, 1e-6),
        ("t_sec", RAMP, RAMP, 1e-8),
        ("time", RAMP.astype(np.float32), RAMP, 1e-8),  # Velodyne
        ("time", (RAMP - 0.1).astype(np.float32), RAMP - 0.1, 1e-8),  # stamped at the end of the sweep
        ("t", (RAMP * 1e6).astype(np.uint32), RAMP, 1e-6),
        ("time_stamp", (RAMP * 1e3).astype(np.float32), RAMP, 1e-6),
        ("timestamp", STAMP * 1e-9 + RAMP, RAMP, 1e-6),  # Hesai: epoch in s; a double resolves 0.24 us there
        ("timestamp", STAMP + RAMP * 1e9, RAMP, 1e-6),  # Livox PointCloud2: epoch in ns
        ("timestamp", STAMP * 1e-3 + RAMP * 1e6, RAMP, 1e-6),
        ("timestamp", 7200.0 + RAMP, RAMP, 1e-6),  # clock of the sensor since it was switched on
        ("t", np.uint32([1_800_000_000, 1_800_050_000, 1_800_100_000]), [0, 0.05, 0.1], 1e-6),  # us of the hour
    ],
)
def test_time_units_and_origins(name: str, value: np.ndarray, want: np.ndarray, tolerance: float) -> None:
    _, time = messages.decode_points(cloud(xyz(len(value), **{name: value})))
    assert time is not None
    assert time.dtype == np.float32
    np.testing.assert_allclose(time, want, atol=tolerance)


def test_times_that_tell_nothing() -> None:
    constant = cloud(xyz(3, t=np.uint32([7, 7, 7])))
    assert messages.decode_points(constant)[1] is None
    named = cloud(xyz(3, sweep=np.float32([0, 0.5, 1])))
    assert messages.decode_points(named)[1] is None
    assert messages.decode_points(cloud(xyz(3, t=np.float32([0, 0.5, 1]))), time_field="")[1] is None
    _, time = messages.decode_points(named, time_field="sweep", time_unit="ms")
    np.testing.assert_allclose(time, [0, 5e-4, 1e-3], rtol=1e-6)
    with pytest.raises(MessageError, match="no time field t; fields: x, y, z, sweep"):
        messages.decode_points(named, time_field="t")


def test_a_unit_in_the_name_outweighs_the_span() -> None:
    """Returns of a scan of 1 ms, the first of a sensor that was just switched on: by the span alone they were s."""
    ramp = np.float64([0, 0.5, 1.0])
    np.testing.assert_allclose(messages.decode_points(cloud(xyz(3, time_ms=ramp)))[1], ramp * 1e-3, atol=1e-9)
    np.testing.assert_allclose(messages.decode_points(cloud(xyz(3, time_ms=ramp)), time_unit="s")[1], ramp, atol=1e-9)


@pytest.mark.parametrize(
    ("columns", "reason"),
    [({}, "no time field"), ({"ring": np.uint8([1, 2, 3])}, "no time field"),
     ({"status": np.uint8([0, 1, 2])}, "no time field"), ({"T": np.uint32([7, 7, 7])}, "all points have the same T")],
)  # fmt: skip
def test_why_there_are_no_times_is_said(columns: dict[str, np.ndarray], reason: str) -> None:
    msg = cloud(xyz(3, **columns))
    assert messages.decode_points(msg)[1] is None
    assert messages.why_untimed(msg) == reason


def test_few_points_take_the_unit_of_their_type() -> None:
    """Two points 1 us apart: the span says nothing, an integer is then ns and a float s."""
    np.testing.assert_allclose(messages.decode_points(cloud(xyz(2, t=np.uint32([0, 1000]))))[1], [0, 1e-6])
    np.testing.assert_allclose(messages.decode_points(cloud(xyz(2, t=np.float32([0, 1e-6]))))[1], [0, 1e-6])
    stamps = STAMP * 1e-9 + np.array([0, 1e-6])
    np.testing.assert_allclose(messages.decode_points(cloud(xyz(2, t=stamps)))[1], [0, 1e-6], atol=3e-7)


def test_missing_returns_do_not_spoil_the_times() -> None:
    columns = xyz(4, timestamp=STAMP * 1e-9 + np.array([0, 0.05, 0, 0.1]))
    columns["timestamp"][2] = 0.0  # as drivers leave it
    for name in "xyz":
        columns[name][2] = np.nan
    points, time = messages.decode_points(cloud(columns))
    assert np.isnan(points[2, :3]).all()
    np.testing.assert_allclose(time, [0, 0.05, 0, 0.1], atol=1e-6)


@pytest.mark.parametrize("began", [5.0, STAMP * 1e-9])
def test_a_time_of_zero_among_absolute_ones_means_nothing(began: float) -> None:
    """As of a missing return whose point was moved into the vehicle's frame; by a clock of the sensor or by UTC."""
    _, clean = messages.decode_points(cloud(xyz(4, timestamp=began + np.array([0, 0.05, 0.07, 0.1]))))
    _, time = messages.decode_points(cloud(xyz(5, timestamp=np.append(began + np.array([0, 0.05, 0.07, 0.1]), 0.0))))
    np.testing.assert_array_equal(time, np.append(clean, 0))
    _, relative = messages.decode_points(cloud(xyz(4, time=np.array([0, 0.03, 0.06, 0.1], np.float32))))
    np.testing.assert_allclose(relative, [0, 0.03, 0.06, 0.1])


@pytest.mark.parametrize("unit", ["s", "ns"])
@pytest.mark.parametrize("began", [0.05, 0.3, 1.0, 1.7, 2.5])
def test_absolute_times_of_a_clock_that_has_just_begun(began: float, unit: str) -> None:
    """As of a simulation, for layouts of Hesai, RoboSense and Livox: taken for relative they put points 1.7 s off."""
    ramp, stamp = np.linspace(0, 0.1, 200), round(began * 1e9)
    for first in (0.0, -0.1) if began > 0.1 else (0.0,):  # stamped at its first or its last point
        time = (began + first + ramp) * (1e9 if unit == "ns" else 1)
        _, offset = messages.decode_points(cloud(xyz(200, timestamp=time), stamp))
        np.testing.assert_allclose(offset, first + ramp, atol=1e-6)
        _, offset = messages.decode_points(cloud(xyz(200, time=(first + ramp).astype(np.float32)), stamp))
        np.testing.assert_allclose(offset, first + ramp, atol=1e-6)


def test_times_that_mean_nothing_are_none() -> None:
    """Unsigned ones from before the stamp: as zeros nearly all of them would have passed for known."""
    early = np.uint32(np.arange(-20_000_000, 80_000_000, 1_000_000) % 2**32)
    msg = cloud(xyz(100, t=early))
    assert messages.decode_points(msg)[1] is None
    assert messages.why_untimed(msg) == "t is no possible time of most points"


@pytest.mark.parametrize("wrong", [0, 7e9, 4294967295])
@pytest.mark.parametrize(
    ("began", "unit"), [(0, 1e-6), (0, 1e-9), (0, 1), (STAMP * 1e-9, 1), (60e9, 1e-9), (5.0, 1)]
)  # fmt: skip
def test_one_time_that_is_far_off_spoils_no_other(began: float, unit: float, wrong: float) -> None:
    """As of a damaged packet: it took the unit from the others, or their beginning. Tolerance: float64 of an epoch."""
    ramp = np.linspace(0, 0.1, 1000)
    time = began + ramp / unit
    spoiled = time.copy()
    spoiled[500] = wrong
    _, want = messages.decode_points(cloud(xyz(1000, timestamp=time)))
    _, got = messages.decode_points(cloud(xyz(1000, timestamp=spoiled)))
    assert want is not None
    assert got is not None
    np.testing.assert_allclose(want, ramp, atol=1e-6)
    np.testing.assert_allclose(np.delete(got, 500), np.delete(want, 500), atol=1e-6)
    assert abs(got[500]) <= 2


def test_two_times_years_apart_are_no_sweep() -> None:
    """Nothing says which of the two is right: neither point is moved by more than a sweep can last."""
    _, offset = messages.decode_points(cloud(xyz(2, timestamp=np.array([5.0, STAMP * 1e-9 + 1e8]))))
    assert offset is None or np.abs(offset).max() <= 2.0


def test_odd_points_keep_their_place() -> None:
    columns = xyz(5)
    columns["x"][:] = [np.nan, np.inf, 0, -np.inf, 1]
    points, _ = messages.decode_points(cloud(columns))
    np.testing.assert_array_equal(points[:, 0], columns["x"])
    huge = cloud({k: np.array([1e300, 1.0]) for k in "xyz"})
    assert np.isinf(messages.decode_points(huge)[0][0, 0])


def test_empty_cloud() -> None:
    points, time = messages.decode_points(cloud(xyz(0, intensity=np.empty(0, np.float32), t=np.empty(0, np.uint32))))
    assert points.shape == (0, 4)
    assert time is None


def broken(**changes: Any) -> SimpleNamespace:
    msg = cloud(xyz(6, intensity=np.zeros(6, np.float32)))
    return SimpleNamespace(**(vars(msg) | changes))


@pytest.mark.parametrize(
    ("msg", "message"),
    [
        (broken(fields=[field("x", 0, 7), field("range", 4, 7)]), "no field y, z; fields: x, range"),
        (broken(fields=[]), "no field x, y, z; fields: none"),
        (broken(data=np.zeros(80, np.uint8)), "80 bytes of data, 96 declared"),
        (broken(data=b""), "0 bytes of data, 96 declared"),
        (broken(height=2, width=3, row_step=40), "row_step 40 is less than"),
        (broken(fields=[field("x", 0, 7), field("y", 4, 7), field("z", 14, 7)]), "field z ends beyond point_step 16"),
        (broken(fields=[field("x", 0, 7), field("y", 4, 7), field("z", 8, 9)]), "field z: unknown datatype 9"),
    ],
)
def test_contradictory_clouds_are_rejected(msg: SimpleNamespace, message: str) -> None:
    with pytest.raises(MessageError, match=message):
        messages.decode_points(msg)


def test_row_step_of_a_single_row_is_not_needed() -> None:
    assert messages.decode_points(broken(row_step=0))[0].shape == (6, 4)


@pytest.mark.parametrize("kind", ["i1", "u1", "i2", "u2", "i4", "u4", "f4", "f8"])
def test_written_columns_come_back(kind: str) -> None:
    """What `cloud_fields` writes, `cloud_view` reads: any type, and features of many values a point."""
    rng = np.random.default_rng(1)
    columns = {"x": rng.normal(size=7).astype("f4"), "feature": rng.integers(0, 100, (7, 16)).astype(kind)}
    view = messages.cloud_view(SimpleNamespace(**messages.cloud_fields(columns, SimpleNamespace)))
    for name, column in columns.items():
        np.testing.assert_array_equal(view[name], column)


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


@pytest.mark.parametrize("bits", [10, 12, 14, 16])
def test_the_upper_bits_that_a_camera_uses_count(bits: int) -> None:
    """Many cameras leave those above zero: of 12 bits the upper 8 of 16 are nearly black."""
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
    """image_transport compresses a Bayer image as it is; one whose format says bgr8 has its color already."""
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
    """By the upper eight of its 16 a camera of 12 bits is nearly black."""
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
        (image(GRAY.astype(np.uint16), "16UC1"), "encoding '16UC1' is not supported"),  # depth in mm, as REP 118 has it
        (SimpleNamespace(format="16UC1; compressedDepth png", data=b"12345"), "compressedDepth"),
        (SimpleNamespace(format="16UC1; png compressed ", data=b"12345"), "format '16UC1; png compressed ' is not sup"),
    ],
)
def test_images_that_cannot_be_used_are_named(msg: SimpleNamespace, message: str) -> None:
    with pytest.raises(MessageError, match=message):
        image_messages.decode_image(msg)


def info(**changes: Any) -> SimpleNamespace:
    K, P = np.array([500, 0, 320, 0, 510, 240, 0, 0, 1.0]), np.array([480, 0, 310, 0, 0, 490, 230, 0, 0, 0, 1, 0.0])
    base = {"k": K, "p": P, "d": [0.0] * 5, "distortion_model": "plumb_bob", "width": 640, "height": 480}
    whole = {"binning_x": 0, "binning_y": 0, "roi": roi(0, 0, 0, 0), "header": header()}
    return SimpleNamespace(**(base | whole | changes))


def roi(x: int, y: int, width: int, height: int) -> SimpleNamespace:
    return SimpleNamespace(x_offset=x, y_offset=y, width=width, height=height)


def test_camera_of_a_rectified_image_has_the_rectified_intrinsics() -> None:
    camera = image_messages.decode_camera(info(), np.eye(4), "left")
    np.testing.assert_array_equal(camera.K, [[480, 0, 310], [0, 490, 230], [0, 0, 1]])
    assert (camera.size, camera.distortion, camera.name) == ((640, 480), (), "left")
    unrectified = image_messages.decode_camera(info(p=np.zeros(12), d=[]), np.eye(4), "left")
    assert unrectified.K[0, 0] == 500


@pytest.mark.parametrize("model", ["plumb_bob", "equidistant"])
def test_the_info_of_a_raw_image_beside_its_rectified_one(model: str) -> None:
    """image_proc publishes image_rect beside the CameraInfo of the raw image: P counts, without distortion."""
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
    """A ray falls on the pixel of the whole sensor, less the corner of the part, in pixels of the binned image."""
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
    """Of a simulator: the light is where the angle says, not where a pinhole camera has it."""
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
    """A light at a known direction is where the pinhole camera says, to a pixel; the fisheye had it elsewhere."""
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


def test_real_rclpy_messages_decode_alike() -> None:
    """The duck typing holds for the classes that the node gets, with array.array data."""
    sensor_msgs = pytest.importorskip("sensor_msgs.msg")
    columns = xyz(50, intensity=np.linspace(0, 1, 50, dtype=np.float32), t=np.arange(50, dtype=np.uint32) * 2_000_000)
    fields = messages.cloud_fields(columns, sensor_msgs.PointField)
    data = array.array("B", fields.pop("data").tobytes())
    msg = sensor_msgs.PointCloud2(data=data, **fields)
    points, time = messages.decode_points(msg)
    np.testing.assert_array_equal(points, np.stack([columns[k] for k in ("x", "y", "z", "intensity")], 1))
    np.testing.assert_allclose(time, np.arange(50) * 2e-3, atol=1e-8)
    camera = image_messages.decode_camera(
        sensor_msgs.CameraInfo(k=info().k, p=info().p, width=64, height=48), np.eye(4), "c"
    )
    assert camera.K[0, 0] == 480


def test_times_that_no_sweep_can_have_are_left_out() -> None:
    """They would move the points to anywhere; the other points keep theirs."""
    _, offset = messages.decode_points(cloud(xyz(5, t=np.array([0.0, 0.05, 0.1, 1e300, np.nan]))), time_unit="s")
    assert offset is not None
    np.testing.assert_allclose(offset[:3], [0, 0.05, 0.1])
    assert np.isfinite(offset).all()
    assert np.abs(offset).max() <= 2.0


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
