# SPDX-License-Identifier: Apache-2.0
"""Bags of ROS 2 and ROS 1 without ROS: what is in them, their messages in order, and what is left of damaged ones.

A bag defines its own message types; they are not used: a reader for them would be code made of what the file says.
Types that ROS 2 Jazzy defines are read, and Livox' CustomMsg; others are only named. Messages of ROS 1 come as ROS 2
has them (CDR), so that all that follows is the same.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from functools import cache, partial
from heapq import merge
from io import BufferedReader, FileIO
from itertools import chain
from pathlib import Path
from typing import Any

from mcap.records import Channel, Message, Schema
from mcap.stream_reader import StreamReader
from rosbags.rosbag1 import Reader as Ros1Reader
from rosbags.rosbag2 import Reader
from rosbags.typesys import Stores, get_typestore
from rosbags.typesys.store import Typestore

from dpm2_core.data.livox import LIVOX, cloud_of_custom, custom_of_ros1
from dpm2_core.data.messages import MessageError
from dpm2_core.data.pairing import RawMessage
from dpm2_core.database import check_plain
from dpm2_core.errors import UsageError

_MCAP_MAGIC = b"\x89MCAP0\r\n"
_LATEST = 2**63 - 1  # ns; MCAP allows twice that


@dataclass(eq=False)
class Bag:
    """An opened recording; it holds no file open between calls.

    Attributes:
        path: what was asked for.
        types: topic to message type, such as sensor_msgs/msg/PointCloud2.
        counts: topic to number of messages.
        notes: messages for the user (salvaged, damaged).
        start: log time of the first message, ns; 0 where it is not known.
    """

    path: Path
    types: dict[str, str]
    counts: dict[str, int]
    _read: Callable[[Collection[str]], Iterator[RawMessage]]
    notes: list[str] = field(default_factory=list)
    start: int = 0

    def messages(self, topics: Collection[str]) -> Iterator[RawMessage]:
        """(topic, log time in ns, serialized message) of some topics, in order of log time.

        Where a file turns out damaged its messages end, and `notes` says so.
        """
        requested = [topic for topic in topics if topic in self.types]
        if not requested:
            return
        count = 0
        try:
            for topic, time, data in self._read(requested):
                count += 1
                yield topic, min(time, _LATEST), data
        except Exception as error:  # a damaged chunk raises anything from ReaderError to struct.error
            self.notes.append(
                f"{self.path}: damaged after {count} messages of {', '.join(requested)} ({_reason(error)})"
            )

    def playable(self, topics: Collection[str]) -> Iterator[RawMessage]:
        """`messages` without those of ROS 1 that cannot become one of ROS 2; `notes` has their topics."""
        for topic, time, data in self.messages(topics):
            if data:
                yield topic, time, data
                continue
            note = f"{self.path}: {topic}: messages that are no {self.types[topic]} of ROS 2 Jazzy are left out"
            if note not in self.notes:
                self.notes.append(note)

    def decode(self, topic: str, data: bytes) -> Any:
        """A message object of rosbags; a Livox CustomMsg as a PointCloud2.

        Raises:
            MessageError: the bytes are no message of the topic's type.
        """
        try:
            if self.types[topic] in LIVOX:
                return cloud_of_custom(data)
            return _jazzy().deserialize_cdr(data, self.types[topic])
        except Exception as error:  # overwritten bytes raise anything from SerdeError to UnicodeDecodeError
            raise MessageError(f"{topic}: message of {len(data)} bytes is damaged ({_reason(error)})") from None

    def decoded(self, topic: str) -> Iterator[Any]:
        """The messages of a topic that can be decoded."""
        for _, _, data in self.messages([topic]):
            with suppress(MessageError):
                yield self.decode(topic, data)

    def first(self, topic: str) -> Any | None:
        """The first of those; None without."""
        return next(self.decoded(topic), None)

    def topics(self, *types: str) -> list[str]:
        """Topics of these message types that have messages, sorted."""
        return sorted(topic for topic, kind in self.types.items() if kind in types and self.counts[topic])


def open_bag(path: Path) -> Bag:
    """Open a rosbag2 folder, or a .mcap, .db3 or ROS 1 .bag file. A truncated MCAP file gives what is whole; a file of
    a folder that cannot be read is left out, with a note.

    Raises:
        UsageError: there is nothing that can be read, and why.
    """
    if path.suffix == ".bag" and path.is_file():
        return _open_ros1(path)
    if not path.is_dir():
        return _open_file(path)
    files = sorted(file for file in path.iterdir() if file.suffix in (".mcap", ".db3") and file.is_file())
    if not files:
        raise UsageError(f"{path}: no .mcap or .db3 file in this folder")
    missing = "no metadata.yaml"
    if (path / "metadata.yaml").is_file():
        try:
            return _open_indexed(path)
        except Exception as error:  # as in _open_file
            missing = f"metadata.yaml is unusable ({_reason(error)})"
    bag = _open_files(path, files)
    if not bag.notes:  # a damaged file is what makes the metadata unusable, and is named
        bag.notes.append(f"{path}: {missing}; read {', '.join(file.name for file in files)}")
    return bag


def _open_files(path: Path, files: list[Path]) -> Bag:
    """Several files of one recording as one bag. What cannot be read of one of them costs nothing of the others."""
    parts, problems = list[Bag](), list[str]()
    for file in files:
        try:
            parts.append(_open_file(file))
        except (UsageError, OSError) as error:
            problems.append(str(error))
    if not parts:
        raise UsageError(problems[0])
    notes = [f"{problem}; read without it" for problem in problems] + [note for part in parts for note in part.notes]
    types, counts = dict[str, str](), Counter[str]()
    for part in parts:
        types |= part.types
        counts.update(part.counts)
        part.notes = notes
    return Bag(path, types, counts, partial(_read_parts, parts), notes)


def _read_parts(parts: list[Bag], topics: Collection[str]) -> Iterator[RawMessage]:
    """The messages of all in order of log time; a file is opened when its first message is due."""
    streams = (chain([("", part.start, b"")], part.messages(topics)) for part in parts)
    return (message for message in merge(*streams, key=lambda message: message[1]) if message[0])


def _open_file(file: Path) -> Bag:
    try:
        return _open_indexed(file)
    except Exception as error:  # rosbags raises ReaderError, TypeError, apsw.Error... by the kind of damage
        return _salvage(file, _reason(error))


def _reason(error: Exception) -> str:
    return " ".join(str(error).split()) or type(error).__name__


@cache
def _jazzy() -> Typestore:
    return get_typestore(Stores.ROS2_JAZZY)


@contextmanager
def _opened(path: Path) -> Iterator[Reader]:
    for file in path.glob("*.db3") if path.is_dir() else [path]:
        if file.suffix == ".db3":
            check_plain(file)
    with Reader(path) as reader:
        yield reader


def _open_indexed(path: Path) -> Bag:
    with _opened(path) as reader:
        connections, start = list(reader.connections), reader.start_time
    types = {connection.topic: connection.msgtype for connection in connections}
    counts = Counter(dict.fromkeys(types, 0))
    for connection in connections:
        counts[connection.topic] += connection.msgcount
    return Bag(path, types, counts, partial(_read_indexed, path), start=start)


def _read_indexed(path: Path, topics: Collection[str]) -> Iterator[RawMessage]:
    with _opened(path) as reader:
        requested = [connection for connection in reader.connections if connection.topic in topics]
        for connection, time, data in reader.messages(connections=requested):
            yield connection.topic, time, data


def _open_ros1(path: Path) -> Bag:
    try:
        with Ros1Reader(path) as reader:
            connections = list(reader.connections)  # closing forgets them
    except Exception as error:  # damaged files raise anything from ReaderError to struct.error
        raise UsageError(f"{path}: cannot be read as a ROS 1 bag: {_reason(error)}") from None
    counts: Counter[str] = Counter()
    for connection in connections:
        counts[connection.topic] += connection.msgcount
    types = {connection.topic: connection.msgtype for connection in connections}
    return Bag(path, types, dict(counts), partial(_read_ros1, path))


def _read_ros1(path: Path, topics: Collection[str]) -> Iterator[RawMessage]:
    with Ros1Reader(path) as reader:
        requested = [connection for connection in reader.connections if connection.topic in topics]
        for connection, time, data in reader.messages(connections=requested):
            yield connection.topic, time, _as_ros2(data, connection.msgtype)


def _as_ros2(data: bytes, kind: str) -> bytes:
    """A message of ROS 1 as ROS 2 serializes it; damaged ones, and types that are not known, as no bytes."""
    with suppress(Exception):  # SerdeError, KeyError, struct.error by the kind of damage
        return custom_of_ros1(data) if kind in LIVOX else bytes(_jazzy().ros1_to_cdr(data, kind))
    return b""


def _salvage(file: Path, reason: str) -> Bag:
    """What can be read of an MCAP file from its start, without the index at its end, in the order of the file."""
    with file.open("rb") as stream:
        head = stream.read(len(_MCAP_MAGIC))
    if not head:
        raise UsageError(f"{file}: the file is empty")
    if head != _MCAP_MAGIC:
        kind = "is no MCAP file (wrong magic bytes)" if file.suffix == ".mcap" else "cannot be read as a bag"
        raise UsageError(f"{file}: {kind}: {reason}")
    types, counts, start = dict[str, str](), Counter[str](), _LATEST
    for topic, kind, time, _ in _whole_messages(file):
        types[topic] = kind
        counts[topic] += 1
        start = min(start, time)
    if not types:
        raise UsageError(f"{file}: truncated before its first message ({reason})")
    note = f"{file}: truncated or never closed ({reason}); {counts.total()} messages of it could be saved"
    return Bag(file, types, counts, partial(_read_whole, file), [note], start)


def _read_whole(file: Path, topics: Collection[str]) -> Iterator[RawMessage]:
    return ((topic, time, data) for topic, _, time, data in _whole_messages(file) if topic in topics)


def _whole_messages(file: Path) -> Iterator[tuple[str, str, int, bytes]]:
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
