# SPDX-License-Identifier: Apache-2.0
"""Layout of a map file: an SQLite database, which any program can read, and which a kill at any time does not damage.

Rows have a CRC-32 of their content, since SQLite detects damaged pages of its trees, but not damage within a value.
Numbers in blobs are little-endian: poses 16, covariances 36 float64, row by row.
"""

from __future__ import annotations

import sqlite3
import struct
import zlib
from pathlib import Path

from dpm2_core.database import check_schema, statements
from dpm2_core.errors import UsageError

APPLICATION_ID = 0x64706D32
"""The bytes `dpm2` at offset 68 of the file."""
VERSION = 5
"""In SQLite's user_version: the version of the first release. Older ones cannot be read."""

SCHEMA = """
CREATE TABLE sessions (          -- every time that a program wrote to the map
  session  INTEGER PRIMARY KEY,  -- from 1
  program  TEXT NOT NULL,        -- version of dpm2
  started  TEXT NOT NULL,        -- ISO 8601, UTC
  config   TEXT NOT NULL,        -- YAML, or empty
  weights  TEXT NOT NULL         -- name and hash of the network's weights, or empty
);
CREATE TABLE keyframes (
  node     INTEGER PRIMARY KEY,  -- from 0, without gaps
  id       INTEGER NOT NULL,     -- count within its robot
  robot    TEXT NOT NULL,
  session  INTEGER NOT NULL,
  stamp    INTEGER NOT NULL,     -- ns
  frame    INTEGER NOT NULL,     -- number in the recording
  T_odom_kf BLOB NOT NULL,
  lender   INTEGER,              -- a revisit: the keyframe whose cloud and descriptors it shares
  T_kf_lender BLOB,
  crc      INTEGER NOT NULL
);
CREATE TABLE payloads (          -- of those that share none, and clouds that tell how a place was last seen
  node     INTEGER PRIMARY KEY,
  cloud    BLOB NOT NULL,        -- see slam/store/cloud_codec.py
  descriptors BLOB,              -- see slam/store/rows.py
  thumbnail BLOB,                -- JPEG
  crc      INTEGER NOT NULL
);
CREATE TABLE moving (            -- points of a cloud that belong to moving things: one bit each, deflated
  node     INTEGER PRIMARY KEY,
  mask     BLOB NOT NULL,
  crc      INTEGER NOT NULL
);
CREATE TABLE poses (             -- optimized
  node     INTEGER PRIMARY KEY,
  T_map_kf BLOB NOT NULL,
  crc      INTEGER NOT NULL
);
CREATE TABLE edges (
  id       INTEGER PRIMARY KEY,
  kind     TEXT NOT NULL,        -- odometry or loop
  from_node INTEGER NOT NULL,
  to_node  INTEGER NOT NULL,
  T_from_to BLOB NOT NULL,
  covariance BLOB NOT NULL,      -- rotation (rad) first, then translation (m), in the frame of to_node
  ok       INTEGER NOT NULL,     -- 0: a loop that was rejected
  confidence REAL NOT NULL,
  rmse     REAL NOT NULL,        -- m
  method   TEXT NOT NULL,
  reason   TEXT NOT NULL,        -- of a rejection
  crc      INTEGER NOT NULL
);
CREATE TABLE trail (             -- keyframes that were pruned: where they were, relative to one that is still there
  id       INTEGER NOT NULL,
  robot    TEXT NOT NULL,
  session  INTEGER NOT NULL,
  stamp    INTEGER NOT NULL,
  node     INTEGER NOT NULL,
  T_node_kf BLOB NOT NULL,
  crc      INTEGER NOT NULL
);
CREATE TABLE fixes (             -- of satellites (GNSS), WGS84
  node     INTEGER PRIMARY KEY,  -- the keyframe that it was measured near
  stamp    INTEGER NOT NULL,     -- ns
  latitude REAL NOT NULL,        -- degrees
  longitude REAL NOT NULL,
  altitude REAL NOT NULL,        -- m above the ellipsoid
  covariance BLOB NOT NULL,      -- 9 float64: m^2 east, north, up
  antenna_x REAL NOT NULL,       -- m, where the antenna was then, in the keyframe's frame
  antenna_y REAL NOT NULL,
  antenna_z REAL NOT NULL,
  crc      INTEGER NOT NULL
);
CREATE TABLE georeference (      -- one row, once it is known where on Earth the map is
  id       INTEGER PRIMARY KEY,  -- 0
  latitude REAL NOT NULL,        -- of the local frame east, north, up, as in fixes
  longitude REAL NOT NULL,
  altitude REAL NOT NULL,
  T_enu_map BLOB NOT NULL,
  crc      INTEGER NOT NULL
);
"""

CONTENT = {
    "keyframes": ("node", "id", "robot", "session", "stamp", "frame", "T_odom_kf", "lender", "T_kf_lender"),
    "payloads": ("node", "cloud", "descriptors", "thumbnail"),
    "moving": ("node", "mask"),
    "poses": ("node", "T_map_kf"),
    "edges": (
        "id", "kind", "from_node", "to_node", "T_from_to", "covariance", "ok", "confidence", "rmse", "method", "reason",
    ),
    "trail": ("id", "robot", "session", "stamp", "node", "T_node_kf"),
    "fixes": (
        "node", "stamp", "latitude", "longitude", "altitude", "covariance", "antenna_x", "antenna_y", "antenna_z",
    ),
    "georeference": ("id", "latitude", "longitude", "altitude", "T_enu_map"),
}  # fmt: skip
"""Columns of the tables with checksums, in the order of the checksum."""


def row_crc(*values: bytes | str | int | float | None) -> int:
    """CRC-32 of a row, including types and lengths, so that values moved between columns are detected."""
    crc = 0
    for value in values:
        if isinstance(value, str):
            value = value.encode()
        if value is None:
            data = b"n"
        elif isinstance(value, bytes):
            data = b"b" + struct.pack("<q", len(value)) + value
        elif isinstance(value, float):
            data = b"f" + struct.pack("<d", value)
        else:
            data = b"i" + struct.pack("<q", value)
        crc = zlib.crc32(data, crc)
    return crc


def create(connection: sqlite3.Connection) -> None:
    """Make an empty map in an empty database, whole or not at all."""
    pragmas = f"PRAGMA application_id = {APPLICATION_ID}; PRAGMA user_version = {VERSION};"
    connection.executescript(f"BEGIN; {SCHEMA} {pragmas} COMMIT;")


def check(connection: sqlite3.Connection, path: Path) -> None:
    """Check that a database is a map of this version: it has its tables and nothing else.

    Raises:
        UsageError: the file is not a map, or one of another version.
        sqlite3.DatabaseError: it has other tables, or cannot be read.
    """
    if connection.execute("PRAGMA application_id").fetchone()[0] != APPLICATION_ID:
        raise UsageError(f"{path}: an SQLite database, but no dpm2 map")
    version = int(connection.execute("PRAGMA user_version").fetchone()[0])
    if version != VERSION:
        when = "a later dpm2" if version > VERSION else "a dpm2 from before the first release"
        raise UsageError(f"{path}: written by {when} (map version {version}, this one reads {VERSION})")
    check_schema(connection, statements(SCHEMA))
