# SPDX-License-Identifier: Apache-2.0
"""Results are complete or absent, and the previous files survive every failure."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from dpm2_core.data.ply import write_ply
from dpm2_core.errors import Dpm2Error
from dpm2_core.files import atomic_write, write_json

from ..helpers.full_disk import largest_file


def test_what_is_not_finite_is_null(tmp_path: Path) -> None:
    """NaN and Infinity are not valid JSON: jq and browsers reject the whole file."""
    write_json(tmp_path / "a.json", {"a": [float("nan"), (1.5, float("-inf"))], "b": {"c": float("inf"), "d": "NaN"}})
    assert json.loads((tmp_path / "a.json").read_text(), parse_constant=pytest.fail) == {
        "a": [None, [1.5, None]], "b": {"c": None, "d": "NaN"},
    }  # fmt: skip


def test_the_file_appears_only_when_it_is_whole(tmp_path: Path) -> None:
    path = tmp_path / "new folder" / "result.txt"
    with atomic_write(path) as file:
        file.write("µ")
        assert not path.exists()
    assert path.read_text(encoding="utf-8") == "µ"
    assert [entry.name for entry in path.parent.iterdir()] == ["result.txt"]


@pytest.mark.parametrize("failure", [RuntimeError, KeyboardInterrupt])
def test_an_interrupted_writer_leaves_the_old_file_and_nothing_else(
    tmp_path: Path, failure: type[BaseException]
) -> None:
    path = tmp_path / "result.txt"
    path.write_text("old")

    def write() -> None:
        with atomic_write(path) as file:
            file.write("half of the new")
            raise failure

    with pytest.raises(failure):
        write()
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


def test_what_killed_writers_have_left_goes_with_the_next_file_of_the_name(tmp_path: Path) -> None:
    """Otherwise every kill would leave a partial file: for a checkpoint or a map.ply as large as the file itself."""
    path, others = tmp_path / "result.txt", [".other.txt.{}.part", "result.txt.{}.part"]
    with subprocess.Popen([sys.executable, "-c", ""]) as killed:
        pass
    for name in (".result.txt.{}.part", "..result.txt.{0}.part.{0}.part", *others):
        (tmp_path / name.format(killed.pid)).touch()
    (living := tmp_path / f".result.txt.{os.getppid()}.part").touch()
    with atomic_write(path) as file:
        file.write("new")
    assert set(tmp_path.iterdir()) == {path, living, *(tmp_path / name.format(killed.pid) for name in others)}


def test_a_full_disk_leaves_the_old_file_and_nothing_else(tmp_path: Path) -> None:
    """A file size limit makes the kernel reject the write half-way, as a full disk does, without root or a mount."""
    path = tmp_path / "map.ply"
    path.write_text("old")
    with largest_file(100_000), pytest.raises(Dpm2Error, match=f"{path}: .*File too large"):
        write_ply(path, np.ones((100_000, 4), np.float32))
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


def test_a_place_that_cannot_be_written_is_named(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    for path in (tmp_path / "file" / "below.txt", tmp_path):
        with pytest.raises(Dpm2Error, match=str(path)), atomic_write(path) as file:
            file.write("x")
    assert [entry.name for entry in tmp_path.iterdir()] == ["file"]
    assert [entry.name for entry in tmp_path.parent.iterdir() if entry.name.endswith(".part")] == []


def test_a_symbolic_link_stays_one(tmp_path: Path) -> None:
    (tmp_path / "target").write_text("old")
    (tmp_path / "link").symlink_to(tmp_path / "target")
    with atomic_write(tmp_path / "link") as file:
        file.write("new")
    assert (tmp_path / "link").is_symlink()
    assert (tmp_path / "target").read_text() == "new"


def test_a_pipe_is_written_to_and_not_replaced() -> None:
    program = "from dpm2_core.files import atomic_write\nwith atomic_write('/dev/stdout') as f: f.write('through')"
    result = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert result.stdout == "through"
    assert Path("/dev/stdout").is_symlink()
