# SPDX-License-Identifier: Apache-2.0
"""A map file survives: kills, cut-off files, full disks, readers meanwhile, and programs of another time."""

from __future__ import annotations

import hashlib
import os
import shutil
import signal
import sqlite3
import struct
import subprocess
import sys
import tempfile
import time
from contextlib import closing, suppress
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from dpm2_core.descriptors import Descriptors
from dpm2_core.errors import Dpm2Error, UsageError
from dpm2_core.estimates import Keyframe
from dpm2_core.frame import Fix, Georeference
from dpm2_core.geometry import se3
from dpm2_core.slam.mapping.merge import merge_maps
from dpm2_core.slam.mapping.prune import prune
from dpm2_core.slam.session import open_session
from dpm2_core.slam.settings import SlamSettings
from dpm2_core.slam.store import schema
from dpm2_core.slam.store.check import check_map
from dpm2_core.slam.store.cloud_codec import pack_cloud
from dpm2_core.slam.store.cloud_store import CloudStore, Loan
from dpm2_core.slam.store.map_data import append_map, load_map, save_as
from dpm2_core.slam.store.map_store import Change, MapStore
from dpm2_core.slam.store.rows import pack_descriptors, unpack_descriptors
from test.helpers.full_disk import CHECKPOINT, largest_file
from test.helpers.maps import ring

WRITER = """
import sys
from pathlib import Path
import numpy as np
from dpm2_core.descriptors import Descriptors
from dpm2_core.estimates import Edge, Keyframe, Registration
from dpm2_core.slam.store.cloud_codec import pack_cloud
from dpm2_core.slam.store.map_store import Change, MapStore
rng = np.random.default_rng(0)
store = MapStore.create(Path(sys.argv[1]))
store.begin_session()
print("begun", flush=True)
for node in range(int(sys.argv[2])):
    cloud = rng.uniform(0, 1, (2000, 4)).astype(np.float32)
    d = Descriptors.of(np.zeros((64, 3), np.float32), np.zeros((64, 128)))
    k = Keyframe(node, node, node, np.eye(4), cloud, None, "", d)
    edges = [Edge("odometry", node - 1, node, Registration(np.eye(4), np.eye(6)))] if node else []
    store.write(Change([(node, k, pack_cloud(cloud), None)], edges, {n: np.eye(4) for n in range(node + 1)}))
    print(node, flush=True)
"""


def whole_prefix(path: Path) -> int:
    """How many keyframes the map has; they must be the first ones, each with all that belongs to it."""
    with MapStore.open(path) as store:
        data = load_map(store)
        assert [k.id for k in data.keyframes] == list(range(len(data)))
        assert len(data.edges) == max(len(data) - 1, 0)
        assert all(len(data.clouds[node]) == 2000 and k.descriptors for node, k in enumerate(data.keyframes))
        return len(data)


def test_everything_comes_back(tmp_path: Path, map_file: Path, keyframes: list[Keyframe]) -> None:
    """Poses and covariances to the last bit, clouds to half a centimeter, descriptors as the bytes they are."""
    for path in (map_file, tmp_path / "again.dpm2map", tmp_path / "without.dpm2map"):
        if path != map_file:
            with MapStore.open(map_file) as store:
                save_as(load_map(store, descriptors=path.stem == "again"), path)
        with MapStore.open(path) as store:
            data = load_map(store)
            assert [(s.number, s.config, s.weights) for s in data.sessions] == [
                (1, "slam: {}", "small 0123456789abcdef")
            ]
            for node, (k, back) in enumerate(zip(keyframes, data.keyframes, strict=True)):
                assert (back.id, back.stamp, back.index, back.robot) == (k.id, k.stamp, k.index, k.robot)
                np.testing.assert_array_equal(back.T_odom_kf, k.T_odom_kf)
                np.testing.assert_array_equal(data.poses[node], k.T_odom_kf)
                np.testing.assert_allclose(data.clouds[node], k.cloud, atol=0.0051)
                assert back.descriptors is not None
                assert k.descriptors is not None
                np.testing.assert_array_equal(back.descriptors.xyz, k.descriptors.xyz)
                np.testing.assert_array_equal(back.descriptors.features, k.descriptors.features)
                if k.edge is not None:
                    assert back.edge is not None
                    np.testing.assert_array_equal(back.edge.covariance, k.edge.covariance)
            assert [(e.kind, e.ok) for e in data.edges[-2:]] == [("loop", True), ("loop", False)]
            assert data.edges[-1].registration.reason == "too far"
            assert data.edges[-1].registration.rmse == np.inf


