# SPDX-License-Identifier: Apache-2.0
"""Reads an MCAP file from its start, without the index at its end, which may be incomplete or missing."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from heapq import heappop, heappush
from io import BufferedReader, FileIO
from pathlib import Path
from typing import NamedTuple

from mcap.records import Channel, Message, Schema
from mcap.stream_reader import StreamReader

from dpm2_core.data.pairing import LATE


class McapMessage(NamedTuple):
    """A message of a file.

    Attributes:
        kind: its type in ROS 2's notation, such as sensor_msgs/msg/PointCloud2; empty without a schema.
        ros1: whether `data` is in ROS 1's serialization.
        time: time of recording, ns.
    """

    topic: str
    kind: str
    ros1: bool
    time: int
    data: bytes


def scanned_messages(file: Path) -> Iterator[McapMessage]:
    """All messages in file order.

    Raises:
        Exception: the file is cut or damaged; anything from EOFError to the decompressor's own errors.
    """
    schemas: dict[int, str] = {}
    channels: dict[int, tuple[str, str, bool]] = {}
    with _StrictReader(FileIO(file)) as stream:
        for record in StreamReader(stream, record_size_limit=file.stat().st_size).records:
            if isinstance(record, Schema):
                schemas[record.id] = record.name
            elif isinstance(record, Channel):
                kind, ros1 = schemas.get(record.schema_id, ""), record.message_encoding == "ros1"
                kind = kind.replace("/", "/msg/") if ros1 and "/msg/" not in kind else kind
                channels[record.id] = (record.topic, kind, ros1)
            elif isinstance(record, Message):
                yield McapMessage(*channels[record.channel_id], record.log_time, record.data)


def by_log_time(messages: Iterable[McapMessage]) -> Iterator[McapMessage]:
    """Messages in order of log time; a message more than 0.5 s too late in the file is returned late."""
    held, latest = list[tuple[int, int, McapMessage]](), 0
    for number, message in enumerate(messages):
        heappush(held, (message.time, number, message))
        latest = max(latest, message.time)
        while held[0][0] <= latest - LATE:
            yield heappop(held)[2]
    while held:
        yield heappop(held)[2]


class _StrictReader(BufferedReader):
    """Raises EOFError for a short read at the end of the file, which the mcap package takes for a whole record."""

    def read(self, size: int | None = -1, /) -> bytes:
        data = super().read(size)
        if size is not None and len(data) < size:
            raise EOFError
        return data
