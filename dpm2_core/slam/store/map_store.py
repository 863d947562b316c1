# SPDX-License-Identifier: Apache-2.0
"""The map as one file, written as the drive goes on: `kill -9` at any instant loses at most the keyframe in flight.

SQLite in WAL mode: one transaction per keyframe; other processes read while one writes. A map that was closed is that
one file; beside one whose writer was killed, or is alive, FILE-wal belongs to it. `synchronous=NORMAL`: a power cut may
take the last seconds with it, but never the map.
"""

from __future__ import annotations

import sqlite3
import tempfile
from collections.abc import Iterable, Iterator, Sequence
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from dpm2_core._version import __version__
from dpm2_core.database import Connection, connect
from dpm2_core.errors import Dpm2Error, UsageError
from dpm2_core.estimates import Edge, Keyframe
from dpm2_core.files import part_beside
from dpm2_core.frame import Array, Georeference
from dpm2_core.slam.store import schema
from dpm2_core.slam.store.cloud_store import Loan
from dpm2_core.slam.store.map_file import copy_with_log, remove_log, remove_map
from dpm2_core.slam.store.rows import (
    RemovedKeyframe,
    Session,
    array_bytes,
    edge_row,
    fix_row,
    georeference_row,
    keyframe_row,
    pack_descriptors,
    removed_row,
    with_crc,
)

BUSY = 5.0
"""s to wait for another program: a reader never blocks the writer for long, another writer is an error."""
_HEAD = b"SQLite format 3"


@dataclass
class Change:
    """What goes into the file together, or not at all.

    Attributes:
        keyframes: node, keyframe (its cloud is not looked at), packed cloud or whose it borrows, JPEG or None.
        edges: in the order of the map; appended to those of the file.
        poses: T_map_kf (4, 4) by node. moving: packed mask by node. trail: what was pruned.
        georeference: as it is from now on; None: as it was.
        judged: edges of the file by their number, as they are from now on.
    """

    keyframes: list[tuple[int, Keyframe, bytes | Loan | None, bytes | None]] = field(default_factory=list)
    edges: list[Edge] = field(default_factory=list)
    poses: dict[int, Array] = field(default_factory=dict)
    moving: dict[int, bytes] = field(default_factory=dict)
    trail: list[RemovedKeyframe] = field(default_factory=list)
    judged: dict[int, Edge] = field(default_factory=dict)
    georeference: Georeference | None = None


