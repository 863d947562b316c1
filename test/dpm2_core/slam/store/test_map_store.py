# SPDX-License-Identifier: Apache-2.0
"""A map file survives kills, truncated files, full disks, and readers and writers at the same time."""

from __future__ import annotations

import hashlib
import os
import shutil
import signal
import sqlite3
import subprocess
import sys
import tempfile
import time
from contextlib import closing, suppress
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from dpm2_core.errors import Dpm2Error, UsageError
from dpm2_core.estimates import Keyframe
from dpm2_core.slam.session import open_session
from dpm2_core.slam.settings import SlamSettings
from dpm2_core.slam.store.check import check_map
from dpm2_core.slam.store.cloud_store import Loan
from dpm2_core.slam.store.map_data import append_map, load_map, save_as
from dpm2_core.slam.store.map_store import Change, MapStore
from test.helpers.full_disk import largest_file
from test.helpers.maps import change, execute, ring

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
    if sys.argv[3:] and node % int(sys.argv[3]) == 0:
        sys.stdin.readline()
    cloud = rng.uniform(0, 1, (2000, 4)).astype(np.float32)
    d = Descriptors.of(np.zeros((64, 3), np.float32), np.zeros((64, 128)))
    k = Keyframe(node, node, node, np.eye(4), cloud, None, "", d)
    edges = [Edge("odometry", node - 1, node, Registration(np.eye(4), np.eye(6)))] if node else []
    store.write(Change([(node, k, pack_cloud(cloud), None)], edges, {n: np.eye(4) for n in range(node + 1)}))
    print(node, flush=True)
"""


def whole_prefix(path: Path) -> int:
    """Number of keyframes of the map. They must be the first ones, each complete."""
    with MapStore.open(path) as store:
        data = load_map(store)
        assert [k.id for k in data.keyframes] == list(range(len(data)))
        assert len(data.edges) == max(len(data) - 1, 0)
        assert all(len(data.clouds[node]) == 2000 and k.descriptors for node, k in enumerate(data.keyframes))
        return len(data)


def test_everything_comes_back(tmp_path: Path, map_file: Path, keyframes: list[Keyframe]) -> None:
    """Poses and covariances to the last bit, clouds to half a centimeter, descriptors byte for byte."""
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


def test_a_loan_and_a_thumbnail_come_back(map_file: Path, keyframes: list[Keyframe]) -> None:
    T = np.eye(4)
    T[0, 3] = 2.0
    with MapStore.open(map_file, read_only=False) as store:
        store.begin_session()
        store.write(Change([(12, keyframes[0], None, None)], poses={12: np.eye(4)}, loans={12: Loan(3, T)}))
        store.write(change(13, keyframes[1], b"jpeg"))
    with MapStore.open(map_file) as store:
        data = load_map(store)
        assert [k.session for k in data.keyframes[-2:]] == [2, 2]
        np.testing.assert_allclose(data.clouds[12][:, 0], data.clouds[3][:, 0] + 2, atol=1e-5)
        borrowed, lent = data.keyframes[12].descriptors, data.keyframes[3].descriptors
        assert borrowed is not None
        assert lent is not None
        assert borrowed.features is lent.features  # no additional memory
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
    with MapStore.open(path, read_only=False) as store:  # and the file can be written to again
        store.begin_session()


def test_a_file_cut_off_at_any_place_holds_the_first_keyframes(tmp_path: Path) -> None:
    """A machine that dies leaves any prefix of FILE-wal, and possibly garbage after it."""
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
        except UsageError:  # the very beginning: not even the schema was written
            assert size < 100_000
    assert 12 in counts or max(counts) >= 10
    assert len(counts) > 4


def test_a_reader_sees_whole_keyframes_while_they_are_written(tmp_path: Path) -> None:
    path, told = tmp_path / "a.dpm2map", 0
    writer = [sys.executable, "-c", WRITER, str(path), "60", "20"]
    child = subprocess.Popen(writer, stdin=subprocess.PIPE, stdout=subprocess.PIPE)
    assert child.stdin is not None
    assert child.stdout is not None
    assert child.stdout.readline() == b"begun\n"
    counts = []
    while child.poll() is None:
        counts.append(whole_prefix(path))
        if counts[-1] == 20 * told < 60:  # the writer waits until this was seen: else a slow reader might miss all
            child.stdin.write(b"\n")
            child.stdin.flush()
            told += 1
    child.stdin.close()
    child.stdout.close()
    assert child.returncode == 0  # and the writer was not disturbed
    assert counts == sorted(counts)
    assert {0, 20, 40} <= set(counts)
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
    """Reading works, also for a map whose writer was killed. Writing is an error that reports the reason."""
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


def test_what_is_no_map_is_rejected_in_one_line(tmp_path: Path, map_file: Path) -> None:
    text, other, later, earlier = tmp_path / "a.txt", tmp_path / "other.db", map_file, tmp_path / "earlier"
    text.write_text("no map at all, but long enough to look like something")
    execute(other, "CREATE TABLE t (x)")
    shutil.copyfile(map_file, earlier)
    execute(earlier, "PRAGMA user_version = 4")
    execute(later, "PRAGMA user_version = 99")
    words_of = {text: "not a dpm2 map", other: "no dpm2 map", tmp_path: "no such"}
    words_of |= {
        later: r"later dpm2 \(map version 99, this",
        earlier: r"before the first release \(map version 4, this",
    }
    for path, words in words_of.items():
        for read_only in (True, False):
            with pytest.raises(UsageError, match=words) as caught:
                MapStore.open(path, read_only=read_only)
            assert str(path) in str(caught.value)
    with pytest.raises(UsageError, match="there is a file already"):
        MapStore.create(text)


_KILLED_AT_THE_START = """
import os, signal, sys
from pathlib import Path
from dpm2_core.slam.store import schema
from dpm2_core.slam.store.map_store import MapStore
create = schema.create
def killed(sql):
    sql.execute("BEGIN")
    sql.execute("CREATE TABLE t (x)")
    os.kill(os.getpid(), signal.SIGKILL)
