# SPDX-License-Identifier: Apache-2.0
"""What is packed into rows and read from them: descriptors, fixes, numbers."""

from __future__ import annotations

import sqlite3
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from dpm2_core.descriptors import Descriptors
from dpm2_core.errors import Dpm2Error
from dpm2_core.estimates import Keyframe
from dpm2_core.slam.store import schema
from dpm2_core.slam.store.check import check_map
from dpm2_core.slam.store.map_data import load_map, save_as
from dpm2_core.slam.store.map_store import Change, MapStore
from dpm2_core.slam.store.rows import pack_descriptors, unpack_descriptors, with_crc
from test.helpers.maps import FIX, GEOREFERENCE, change, execute


def test_descriptors_of_a_tilted_lidar_come_back_with_where_up_is(noise: np.random.Generator) -> None:
    made = Descriptors.of(noise.normal(size=(9, 3)).astype("f4"), noise.normal(size=(9, 8)))
    up = np.array([0.6, 0, -0.8], "f4")  # of a LiDAR that hangs upside down
    for axis in (None, noise.normal(size=(9, 2)).astype("f4")):
        packed = pack_descriptors(replace(made, axis=axis, up=up))
        back = unpack_descriptors(packed)
        assert back.up is not None
        np.testing.assert_array_equal(back.up, up)
        np.testing.assert_array_equal(back.values, made.values)
        assert (back.axis is None) == (axis is None)
        for wrong in ([0.6, 0, -0.9], [0, 0, 2], [np.nan, 0, 1]):
            with pytest.raises(ValueError, match="no descriptors"):
                unpack_descriptors(packed[:-12] + np.array(wrong, "f4").tobytes())
        with pytest.raises(ValueError, match="bytes for 9 of 8"):
            unpack_descriptors(packed[:-4])


@pytest.mark.parametrize("tilted", [False, True])
def test_descriptors_of_a_room_come_back_with_their_scale(noise: np.random.Generator, tilted: bool) -> None:
    made = Descriptors.of(noise.normal(size=(9, 3)).astype("f4"), noise.normal(size=(9, 8)))
    up = np.array([0.6, 0, 0.8], "f4") if tilted else None
    packed = pack_descriptors(replace(made, up=up, scale=5.0))
    back = unpack_descriptors(packed)
    assert back.scale == 5
    assert (back.up is None) == (not tilted)
    np.testing.assert_array_equal(back.xyz, made.xyz)
    for wrong in (np.nan, np.inf, 0.0, -5.0, 1e9):
        with pytest.raises(ValueError, match="no descriptors: a scale of"):
            unpack_descriptors(packed[:-4] + np.array(wrong, "f4").tobytes())
    with pytest.raises(ValueError, match="bytes for 9 of 8"):
        unpack_descriptors(packed[:-4])


@pytest.mark.parametrize("parts", [0, 16, 24, 255])
def test_descriptors_with_parts_that_nobody_knows_are_rejected(noise: np.random.Generator, parts: int) -> None:
    packed = bytearray(pack_descriptors(Descriptors.of(noise.normal(size=(9, 3)).astype("f4"), np.ones((9, 8)))))
    packed[8] = parts
    with pytest.raises(ValueError, match="no descriptors"):
        unpack_descriptors(bytes(packed))


def test_fixes_and_georeference_come_back(tmp_path: Path, keyframes: list[Keyframe]) -> None:
    path, copy = tmp_path / "a.dpm2map", tmp_path / "b.dpm2map"
    with MapStore.create(path) as store:
        store.begin_session()
        for node, keyframe in enumerate(keyframes):
            store.write(change(node, replace(keyframe, fix=FIX if node % 2 else None)))
        store.write(Change(georeference=GEOREFERENCE))
    with MapStore.open(path) as store:
        save_as(load_map(store), copy)
    for file in (path, copy):
        with MapStore.open(file) as store:
            data = load_map(store)
        assert [k.fix is not None for k in data.keyframes] == [False, True] * 6
        found, known = data.keyframes[3].fix, data.georeference
        assert found is not None
        assert known is not None
        assert found.stamp == FIX.stamp
        for name in ("geodetic", "covariance", "antenna"):
            np.testing.assert_array_equal(getattr(found, name), getattr(FIX, name))
        np.testing.assert_array_equal(known.origin, GEOREFERENCE.origin)
        np.testing.assert_array_equal(known.T_enu_map, GEOREFERENCE.T_enu_map)


