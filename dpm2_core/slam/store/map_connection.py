# SPDX-License-Identifier: Apache-2.0
"""Opens a map file: for writing, for reading in place, or from a copy; errors of SQLite become one line of text."""

from __future__ import annotations

import sqlite3
import tempfile
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from threading import Lock
from typing import NamedTuple

from dpm2_core.database import Connection, connect
from dpm2_core.errors import Dpm2Error, UsageError
from dpm2_core.files import named, part_beside
from dpm2_core.slam.store import schema
from dpm2_core.slam.store.map_file import copy_with_log, foreign_log, name_map, remove_map

BUSY = 5.0
"""s to wait for another program: a reader never blocks the writer for long; another writer is an error."""
BRIEFLY = 0.2
"""s to wait if it is tried again later, or if nothing depends on it."""
_MAGIC = b"SQLite format 3"
_CREATE_LOCK = Lock()  # `part_beside` returns one file for the whole process


class MapConnection(NamedTuple):
    """An open map file, and the folder of the copy that is used instead of it, if there is one: close both."""

    sql: sqlite3.Connection
    copy: tempfile.TemporaryDirectory[str] | None = None

    def close(self) -> None:
        self.sql.close()
        if self.copy is not None:
            self.copy.cleanup()


def create_map(path: Path) -> MapConnection:
    """Make a new, empty map file, and open it for writing. After a kill half-way there is no file of that name.

    Raises:
        UsageError: see `check_new`. Dpm2Error: it cannot be made.
    """
    with explained(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        target = path.resolve()  # a symbolic link stays a link
        with _CREATE_LOCK, named(path, target):
            _create(target)
        try:
            return open_map(path, read_only=False)
        except BaseException:
            remove_map(path)  # else it would block the next attempt, such as after a full disk
            raise


def _create(path: Path) -> None:
    part = part_beside(path)
    try:
        part.touch()
        with closing(_connect(part, "rw")) as sql:
            schema.create(sql)  # not in FILE-wal, whose end a power failure may take
        name_map(part, path)
    finally:
        remove_map(part)


def open_map(path: Path, read_only: bool) -> MapConnection:
    """Open a map file. With `read_only` none of its bytes changes.

    Raises:
        UsageError: not a map, one of another version, or one with the log of another map. Dpm2Error: it cannot be read,
            or written, or is damaged.
    """
    if not path.is_file():
        raise UsageError(f"{path}: no such map file")
    with explained(path):
        if _read_header(path)[:15] != _MAGIC:
            raise UsageError(f"{path}: not a dpm2 map")
        if foreign := foreign_log(path):
            raise UsageError(f"{path}: {foreign}")
        connection = _open_to_read(path) if read_only else MapConnection(_connect(path, "rw"))
        try:
            schema.check(connection.sql, path)
            if not read_only:
                connection.sql.execute("PRAGMA journal_mode = WAL")
                connection.sql.execute("PRAGMA synchronous = NORMAL")
        except BaseException:
            connection.close()
            raise
        return connection


def _connect(path: Path, mode: str) -> Connection:
    return connect(path.resolve(), mode, BUSY)


def _open_to_read(path: Path) -> MapConnection:
    """Open it in place if it is complete; with FILE-wal as a reader of both; else from a copy."""
    wal = Path(f"{path.resolve()}-wal")  # SQLite names it after the file, not after a link to it
    if not wal.exists() or not wal.stat().st_size:
        if _read_header(path)[18] == 1:  # closed, with a rollback journal: a reader leaves no files
            return MapConnection(_connect(path, "ro"))
        return MapConnection(_connect(path, "ro&immutable=1"))
    connection = _connect(path, "ro")
    try:
        connection.execute("SELECT name FROM sqlite_master LIMIT 1").fetchone()
        return MapConnection(connection)
    except sqlite3.OperationalError:  # a read-only folder: SQLite needs FILE-shm to read FILE-wal
        connection.close()
        folder = tempfile.TemporaryDirectory(prefix="dpm2_map_")
        copy = Path(folder.name) / "map"
        copy_with_log(path, copy)
        return MapConnection(_connect(copy, "rw"), folder)


def _read_header(path: Path) -> bytes:
    """The first 100 bytes, with zeros if the file is shorter; see the SQLite file format."""
    with path.open("rb") as file:
        return file.read(100).ljust(100, b"\0")


@contextmanager
def explained(path: Path) -> Iterator[None]:
    """Turn errors of SQLite and the system into one line that names the file.

    Raises:
        Dpm2Error: instead of their errors.
    """
    try:
        yield
    except sqlite3.Error as error:
        text = str(error)
        hint = "; see dpm2 map check" if "malformed" in text or "not a database" in text else ""
        raise Dpm2Error(f"{path}: {text}{hint}") from error
    except OSError as error:
        raise Dpm2Error(f"{path}: {error.strerror or error}") from error
