# SPDX-License-Identifier: Apache-2.0
"""MCAP files whose index is missing or covers only some of their messages, as writers other than rosbag2's make
them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from mcap.writer import IndexType, Writer

from dpm2_core.data.open import open_source

COUNT = 20


def write(bags: Any, file: Path, ros1: bool = False, profile: str = "ros2", **options: Any) -> Path:
    """Clouds at 10 Hz with their numbers as x, every second one written before its predecessor, and a message of a
    channel without a schema."""
    with file.open("wb") as stream:
        writer, kind = Writer(stream, **options), "sensor_msgs/msg/PointCloud2"
        writer.start(profile=profile, library="test")
        notes = writer.register_channel("/notes", "json", 0)
        name = kind.replace("/msg", "") if ros1 else kind
        schema = writer.register_schema(name, "ros1msg" if ros1 else "ros2msg", b"")
        channel = writer.register_channel("/points", "ros1" if ros1 else "cdr", schema)
        writer.add_message(notes, 10**9, b"{}", 10**9)
        for n in (n ^ 1 for n in range(COUNT)):
            data = bags.store.serialize_cdr(bags.cloud(1 + 0.1 * n, x=n), kind)
            data = bags.store.cdr_to_ros1(data, kind) if ros1 else data
            time = 10**9 + n * 10**8
            writer.add_message(channel, time, bytes(data), time)
        writer.finish()
    return file


NO_SUMMARY = {"repeat_channels": False, "use_statistics": False, "use_summary_offsets": False}


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"chunk_size": 3000},
        {"use_chunking": False},
        {"use_chunking": False, "repeat_schemas": False, **NO_SUMMARY},
        {"index_types": IndexType.NONE},
        {"index_types": IndexType.CHUNK, "chunk_size": 3000},
        {"index_types": IndexType.CHUNK, "use_statistics": False},
        {"repeat_channels": False},
        {"repeat_schemas": False},
        {"repeat_schemas": False, **NO_SUMMARY},
        {"profile": ""},
        {"profile": "ros1", "ros1": True},
    ],
    ids=str,
)
def test_all_messages_are_read_in_order_whatever_the_index_lacks(
    bags: Any, tmp_path: Path, options: dict[str, Any]
) -> None:
    """Such a file is complete, and is not reported as damaged or truncated."""
    source = open_source(write(bags, tmp_path / "drive.mcap", **options))
    assert len(source) == COUNT
    assert [frame.points[0, 0] for frame in source.frames()] == list(range(COUNT))
    assert source.notes == ["/points: no time field: not de-skewed (first at frame 0)"]


def test_a_cut_file_without_chunks_gives_what_is_whole_in_order(bags: Any, tmp_path: Path) -> None:
    file = write(bags, tmp_path / "drive.mcap", use_chunking=False)
    whole = file.read_bytes()
    file.write_bytes(whole[: len(whole) // 2])
    source = open_source(file)
    numbers = [frame.points[0, 0] for frame in source.frames()]
    assert len(numbers) == len(source) < COUNT
    assert numbers == sorted(numbers)
    assert "truncated or never closed" in source.notes[0]