class MapStore:
    """An open map file. Not for two threads at once."""

    def __init__(self, path: Path, connection: sqlite3.Connection, read_only: bool) -> None:
        """Use `create` and `open`."""
        self.path = path
        self.read_only = read_only
        self.session = 0
        self._file = _identity(path)
        self._newest = 0  # number of the last session that this program has written
        self._connection = connection
        self._together = False
        self._copy: tempfile.TemporaryDirectory[str] | None = None

    @classmethod
    def create(cls, path: Path) -> MapStore:
        """A new, empty map; `begin_session` comes next.

        Raises:
            UsageError: there is a file already. Dpm2Error: it cannot be made.
        """
        with _explained(path):
            path.parent.mkdir(parents=True, exist_ok=True)
            try:
                path.touch(exist_ok=False)  # of two programs that want the same name, one gets it
            except FileExistsError:
                raise UsageError(f"{path}: there is a file already") from None
            try:
                with closing(_connect(path, "rw")) as sql:
                    schema.create(sql)  # not in FILE-wal, the end of which a power cut may take
                return cls.open(path, read_only=False)
            except BaseException:
                remove_map(path)  # what is no map yet would be in the way of the next one
                raise

    @classmethod
    def open(cls, path: Path, read_only: bool = True) -> MapStore:
        """A map that is there. Opened read-only, no byte of it changes; else an older one is brought up to date.

        Raises:
            UsageError: no map, or one of a later dpm2. Dpm2Error: it cannot be read, or written, or is damaged.
        """
        if not path.is_file():
            raise UsageError(f"{path}: no such map file")
        with _explained(path):
            if _head(path)[:15] != _HEAD:
                raise UsageError(f"{path}: not a dpm2 map")
            store = _open_read_only(path) if read_only else cls(path, _connect(path, "rw"), False)
            try:
                version = schema.version_of(store._connection, path)
                schema.check(store._connection, version)
                if version < schema.VERSION and not read_only:
                    schema.migrate(store._connection, version)
                elif version < schema.TABLES:
                    store = _migrated_copy(store, version)
                if not read_only:
                    _durable(store._connection)
            except BaseException:
                store.close()
                raise
            return store

    def begin_session(self, config: str = "", weights: str = "") -> int:
        """Note that this program writes from now on; returns the number of the session, from 1.

        Raises:
            Dpm2Error: it could not be written.
        """
        started = datetime.now(UTC).isoformat(timespec="seconds")
        with self._transaction() as sql:
            number = sql.execute("SELECT coalesce(max(session), 0) + 1 FROM sessions").fetchone()[0]
            sql.execute("INSERT INTO sessions VALUES (?,?,?,?,?)", (number, __version__, started, config, weights))
        self.session = self._newest = int(number)
        return self.session

    def add_sessions(self, sessions: Iterable[Session]) -> None:
        """Take over those of other maps."""
        with self._transaction() as sql:
            rows = [(s.number, s.program, s.started, s.config, s.weights) for s in sessions]
            sql.executemany("INSERT INTO sessions VALUES (?,?,?,?,?)", rows)
        self._newest = max([self._newest, *(row[0] for row in rows)])

    def write(self, change: Change, sessions: dict[int, int] | None = None) -> None:
        """Take a change in, whole or not at all. `sessions`: of nodes that are not of the present one.

        Raises:
            Dpm2Error: it could not be written: a full disk, a read-only file, another writer.
        """
        with self._transaction() as sql:
            self._check_alone(sql)
            for node, keyframe, cloud, thumbnail in change.keyframes:
                session = (sessions or {}).get(node, self.session)
                loan = cloud if isinstance(cloud, Loan) else None
                _insert(sql, "keyframes", [keyframe_row(node, keyframe, session, loan)])
                if keyframe.fix is not None:
                    _insert(sql, "fixes", [fix_row(node, keyframe.fix)])
                if isinstance(cloud, bytes):
                    d = keyframe.descriptors
                    packed = None if d is None else pack_descriptors(d)
                    _insert(sql, "payloads", [with_crc(node, cloud, packed, thumbnail)])
            first = sql.execute("SELECT coalesce(max(id), -1) + 1 FROM edges").fetchone()[0]
            _insert(sql, "edges", [edge_row(first + i, edge) for i, edge in enumerate(change.edges)])
            _insert(sql, "edges", [edge_row(number, edge) for number, edge in change.judged.items()])
            _insert(sql, "poses", [with_crc(node, array_bytes(T)) for node, T in change.poses.items()])
            _insert(sql, "moving", [with_crc(node, mask) for node, mask in change.moving.items()])
            _insert(sql, "trail", [removed_row(p) for p in change.trail])
            if change.georeference is not None:
                _insert(sql, "georeference", [georeference_row(change.georeference)])

    def _check_alone(self, sql: sqlite3.Connection) -> None:
        """Two programs that go on from the same last keyframe would give the same number to different ones."""
        newest = sql.execute("SELECT coalesce(max(session), 0) FROM sessions").fetchone()[0]
        if self.session and newest > self._newest:
            raise Dpm2Error(f"{self.path}: another program has begun to write to it")

    @property
    def in_place(self) -> bool:
        """Whether its path still is the file that was opened, and not one that was removed or moved since."""
        return _identity(self.path) == self._file

    @property
    def size(self) -> int:
        """Keyframes in it.

        Raises:
            Dpm2Error: it cannot be read.
        """
        with _explained(self.path):
            return int(self._connection.execute("SELECT coalesce(max(node), -1) + 1 FROM keyframes").fetchone()[0])

    @contextmanager
    def together(self) -> Iterator[None]:
        """All that is written in this block goes into the file at its end, or not at all.

        Raises:
            Dpm2Error: it could not be written.
        """
        with self._transaction():
            self._together = True
            try:
                yield
            finally:
                self._together = False

    def rows(self, table: str, columns: str = "", checked: bool = True, where: str = "") -> Iterator[tuple[Any, ...]]:
        """Rows of a table in their order, without checksums; `where`: a condition of SQL.

        Raises:
            Dpm2Error: damage; `dpm2 map check` says how much.
        """
        names = () if columns else schema.CONTENT.get(table, ())
        requested = ", ".join((*names, "crc")) if names else columns or "*"
        with _explained(self.path):
            before = None
            query = f"SELECT rowid, {requested} FROM {table} {where and f'WHERE {where}'} ORDER BY rowid"
            for key, *row in self._connection.execute(query):
                if before is not None and key <= before:  # a tree whose pages lead in a circle has no end
                    raise sqlite3.DatabaseError(f"malformed: {table} {key} comes after {before}")
                before = key
                if names and row.pop() != schema.row_crc(*row) and checked:
                    raise Dpm2Error(f"{self.path}: {table} {row[0]} is damaged; see dpm2 map check")
                yield tuple(row)

    def payload(self, node: int, what: str) -> bytes | None:
        """`cloud`, `descriptors` or `thumbnail` of a node; None where it has none.

        Raises:
            Dpm2Error: it cannot be read.
        """
        with _explained(self.path):
            row = self._connection.execute(f"SELECT {what} FROM payloads WHERE node = ?", (node,)).fetchone()
        return None if row is None else row[0]

    def cloud(self, node: int) -> bytes | None:
        """The packed cloud of a node."""
        return self.payload(node, "cloud")

    def close(self) -> None:
        """End it. The last one to write leaves a single file behind, without FILE-wal."""
        if not self.read_only:
            with suppress(sqlite3.Error):  # there is a reader, or the disk is full: FILE-wal stays, and nothing is lost
                self._connection.execute("PRAGMA busy_timeout = 200")
                self._connection.execute("PRAGMA journal_mode = DELETE")
        self._connection.close()
        if self._copy is not None:
            self._copy.cleanup()

    def __enter__(self) -> MapStore:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @contextmanager
    def snapshot(self) -> Iterator[None]:
        """All that is read in this block is of one instant, whatever another process writes meanwhile.

        Raises:
            Dpm2Error: it cannot be read.
        """
        with _explained(self.path):
            self._connection.execute("BEGIN")
            try:
                yield
            finally:
                self._connection.execute("ROLLBACK")

    def copy_to(self, path: Path) -> None:
        """All that is in it now as another map file, whole or not at all; an older one there is replaced.

        Raises:
            Dpm2Error: it could not be written.
        """
        part = part_beside(path)
        with _explained(path):
            try:
                with closing(sqlite3.connect(part)) as copy:
                    self._connection.backup(copy)
                remove_log(path)
                part.replace(path)
            finally:
                remove_map(part)

    @contextmanager
    def _transaction(self) -> Iterator[sqlite3.Connection]:
        with _explained(self.path):
            if self._together:
                yield self._connection
                return
            self._connection.execute("BEGIN IMMEDIATE")
            try:
                yield self._connection
                self._connection.execute("COMMIT")
            except BaseException:
                with suppress(sqlite3.Error):  # SQLite may have rolled back by itself
                    self._connection.execute("ROLLBACK")
                raise


