# SPDX-License-Identifier: Apache-2.0
"""Opens SQLite files of unknown origin: nothing in them is executed, and no query can run without end.

It follows sqlite.org/security.html for untrusted files. A map file has only tables: the text of its schema is compared
with ours, and a view, a trigger or an expression in it is an error before any row is read. Bags are written by other
programs, so only the absence of anything but plain tables is checked.
"""

from __future__ import annotations

import os
import re
import sqlite3
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any
from urllib.parse import quote

MAX_VALUE = 64 << 20
"""Bytes of one value or row: the largest cloud takes a quarter of it."""
_STEPS_PER_CALL = 100_000  # steps of SQLite's virtual machine between two calls of the handler
_MAX_STEPS = 30_000_000  # per statement, plus one per byte of the file: a second or two

_COMPUTED = re.compile(r"\b(AS|VIRTUAL|CHECK|WHERE)\b", re.IGNORECASE)


class Connection(sqlite3.Connection):
    """A connection that aborts any statement that takes more steps than a map file of this size can need."""

    def __init__(self, database: str | Path, *arguments: Any, size: int = 0, **options: Any) -> None:
        """As `sqlite3.connect`; `size`: file size, bytes."""
        super().__init__(database, *arguments, **options)
        self._steps = _StepLimit((_MAX_STEPS + size) // _STEPS_PER_CALL)
        self.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, MAX_VALUE)
        self.setlimit(sqlite3.SQLITE_LIMIT_ATTACHED, 0)
        self.execute("PRAGMA trusted_schema = OFF")
        self.execute("PRAGMA cell_size_check = ON")
        self.set_progress_handler(self._steps, _STEPS_PER_CALL)

    def execute(self, *arguments: Any) -> sqlite3.Cursor:
        self._steps.calls = 0
        return super().execute(*arguments)

    def executemany(self, *arguments: Any) -> sqlite3.Cursor:
        self._steps.calls = 0
        return super().executemany(*arguments)

    def executescript(self, *arguments: Any) -> sqlite3.Cursor:
        self._steps.calls = 0
        return super().executescript(*arguments)


class _StepLimit:
    """Counts its calls; SQLite stops at the first call beyond `max_calls`."""

    def __init__(self, max_calls: int) -> None:
        self.calls, self._max_calls = 0, max_calls

    def __call__(self) -> bool:
        self.calls += 1
        return self.calls > self._max_calls


def size_with_log(path: Path) -> int:
    """Bytes of a database file and of its FILE-wal, which lies next to the target of a symbolic link."""
    source = path.resolve()
    return sum(file.stat().st_size for suffix in ("", "-wal") if (file := Path(f"{source}{suffix}")).exists())


def connect(path: Path, mode: str, timeout: float = 5.0) -> Connection:
    """Open a database file.

    Args:
        mode: of SQLite's file URIs: ro, rw, rwc; `ro&immutable=1` for a file that no process writes.
    """
    # The mapper of a ROS node is created in one thread and used in another, but never in both at once.
    return Connection(
        f"file:{quote(os.fsencode(path))}?mode={mode}", timeout, isolation_level=None, check_same_thread=False,
        uri=True, size=size_with_log(path),
    )  # fmt: skip


def check_schema(connection: sqlite3.Connection, tables: Mapping[str, str]) -> None:
    """Compare the schema of a database with the expected tables, their CREATE statements by name.

    Raises:
        sqlite3.DatabaseError: a table is missing, unexpected or different, or the schema cannot be read.
    """
    missing = dict(tables)
    for kind, name, sql in connection.execute("SELECT type, name, sql FROM sqlite_master"):
        if kind != "table" or name not in missing:
            raise sqlite3.DatabaseError(f"malformed: {kind} {name} does not belong into it")
        if not isinstance(sql, str) or _normalized(sql) != _normalized(missing.pop(name)):
            raise sqlite3.DatabaseError(f"malformed: table {name} has other columns")
    if missing:
        raise sqlite3.DatabaseError(f"malformed: no table {', '.join(missing)}")


def check_plain(path: Path) -> None:
    """Check that a database has only tables of values and ordinary indices: nothing is computed when it is read.

    Raises:
        sqlite3.DatabaseError: it has something else, or cannot be read.
    """
    connection = connect(path, "ro")
    try:
        for kind, name, sql in connection.execute("SELECT type, name, sql FROM sqlite_master"):
            if kind not in ("table", "index") or _COMPUTED.search(_normalized(sql or "")):
                raise sqlite3.DatabaseError(f"malformed: {kind} {name} does not belong into it")
    finally:
        connection.close()


def statements(script: str) -> dict[str, str]:
    """The CREATE TABLE statements of a script by the name of their table."""
    found: Sequence[str] = re.findall(r"CREATE TABLE [^;]*", script)
    return {statement.split(None, 3)[2]: statement for statement in found}


def _normalized(sql: str) -> str:
    """Without comments and needless spaces. The expected text has no quotes: each `--` in an equal one is a comment."""
    return re.sub(r" ?([(),]) ?", r"\1", re.sub(r"\s+", " ", re.sub(r"--[^\n]*", " ", sql))).strip()