def test_descriptors_of_a_tilted_lidar_come_back_with_where_up_is(noise: np.random.Generator) -> None:
    made = Descriptors.of(noise.normal(size=(9, 3)).astype("f4"), noise.normal(size=(9, 8)))
    up = np.array([0.6, 0, 0.8], "f4")
    for axis in (None, noise.normal(size=(9, 2)).astype("f4")):
        packed = pack_descriptors(replace(made, axis=axis, up=up))
        back = unpack_descriptors(packed)
        assert back.up is not None
        np.testing.assert_array_equal(back.up, up)
        np.testing.assert_array_equal(back.values, made.values)
        assert (back.axis is None) == (axis is None)
        for wrong in ([0.6, 0, -0.8], [0, 0, 2], [np.nan, 0, 1]):
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


def test_descriptors_of_an_earlier_map_are_float16(noise: np.random.Generator) -> None:
    """As `pack_descriptors` wrote them before version 4 of the map."""
    xyz, features = noise.normal(size=(9, 3)).astype("<f4"), noise.normal(size=(9, 8)).astype("<f2")
    back = unpack_descriptors(struct.pack("<IIB", 9, 8, 0) + xyz.tobytes() + features.tobytes())
    np.testing.assert_array_equal(back.xyz, xyz)
    np.testing.assert_allclose(back.values, features, atol=np.abs(features).max() / 254 + 1e-6)
    features[3, 2] = np.nan
    with pytest.raises(ValueError, match="not finite"):
        unpack_descriptors(struct.pack("<IIB", 9, 8, 0) + xyz.tobytes() + features.tobytes())


def test_a_loan_and_a_thumbnail_come_back(map_file: Path, keyframes: list[Keyframe]) -> None:
    T = np.eye(4)
    T[0, 3] = 2.0
    with MapStore.open(map_file, read_only=False) as store:
        store.begin_session()
        store.write(Change([(12, keyframes[0], Loan(3, T), None)], poses={12: np.eye(4)}))
        store.write(Change([(13, keyframes[1], pack_cloud(keyframes[1].cloud), b"jpeg")], poses={13: np.eye(4)}))
    with MapStore.open(map_file) as store:
        data = load_map(store)
        assert data.session[-2:] == [2, 2]
        np.testing.assert_allclose(data.clouds[12][:, 0], data.clouds[3][:, 0] + 2, atol=1e-5)
        borrowed, lent = data.keyframes[12].descriptors, data.keyframes[3].descriptors
        assert borrowed is not None
        assert lent is not None
        assert borrowed.features is lent.features  # no memory
        assert data.thumbnail(13) == b"jpeg"
        assert data.thumbnail(0) is None


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(5))
def test_kill_at_any_instant_loses_no_keyframe_that_was_taken_in(tmp_path: Path, seed: int) -> None:
    path = tmp_path / "a.dpm2map"
    child = subprocess.Popen([sys.executable, "-c", WRITER, str(path), "1000000"], stdout=subprocess.PIPE)
    assert child.stdout is not None
    assert child.stdout.readline() == b"begun\n"
    time.sleep(float(np.random.default_rng(seed).uniform(0, 0.5)))
    child.send_signal(signal.SIGKILL)
    acknowledged = len(child.stdout.read().splitlines())
    child.wait()
    child.stdout.close()
    assert acknowledged - 1 <= whole_prefix(path) <= acknowledged + 1  # the last line itself may be cut off
    assert check_map(path).problems == []
    with MapStore.open(path, read_only=False) as store:  # and it can be written to again
        store.begin_session()


def test_a_file_cut_off_at_any_place_holds_the_first_keyframes(tmp_path: Path) -> None:
    """What a machine that dies leaves of FILE-wal: any prefix, and garbage after it."""
    path = tmp_path / "a.dpm2map"
    program = WRITER + "\nimport os; os._exit(0)"  # without closing: FILE-wal stays
    subprocess.run([sys.executable, "-c", program, str(path), "12"], check=True, capture_output=True, timeout=60)
    main, wal = path.read_bytes(), Path(f"{path}-wal").read_bytes()
    rng, counts = np.random.default_rng(0), set()
    for trial in range(30):
        cut = tmp_path / f"{trial}.dpm2map"
        cut.write_bytes(main)
        size = int(rng.integers(0, len(wal) + 1))
        Path(f"{cut}-wal").write_bytes(wal[:size] + (rng.bytes(5000) if trial % 2 else b""))
        try:
            counts.add(whole_prefix(cut))
        except UsageError:  # the very beginning: not even the schema had been written
            assert size < 100_000
    assert 12 in counts or max(counts) >= 10
    assert len(counts) > 4