@pytest.mark.parametrize(
    ("table", "row"),
    [
        ("fixes", (3, 5, 95.0, 8.4, 110.0, FIX.covariance.tobytes(), 0.0, 0.0, 0.0)),
        ("fixes", (3, 5, 49.0, "8", 110.0, FIX.covariance.tobytes(), 0.0, 0.0, 0.0)),
        ("fixes", (3, 5, 49.0, 8.4, 110.0, np.zeros(9).tobytes(), 0.0, 0.0, 0.0)),
        ("fixes", (3, 5, 49.0, 8.4, 110.0, b"short", 0.0, 0.0, 0.0)),
        ("fixes", (3, 5, 49.0, 8.4, 110.0, FIX.covariance.tobytes(), 1e9, 0.0, 0.0)),
        ("fixes", (99, 5, 49.0, 8.4, 110.0, FIX.covariance.tobytes(), 0.0, 0.0, 0.0)),
        ("georeference", (0, 49.0, 8.4, 1e9, np.eye(4).tobytes())),
        ("georeference", (0, 49.0, 8.4, 110.0, np.zeros((4, 4)).tobytes())),
    ],
)
def test_hostile_fixes_are_found_and_left_out(map_file: Path, tmp_path: Path, table: str, row: tuple) -> None:
    marks = ",".join("?" * (len(row) + 1))
    execute(map_file, (f"INSERT INTO {table} VALUES ({marks})", with_crc(*row)))
    with MapStore.open(map_file) as store, pytest.raises(Dpm2Error, match="see dpm2 map check"):
        load_map(store)
    findings = check_map(map_file, tmp_path / "good.dpm2map")
    assert len(findings.problems) == 1
    assert findings.keyframes == 12
    with MapStore.open(tmp_path / "good.dpm2map") as store:
        data = load_map(store)
    assert data.georeference is None
    assert all(keyframe.fix is None for keyframe in data.keyframes)


@pytest.mark.parametrize("column", ["id", "session", "lender"])
@pytest.mark.parametrize("number", [2**63 - 1, 2**31, -1])
def test_numbers_after_which_none_comes_are_found_and_left_out(map_file: Path, column: str, number: int) -> None:
    """The next drive would continue the numbers from there."""
    names = schema.CONTENT["keyframes"]
    with closing(sqlite3.connect(map_file)) as db, db:
        row = dict(
            zip(names, db.execute(f"SELECT {', '.join(names)} FROM keyframes WHERE node = 3").fetchone(), strict=True)
        )
        row |= {"T_kf_lender": np.eye(4).tobytes()} | {column: number}
        db.execute("DELETE FROM keyframes WHERE node = 3")
        marks = ",".join("?" * (len(row) + 1))
        db.execute(f"INSERT INTO keyframes VALUES ({marks})", with_crc(*row.values()))
    with MapStore.open(map_file) as store, pytest.raises(Dpm2Error, match="see dpm2 map check"):
        load_map(store)
    assert any(
        text.startswith(f"keyframe 3: a number that is not from 0 to {2**31 - 1}")
        for text in check_map(map_file).problems
    )


def test_rows_before_the_first_are_found(map_file: Path) -> None:
    execute(map_file, ("INSERT INTO moving VALUES (?, ?, ?)", with_crc(-7, bytes(3))))
    assert check_map(map_file).problems == ["moving: rows before 0, from -7"]


def test_damage_within_descriptors_is_found_when_they_are_read(map_file: Path) -> None:
    """One bit, which SQLite does not notice. Previously, the descriptors were different then, and copies of the map
    with them passed the check."""
    with closing(sqlite3.connect(map_file)) as db, db:
        node, packed = db.execute("SELECT node, descriptors FROM payloads WHERE descriptors NOT NULL").fetchone()
        wrong = packed[:-40] + bytes([packed[-40] ^ 1]) + packed[-39:]
        db.execute("UPDATE payloads SET descriptors = ? WHERE node = ?", (wrong, node))
    with MapStore.open(map_file) as store, pytest.raises(Dpm2Error, match=f"payloads {node} is damaged; see dpm2 map"):
        load_map(store)
