# SPDX-License-Identifier: Apache-2.0
"""A map file and its log belong together: neither is used with that of another map."""

from __future__ import annotations

import errno
import os
import re
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

from dpm2_core.cli import main
from dpm2_core.errors import Dpm2Error, UsageError
from dpm2_core.estimates import Keyframe
from dpm2_core.slam.session import open_session
from dpm2_core.slam.settings import SlamSettings
from dpm2_core.slam.store.check import check_map
from dpm2_core.slam.store.map_data import load_map, save_as
from dpm2_core.slam.store.map_store import MapStore
from test.helpers.maps import change


def begun(source: Path, path: Path) -> None:
    """Create a map like a drive or a robot."""
    open_session(path, SlamSettings(registration="geometric", loops={"descriptors": False}), "", resume=False).close()


def saved(source: Path, path: Path) -> None:
    """Create a map like prune, merge and check --recover."""
    with MapStore.open(source) as store:
        save_as(load_map(store), path)


def copied(source: Path, path: Path) -> None:
    """Create a map like the node when it saves one."""
    with MapStore.open(source) as store:
        store.copy_to(path)


@pytest.mark.parametrize("make", [begun, saved, copied])
@pytest.mark.parametrize("there", [False, True])
def test_a_map_under_a_link_is_made_where_the_link_leads(
    tmp_path: Path, map_file: Path, make: Callable[[Path, Path], None], there: bool
) -> None:
    """For example on a larger disk. Previously, the map was rejected after all the work, or it replaced the link."""
    link, disk = tmp_path / "link.dpm2map", tmp_path / "disk"
    disk.mkdir()
    link.symlink_to(disk / "new.dpm2map")
    if there:
        shutil.copyfile(map_file, link)
    if there and make is not copied:
        with pytest.raises(UsageError, match=r"link\.dpm2map: there is a file already"):
            make(map_file, link)
        return
    make(map_file, link)
    assert link.is_symlink()
    assert [path.name for path in disk.iterdir()] == ["new.dpm2map"]
    assert not check_map(link).problems


@pytest.mark.parametrize("make", [begun, saved])
def test_a_map_whose_name_has_the_log_of_another_one_is_not_made(
    tmp_path: Path, map_file: Path, keyframes: list[Keyframe], make: Callable[[Path, Path], None]
) -> None:
    """The log of a map whose writer was killed, and that was removed or moved. Previously, SQLite used it for the new
    map, which then contained the keyframes of the old one, or was malformed."""
    path = tmp_path / "new.dpm2map"
    log = path.with_name("new.dpm2map-wal")
    with MapStore.create(tmp_path / "killed") as store:
        store.begin_session()
        store.write(change(0, keyframes[0]))
        shutil.copyfile(tmp_path / "killed-wal", log)  # left by `kill -9` and then `rm` or `mv` of the map
    before = log.read_bytes()
    with pytest.raises(UsageError, match=r"new\.dpm2map-wal: the last keyframes of a map .* or remove it"):
        make(map_file, path)
    assert not path.exists()
    assert log.read_bytes() == before  # the moved map needs it
    log.unlink()
    make(map_file, path)
    assert check_map(path).problems == []
    assert check_map(path).keyframes == (0 if make is begun else check_map(map_file).keyframes)


@pytest.mark.parametrize("more", [1, 100])
def test_a_map_that_was_copied_over_a_killed_one_is_not_read_with_its_log(
    tmp_path: Path, map_file: Path, keyframes: list[Keyframe], more: int
) -> None:
    """For example a restored backup. Previously, it contained the drive that it must not have, or was malformed, as
    with 4 MB of log."""
    path = tmp_path / "town.dpm2map"
    shutil.copyfile(map_file, path)
    with MapStore.open(path, read_only=False) as store:
        for node in range(12, 12 + more):
            store.write(change(node, keyframes[0]))
        for suffix in ("-wal", "-shm"):
            shutil.copyfile(f"{path}{suffix}", tmp_path / f"left{suffix}")
    for suffix in ("-wal", "-shm"):
        shutil.copyfile(tmp_path / f"left{suffix}", f"{path}{suffix}")
    shutil.copyfile(map_file, path)
    words = rf"{path}-wal is not of this map, .*, or remove it"
    for read_only in (True, False):
        with pytest.raises(UsageError, match=words):
            MapStore.open(path, read_only)
    found = check_map(path, recover=tmp_path / "recovered")
    assert re.fullmatch(words, *found.problems)
    assert (found.keyframes, check_map(tmp_path / "recovered").problems) == (12, [])
    assert path.read_bytes() == map_file.read_bytes()
    Path(f"{path}-wal").unlink()
    with MapStore.open(path, read_only=False) as store:
        assert store.size == 12
    assert check_map(path).problems == []


def test_where_nothing_can_be_written_that_is_said(
    tmp_path: Path, map_file: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """There, removing a file that was not created is an error, too. Previously, this error was raised, as a
    traceback."""

    def refuse(*_: object, **__: object) -> None:
        raise OSError(errno.EROFS, os.strerror(errno.EROFS))

    monkeypatch.setattr(Path, "touch", refuse)
    monkeypatch.setattr(os, "unlink", refuse)
    with pytest.raises(Dpm2Error, match=r"new\.dpm2map: Read-only file system"):
        saved(map_file, tmp_path / "new.dpm2map")


def test_prune_says_so_before_it_has_worked(tmp_path: Path, map_file: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The exit code is that of a usage error, as if the file existed."""
    (tmp_path / "less.dpm2map-wal").write_bytes(b"log")
    with pytest.raises(SystemExit, match="2"):
        main(["map", "prune", str(map_file), "--out", str(tmp_path / "less.dpm2map")])
    assert "less.dpm2map-wal: the last keyframes" in capsys.readouterr().err
