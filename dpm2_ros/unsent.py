# SPDX-License-Identifier: Apache-2.0
"""Stores a robot's keyframes on its disk until the mapper has them, also those of a process that was killed."""

from __future__ import annotations

import re
import sqlite3
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from urllib.parse import quote

from dpm2_core.database import Connection, check_schema, connect, statements
from dpm2_core.slam.store.cloud_store import SpillFile

_SUFFIX = ".unsent"
_TABLES = """
CREATE TABLE keyframe (id INTEGER PRIMARY KEY, pose BLOB NOT NULL, descriptors BLOB NOT NULL, cloud BLOB NOT NULL)
"""
_MAX_MESSAGE_SIZE = 200_000  # bytes of a message: twice what a keyframe may have


class KeyframeFile:
    """The messages of a drive's keyframes, in order from number 0; each keyframe is added whole or not at all.

    If the disk is full or no file is wanted, keyframes are put into a `SpillFile`. They are lost with the process,
    unless there is space for them later.

    Attributes:
        stored: number of keyframes in the file. problem: why the last one could not be added to it; empty if it was.

    Raises:
        sqlite3.Error, OSError: the file cannot be created, is not such a file, is damaged, or another process uses it;
            also when it is opened again, after `pause`.
    """

    def __init__(self, path: Path | None = None) -> None:
        """`path`: created if it does not exist; None: nothing is to outlive the process."""
        self.path = path
        self.stored, self.problem = 0, ""
        self._spilled: list[list[int]] = []  # keyframes after those: their numbers in `_spill`
        self._spill = SpillFile()
        self._connection: Connection | None = None
        if path is not None:
            path.parent.mkdir(parents=True, exist_ok=True)
            self._connection, self.stored = _open(path, "rwc")

    def _connect(self) -> Connection:
        """The connection to the file, which is opened again if necessary."""
        if self._connection is None:
            assert self.path is not None
            connection, stored = _open(self.path, "rw")
            if stored != self.stored:
                connection.close()
                raise sqlite3.DatabaseError(f"{stored} keyframes, {self.stored} before: another process has written")
            self._connection = connection
        return self._connection

    def __len__(self) -> int:
        return self.stored + len(self._spilled)

    def append(self, parts: Sequence[bytes]) -> None:
        """Add the next keyframe: its pose, its descriptors, its cloud, each serialized."""
        if not self.catch_up(parts):
            self._spilled.append([self._spill.append(part) for part in parts])

    def catch_up(self, parts: Sequence[bytes] | None = None) -> bool:
        """Write the keyframes of the `SpillFile`, then `parts`; returns whether all are in the file. See `problem`."""
        if self.path is None:
            return False
        try:
            while self._spilled:  # in order: a file has no gap
                self._insert([self._spill.read(number) for number in self._spilled[0]])
                del self._spilled[0]
                if not self._spilled:
                    self._spill = SpillFile()
            if parts is not None:
                self._insert(parts)
            self.problem = ""
        except sqlite3.Error as error:
            self.problem = str(error)
        return not self.problem

    def _insert(self, parts: Sequence[bytes]) -> None:
        self._connect().execute("INSERT INTO keyframe VALUES (?, ?, ?, ?)", (self.stored, *parts))
        self.stored += 1

    def read(self, id: int) -> list[bytes]:
        """The three messages of a keyframe.

        Raises:
            sqlite3.DatabaseError: it is damaged.
        """
        if id >= self.stored:
            return [self._spill.read(number) for number in self._spilled[id - self.stored]]
        query = "SELECT pose, descriptors, cloud FROM keyframe WHERE id = ?"
        parts: tuple[object, ...] | None = self._connect().execute(query, (id,)).fetchone()
        found = [part for part in parts or () if isinstance(part, bytes)]
        if len(found) != 3:
            raise sqlite3.DatabaseError(f"keyframe {id} is damaged")
        return found

    def pause(self) -> None:
        """Close the file, so that any process can use it, until a keyframe is read or added."""
        if self._connection is not None:
            with suppress(sqlite3.Error):
                self._connection.close()
            self._connection = None

    def close(self, keep: bool) -> None:
        """Close the file; `keep`: leave it for the next start, else it is deleted."""
        self.pause()
        if self.path is not None and not keep:
            with suppress(OSError):  # the file system is read-only by now, or the folder is not empty
                for path in (self.path, Path(f"{self.path}-wal")):
                    path.unlink(missing_ok=True)
                self.path.parent.rmdir()


def _open(path: Path, mode: str) -> tuple[Connection, int]:
    """The opened file, and the number of keyframes in it; `mode`: see `connect`.

    Raises:
        sqlite3.Error, OSError: see `KeyframeFile`.
    """
    connection = connect(path, mode, timeout=0.0)
    try:
        # For one process only: a second one with the same robot name and folder uses a file of its own.
        connection.execute("PRAGMA locking_mode = EXCLUSIVE")
        connection.execute("PRAGMA journal_mode = WAL")
        connection.execute("PRAGMA synchronous = NORMAL")
        connection.execute("BEGIN EXCLUSIVE")
        if not connection.execute("SELECT count(*) FROM sqlite_master").fetchone()[0]:
            connection.execute(_TABLES)
        connection.execute("COMMIT")
        check_schema(connection, statements(_TABLES))
        query = "SELECT count(*), max(id), max(max(length(pose), length(descriptors), length(cloud))) FROM keyframe"
        count, last, largest = connection.execute(query).fetchone()
        if count and (last != count - 1 or largest > _MAX_MESSAGE_SIZE):
            raise sqlite3.DatabaseError("malformed: not the keyframes of a drive")
    except BaseException:
        connection.close()
        raise
    return connection, int(count)


def path_of(folder: Path, robot: str, session: str) -> Path:
    """The file of a robot's drive: `drive.5f3a9c01.unsent`, in a namespace `drive_red.5f3a9c01.unsent`."""
    return folder / f"{_stem(robot)}.{session}{_SUFFIX}"


def left_behind(folder: Path, robot: str) -> list[tuple[str, Path]]:
    """Session and path of that robot's drives in a folder, the oldest first."""
    pattern, found = re.compile(rf"{re.escape(_stem(robot))}\.([0-9a-f]{{8}}){re.escape(_SUFFIX)}"), []
    with suppress(OSError):
        for path in folder.iterdir():
            if name := pattern.fullmatch(path.name):
                found.append((path.stat().st_mtime, name[1], path))
    return [(session, path) for _, session, path in sorted(found)]


def _stem(robot: str) -> str:
    return f"drive_{quote(robot, safe='')}" if robot else "drive"