def test_a_reader_sees_whole_keyframes_while_they_are_written(tmp_path: Path) -> None:
    path = tmp_path / "a.dpm2map"
    child = subprocess.Popen([sys.executable, "-c", WRITER, str(path), "60"], stdout=subprocess.PIPE)
    assert child.stdout is not None
    assert child.stdout.readline() == b"begun\n"
    counts = []
    while child.poll() is None:
        counts.append(whole_prefix(path))
    child.stdout.close()
    assert child.returncode == 0  # and the writer was not disturbed
    assert counts == sorted(counts)
    assert len(set(counts)) > 2
    assert whole_prefix(path) == 60


def test_reading_leaves_no_trace(map_file: Path) -> None:
    def state() -> tuple[str, list[str]]:
        files = sorted(os.listdir(map_file.parent))
        return hashlib.sha256(map_file.read_bytes()).hexdigest(), files

    before = state()
    with MapStore.open(map_file) as store:
        data = load_map(store)
        assert len(data.clouds[3])
        with pytest.raises(Dpm2Error, match="readonly"):
            store.begin_session()
    assert state() == before


@pytest.mark.slow
def test_a_folder_that_cannot_be_written(map_file: Path) -> None:
    """Reading works, also of a map whose writer was killed; writing is an error that says so."""
    program = f"""
import os, sys
from pathlib import Path
from dpm2_core.errors import Dpm2Error
from dpm2_core.slam.store.map_data import load_map
from dpm2_core.slam.store.map_store import Change, MapStore
path = Path({str(map_file)!r})
store = MapStore.open(path, read_only=False)
store.begin_session()
for folder in path.parents:
    if Path({tempfile.gettempdir()!r}) in folder.parents:
        folder.chmod(0o755)
path.parent.chmod(0o555)
for file in path.parent.iterdir():
    file.chmod(0o444)
if os.getuid() == 0:
    os.setuid(65534)  # root may write anywhere
with MapStore.open(path) as reader:
    data = load_map(reader)
    print(len(data), len(data.sessions), len(data.clouds[0]), flush=True)
attempts = (lambda: MapStore.open(path, read_only=False).begin_session(), lambda: MapStore.create(path.parent / "b"))
for attempt in attempts:
    try:
        attempt()
    except Dpm2Error as error:
        print(str(path.parent) in str(error), len(str(error).splitlines()), flush=True)
os._exit(0)
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=60)
    map_file.parent.chmod(0o755)
    assert done.stdout.splitlines() == ["12 2 300", "True 1", "True 1"], done.stderr


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


def test_a_map_of_version_3_has_the_same_tables(map_file: Path) -> None:
    """It is read where it is, and written on after its number has been raised."""
    with sqlite3.connect(map_file) as sql:
        sql.execute("PRAGMA user_version = 3")
    sql.close()
    for read_only, version in ((True, 3), (False, schema.VERSION)):
        with MapStore.open(map_file, read_only=read_only) as store:
            assert len(load_map(store)) == 12
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


GEOREFERENCE = Georeference(np.array([49.0, 8.4, 110.0]), se3.exp(np.array([0, 0, 1.0, 2, 3, 4])))
FIX = Fix(5, np.array([49.0, 8.4, 110.5]), np.diag([4.0, 4, 16]), np.array([0.1, 0, 1.5]))


def test_fixes_and_georeference_come_back(tmp_path: Path, keyframes: list[Keyframe]) -> None:
    path, copy = tmp_path / "a.dpm2map", tmp_path / "b.dpm2map"
    with MapStore.create(path) as store:
        store.begin_session()
        for node, keyframe in enumerate(keyframes):
            keyframe = replace(keyframe, fix=FIX if node % 2 else None)
            cloud = pack_cloud(keyframe.cloud)
            store.write(Change([(node, keyframe, cloud, None)], poses={node: keyframe.T_odom_kf}))
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
    with sqlite3.connect(map_file) as sql:
        marks = ",".join("?" * (len(row) + 1))
        sql.execute(f"INSERT INTO {table} VALUES ({marks})", (*row, schema.row_crc(*row)))
    sql.close()
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
    """The next drive would count on from there."""
    names = schema.CONTENT["keyframes"]
    with closing(sqlite3.connect(map_file)) as db, db:
        row = dict(
            zip(names, db.execute(f"SELECT {', '.join(names)} FROM keyframes WHERE node = 3").fetchone(), strict=True)
        )
        row |= {"T_kf_lender": np.eye(4).tobytes()} | {column: number}
        db.execute("DELETE FROM keyframes WHERE node = 3")
        marks = ",".join("?" * (len(row) + 1))
        db.execute(f"INSERT INTO keyframes VALUES ({marks})", (*row.values(), schema.row_crc(*row.values())))
    with MapStore.open(map_file) as store, pytest.raises(Dpm2Error, match="see dpm2 map check"):
        load_map(store)
    assert any(
        text.startswith(f"keyframe 3: a number that is not from 0 to {2**31 - 1}")
        for text in check_map(map_file).problems
    )


def test_rows_before_the_first_are_found(map_file: Path) -> None:
    with closing(sqlite3.connect(map_file)) as db, db:
        (mask,) = (np.zeros(3, np.uint8).tobytes(),)
        db.execute("INSERT INTO moving VALUES (?, ?, ?)", (-7, mask, schema.row_crc(-7, mask)))
    assert check_map(map_file).problems == ["moving: rows before 0, from -7"]


def test_damage_within_descriptors_is_found_when_they_are_read(map_file: Path) -> None:
    """One bit, of which SQLite knows nothing: they were others then, and copies of the map were sound with them."""
    with closing(sqlite3.connect(map_file)) as db, db:
        node, packed = db.execute("SELECT node, descriptors FROM payloads WHERE descriptors NOT NULL").fetchone()
        wrong = packed[:-40] + bytes([packed[-40] ^ 1]) + packed[-39:]
        db.execute("UPDATE payloads SET descriptors = ? WHERE node = ?", (wrong, node))
    with MapStore.open(map_file) as store, pytest.raises(Dpm2Error, match=f"payloads {node} is damaged; see dpm2 map"):
        load_map(store)


def test_what_is_no_map_is_rejected_in_one_line(tmp_path: Path, map_file: Path) -> None:
    text, other, later = tmp_path / "a.txt", tmp_path / "other.db", map_file
    text.write_text("no map at all, but long enough to look like something")
    with sqlite3.connect(other) as sql:
        sql.execute("CREATE TABLE t (x)")
    sql.close()
    with sqlite3.connect(later) as sql:
        sql.execute("PRAGMA user_version = 99")
    sql.close()
    for path, words in ((text, "not a dpm2 map"), (other, "no dpm2 map"), (later, "later dpm2"), (tmp_path, "no such")):
        for read_only in (True, False):
            with pytest.raises(UsageError, match=words) as caught:
                MapStore.open(path, read_only=read_only)
            assert str(path) in str(caught.value)
    with pytest.raises(UsageError, match="there is a file already"):
        MapStore.create(text)


def test_two_writers(map_file: Path, keyframes: list[Keyframe], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("dpm2_core.slam.store.map_connection.BUSY", 0.1)
    with closing(sqlite3.connect(map_file)) as one, MapStore.open(map_file, read_only=False) as two:
        one.execute("BEGIN IMMEDIATE")
        with pytest.raises(Dpm2Error, match="locked"):
            two.begin_session()


def test_of_two_programs_that_go_on_with_a_map_only_the_later_one_writes(
    map_file: Path, keyframes: list[Keyframe]
) -> None:
    """Both count on from its 12 keyframes: the one would replace what the other has written."""
    cloud = pack_cloud(keyframes[0].cloud)

    def change(robot: str, node: int) -> Change:
        return Change([(node, replace(keyframes[0], robot=robot), cloud, None)], poses={node: np.eye(4)})

    with MapStore.open(map_file, read_only=False) as one, MapStore.open(map_file, read_only=False) as two:
        one.begin_session()
        one.write(change("one", 12))
        two.begin_session()
        two.write(change("two", 13))
        with pytest.raises(Dpm2Error, match="another program has begun to write to it") as caught:
            one.write(change("one", 13))
        assert str(map_file) in str(caught.value)
        two.write(change("two", 14))
    with MapStore.open(map_file) as store:
        data = load_map(store)
    assert [keyframe.robot for keyframe in data.keyframes[12:]] == ["one", "two", "two"]
    assert data.session[12:] == [2, 3, 3]


def test_a_program_that_takes_over_other_maps_goes_on_with_its_own_session(
    tmp_path: Path, keyframes: list[Keyframe]
) -> None:
    with MapStore.create(tmp_path / "map") as store:
        store.begin_session()
        append_map(store, ring(3))
        store.write(Change([(3, keyframes[0], pack_cloud(keyframes[0].cloud), None)], poses={3: np.eye(4)}))
    with MapStore.open(tmp_path / "map") as store:
        assert load_map(store).session == [2, 2, 2, 1]


def test_a_copy_that_does_not_fit_on_the_disk_is_an_error(tmp_path: Path, noise: np.random.Generator) -> None:
    """Also where only the last step fails: all of it is in FILE-wal then, but not in the file."""
    data = replace(ring(13), thumbnail=lambda node: noise.bytes(500_000))
    save_as(data, tmp_path / "map")
    size = (tmp_path / "map").stat().st_size
    with largest_file(size - 300_000), pytest.raises(Dpm2Error, match=r"copy: not written: .*is the disk full"):
        save_as(data, tmp_path / "copy")
    assert size > CHECKPOINT + 600_000  # else FILE-wal would have been too large first, which is another error
    assert os.listdir(tmp_path) == ["map"]


@pytest.mark.parametrize("size", [20_000, 60_000])
def test_a_map_that_cannot_be_begun_is_not_in_the_way_of_the_next(tmp_path: Path, size: int) -> None:
    """Neither where its tables do not fit on the disk, 41 kB, nor where the settings of its first session do not."""
    settings = SlamSettings(registration="geometric", loops={"descriptors": False})
    path = tmp_path / "map"
    with largest_file(size), pytest.raises(Dpm2Error, match=r"map: (disk I/O error|database or disk is full)"):
        open_session(path, settings, "x" * 100_000, resume=True)
    assert os.listdir(tmp_path) == []
    with open_session(path, settings, "x" * 100_000, resume=False) as store:
        assert store.session == 1


def test_a_new_map_is_whole_without_its_log(tmp_path: Path) -> None:
    """A power cut in the first seconds may take all of FILE-wal; what it left was no map, and in the way of one."""
    with MapStore.create(tmp_path / "map") as store:
        store.begin_session()
        shutil.copyfile(tmp_path / "map", tmp_path / "copy")
    with MapStore.open(tmp_path / "copy", read_only=False) as store:
        assert store.begin_session() == 1


@pytest.mark.parametrize("read_only", [True, False])
def test_a_link_to_a_map_that_is_being_written_shows_all_of_it(
    tmp_path: Path, map_file: Path, keyframes: list[Keyframe], read_only: bool
) -> None:
    """FILE-wal lies beside the file, and not beside the link."""
    link = tmp_path / "elsewhere" / "latest"
    link.parent.mkdir()
    link.symlink_to(map_file)
    with MapStore.open(map_file, read_only=False) as writer:
        writer.begin_session()
        writer.write(Change([(12, keyframes[0], pack_cloud(keyframes[0].cloud), None)], poses={12: np.eye(4)}))
        with MapStore.open(link, read_only=read_only) as store:
            assert store.path == link
            assert len(load_map(store)) == 13
        assert check_map(link).keyframes == 13
    assert os.listdir(link.parent) == [link.name]


def test_an_unfinished_copy_leaves_nothing_behind(
    tmp_path: Path, map_file: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def gone(store: CloudStore, index: int) -> bytes:
        raise Dpm2Error("disk gone")

    monkeypatch.setattr(CloudStore, "packed", gone)
    with MapStore.open(map_file) as store:
        data = load_map(store, descriptors=False)
        with pytest.raises(Dpm2Error, match="disk gone"):
            save_as(data, tmp_path / "copy.dpm2map")
        with pytest.raises(UsageError, match="already"):
            save_as(data, map_file)
    assert os.listdir(tmp_path) == [map_file.name]


COPY = """
import os, signal, sys
from dataclasses import replace
from pathlib import Path
from dpm2_core.slam.store.map_data import load_map, save_as
from dpm2_core.slam.store.map_store import MapStore
with MapStore.open(Path(sys.argv[1])) as store:
    data = load_map(store)
    if sys.argv[3:]:
        data = replace(data, thumbnail=lambda node: os.kill(os.getpid(), signal.SIGKILL) if node == 5 else None)
    save_as(data, Path(sys.argv[2]))
