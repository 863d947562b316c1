# SPDX-License-Identifier: Apache-2.0
"""A damaged map is diagnosed without being changed, and its good part becomes a new, valid map."""

from __future__ import annotations

import os
import shutil
import signal
import sqlite3
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from dpm2_core.data.thumbnail import thumbnail
from dpm2_core.errors import Dpm2Error, UsageError
from dpm2_core.estimates import Edge, Keyframe, Registration
from dpm2_core.slam.mapping.merge import merge_maps
from dpm2_core.slam.mapping.parts import parts_of
from dpm2_core.slam.store.check import check_map
from dpm2_core.slam.store.cloud_codec import pack_cloud
from dpm2_core.slam.store.cloud_store import Loan
from dpm2_core.slam.store.map_data import MapData, load_map, save_as
from dpm2_core.slam.store.map_store import Change, MapStore
from dpm2_core.slam.store.rows import with_crc
from test.helpers.full_disk import largest_file
from test.helpers.maps import execute, ring
from test.helpers.scenes import make_image


def recovered(path: Path) -> MapData:
    """The good part, which must be valid; the damaged file is not changed."""
    before, out = path.read_bytes(), path.with_name("recovered.dpm2map")
    out.unlink(missing_ok=True)
    check_map(path, out)
    assert path.read_bytes() == before
    assert check_map(out).problems == []
    with MapStore.open(out) as store:
        return load_map(store)


def test_a_sound_map_has_no_problems(map_file: Path, keyframes: list[Keyframe]) -> None:
    result = check_map(map_file)
    assert (result.problems, result.keyframes, result.lost) == ([], 12, 0)
    data = recovered(map_file)
    assert len(data.edges) == 13
    np.testing.assert_array_equal(data.poses[11], keyframes[11].T_odom_kf)


def test_rounding_is_no_damage(map_file: Path) -> None:
    """A rejected loop as dpm2 0.1 wrote it: 1 + 2e-15 in its last corner."""
    T = np.eye(4)
    T[3, 3] = 1.0000000000000016
    row = (90, "loop", 1, 5, T.tobytes(), np.eye(6).tobytes(), 0, 0.0, 1.9, "neural", "too unlike")
    execute(map_file, ("INSERT INTO edges VALUES (?,?,?,?,?,?,?,?,?,?,?,?)", with_crc(*row)))
    assert check_map(map_file).problems == []


def test_each_kind_of_damage_is_named(map_file: Path, keyframes: list[Keyframe]) -> None:
    nan, eye6 = np.full((4, 4), np.nan).tobytes(), np.eye(6).tobytes()
    execute(
        map_file,
        ("UPDATE poses SET T_map_kf = ?, crc = ? WHERE node = 4", with_crc(4, nan)[1:]),
        ("UPDATE payloads SET cloud = zeroblob(100) WHERE node = 6", ()),
        ("UPDATE edges SET to_node = 77 WHERE id = 2", ()),
        ("INSERT INTO edges VALUES (?,?,?,?,?,?,?,?,?,?,?,?)", with_crc(
            90, "loop", 1, 55, np.eye(4).tobytes(), eye6, 1, 1.0, 0.1, "", "")),
        ("DELETE FROM keyframes WHERE node = 8", ()),
    )  # fmt: skip
    result = check_map(map_file)
    info = "\n".join(result.problems)
    for words in (
        "keyframe 4: its optimized pose is not a finite", "keyframe 6: its payload is lost", "edges 2: its checksum",
        "edge 90: leads from 1 to 55", "keyframes lost: 8",
    ):  # fmt: skip
        assert words in info, info
    assert (result.keyframes, result.lost, result.lost_clouds) == (11, 1, 1)
    with MapStore.open(map_file) as store, pytest.raises(Dpm2Error, match="keyframe 8 is missing; see dpm2 map check"):
        load_map(store)
    data = recovered(map_file)
    assert [k.id for k in data.keyframes] == [0, 1, 2, 3, 4, 5, 6, 7, 9, 10, 11]
    # The lost pose follows from the odometry, which also bridges the gaps in the chain.
    np.testing.assert_allclose(data.poses[4], keyframes[4].T_odom_kf, atol=1e-9)
    chain = {(e.from_node, e.to_node) for e in data.edges if e.kind == "odometry"}
    assert chain == {(i, i + 1) for i in range(10)}
    with MapStore.open(map_file.with_name("recovered.dpm2map")) as store:
        assert [len(cloud) for cloud in load_map(store).clouds] == [300] * 6 + [0] + [300] * 4