schema.create = killed
MapStore.create(Path(sys.argv[1]))
"""


def test_a_kill_while_a_map_is_made_leaves_no_file_of_its_name(tmp_path: Path) -> None:
    """Otherwise, a robot that is switched off then would find "not a dpm2 map" there forever."""
    path = tmp_path / "map"
    done = subprocess.run([sys.executable, "-c", _KILLED_AT_THE_START, str(path)], check=False)
    assert done.returncode == -signal.SIGKILL
    assert not path.exists()
    MapStore.create(path).close()
    assert check_map(path).problems == []
    assert [file.name for file in tmp_path.iterdir()] == ["map"]


@pytest.mark.parametrize("error", [None, PermissionError(1, "Operation not permitted")], ids=["links", "no links"])
def test_of_two_programs_that_make_a_map_of_one_name_one_gets_it(
    tmp_path: Path, error: OSError | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The other program creates its file in between; also on a file system without hard links."""
    path, link = tmp_path / "map", os.link

    def late(source: Path, target: Path) -> None:
        path.write_bytes(b"the other's")
        if error is not None:
            raise error
        link(source, target)

    monkeypatch.setattr(os, "link", late)
    with pytest.raises(UsageError, match="there is a file already"):
        MapStore.create(path)
    assert path.read_bytes() == b"the other's"
    path.unlink()
    monkeypatch.setattr(
        os, "link", lambda source, target: (_ for _ in ()).throw(error) if error else link(source, target)
    )
    MapStore.create(path).close()
    assert check_map(path).problems == []


