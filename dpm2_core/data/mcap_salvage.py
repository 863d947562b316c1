# SPDX-License-Identifier: Apache-2.0
"""What is left of an MCAP file that was cut off, without the index at its end."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from io import BufferedReader, FileIO
from pathlib import Path

from mcap.records import Channel, Message, Schema
from mcap.stream_reader import StreamReader


def whole_messages(file: Path) -> Iterator[tuple[str, str, int, bytes]]:
    """(topic, type, log time, data) up to where the file is cut."""
    schemas: dict[int, str] = {}
    channels: dict[int, tuple[str, str]] = {}
    # The cut raises anything from EOFError to the decompressor's own errors.
    with _WholeReads(FileIO(file)) as stream, suppress(Exception):
        for record in StreamReader(stream, record_size_limit=file.stat().st_size).records:
            if isinstance(record, Schema):
                schemas[record.id] = record.name
            elif isinstance(record, Channel):
                channels[record.id] = (record.topic, schemas[record.schema_id])
            elif isinstance(record, Message):
                yield (*channels[record.channel_id], record.log_time, record.data)


class _WholeReads(BufferedReader):
    """The mcap package takes a short read at the end of the file for the whole record."""

    def read(self, size: int | None = -1, /) -> bytes:
        data = super().read(size)
        if size is not None and len(data) < size:
            raise EOFError
        return data