@pytest.mark.parametrize("seed", range(8))
def test_damaged_pages_cost_only_what_is_on_them(map_file: Path, seed: int) -> None:
    content = bytearray(map_file.read_bytes())
    rng, pages = np.random.default_rng(seed), len(content) // 4096
    for page in rng.choice(np.arange(10, pages), 2, replace=False):  # the root pages of the tables come before
        content[page * 4096 + 200 : (page + 1) * 4096] = rng.bytes(3896)
    map_file.write_bytes(content)
    assert check_map(map_file).problems
    data = recovered(map_file)
    assert len(data) >= 8  # each page contains a few keyframes or less


def test_an_invalid_picture_costs_nothing_but_itself(map_file: Path, noise: np.random.Generator) -> None:
    """Its checksum is right: the writer is faulty or malicious."""
    jpeg = thumbnail(make_image(noise), 32).replace(b'"K": [[', b'"K": [["')
    with closing(sqlite3.connect(map_file)) as sql:
        row = sql.execute("SELECT node, cloud, descriptors, ? FROM payloads WHERE node = 3", (jpeg,)).fetchone()
    execute(map_file, ("UPDATE payloads SET thumbnail = ?, crc = ? WHERE node = 3", with_crc(*row)[3:]))
    assert check_map(map_file).problems == []  # it has no camera at all: a foreign JPEG
    jpeg = thumbnail(make_image(noise), 32).replace(b'"size": [32,', b'"size": [-2,')
    row = (*row[:3], jpeg)
    execute(map_file, ("UPDATE payloads SET thumbnail = ?, crc = ? WHERE node = 3", with_crc(*row)[3:]))
    result = check_map(map_file)
    assert result.problems == ["keyframe 3: thumbnail: its camera is invalid: size of [-2.0, 16.0] pixels"]
    assert (result.lost, result.lost_clouds) == (0, 0)
    assert len(recovered(map_file)) == 12
    with MapStore.open(map_file.with_name("recovered.dpm2map")) as store:
        data = load_map(store)
        assert data.thumbnail(3) is None
        assert len(data.clouds[3])


def test_how_a_place_was_last_seen_costs_nothing_but_itself(tmp_path: Path) -> None:
    """A keyframe that borrows has its own cloud in the file, too. If this cloud is damaged, it is reported and left
    out."""
    data, path = ring(12), tmp_path / "a.dpm2map"
    for node in (10, 11):
        data.clouds.borrow(node, Loan(node - 10, np.eye(4)))
    save_as(data, path)
    execute(path, "UPDATE payloads SET cloud = x'00' WHERE node = 10")
    result = check_map(path)
    assert (result.keyframes, result.lost, result.lost_clouds) == (12, 0, 0)
    assert result.problems == ["keyframe 10: its own cloud is lost: its checksum is wrong"]
    recovered(path)
    with MapStore.open(path.with_name("recovered.dpm2map")) as store:
        assert sorted(node for (node,) in store.rows("payloads", "node")) == [*range(10), 11]


def test_a_destroyed_header(map_file: Path, keyframes: list[Keyframe]) -> None:
    content = bytearray(map_file.read_bytes())
    content[:2000] = bytes(2000)
    map_file.write_bytes(content)
    with pytest.raises(UsageError, match="not a dpm2 map"):
        MapStore.open(map_file)
    data = recovered(map_file)
    assert len(data) == 12
    np.testing.assert_array_equal(data.poses[11], keyframes[11].T_odom_kf)


