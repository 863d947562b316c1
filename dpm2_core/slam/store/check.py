# SPDX-License-Identifier: Apache-2.0
"""Checks a map file, and writes its good part to another one."""

from __future__ import annotations

import sqlite3
import tempfile
from collections.abc import Callable
from contextlib import closing, suppress
from pathlib import Path

from dpm2_core.database import connect
from dpm2_core.errors import Dpm2Error, UsageError
from dpm2_core.files import explaining
from dpm2_core.slam.store import schema
from dpm2_core.slam.store.map_connection import explained
from dpm2_core.slam.store.map_data import MapData, save_as
from dpm2_core.slam.store.map_file import check_new, copy_with_log, foreign_log, missing_log
from dpm2_core.slam.store.salvage import Findings, Salvage


def check_map(
    path: Path, recover: Path | None = None, complete: Callable[[MapData], MapData] = lambda data: data
) -> Findings:
    """Check a map file without changing it; optionally write its good part to a new file.

    Args:
        complete: receives the good part, and returns it with recomputed replacements of lost data.

    Raises:
        UsageError: not a map, or one of another version; `recover` is not a new file. Dpm2Error: nothing can be read,
            `recover` cannot be written, or there is no room for a copy in the folder for temporary files.
    """
    if not path.is_file():
        raise UsageError(f"{path}: no such map file")
    if recover is not None:
        check_new(recover)
    findings = Findings()
    with explained(path):
        findings.problems += filter(None, (missing_log(path), foreign_log(path)))
    with tempfile.TemporaryDirectory(prefix="dpm2_check_") as folder:
        copy = Path(folder) / "map"  # opening replays FILE-wal, which would change the damaged file
        _copy(path, copy)
        with closing(_open_copy(copy, path, findings)) as sql:
            data = Salvage(sql, copy.stat().st_size, findings).run()
            findings.keyframes = len(data)
            if recover is not None:
                if not len(data):
                    raise Dpm2Error(f"{path}: nothing in it can be recovered")
                save_as(complete(data), recover)
    return findings


def _copy(path: Path, copy: Path) -> None:
    """Copy a map with its FILE-wal; while a program writes to it, its state at one instant."""
    source = path.resolve()
    if Path(f"{source}-shm").exists() and not foreign_log(source):
        # A damaged file that SQLite cannot read is copied byte by byte.
        with suppress(sqlite3.Error), closing(connect(source, "ro")) as sql, closing(sqlite3.connect(copy)) as target:
            sql.execute("BEGIN")
            sql.execute("SELECT name FROM sqlite_master LIMIT 1").fetchone()
            sql.backup(target)
            return
    reason = f"no copy of it could be made in {copy.parent.parent}, which TMPDIR can change"
    with explaining(path, f"not checked: {reason}"):
        copy_with_log(source, copy)


def _open_copy(copy: Path, path: Path, findings: Findings) -> sqlite3.Connection:
    """The copy of the map as a database; with a new first page if the old one is invalid."""
    try:
        sql: sqlite3.Connection = connect(copy, "rw")
        schema.check(sql, path)
    except sqlite3.DatabaseError as error:
        findings.problems.append(f"header: {error}")
        sql = _with_new_header(copy)
    with suppress(sqlite3.DatabaseError):
        info = [row[0] for row in sql.execute("PRAGMA integrity_check(20)")]
        findings.problems += [f"database: {' '.join(line.split())}" for line in info if line != "ok"]
    return sql


def _with_new_header(copy: Path) -> sqlite3.Connection:
    """Replace the first page, which has the schema and is the same in all maps, by that of an empty map."""
    empty = copy.with_name("empty")
    with closing(connect(empty, "rwc")) as sql:
        schema.create(sql)
        size = sql.execute("PRAGMA page_size").fetchone()[0]
    Path(f"{copy}-wal").unlink(missing_ok=True)
    page = bytearray(empty.read_bytes()[:size])
    page[28:32] = (copy.stat().st_size // size).to_bytes(4, "big")  # pages in the file
    page[32:40] = bytes(8)  # no free pages
    with copy.open("r+b") as file:
        file.write(page)
    return connect(copy, "rw")
