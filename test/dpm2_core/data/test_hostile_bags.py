# SPDX-License-Identifier: Apache-2.0
"""Malicious recordings: nothing in them is executed, little memory is used, and the drive is read without them."""

from __future__ import annotations

import re
import sqlite3
import struct
import sys
import time
import tracemalloc
import zlib
from contextlib import closing
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from backports import zstd
from rosbags.rosbag2 import StoragePlugin, Writer

from dpm2_core.data.bag_file import open_bag
from dpm2_core.data.bags import BagSource
from dpm2_core.data.compressed import compressed_size, decode_compressed
from dpm2_core.data.messages import MessageError
from dpm2_core.errors import UsageError


def png(width: int, height: int) -> bytes:
    """An image of one color, in a thousandth of the bytes that it is decoded to."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    rows = zlib.compressobj(9)
    data = b"".join(rows.compress(bytes(1 + (width + 7) // 8) * 1000) for _ in range(height // 1000)) + rows.flush()
    head = struct.pack(">IIBBBBB", width, height, 1, 0, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + chunk(b"IDAT", data) + chunk(b"IEND", b"")


def jpeg(width: int, height: int) -> bytes:
    """A small JPEG whose header claims another size."""
    data = bytearray(cv2.imencode(".jpg", np.zeros((8, 8, 3), np.uint8))[1].tobytes())
    at = data.index(b"\xff\xc0")
    data[at + 5 : at + 9] = struct.pack(">HH", height, width)
    return bytes(data)


@pytest.mark.parametrize("ending", [".png", ".jpg"])
@pytest.mark.parametrize("size", [(1, 1), (640, 480), (7, 300)])
def test_the_size_is_in_the_header(ending: str, size: tuple[int, int]) -> None:
    pixels = np.full((size[1], size[0], 3), 77, np.uint8)
    options = [cv2.IMWRITE_JPEG_PROGRESSIVE, 1] if ending == ".jpg" else []
    data = cv2.imencode(ending, pixels, options)[1].tobytes()
    assert compressed_size(data) == size
    np.testing.assert_allclose(decode_compressed(data, size).astype(int), pixels, atol=1)
    for cut in (0, 1, 10, 20):
        with pytest.raises(ValueError, match="neither JPEG nor PNG"):
            decode_compressed(data[:cut])
    decode_compressed(data)
    with pytest.raises(ValueError, match="the camera has 2 x 2"):
        decode_compressed(data, (2, 2))


@pytest.mark.parametrize("image", [png(30_000, 30_000), jpeg(65_000, 65_000), png(0, 0), b"BM" + bytes(100)])
@pytest.mark.parametrize("size", [None, (8, 6)])
def test_a_image_that_is_a_bomb(image: bytes, size: tuple[int, int] | None) -> None:
    began = time.process_time()
    tracemalloc.start()
    try:
        with pytest.raises(ValueError, match=r"pixels|neither"):
            decode_compressed(image, size)
        assert tracemalloc.get_traced_memory()[1] < 1e6
    finally:
        tracemalloc.stop()
    assert time.process_time() - began < 1


def rig(bags: Any) -> list[tuple[float, str, Any]]:
    """A cloud, and a camera."""
    transform = bags.transform("velo_link", "cam", (0.1, 0.2, 0.3))
    return [(1, "/points", bags.cloud(1)), (1, "/tf_static", transform), (1, "/cam/camera_info", bags.info(1))]


def test_a_bag_with_such_images_is_read_without_them(bags: Any, tmp_path: Path) -> None:
    image = bags.new(
        "sensor_msgs/CompressedImage", bags.header(1, "cam"), "png", np.frombuffer(png(30_000, 30_000), np.uint8)
    )
    source = BagSource(bags.write(tmp_path / "bag", [*rig(bags), (1, "/cam/image_raw/compressed", image)]))
    assert [(len(frame.points), frame.images) for frame in source.frames()] == [(60, ())]
    assert "30000 x 30000 pixels, the camera has 8 x 6" in source.notes[0]


def test_transforms_and_a_calibration_that_are_none_cost_themselves(bags: Any, tmp_path: Path) -> None:
    """Also if their names contain control sequences of a terminal."""
    wrong, info = bags.transform("base", "\x1b[2Jgripper", (0.0, np.nan, 0.0)), bags.info(1)
    info.k = np.full(9, np.nan)
    image = (1, "/cam/image_raw", bags.image(1, 7))
    messages = [(0.5, "/tf_static", wrong), (0.6, "/cam/camera_info", info), *rig(bags), image]
    source = BagSource(bags.write(tmp_path / "bag", messages))
    assert [(len(frame.points), len(frame.images)) for frame in source.frames()] == [(60, 1)]
    note = source.notes[0]
    assert note.startswith("/tf_static: 1 transforms left out (the first: tf base -> ")
    assert "no rigid transform" in note
    assert "\x1b" not in note


def test_types_that_a_bag_defines_are_not_used(bags: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Neither a type whose module could be imported, nor another definition of a cloud."""
    package = tmp_path / "lib" / "evil" / "msg"
    package.mkdir(parents=True)
    (package.parent / "__init__.py").write_text("")
    (package / "__init__.py").write_text("raise SystemExit('imported')")
    monkeypatch.syspath_prepend(str(tmp_path / "lib"))
    writer = Writer(tmp_path / "bag", version=9, storage_plugin=StoragePlugin.MCAP)
    digest = "RIHS01_" + 64 * "0"
    with writer:
        evil = writer.add_connection("/evil", "evil/msg/Thing", msgdef="string __import__\n", rihs01=digest)
        cloud = writer.add_connection("/points", "sensor_msgs/msg/PointCloud2", msgdef="int8 no_cloud\n", rihs01=digest)
        writer.write(evil, 1, b"\0\1\0\0" + bytes(8))
        data = bags.store.serialize_cdr(bags.cloud(1), "sensor_msgs/msg/PointCloud2")
        writer.write(cloud, 1, data)
    source = BagSource(tmp_path / "bag")
    assert [len(frame.points) for frame in source.frames()] == [60]
    bag = open_bag(tmp_path / "bag")
    with pytest.raises(MessageError, match="/evil: message of 12 bytes"):
        bag.decode("/evil", b"\0\1\0\0" + bytes(8))
    assert "evil.msg" not in sys.modules


