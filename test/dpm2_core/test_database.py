# SPDX-License-Identifier: Apache-2.0
"""A database of unknown origin is closed after a bounded time, and a valid large one is read completely."""

from __future__ import annotations

import os
import sqlite3
import sys
import time
from contextlib import closing
from pathlib import Path

import pytest

from dpm2_core.database import check_schema, connect

TABLE = "CREATE TABLE t (x INTEGER PRIMARY KEY, y TEXT NOT NULL)"


@pytest.mark.slow
def test_a_query_without_end_is_ended(tmp_path: Path) -> None:
    with closing(connect(tmp_path / "a", "rwc")) as sql:
        for _ in range(2):  # the next statement starts with a new count
            began = time.process_time()
            with pytest.raises(sqlite3.OperationalError, match="interrupted"):
                sql.execute("WITH RECURSIVE n(x) AS (SELECT 1 UNION ALL SELECT x + 1 FROM n) SELECT max(x) FROM n")
            assert time.process_time() - began < 10  # half a second; some seconds on a slow and busy machine
        assert sql.execute("SELECT 1").fetchone() == (1,)


def test_a_large_table_is_read_whole(tmp_path: Path) -> None:
    """It has far more rows, in one statement and in many, than the number of steps between two checks."""
    with closing(connect(tmp_path / "a", "rwc")) as sql:
        sql.execute("CREATE TABLE t (x INTEGER PRIMARY KEY, y)")
        sql.execute("BEGIN")
        sql.executemany("INSERT INTO t VALUES (?, ?)", ((i, "y" * 20) for i in range(200_000)))
        sql.execute("COMMIT")
    with closing(connect(tmp_path / "a", "ro")) as sql:
        assert sum(1 for _ in sql.execute("SELECT x, y FROM t ORDER BY x")) == 200_000


@pytest.mark.skipif(sys.platform != "linux", reason="elsewhere a name has to be text")
@pytest.mark.parametrize("name", [b"st\xe4dt.dpm2map", b"a?b#c%20 d.dpm2map"])
def test_a_file_of_any_name_is_opened(tmp_path: Path, name: bytes) -> None:
    """This includes names with bytes that are not UTF-8, as from an archive of another system."""
    path = tmp_path / os.fsdecode(name)
    with closing(connect(path, "rwc")) as sql:
        sql.execute(TABLE)
    with closing(connect(path, "ro")) as sql:
        check_schema(sql, {"t": TABLE})
    assert os.listdir(os.fsencode(tmp_path)) == [name]


def test_a_value_beyond_bounds_is_not_made(tmp_path: Path) -> None:
    with closing(connect(tmp_path / "a", "rwc")) as sql, pytest.raises(sqlite3.DataError, match="too big"):
        sql.execute("SELECT zeroblob(1000000000)")


@pytest.mark.parametrize(
    ("made", "fits"),
    [
        (TABLE, True),
        ("CREATE TABLE t ( -- words, and ; and ' and more\n x  INTEGER PRIMARY KEY,\n y TEXT NOT NULL --y\n)", True),
        ("CREATE TABLE t (x INTEGERPRIMARYKEY, y TEXT NOT NULL)", False),
        ("CREATE TABLE t (x INTEGER PRIMARY KEY, y TEXT NOT NULL DEFAULT '--\n')", False),
        ("CREATE TABLE t (x INTEGER PRIMARY KEY, y TEXT NOT NULL CHECK (y > 0))", False),
        ("CREATE TABLE t (x INTEGER PRIMARY KEY, y TEXT NOT NULL, z)", False),
        ("CREATE TABLE u (x INTEGER PRIMARY KEY, y TEXT NOT NULL)", False),
    ],
)
def test_only_the_very_tables_pass(tmp_path: Path, made: str, fits: bool) -> None:
    """Comments and line breaks may differ between versions; columns, types and constraints may not."""
    with closing(connect(tmp_path / "a", "rwc")) as sql:
        sql.execute(made)
        if fits:
            check_schema(sql, {"t": TABLE})
        else:
            with pytest.raises(sqlite3.DatabaseError, match="malformed"):
                check_schema(sql, {"t": TABLE})
