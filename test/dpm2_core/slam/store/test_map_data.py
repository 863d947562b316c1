# SPDX-License-Identifier: Apache-2.0
"""Copies of maps, and maps appended to one another: complete, or not there."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from dpm2_core.errors import Dpm2Error, UsageError
from dpm2_core.estimates import Keyframe
from dpm2_core.slam.mapping.merge import merge_maps
from dpm2_core.slam.mapping.prune import prune
from dpm2_core.slam.store import schema
from dpm2_core.slam.store.check import check_map
from dpm2_core.slam.store.cloud_store import CloudStore, Loan
from dpm2_core.slam.store.map_data import append_map, load_map, save_as, trajectory
from dpm2_core.slam.store.map_store import MapStore
from test.helpers.full_disk import CHECKPOINT, largest_file
from test.helpers.maps import change, ring


def test_a_copy_that_does_not_fit_on_the_disk_is_an_error(tmp_path: Path, noise: np.random.Generator) -> None:
    """Also if only the last step fails: then all of it is in FILE-wal, but not in the file."""
    data = replace(ring(13), thumbnail=lambda node: noise.bytes(500_000))
    save_as(data, tmp_path / "map")
    size = (tmp_path / "map").stat().st_size
    with largest_file(size - 300_000), pytest.raises(Dpm2Error, match=r"copy: not written: .*is the disk full"):
        save_as(data, tmp_path / "copy")
    assert size > CHECKPOINT + 600_000  # else FILE-wal would become too large first, which is another error
    assert os.listdir(tmp_path) == ["map"]


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
    """Previously, it left an empty map, which the check reported as sound, and because of which the same call was
    rejected."""
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
    """Previously, the second one deleted what the first had written, and neither was left."""
    out = tmp_path / "copy"

    def meanwhile(node: int) -> None:
        if node == 3:
            subprocess.run([sys.executable, "-c", COPY, str(map_file), str(out)], timeout=60, check=True)

    with pytest.raises(UsageError, match="copy: there is a file already"):
        save_as(replace(ring(5), thumbnail=meanwhile), out)
    assert check_map(out).keyframes == 12
    assert sorted(os.listdir(tmp_path)) == sorted([map_file.name, "copy"])


def test_a_map_behind_another_one_is_the_map_of_both(tmp_path: Path, map_file: Path) -> None:
    """The numbers of nodes, sessions, lenders, edges and pruned keyframes continue, as if two maps were joined in
    memory."""
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
    """Previously, its log stayed next to the new map, which was then read with pages of the old map."""
    path, target = tmp_path / "a.dpm2map", tmp_path / "b.dpm2map"
    with MapStore.create(tmp_path / "killed") as store:
        store.begin_session()
        for node, keyframe in enumerate(keyframes):
            store.write(change(node, keyframe))
        for suffix in ("", "-wal"):  # as `kill -9` leaves them
            shutil.copyfile(tmp_path / f"killed{suffix}", f"{target}{suffix}")
    assert Path(f"{target}-wal").stat().st_size > 0
    with MapStore.create(path) as store:
        store.begin_session()
        for node, keyframe in enumerate(keyframes[:2]):
            store.write(change(node, keyframe))
        store.copy_to(target)
    assert not Path(f"{target}-wal").exists()
    with MapStore.open(target) as store:
        assert len(load_map(store).keyframes) == 2


def test_a_way_goes_as_it_was_driven_where_its_stamps_come_again() -> None:
    """For example after a clock was set back, or if a bag is played twice. Previously, the two halves were
    interleaved."""
    data = ring(12, points=10)
    keyframes = [replace(k, stamp=k.stamp - 6 * 10**9 * (k.id >= 6)) for k in data.keyframes]
    data = replace(data, keyframes=keyframes)
    for one in (data, prune(data, [3, 7, 8])):
        stamps, poses = trajectory(one)
        assert stamps == [k.stamp for k in keyframes]
        np.testing.assert_allclose(poses, data.poses, atol=1e-9)  # rounding
