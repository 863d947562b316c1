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

from dpm2_core.data import messages
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