"""


def test_a_copy_that_is_killed_leaves_no_map_and_the_next_one_cleans_up(tmp_path: Path, map_file: Path) -> None:
    """It left an empty map, which the check called sound, and for which the same call was refused."""
    out = tmp_path / "copy"
    killed = subprocess.run([sys.executable, "-c", COPY, str(map_file), str(out), "killed"], timeout=60, check=False)
    assert killed.returncode == -signal.SIGKILL
    assert not out.exists()
    assert list(tmp_path.glob(".copy.*.part"))
    with MapStore.open(map_file) as store:
        save_as(load_map(store), out)
    assert check_map(out).keyframes == 12
    assert sorted(os.listdir(tmp_path)) == sorted([map_file.name, "copy"])


def test_of_two_copies_of_one_name_the_first_that_is_whole_gets_it(tmp_path: Path, map_file: Path) -> None:
    """The second took away what the first had written, and neither was left."""
    out = tmp_path / "copy"

    def meanwhile(node: int) -> None:
        if node == 3:
            subprocess.run([sys.executable, "-c", COPY, str(map_file), str(out)], timeout=60, check=True)

    with pytest.raises(UsageError, match="copy: there is a file already"):
        save_as(replace(ring(5), thumbnail=meanwhile), out)
    assert check_map(out).keyframes == 12
    assert sorted(os.listdir(tmp_path)) == sorted([map_file.name, "copy"])


def test_what_is_written_together_is_there_together_or_not_at_all(tmp_path: Path, keyframes: list[Keyframe]) -> None:
    """An error within takes back what was written before it, and what comes after the block stands by itself."""
    with MapStore.create(tmp_path / "map") as store:
        store.begin_session()
        for node, keyframe in enumerate(keyframes[:3]):
            change = Change([(node, keyframe, pack_cloud(keyframe.cloud), None)], poses={node: np.eye(4)})
            with suppress(ZeroDivisionError), store.together():
                store.write(change)
                assert store.size == node + 1
                raise ZeroDivisionError
            assert store.size == node
            store.write(change)
    with MapStore.open(tmp_path / "map") as store:
        assert len(load_map(store)) == 3


def test_a_map_behind_another_one_is_the_map_of_both(tmp_path: Path, map_file: Path) -> None:
    """Nodes, sessions, lenders, edges and what was pruned count on, as where two maps are joined in memory."""
    with MapStore.open(map_file) as first, MapStore.create(tmp_path / "both") as both:
        save_as(ring(30), tmp_path / "ring")
        with MapStore.open(tmp_path / "ring") as second:
            a, b = load_map(first), prune(load_map(second), [7, 8])
            b.clouds.borrow(9, Loan(2, np.eye(4)))
            for data in (a, b):
                append_map(both, data)
            save_as(merge_maps(a, b, np.eye(4)), tmp_path / "merged")
        with MapStore.open(tmp_path / "merged") as merged:
            for table in ("sessions", *schema.CONTENT):
                assert list(both.rows(table)) == list(merged.rows(table)), table
            assert len(list(both.rows("edges", where="from_node < 12"))) == 13
    assert not check_map(tmp_path / "both").problems


def test_a_copy_replaces_a_map_whose_writer_was_killed(tmp_path: Path, keyframes: list[Keyframe]) -> None:
    """Its log stayed beside the new map, which was then read with the old one's pages."""
    path, target = tmp_path / "a.dpm2map", tmp_path / "b.dpm2map"
    with MapStore.create(tmp_path / "killed") as store:
        store.begin_session()
        for node, keyframe in enumerate(keyframes):
            store.write(Change([(node, keyframe, pack_cloud(keyframe.cloud), None)], poses={node: keyframe.T_odom_kf}))
        for suffix in ("", "-wal"):  # as `kill -9` leaves them
            shutil.copyfile(tmp_path / f"killed{suffix}", f"{target}{suffix}")
    assert Path(f"{target}-wal").stat().st_size > 0
    with MapStore.create(path) as store:
        store.begin_session()
        for node, keyframe in enumerate(keyframes[:2]):
            store.write(Change([(node, keyframe, pack_cloud(keyframe.cloud), None)], poses={node: keyframe.T_odom_kf}))
        store.copy_to(target)
    assert not Path(f"{target}-wal").exists()
    with MapStore.open(target) as store:
        assert len(load_map(store).keyframes) == 2