def test_two_writers(map_file: Path, keyframes: list[Keyframe], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("dpm2_core.slam.store.map_connection.BUSY", 0.1)
    with closing(sqlite3.connect(map_file)) as one, MapStore.open(map_file, read_only=False) as two:
        one.execute("BEGIN IMMEDIATE")
        with pytest.raises(Dpm2Error, match="locked"):
            two.begin_session()


def test_of_two_programs_that_go_on_with_a_map_only_the_later_one_writes(
    map_file: Path, keyframes: list[Keyframe]
) -> None:
    """Both continue after its 12 keyframes: one would overwrite what the other has written."""
    mine, others = (replace(keyframes[0], robot=robot) for robot in ("one", "two"))
    with MapStore.open(map_file, read_only=False) as one, MapStore.open(map_file, read_only=False) as two:
        one.begin_session()
        one.write(change(12, mine))
        two.begin_session()
        two.write(change(13, others))
        with pytest.raises(Dpm2Error, match="another program has begun to write to it") as caught:
            one.write(change(13, mine))
        assert str(map_file) in str(caught.value)
        two.write(change(14, others))
    with MapStore.open(map_file) as store:
        data = load_map(store)
    assert [keyframe.robot for keyframe in data.keyframes[12:]] == ["one", "two", "two"]
    assert [k.session for k in data.keyframes[12:]] == [2, 3, 3]


def test_a_program_that_takes_over_other_maps_goes_on_with_its_own_session(
    tmp_path: Path, keyframes: list[Keyframe]
) -> None:
    with MapStore.create(tmp_path / "map") as store:
        store.begin_session()
        append_map(store, ring(3))
        store.write(change(3, keyframes[0]))
    with MapStore.open(tmp_path / "map") as store:
        assert [k.session for k in load_map(store).keyframes] == [2, 2, 2, 1]


@pytest.mark.parametrize("size", [20_000, 60_000])
def test_a_map_that_cannot_be_begun_is_not_in_the_way_of_the_next(tmp_path: Path, size: int) -> None:
    """Neither if its tables do not fit on the disk, 41 kB, nor if the settings of its first session do not."""
    settings = SlamSettings(registration="geometric", loops={"descriptors": False})
    path = tmp_path / "map"
    with largest_file(size), pytest.raises(Dpm2Error, match=r"map: (disk I/O error|database or disk is full)"):
        open_session(path, settings, "x" * 100_000, resume=True)
    assert os.listdir(tmp_path) == []
    with open_session(path, settings, "x" * 100_000, resume=False) as store:
        assert store.session == 1


def test_a_new_map_is_whole_without_its_log(tmp_path: Path) -> None:
    """A power cut in the first seconds may delete all of FILE-wal. Previously, the rest was no map, and prevented a new
    one."""
    with MapStore.create(tmp_path / "map") as store:
        store.begin_session()
        shutil.copyfile(tmp_path / "map", tmp_path / "copy")
    with MapStore.open(tmp_path / "copy", read_only=False) as store:
        assert store.begin_session() == 1


@pytest.mark.parametrize("read_only", [True, False])
def test_a_link_to_a_map_that_is_being_written_shows_all_of_it(
    tmp_path: Path, map_file: Path, keyframes: list[Keyframe], read_only: bool
) -> None:
    """FILE-wal is next to the file, not next to the link."""
    link = tmp_path / "elsewhere" / "latest"
    link.parent.mkdir()
    link.symlink_to(map_file)
    with MapStore.open(map_file, read_only=False) as writer:
        writer.begin_session()
        writer.write(change(12, keyframes[0]))
        with MapStore.open(link, read_only=read_only) as store:
            assert store.path == link
            assert len(load_map(store)) == 13
        assert check_map(link).keyframes == 13
    assert os.listdir(link.parent) == [link.name]


def test_what_is_written_together_is_there_together_or_not_at_all(tmp_path: Path, keyframes: list[Keyframe]) -> None:
    """An error within the block reverts what was written before it. What follows the block is independent of it."""
    with MapStore.create(tmp_path / "map") as store:
        store.begin_session()
        for node, keyframe in enumerate(keyframes[:3]):
            with suppress(ZeroDivisionError), store.together():
                store.write(change(node, keyframe))
                assert store.size == node + 1
                raise ZeroDivisionError
            assert store.size == node
            store.write(change(node, keyframe))
    with MapStore.open(tmp_path / "map") as store:
        assert len(load_map(store)) == 3
