# SPDX-License-Identifier: Apache-2.0
"""The map as one file, written during the drive: `kill -9` at any time loses at most the keyframe in progress.

SQLite in WAL mode: one transaction per keyframe; other processes can read during a write. A closed map is a single
file; if its writer was killed or is still running, there is also FILE-wal, which belongs to it. `synchronous=NORMAL`: a
power failure may lose the last seconds, but never the map.
"""

from __future__ import annotations

import sqlite3
from collections.abc import Iterable, Iterator, Sequence
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from dpm2_core._version import __version__
from dpm2_core.errors import Dpm2Error
from dpm2_core.estimates import Edge, Keyframe
from dpm2_core.files import part_beside
from dpm2_core.frame import Array, Georeference
from dpm2_core.slam.store import schema
from dpm2_core.slam.store.cloud_store import Loan
from dpm2_core.slam.store.map_connection import BRIEFLY, BUSY, MapConnection, create_map, explained, open_map
from dpm2_core.slam.store.map_file import move_map, remove_map
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


@dataclass
class Change:
    """Data that is written in one transaction.

    Attributes:
        keyframes: node, keyframe (its cloud is not used), packed cloud or None, JPEG or None.
        edges: in the order of the map; appended to those of the file.
        poses: T_map_kf (4, 4) by node. moving: packed mask by node. trail: removed keyframes.
        georeference: the new one; None: unchanged.
        judged: edges of the file by their number, with their new state.
        loans: of the keyframes that borrow. given_up: nodes whose own clouds are no longer needed.
    """

    keyframes: list[tuple[int, Keyframe, bytes | None, bytes | None]] = field(default_factory=list)
    edges: list[Edge] = field(default_factory=list)
    poses: dict[int, Array] = field(default_factory=dict)
    moving: dict[int, bytes] = field(default_factory=dict)
    trail: list[RemovedKeyframe] = field(default_factory=list)
    judged: dict[int, Edge] = field(default_factory=dict)
    georeference: Georeference | None = None
    loans: dict[int, Loan] = field(default_factory=dict)
    given_up: Sequence[int] = ()