def _insert(sql: sqlite3.Connection, table: str, rows: Sequence[tuple[Any, ...]]) -> None:
    if rows:
        sql.executemany(f"INSERT OR REPLACE INTO {table} VALUES ({','.join('?' * len(rows[0]))})", rows)


def _connect(path: Path, mode: str) -> Connection:
    return connect(path.resolve(), mode, BUSY)


def _durable(connection: sqlite3.Connection) -> None:
    connection.execute("PRAGMA journal_mode = WAL")
    connection.execute("PRAGMA synchronous = NORMAL")


def _open_read_only(path: Path) -> MapStore:
    """As it lies there where it is whole; with FILE-wal as a reader of that; from a copy where not even that can be."""
    wal = Path(f"{path.resolve()}-wal")  # SQLite names it after the file, not after a link to it
    if not wal.exists() or not wal.stat().st_size:
        if _head(path)[18] == 1:  # closed, with a journal on rollback: a reader leaves no trace
            return MapStore(path, _connect(path, "ro"), True)
        return MapStore(path, _connect(path, "ro&immutable=1"), True)
    connection = _connect(path, "ro")
    try:
        connection.execute("SELECT name FROM sqlite_master LIMIT 1").fetchone()
        return MapStore(path, connection, True)
    except sqlite3.OperationalError:  # a folder that cannot be written: SQLite needs FILE-shm to read FILE-wal
        connection.close()
        return _copied(path)


def _identity(path: Path) -> tuple[int, int] | None:
    """What a file is, whatever its name; None where there is none."""
    try:
        status = path.stat()
    except OSError:
        return None
    return status.st_dev, status.st_ino


def _head(path: Path) -> bytes:
    """The first 100 bytes, zeros where the file is shorter; see the SQLite file format."""
    with path.open("rb") as file:
        return file.read(100).ljust(100, b"\0")


def _copied(path: Path) -> MapStore:
    folder = tempfile.TemporaryDirectory(prefix="dpm2_map_")
    copy = Path(folder.name) / "map"
    copy_with_log(path, copy)
    store = MapStore(path, _connect(copy, "rw"), True)
    store._copy = folder
    return store


def _migrated_copy(store: MapStore, version: int) -> MapStore:
    """An older map, read-only: brought up to date in memory."""
    size = store.path.stat().st_size
    memory = Connection(":memory:", isolation_level=None, check_same_thread=False, size=size)
    with closing(store._connection) as source:
        source.backup(memory)
    schema.migrate(memory, version)
    store._connection = memory
    return store


@contextmanager
def _explained(path: Path) -> Iterator[None]:
    """What SQLite and the system complain of, in one line that names the file."""
    try:
        yield
    except sqlite3.Error as error:
        text = str(error)
        hint = "; see dpm2 map check" if "malformed" in text or "not a database" in text else ""
        raise Dpm2Error(f"{path}: {text}{hint}") from error
    except OSError as error:
        raise Dpm2Error(f"{path}: {error.strerror or error}") from error
