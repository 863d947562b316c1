# SPDX-License-Identifier: Apache-2.0
"""ROS 2 and ROS 1 bags without ROS: their contents, their messages in order, and the readable part of damaged ones.

A bag contains its own message definitions. They are not used: their reader would be code generated from the file.
Types that ROS 2 Jazzy defines are read, and Livox' CustomMsg; others are only named. Messages of ROS 1 are converted to
ROS 2's serialization (CDR), so that all later steps are the same.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from functools import cache, partial
from heapq import merge
from itertools import chain
from pathlib import Path
from typing import Any

from backports.zstd import ZstdDecompressor, ZstdError, get_frame_info
from rosbags.rosbag1 import Reader as Ros1Reader
from rosbags.rosbag2 import Reader, ReaderError
from rosbags.rosbag2.storage_mcap import McapReader
from rosbags.typesys import Stores, get_typestore
from rosbags.typesys.store import Typestore

from dpm2_core.data.livox import LIVOX, cloud_of_custom, custom_of_ros1
from dpm2_core.data.mcap_scan import McapMessage, by_log_time, scanned_messages
from dpm2_core.data.messages import MessageError
from dpm2_core.data.pairing import RawMessage
from dpm2_core.data.rosbag2_folder import STORAGES, check_unpacked, recorded
from dpm2_core.data.source import note_once
from dpm2_core.database import check_plain
from dpm2_core.errors import UsageError, one_line

_MCAP_MAGIC = b"\x89MCAP0\r\n"
_ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"
_NO_SCHEMA = "__schemaless__"  # rosbags' name of a type that is missing in a file's summary
_MAX_MESSAGE_BYTES = 1 << 29  # bytes of a message: an image of 67 million pixels may have 6 bytes each
_MAX_TIME = 2**63 - 1  # ns; MCAP allows twice that


@dataclass(eq=False)
class Bag:
    """An opened recording; it keeps no file open between calls.

    Attributes:
        path: the path that was opened.
        types: topic to message type, such as sensor_msgs/msg/PointCloud2.
        counts: topic to number of messages.
        notes: messages for the user (salvaged, damaged).
        start: log time of the first message, ns; 0 if unknown.
    """

    path: Path
    types: dict[str, str]
    counts: dict[str, int]
    _read: Callable[[Collection[str]], Iterator[RawMessage]]
    notes: list[str] = field(default_factory=list)
    start: int = 0

    def messages(self, topics: Collection[str]) -> Iterator[RawMessage]:
        """(topic, log time in ns, serialized message) of some topics, in order of log time.

        If a file turns out to be damaged, its messages end there, and `notes` reports it.
        """
        requested = [topic for topic in topics if topic in self.types]
        if not requested:
            return
        count = 0
        try:
            for topic, time, data in self._read(requested):
                count += 1
                yield topic, min(time, _MAX_TIME), _decompressed(data)
        except Exception as error:  # a damaged chunk raises anything from ReaderError to struct.error
            self.notes.append(
                f"{self.path}: damaged after {count} messages of {', '.join(requested)} ({one_line(error)})"
            )

    def playable(self, topics: Collection[str]) -> Iterator[RawMessage]:
        """`messages` without those of ROS 1 that cannot be converted to ROS 2; `notes` names their topics."""
        for topic, time, data in self.messages(topics):
            if data:
                yield topic, time, data
                continue
            what = f"{self.path}: {topic}: messages that do not match {self.types[topic]} of ROS 2 Jazzy are left out"
            note_once(self.notes, what)

    def decode(self, topic: str, data: bytes) -> Any:
        """A deserialized message of rosbags; a Livox CustomMsg as a PointCloud2.

        Raises:
            MessageError: the bytes are not a message of the topic's type.
        """
        try:
            if self.types[topic] in LIVOX:
                return cloud_of_custom(data)
            return _jazzy_types().deserialize_cdr(data, self.types[topic])
        except Exception as error:  # overwritten bytes raise anything from SerdeError to UnicodeDecodeError
            raise MessageError(f"{topic}: message of {len(data)} bytes is damaged ({one_line(error)})") from None

    def decoded(self, topic: str) -> Iterator[Any]:
        """The messages of a topic that can be decoded."""
        for _, _, data in self.messages([topic]):
            with suppress(MessageError):
                yield self.decode(topic, data)

    def first(self, topic: str) -> Any | None:
        """The first message of a topic that can be decoded; None without any."""
        return next(self.decoded(topic), None)

    def topics(self, *types: str) -> list[str]:
        """Topics of these message types that have messages, sorted."""
        return sorted(topic for topic, kind in self.types.items() if kind in types and self.counts[topic])


def open_bag(path: Path) -> Bag:
    """Open a folder of rosbag2 or of split ROS 1 bags, or a .mcap, .db3 or .bag file. From a truncated MCAP file the
    intact messages are read; an unreadable file in a folder is left out, with a note.

    Raises:
        UsageError: nothing can be read; the message gives the reason.
    """
    if not path.is_dir():
        check_unpacked([path])
        return _open_file(path)
    files = sorted(file for file in path.iterdir() if file.suffix in STORAGES and file.is_file())
    check_unpacked(path.iterdir())
    types, problem = dict[str, str](), ""
    try:
        if files:
            files, types = recorded(path)
        else:  # of rosbag record --split
            files, problem = sorted(path.glob("*.bag")), f"{path}: bags of ROS 1 in one folder are one recording"
    except UsageError as error:
        problem = str(error)
    if not files:
        raise UsageError(f"{path}: no .mcap or .db3 file in this folder")
    bag = _open_files(path, files, types)
    if problem and not bag.notes:  # a damaged file was not closed, so that metadata are missing anyway
        bag.notes.append(f"{problem}; read {', '.join(file.name for file in files)}")
    return bag


def _open_files(path: Path, files: list[Path], types: dict[str, str]) -> Bag:
    """Several files of one recording as one bag; an unreadable file does not affect the others.

    Args:
        types: topic to message type, of the topics that are known to have been recorded.
    """
    parts, problems = list[Bag](), list[str]()
    for file in files:
        try:
            parts.append(_open_file(file))
        except (UsageError, OSError) as error:
            problems.append(str(error))
    if not parts:
        raise UsageError(problems[0])
    notes = [f"{problem}; read without it" for problem in problems] + [note for part in parts for note in part.notes]
    counts = Counter(dict.fromkeys(types, 0))
    for part in parts:
        types |= part.types
        counts.update(part.counts)
        part.notes = notes
    return Bag(path, types, counts, partial(_read_parts, parts), notes)


def _read_parts(parts: list[Bag], topics: Collection[str]) -> Iterator[RawMessage]:
    """The messages of all files in order of log time; a file is opened when its first message is due."""
    streams = (chain([("", part.start, b"")], part.messages(topics)) for part in parts)
    return (message for message in merge(*streams, key=lambda message: message[1]) if message[0])


def _open_file(file: Path) -> Bag:
    try:
        return _open_indexed(file)
    except Exception as error:  # rosbags raises ReaderError, TypeError, apsw.Error... by the kind of damage
        if _is_ros1(file):
            raise UsageError(f"{file}: cannot be read as a ROS 1 bag: {one_line(error)}") from None
        return _open_scanned(file, one_line(error))


def _is_ros1(file: Path) -> bool:
    return file.suffix == ".bag" and file.is_file()


@cache
def _jazzy_types() -> Typestore:
    return get_typestore(Stores.ROS2_JAZZY)


@contextmanager
def _open_reader(file: Path) -> Iterator[Reader | Ros1Reader]:
    if file.suffix == ".db3":
        check_plain(file)
    with Ros1Reader(file) if _is_ros1(file) else Reader(file) as reader:
        yield reader


def _open_indexed(file: Path) -> Bag:
    with _open_reader(file) as reader:
        _check_index(reader)
        connections, start = list(reader.connections), reader.start_time  # closing discards them
    types = {connection.topic: connection.msgtype for connection in connections}
    counts = Counter(dict.fromkeys(types, 0))
    for connection in connections:
        counts[connection.topic] += connection.msgcount
    return Bag(file, types, counts, partial(_read_indexed, file), start=start)


def _check_index(reader: Reader | Ros1Reader) -> None:
    """Check an index. Without one, rosbags ends at a message that was written late; messages not in it are skipped.

    Raises:
        ReaderError: the index of an MCAP file does not lead to every message, or types are missing for some.
    """
    if isinstance(reader, Ros1Reader) or not isinstance(reader.storage, McapReader):
        return
    chunks, typed_ids = reader.storage.chunks, {c.id for c in reader.connections if c.msgtype != _NO_SCHEMA}
    indexed = sum(count for chunk in chunks for key, count in chunk.channel_count.items() if key in typed_ids)
    if indexed < reader.message_count or (chunks and not indexed):
        raise ReaderError("its index does not lead to every message")


def _read_indexed(file: Path, topics: Collection[str]) -> Iterator[RawMessage]:
    ros1 = _is_ros1(file)
    with _open_reader(file) as reader:
        requested = [connection for connection in reader.connections if connection.topic in topics]
        for connection, time, data in reader.messages(connections=requested):
            yield connection.topic, time, _as_ros2(data, connection.msgtype) if ros1 else data


def _as_ros2(data: bytes, kind: str) -> bytes:
    """A message of ROS 1 in ROS 2's serialization; no bytes for damaged messages and unknown types."""
    with suppress(Exception):  # SerdeError, KeyError, struct.error by the kind of damage
        return custom_of_ros1(data) if kind in LIVOX else bytes(_jazzy_types().ros1_to_cdr(data, kind))
    return b""