class MapStore:
    """An open map file. Use it in one thread at a time."""

    def __init__(self, path: Path, connection: MapConnection, read_only: bool) -> None:
        """Use `create` and `open`."""
        self.path = path
        self.read_only = read_only
        self.session = 0
        self._file = _identity(path)
        self._last_session = 0  # number of the last session that this program has written
        self._map_connection = connection
        self._connection = connection.sql
        self._in_transaction = False

    @classmethod
    def create(cls, path: Path) -> MapStore:
        """Make a new, empty map; call `begin_session` next. Raises as `create_map`."""
        return cls(path, create_map(path), read_only=False)

    @classmethod
    def open(cls, path: Path, read_only: bool = True) -> MapStore:
        """Open an existing map; see `open_map`, also for its errors."""
        return cls(path, open_map(path, read_only), read_only)

    def begin_session(self, config: str = "", weights: str = "") -> int:
        """Record that this program writes from now on; returns the number of the session, from 1.

        Raises:
            Dpm2Error: it could not be written.
        """
        started = datetime.now(UTC).isoformat(timespec="seconds")
        with self._transaction() as sql:
            number = sql.execute("SELECT coalesce(max(session), 0) + 1 FROM sessions").fetchone()[0]
            sql.execute("INSERT INTO sessions VALUES (?,?,?,?,?)", (number, __version__, started, config, weights))
        self.session = self._last_session = int(number)
        return self.session

    def add_sessions(self, sessions: Iterable[Session]) -> None:
        """Add the sessions of other maps."""
        with self._transaction() as sql:
            rows = [(s.number, s.program, s.started, s.config, s.weights) for s in sessions]
            sql.executemany("INSERT INTO sessions VALUES (?,?,?,?,?)", rows)
        self._last_session = max([self._last_session, *(row[0] for row in rows)])

    def write(self, change: Change, wait: float = BUSY) -> None:
        """Write a change, whole or not at all; `wait`: s to wait for another program that writes.

        Raises:
            Dpm2Error: it could not be written: a full disk, a read-only file, another writer.
        """
        self._wait_at_most(wait)
        with self._transaction() as sql:
            self._check_only_writer(sql)
            for node, keyframe, cloud, thumbnail in change.keyframes:
                loan = change.loans.get(node)
                _insert(sql, "keyframes", [keyframe_row(node, keyframe, self.session, loan)])
                if keyframe.fix is not None:
                    _insert(sql, "fixes", [fix_row(node, keyframe.fix)])
                if cloud is not None:
                    d = keyframe.descriptors if loan is None else None
                    packed = None if d is None else pack_descriptors(d)
                    _insert(sql, "payloads", [with_crc(node, cloud, packed, thumbnail if loan is None else None)])
            for table in ("payloads", "moving"):
                sql.executemany(f"DELETE FROM {table} WHERE node = ?", [(node,) for node in change.given_up])
            first = sql.execute("SELECT coalesce(max(id), -1) + 1 FROM edges").fetchone()[0]
            _insert(sql, "edges", [edge_row(first + i, edge) for i, edge in enumerate(change.edges)])
            _insert(sql, "edges", [edge_row(number, edge) for number, edge in change.judged.items()])
            _insert(sql, "poses", [with_crc(node, array_bytes(T)) for node, T in change.poses.items()])
            _insert(sql, "moving", [with_crc(node, mask) for node, mask in change.moving.items()])
            _insert(sql, "trail", [removed_row(p) for p in change.trail])
            if change.georeference is not None:
                _insert(sql, "georeference", [georeference_row(change.georeference)])

    def _check_only_writer(self, sql: sqlite3.Connection) -> None:
        """Raise if another program writes: both would give the same numbers to different keyframes."""
        newest = sql.execute("SELECT coalesce(max(session), 0) FROM sessions").fetchone()[0]
        if self.session and newest > self._last_session:
            raise Dpm2Error(f"{self.path}: another program has begun to write to it")

    @property
    def in_place(self) -> bool:
        """Whether the opened file is still at its path, and was not removed or moved since."""
        return _identity(self.path) == self._file

    @property
    def size(self) -> int:
        """Number of keyframes.

        Raises:
            Dpm2Error: it cannot be read.
        """
        with explained(self.path):
            return int(self._connection.execute("SELECT coalesce(max(node), -1) + 1 FROM keyframes").fetchone()[0])

    @contextmanager
    def together(self) -> Iterator[None]:
        """All writes in this block become one transaction.

        Raises:
            Dpm2Error: it could not be written.
        """
        with self._transaction():
            self._in_transaction = True
            try:
                yield
            finally:
                self._in_transaction = False

    def rows(self, table: str, columns: str = "", where: str = "") -> Iterator[tuple[Any, ...]]:
        """Rows of a table in their order, without checksums; `where`: an SQL condition.

        Raises:
            Dpm2Error: damage; `dpm2 map check` shows how much.
        """
        names = () if columns else schema.CONTENT.get(table, ())
        requested = ", ".join((*names, "crc")) if names else columns or "*"
        with explained(self.path):
            before = None
            query = f"SELECT rowid, {requested} FROM {table} {where and f'WHERE {where}'} ORDER BY rowid"
            for key, *row in self._connection.execute(query):
                if before is not None and key <= before:  # a damaged tree with a cycle of pages has no end
                    raise sqlite3.DatabaseError(f"malformed: {table} {key} comes after {before}")
                before = key
                if names and row.pop() != schema.row_crc(*row):
                    raise Dpm2Error(f"{self.path}: {table} {row[0]} is damaged; see dpm2 map check")
                yield tuple(row)

    def payload(self, node: int, what: str) -> bytes | None:
        """`cloud`, `descriptors` or `thumbnail` of a node; None if it has none.

        Raises:
            Dpm2Error: it cannot be read, or is damaged.
        """
        column = schema.CONTENT["payloads"].index(what)
        return next((row[column] for row in self.rows("payloads", where=f"node = {node:d}")), None)

    @property
    def weights(self) -> list[str]:
        """Ids of the weights that made its descriptors, session by session; empty for sessions without."""
        return [weights for (weights,) in self.rows("sessions", "weights")]

    @property
    def described(self) -> bool:
        """Whether any keyframe has descriptors."""
        return any(self.payload(node, "descriptors") for (node,) in self.rows("keyframes", "node"))

    def close(self) -> None:
        """Close the file. The last writer leaves a single file, without FILE-wal."""
        if not self.read_only:
            with suppress(sqlite3.Error):  # with a reader, or a full disk, FILE-wal stays, and nothing is lost
                self._wait_at_most(BRIEFLY)
                self._connection.execute("PRAGMA journal_mode = DELETE")
        self._map_connection.close()

    def __enter__(self) -> MapStore:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @contextmanager
    def snapshot(self) -> Iterator[None]:
        """All reads in this block see one state, whatever another process writes meanwhile.

        Raises:
            Dpm2Error: it cannot be read.
        """
        with explained(self.path):
            self._connection.execute("BEGIN")
            try:
                yield
            finally:
                self._connection.execute("ROLLBACK")

    def copy_to(self, path: Path) -> None:
        """Copy the current content to another map file, whole or not at all; an older file there is replaced. Does
        nothing if `path` leads to its own file.

        Raises:
            Dpm2Error: it could not be written.
        """
        if path.resolve() == self.path.resolve():
            return
        part = part_beside(path)
        with explained(path):
            try:
                with closing(sqlite3.connect(part)) as copy:
                    self._connection.backup(copy)
                    copy.execute("PRAGMA locking_mode = EXCLUSIVE")  # needs no shared memory, which network shares lack
                    copy.execute("PRAGMA journal_mode = DELETE")  # a single file, also by its header
                move_map(part, path)
            finally:
                remove_map(part)

    def _wait_at_most(self, seconds: float) -> None:
        with explained(self.path):
            self._connection.execute(f"PRAGMA busy_timeout = {1000 * seconds:.0f}")

    @contextmanager
    def _transaction(self) -> Iterator[sqlite3.Connection]:
        with explained(self.path):
            if self._in_transaction:
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


def _identity(path: Path) -> tuple[int, int] | None:
    """Device and inode of a file, whatever its name; None if there is no file."""
    try:
        status = path.stat()
    except OSError:
        return None
    return status.st_dev, status.st_ino
