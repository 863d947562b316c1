# SPDX-License-Identifier: Apache-2.0
"""PointCloud2 decoding: compared with plain struct decoding, and for damaged messages."""

from __future__ import annotations

import array
import struct
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dpm2_core.data import image_messages, messages
from dpm2_core.data.messages import MessageError
from test.helpers.messages import cloud, field, header, info, xyz

CODES = {1: "b", 2: "B", 3: "h", 4: "H", 5: "i", 6: "I", 7: "f", 8: "d"}


@st.composite
def raw_clouds(draw: st.DrawFn) -> tuple[SimpleNamespace, np.ndarray]:
    """A PointCloud2 of random layout, written with struct one value at a time, and its xyz."""
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
        ("intensity", np.float64([0, np.nan, 255]), [0, 0, 1]),  # an unknown intensity does not make the point invalid
        ("intensity", np.float32([-1, np.inf, 1]), [0, 0, 1]),
        ("ring", np.uint8([1, 2, 3]), [0, 0, 0]),
    ],
)
def test_intensity_is_scaled_to_one(name: str, value: np.ndarray, want: list[float]) -> None:
    msg = cloud(xyz(3, **{name: value}))
    before = bytes(msg.data)
    points, _ = messages.decode_points(msg)
    np.testing.assert_allclose(points[:, 3], want, rtol=1e-6)
    assert bytes(msg.data) == before  # the message itself is not changed


def test_intensity_max_is_obeyed() -> None:
    points, _ = messages.decode_points(cloud(xyz(2, intensity=np.float32([0.5, 4]))), intensity_max=2.0)
    np.testing.assert_allclose(points[:, 3], [0.25, 1])


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
    """`cloud_view` reads what `cloud_fields` writes: any type, and features with many values per point."""
    rng = np.random.default_rng(1)
    columns = {"x": rng.normal(size=7).astype("f4"), "feature": rng.integers(0, 100, (7, 16)).astype(kind)}
    view = messages.cloud_view(SimpleNamespace(**messages.cloud_fields(columns, SimpleNamespace)), columns)
    for name, column in columns.items():
        np.testing.assert_array_equal(view[name], column)


def test_real_rclpy_messages_decode_alike() -> None:
    """The duck typing works for the classes that the node receives, with array.array data."""
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