@pytest.mark.parametrize("table", ["messages", "topics"])
def test_a_database_that_computes_its_messages(bags: Any, tmp_path: Path, table: str) -> None:
    """An endless view in place of a table."""
    folder = bags.write(tmp_path / "bag", rig(bags), plugin="SQLITE3")
    assert len(BagSource(folder)) == 1
    with closing(sqlite3.connect(next(folder.glob("*.db3")))) as sql:
        columns = ", ".join(row[1] for row in sql.execute(f"PRAGMA table_info({table})"))
        count = columns.count(",") + 1
        sql.execute(f"DROP TABLE {table}")
        sql.execute(
            f"CREATE VIEW {table}({columns}) AS WITH RECURSIVE n(x) AS (SELECT 1 UNION ALL SELECT x + 1 FROM n) "
            f"SELECT {', '.join(['x'] * count)} FROM n"
        )
    began = time.process_time()
    with pytest.raises(UsageError, match=f"view {table} does not belong into it") as caught:
        BagSource(folder)
    assert time.process_time() - began < 2
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("packed", [False, True])
def test_a_database_that_metadata_calls_otherwise_is_not_opened(bags: Any, tmp_path: Path, packed: bool) -> None:
    """It is not unpacked either: a file that does not look like a database is not checked as one."""
    folder = bags.write(tmp_path / "bag", rig(bags), plugin="SQLITE3")
    database, metadata = folder / "bag.db3", folder / "metadata.yaml"
    with closing(sqlite3.connect(database)) as sql:
        sql.executescript(
            "DROP TABLE topics; CREATE VIEW topics(id, name, type, serialization_format, offered_qos_profiles, "
            "type_description_hash) AS WITH RECURSIVE n(x) AS (SELECT 1 UNION ALL SELECT x + 1 FROM n) "
            "SELECT x, x, x, x, x, x FROM n"
        )
    content = database.read_bytes()
    (folder / "bag.data").write_bytes(zstd.compress(content) if packed else content)
    database.unlink()
    (folder / "sound.mcap").touch()
    text = metadata.read_text().replace("bag.db3", "bag.data")
    if packed:
        text = re.sub("compression_format:.*", "compression_format: zstd", text)
        text = re.sub("compression_mode:.*", "compression_mode: FILE", text)
    metadata.write_text(text)
    began = time.process_time()
    with pytest.raises(UsageError, match=r"bag\.data: cannot be read as a bag"):
        BagSource(folder)
    assert time.process_time() - began < 2


def test_a_message_that_is_a_bomb(bags: Any, tmp_path: Path) -> None:
    """It costs only its own frame."""
    bomb = zstd.compress(bytes(600 << 20))
    source = BagSource(bags.write(tmp_path / "bag", [*rig(bags), (2, "/points", bomb)]))
    tracemalloc.start()
    try:
        assert [len(frame.points) for frame in source.frames()] == [60, 0]
        assert tracemalloc.get_traced_memory()[1] < 5e6
    finally:
        tracemalloc.stop()