def test_a_map_that_was_cut_off(map_file: Path) -> None:
    content = map_file.read_bytes()
    map_file.write_bytes(content[: len(content) * 3 // 5])
    assert check_map(map_file).problems
    assert len(recovered(map_file)) >= 1


def test_joined_maps_that_were_cut_off_hang_together(tmp_path: Path) -> None:
    """Previously, all edges were behind the last keyframe: with one percent less, no loop connected the second map to
    the first."""
    path, data = tmp_path / "map", ring(40, 300)
    tie = Edge("loop", 0, 1, Registration(data.poses[1], np.eye(6) * 1e-4))
    save_as(merge_maps(data, data, np.eye(4), [tie]), path)
    content = path.read_bytes()
    path.write_bytes(content[: len(content) * 97 // 100])
    left = recovered(path)
    assert len(left) > 70
    assert set(parts_of(left)) == {0}
    bridges = [edge.to_node for edge in left.edges if edge.registration.method == "bridge"]
    assert all(node > 60 for node in bridges)  # where the cut is; all other odometry is as measured


def test_a_map_without_its_last_pages_keeps_all_before_them(tmp_path: Path) -> None:
    """The end of a map is read from the last page of a table. Previously, without this page a single keyframe was
    recovered, and 0 were reported lost."""
    path = tmp_path / "map"
    save_as(ring(60, 30), path)
    content, cut = bytearray(path.read_bytes()), {}
    with closing(sqlite3.connect(path)) as sql:
        roots = dict(sql.execute("SELECT name, rootpage FROM sqlite_master"))
    for table in ("keyframes", "payloads", "poses", "edges"):
        root = (roots[table] - 1) * 4096
        last = (int.from_bytes(content[root + 8 : root + 12], "big") - 1) * 4096  # see the SQLite file format
        cut[table] = int.from_bytes(content[last + 3 : last + 5], "big")
        content[last : last + 4096] = bytes(4096)
    path.write_bytes(content)
    result = check_map(path)
    left = 60 - cut["keyframes"]
    assert result.keyframes == len(recovered(path)) == left > 20
    assert 1 <= result.lost <= cut["keyframes"]
    assert f"keyframes: rows from {left} on cannot be read, and how many there are is not known" in result.problems


def save_drives(path: Path, robots: Sequence[str], begins: int = 0) -> None:
    """Save a map of one session, with the robot of each keyframe. At the node `begins`, a robot begins another
    drive."""
    data, newest, edges = ring(len(robots), 30), dict[str, int](), []
    keyframes = [replace(k, robot=robot) for k, robot in zip(data.keyframes, robots, strict=True)]
    for node, robot in enumerate(robots):
        if robot in newest and node != begins:
            edges.append(data.edges[0].between(newest[robot], node))
        newest[robot] = node
    keyframes[begins:] = [replace(k, index=k.index - keyframes[begins].index) for k in keyframes[begins:]]
    save_as(replace(data, keyframes=keyframes, edges=edges), path)


@pytest.mark.parametrize(
    "damage", ["", "UPDATE edges SET rmse = 9 WHERE id = 2", "DELETE FROM keyframes WHERE node IN (3, 6)"]
)
def test_two_drives_of_a_robot_in_one_session_stay_apart(tmp_path: Path, damage: str) -> None:
    """The pose of the second drive relative to the first is not known. Gaps within each drive are bridged."""
    save_drives(tmp_path / "map", ["red"] * 12, begins=6)
    execute(tmp_path / "map", damage)
    data = recovered(tmp_path / "map")
    second = [keyframe.id >= 6 for keyframe in data.keyframes].index(True)
    steps = set(range(1, len(data))) - {second}
    assert sorted((edge.from_node, edge.to_node) for edge in data.edges) == [(node - 1, node) for node in sorted(steps)]


def test_a_lost_keyframe_among_those_of_two_robots_is_bridged(tmp_path: Path) -> None:
    save_drives(tmp_path / "map", ["red", "blue"] * 4)
    execute(tmp_path / "map", "DELETE FROM keyframes WHERE node = 4")
    ties = {(edge.from_node, edge.to_node) for edge in recovered(tmp_path / "map").edges}
    assert ties == {(0, 2), (2, 5), (1, 3), (3, 4), (4, 6)}


def test_nothing_left_to_recover(tmp_path: Path) -> None:
    path = tmp_path / "a.dpm2map"
    path.write_bytes(bytes(40960))
    with pytest.raises(Dpm2Error, match="nothing in it"):
        check_map(path, tmp_path / "out")
    with pytest.raises(UsageError, match="no such"):
        check_map(tmp_path / "none")
    assert not (tmp_path / "out").exists()
    (tmp_path / "there").touch()
    with pytest.raises(UsageError, match="there is a file already"):  # before the work, which takes minutes
        check_map(path, tmp_path / "there")


def test_the_tail_of_a_killed_drive_is_recovered_too(map_file: Path) -> None:
    """It is in FILE-wal."""
    program = f"""
import os
from pathlib import Path
from dpm2_core.slam.store.map_store import MapStore
MapStore.open(Path({str(map_file)!r}), read_only=False).begin_session("second")
os._exit(0)
"""
    subprocess.run([sys.executable, "-c", program], check=True, timeout=60)
    assert Path(f"{map_file}-wal").stat().st_size
    assert check_map(map_file).problems == []
    assert [s.config for s in recovered(map_file).sessions] == ["slam: {}", "second"]


def test_the_map_of_a_killed_drive_that_was_moved_without_its_log_is_not_sound(map_file: Path, tmp_path: Path) -> None:
    """All of a short drive is in FILE-wal. Previously, the check returned "0 keyframes, sound". Copies made by
    `~/save_map` have no log."""
    moved, copy = tmp_path / "moved.dpm2map", tmp_path / "copy.dpm2map"
    with MapStore.open(map_file, read_only=False) as store:
        store.begin_session()
        assert check_map(map_file).problems == []  # its writer is alive
        shutil.copy(map_file, moved)
        store.copy_to(copy)
    words = (
        "its writer was killed, and moved.dpm2map-wal, which may contain the last 4 MB or all of it, is not next to it"
    )
    assert check_map(moved).problems == [words]
    assert check_map(copy).problems == check_map(map_file).problems == []


def test_a_map_that_is_written_meanwhile_is_of_one_instant(
    tmp_path: Path, keyframes: list[Keyframe], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Previously, a slow copy of FILE was of another instant than that of FILE-wal, which the writer had restarted."""
    copyfile = shutil.copyfile
    with MapStore.create(tmp_path / "map") as store:
        store.begin_session()

        def write(count: int) -> None:
            for node in range(store.size, store.size + count):
                keyframe, poses = keyframes[node % 12], {n: np.eye(4) for n in range(node + 1)}
                store.write(Change([(node, keyframe, pack_cloud(keyframe.cloud), bytes(50_000))], poses=poses))

        def slow(source: str, target: str) -> None:
            copyfile(source, target)
            if not source.endswith("-wal"):
                write(60)

        write(50)
        monkeypatch.setattr(shutil, "copyfile", slow)
        findings = check_map(tmp_path / "map", tmp_path / "good")
        assert Path(f"{tmp_path / 'map'}-wal").stat().st_size
    assert (findings.problems, findings.keyframes, findings.lost) == ([], 50, 0)


def test_a_map_without_room_for_its_copy_is_not_said_to_be_damaged(map_file: Path) -> None:
    words = (
        rf"drive.dpm2map: not checked: no copy .* in {tempfile.gettempdir()}, which TMPDIR can change: File too large"
    )
    with largest_file(20_000), pytest.raises(Dpm2Error, match=words):
        check_map(map_file)


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_check_that_is_stopped_leaves_no_copy(tmp_path: Path, number: signal.Signals) -> None:
    save_as(ring(300, 3000), tmp_path / "map")  # takes a second or more
    (tmp_path / "temporary").mkdir()
    program = (
        "import signal, time; signal.signal(signal.SIGINT, signal.default_int_handler)\n"
        "from dpm2_core.slam.store.check import Salvage; run = Salvage.run\n"
        "Salvage.run = lambda self: (run(self), time.sleep(60))\n"  # it does not end before it is stopped
        f"from dpm2_core.cli import main; main(['map', 'check', {str(tmp_path / 'map')!r}])"
    )
    environment = {**os.environ, "TMPDIR": str(tmp_path / "temporary")}
    with subprocess.Popen([sys.executable, "-c", program], env=environment, stderr=subprocess.PIPE) as process:
        while process.poll() is None and not list(tmp_path.glob("temporary/*/map")):
            time.sleep(0.01)
        process.send_signal(number)
        _, errors = process.communicate(timeout=60)
    assert (process.returncode, errors) == (130, b"")
    assert os.listdir(tmp_path / "temporary") == []
