# SPDX-License-Identifier: Apache-2.0
"""Maps of earlier versions are read, and brought up to date when they are written."""

from __future__ import annotations

import sqlite3
from pathlib import Path

import numpy as np
import pytest

from dpm2_core.estimates import Keyframe
from dpm2_core.slam.store import schema
from dpm2_core.slam.store.cloud_codec import pack_cloud
from dpm2_core.slam.store.map_data import load_map
from dpm2_core.slam.store.map_store import Change, MapStore
from test.helpers.maps import GEOREFERENCE

VERSION_1 = """
CREATE TABLE about (program TEXT, created TEXT, config TEXT, weights TEXT);
CREATE TABLE keyframes (node INTEGER PRIMARY KEY, robot TEXT, stamp INTEGER, frame INTEGER, T_odom_kf BLOB,
  T_map_kf BLOB, cloud BLOB, descriptors BLOB);
CREATE TABLE edges (kind TEXT, from_node INTEGER, to_node INTEGER, T_from_to BLOB, covariance BLOB);
"""


def version_1(path: Path, keyframes: list[Keyframe]) -> None:
    with sqlite3.connect(path) as sql:
        sql.executescript(VERSION_1)
        sql.execute(f"PRAGMA application_id = {schema.APPLICATION_ID}")
        sql.execute("PRAGMA user_version = 1")
        sql.execute("INSERT INTO about VALUES ('0.0.1', '2026-01-01T00:00:00', 'a: 1', '')")
        for node, k in enumerate(keyframes):
            T = k.T_odom_kf.tobytes()
            row = (node, "", k.stamp, k.index, T, T, pack_cloud(k.cloud), None)
            sql.execute("INSERT INTO keyframes VALUES (?,?,?,?,?,?,?,?)", row)
            if k.edge is not None:
                edge = ("odometry", node - 1, node, k.edge.T_target_source.tobytes(), k.edge.covariance.tobytes())
                sql.execute("INSERT INTO edges VALUES (?,?,?,?,?)", edge)
    sql.close()


@pytest.mark.parametrize("before", [3, 4])
def test_a_map_of_version_3_or_4_has_the_same_tables(map_file: Path, before: int) -> None:
    """It is read where it is, and written on after its number has been raised; its LiDARs were at the origin."""
    with sqlite3.connect(map_file) as sql:
        sql.execute(f"PRAGMA user_version = {before}")
    sql.close()
    for read_only, version in ((True, before), (False, schema.VERSION)):
        with MapStore.open(map_file, read_only=read_only) as store:
            data = load_map(store)
            assert len(data) == 12
            assert not any(data.clouds.origin(node).any() for node in range(12))
        with sqlite3.connect(map_file) as sql:
            assert sql.execute("PRAGMA user_version").fetchone() == (version,)
        sql.close()


def test_an_older_map_is_read_and_brought_up_to_date(tmp_path: Path, keyframes: list[Keyframe]) -> None:
    path = tmp_path / "old.dpm2map"
    version_1(path, keyframes)
    before = path.read_bytes()
    for read_only in (True, False, True):
        with MapStore.open(path, read_only=read_only) as store:
            data = load_map(store)
            assert len(data) == 12
            assert [s.config for s in data.sessions] == ["a: 1"]
            assert len(data.edges) == 11
            np.testing.assert_array_equal(data.poses[7], keyframes[7].T_odom_kf)
            np.testing.assert_allclose(data.clouds[7], keyframes[7].cloud, atol=0.0051)
        assert (path.read_bytes() == before) == read_only or not read_only
        if read_only is False:
            before = path.read_bytes()
            with sqlite3.connect(path) as sql:
                assert sql.execute("PRAGMA user_version").fetchone() == (schema.VERSION,)
            sql.close()


def test_a_map_without_tables_for_fixes_is_read_and_brought_up_to_date(map_file: Path) -> None:
    """Version 2 is version 3 without them."""
    with sqlite3.connect(map_file) as sql:
        sql.executescript("DROP TABLE fixes; DROP TABLE georeference; PRAGMA user_version = 2; VACUUM;")
    sql.close()
    before = map_file.read_bytes()
    for read_only in (True, False):
        with MapStore.open(map_file, read_only=read_only) as store:
            data = load_map(store)
            assert len(data) == 12
            assert data.georeference is None
            if not read_only:
                store.write(Change(georeference=GEOREFERENCE))
        assert (map_file.read_bytes() == before) == read_only
    with MapStore.open(map_file) as store:
        assert load_map(store).georeference is not None
