# SPDX-License-Identifier: Apache-2.0
"""Bags of ROS 2 and ROS 1 without ROS: what is in them, their messages in order, and what is left of damaged ones.

A bag defines its own message types; they are not used: a reader for them would be code made of what the file says.
Types that ROS 2 Jazzy defines are read, and Livox' CustomMsg; others are only named. Messages of ROS 1 come as ROS 2
has them (CDR), so that all that follows is the same.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Collection, Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, field
from functools import cache, partial
from heapq import merge
from io import BufferedReader, FileIO
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
    """

    path: Path
    types: dict[str, str]
    counts: dict[str, int]
    _read: Callable[[Collection[str]], Iterator[RawMessage]]
    notes: list[str] = field(default_factory=list)

    def messages(self, topics: Collection[str]) -> Iterator[RawMessage]:
        """(topic, log time in ns, serialized message) of some topics, in order of log time.

        Where the file turns out damaged the messages end, and `notes` says so.
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
    """Open a rosbag2 folder, or a .mcap, .db3 or ROS 1 .bag file. A truncated MCAP file gives what is whole.

    Raises:
        UsageError: there is nothing that can be read, and why.
    """
    if path.suffix == ".bag" and path.is_file():
        return _open_ros1(path)
    attempts: list[list[Path]] = [[path]]
    files = [path]
    if path.is_dir():
        files = sorted(file for file in path.iterdir() if file.suffix in (".mcap", ".db3"))
        attempts = [[path], files] if (path / "metadata.yaml").is_file() else [files]
    if not files:
        raise UsageError(f"{path}: no .mcap or .db3 file in this folder")
    reasons = []
    for paths in attempts:
        try:
            bag = _open_indexed(path, paths)
        except Exception as error:  # rosbags raises ReaderError, TypeError, apsw.Error... by the kind of damage
            reasons.append(_reason(error))
            continue
        if path.is_dir() and paths is files:
            missing = f"metadata.yaml is unusable ({reasons[0]})" if reasons else "no metadata.yaml"
            bag.notes.append(f"{path}: {missing}; read {', '.join(file.name for file in files)}")
        return bag
    return _salvage(path, files, reasons[-1])


def _reason(error: Exception) -> str:
    return " ".join(str(error).split()) or type(error).__name__


@cache
def _jazzy() -> Typestore:
    return get_typestore(Stores.ROS2_JAZZY)


@contextmanager
def _opened(paths: list[Path]) -> Iterator[list[Reader]]:
    for path in paths:
        for file in path.glob("*.db3") if path.is_dir() else [path]:
            if file.suffix == ".db3":
                check_plain(file)
    with ExitStack() as stack:
        yield [stack.enter_context(Reader(path)) for path in paths]


def _open_indexed(path: Path, paths: list[Path]) -> Bag:
    with _opened(paths) as readers:
        connections = [connection for reader in readers for connection in reader.connections]
    types = {connection.topic: connection.msgtype for connection in connections}
    counts = Counter(dict.fromkeys(types, 0))
    for connection in connections:
        counts[connection.topic] += connection.msgcount
    return Bag(path, types, dict(counts), partial(_read_indexed, paths))


def _read_indexed(paths: list[Path], topics: Collection[str]) -> Iterator[RawMessage]:
    with _opened(paths) as readers:
        requested = [[c for c in reader.connections if c.topic in topics] for reader in readers]
        streams = [reader.messages(connections=c) for reader, c in zip(readers, requested, strict=True) if c]
        for connection, time, data in merge(*streams, key=lambda message: message[1]):
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


def _salvage(path: Path, files: list[Path], reason: str) -> Bag:
    """What can be read of MCAP files from their start, without the index at their end."""
    for file in files:
        with file.open("rb") as stream:
            head = stream.read(len(_MCAP_MAGIC))
        if not head:
            raise UsageError(f"{file}: the file is empty")
        if head != _MCAP_MAGIC:
            kind = "is no MCAP file (wrong magic bytes)" if file.suffix == ".mcap" else "cannot be read as a bag"
            raise UsageError(f"{file}: {kind}: {reason}")
    types: dict[str, str] = {}
    counts: Counter[str] = Counter()
    for topic, kind, _, _ in _whole_messages(files):
        types[topic] = kind
        counts[topic] += 1
    if not types:
        raise UsageError(f"{path}: truncated before its first message ({reason})")
    bag = Bag(path, types, dict(counts), partial(_read_whole, files))
    bag.notes.append(f"{path}: truncated or never closed ({reason}); {counts.total()} messages of it could be saved")
    return bag


def _read_whole(files: list[Path], topics: Collection[str]) -> Iterator[RawMessage]:
    return ((topic, time, data) for topic, _, time, data in _whole_messages(files) if topic in topics)


def _whole_messages(files: list[Path]) -> Iterator[tuple[str, str, int, bytes]]:
    """(topic, type, log time, data) in the order of the files, up to where each is cut."""
    for file in files:
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