def _decompressed(data: bytes) -> bytes:
    """A message, decompressed if it was compressed by itself; no bytes if it is damaged or too large."""
    if data[:4] != _ZSTD_MAGIC:  # no message of ROS 2 begins with these bytes
        return data
    with suppress(ZstdError):
        decompressor, size = ZstdDecompressor(), get_frame_info(data).decompressed_size
        if size is not None and size <= _MAX_MESSAGE_BYTES:
            message = decompressor.decompress(data, size + 1)
            return message if decompressor.eof else b""
    return b""


def _open_scanned(file: Path, reason: str) -> Bag:
    """An MCAP file whose index cannot be used, for that reason: read from its start, as far as possible."""
    with file.open("rb") as stream:
        head = stream.read(len(_MCAP_MAGIC))
    if not head:
        raise UsageError(f"{file}: the file is empty")
    if head != _MCAP_MAGIC:
        kind = "is no MCAP file (wrong magic bytes)" if file.suffix == ".mcap" else "cannot be read as a bag"
        raise UsageError(f"{file}: {kind}: {reason}")
    types, counts, start, notes = dict[str, str](), Counter[str](), _MAX_TIME, list[str]()
    try:
        for message in scanned_messages(file):
            types[message.topic] = message.kind
            counts[message.topic] += 1
            start = min(start, message.time)
    except Exception:  # see scanned_messages
        if not types:
            raise UsageError(f"{file}: truncated before its first message ({reason})") from None
        notes = [f"{file}: truncated or never closed ({reason}); {counts.total()} messages of it could be saved"]
    return Bag(file, types, counts, partial(_read_scanned, file), notes, start)


def _read_scanned(file: Path, topics: Collection[str]) -> Iterator[RawMessage]:
    for message in by_log_time(_messages_before_damage(file, topics)):
        data = _as_ros2(message.data, message.kind) if message.ros1 else message.data
        yield message.topic, message.time, data


def _messages_before_damage(file: Path, topics: Collection[str]) -> Iterator[McapMessage]:
    """The messages up to where the file is cut; that was reported when it was opened."""
    with suppress(Exception):
        yield from (message for message in scanned_messages(file) if message.topic in topics)
