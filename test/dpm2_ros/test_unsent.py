# SPDX-License-Identifier: Apache-2.0
"""Keyframes on a robot's disk are complete or absent, whatever happens to the process, the disk or the file."""

from __future__ import annotations

import errno
import os
import re
import sqlite3
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rclpy

from dpm2_core.estimates import Keyframe
from dpm2_ros.keyframe_sender import KeyframeSender
from dpm2_ros.settings import RosSettings
from dpm2_ros.unsent import KeyframeFile, left_behind, path_of

from ..helpers.full_disk import largest_file
from ..helpers.maps import execute

WRITER = """
import resource, signal, sys
from pathlib import Path
from dpm2_ros.unsent import KeyframeFile
most = int(sys.argv[2])
if most:
    signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (most, most))  # as a full disk
file = KeyframeFile(Path(sys.argv[1]))
for id in range(50):
    file.append([bytes([id]) * 1000, b"descriptors", bytes([id]) * 30000])
assert all(file.read(id)[0] == bytes([id]) * 1000 for id in range(50)), "what does not fit stays in memory"
print(len(file), flush=True)
signal.pause()
"""


def killed_writer(path: Path, most: int = 0) -> None:
    """A process that adds 50 keyframes and is killed; its files cannot be larger than `most` bytes."""
    process = subprocess.Popen([sys.executable, "-c", WRITER, str(path), str(most)], stdout=subprocess.PIPE)
    assert process.stdout is not None
    line = process.stdout.readline()
    process.kill()
    process.wait()
    assert line == b"50\n"


def test_a_killed_process_leaves_every_keyframe(tmp_path: Path) -> None:
    path = path_of(tmp_path / "maps", "red", "5f3a9c01")
    killed_writer(path)
    assert left_behind(tmp_path / "maps", "red") == [("5f3a9c01", path)]
    file = KeyframeFile(path)
    assert len(file) == 50
    assert file.read(49) == [bytes([49]) * 1000, b"descriptors", bytes([49]) * 30000]
    file.append([b"a", b"b", b"c"])
    file.close(keep=True)
    again = KeyframeFile(path)
    assert again.read(50) == [b"a", b"b", b"c"]
    again.close(keep=False)
    assert not (tmp_path / "maps").exists()


def test_a_full_disk_costs_no_keyframe_and_leaves_no_gap(tmp_path: Path) -> None:
    path = path_of(tmp_path, "", "5f3a9c01")
    killed_writer(path, 800_000)
    file = KeyframeFile(path)
    assert 5 < len(file) < 50
    assert [file.read(id)[0][0] for id in range(len(file))] == list(range(len(file)))
    file.close(keep=False)


def test_a_disk_that_can_only_be_read_by_now_does_not_keep_a_node_from_its_end(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Linux remounts a disk with errors read-only: the node still ends. Remaining keyframes are sent again, and the
    mapper recognizes them."""
    file = KeyframeFile(path := path_of(tmp_path, "", "5f3a9c01"))
    file.append([b"pose", b"descriptors", b"cloud"])

    def refuse(path: Path) -> None:
        raise OSError(errno.EROFS, os.strerror(errno.EROFS))

    with monkeypatch.context() as patch:
        patch.setattr(os, "unlink", refuse)
        file.close(keep=False)
    assert left_behind(tmp_path, "") == [("5f3a9c01", path)]


def test_a_file_belongs_to_one_process_and_one_robot(tmp_path: Path) -> None:
    path = path_of(tmp_path, "red", "00000001")
    file = KeyframeFile(path)
    with pytest.raises(sqlite3.OperationalError, match="locked"):
        KeyframeFile(path)
    for name in ("drive_red.0000000g.unsent", "drive_red.00000001.unsent-wal", "drive_red.town.dpm2map"):
        (tmp_path / name).touch()
    assert [session for session, _ in left_behind(tmp_path, "red")] == ["00000001"]
    for other in ("", "re", "red/a", "blue"):
        assert not left_behind(tmp_path, other)
    assert not left_behind(tmp_path / "nowhere", "red")
    file.close(keep=False)
    assert path_of(tmp_path, "a/b", "0" * 8) != path_of(tmp_path, "a_b", "0" * 8)


def test_a_file_that_is_closed_meanwhile_is_opened_again(tmp_path: Path) -> None:
    """A closed file is opened again when needed; if another process has opened it meanwhile, this is an error."""
    path, before = tmp_path / "drive.00000001.unsent", len(os.listdir("/proc/self/fd"))
    file = KeyframeFile(path)
    for _ in range(2):
        file.append([b"a", b"b", b"c"])
        file.pause()
        assert len(os.listdir("/proc/self/fd")) == before
    assert file.read(1) == [b"a", b"b", b"c"]
    file.pause()
    other = KeyframeFile(path)
    with pytest.raises(sqlite3.OperationalError, match="locked"):
        file.read(1)
    other.append([b"a", b"b", b"c"])
    other.close(keep=True)
    with pytest.raises(sqlite3.DatabaseError, match="3 keyframes, 2 before"):
        file.read(1)
    path.unlink()
    with pytest.raises(sqlite3.OperationalError, match="unable to open"):
        file.read(1)
    assert not path.exists()


def test_drives_that_wait_for_the_mapper_hold_no_file_open(ros: Callable[..., Any], tmp_path: Path) -> None:
    """A looped bag, or many resets, with no mapper; then the next start. A drive without a keyframe leaves no file."""
    ros()
    node, opened = rclpy.create_node("robot", use_global_arguments=False), []  # its callbacks are never called
    settings = RosSettings(embed_mapper=False, map_directory=str(tmp_path))
    sender = KeyframeSender(node, "", settings)
    for _ in range(20):
        sender.send(Keyframe(0, 0, 0, np.eye(4), np.zeros((10, 4), np.float32)))
        sender.restart()
        sender.restart()
        opened.append(len(os.listdir("/proc/self/fd")))
    assert opened[0] == opened[-1]
    assert len(left_behind(tmp_path, "")) == 20 + 1
    sender.close()
    before = len(os.listdir("/proc/self/fd"))
    again = KeyframeSender(node, "", settings)
    assert len(os.listdir("/proc/self/fd")) < before + 20
    assert again.arrived == (0, 20)
    again.close()
    assert len(left_behind(tmp_path, "")) == 20
    node.destroy_node()


@pytest.mark.parametrize("room", [False, True])
def test_a_full_disk_is_said_and_what_ends_with_the_process_is_counted(
    ros: Callable[..., Any], tmp_path: Path, capfd: pytest.CaptureFixture[str], room: bool
) -> None:
    """A full disk is reported at once, and keyframes that are lost at the end are counted. Previously, all were
    reported as to be sent at the next start, and nothing was reported during the drive.

    `room`: the disk has room after the last keyframe; keyframes that waited in memory are lost nevertheless.
    """
    ros()
    node = rclpy.create_node("robot", use_global_arguments=False)
    sender = KeyframeSender(node, "", RosSettings(embed_mapper=False, map_directory=str(tmp_path)))
    cloud = np.random.default_rng(0).uniform(-50, 50, (2000, 4)).astype(np.float32)
    with largest_file(200_000):
        for n in range(30):
            sender.send(Keyframe(n, n, n, np.eye(4), cloud))
        problem = sender.problem
        if not room:
            sender.close()
    if room:
        sender.close()
    ((_, path),) = left_behind(tmp_path, "")
    stored, log = len(KeyframeFile(path)), capfd.readouterr().err
    assert 0 < stored <= 30
    assert (stored == 30) == room
    assert f"{stored} keyframes not delivered: sent at the next start" in log
    assert (f"{30 - stored} keyframes neither delivered nor in" in log) == (not room)
    assert re.match(r"\d+ keyframes in memory only: ", problem)
    node.destroy_node()


@pytest.mark.parametrize(
    "damage",
    [
        "DELETE FROM keyframe WHERE id = 1",
        "UPDATE keyframe SET cloud = zeroblob(1000000)",
        "CREATE VIEW v AS SELECT 1",
        "DROP TABLE keyframe",
    ],
)
def test_what_is_no_such_file_is_an_error(tmp_path: Path, damage: str) -> None:
    path = tmp_path / "drive.00000001.unsent"
    file = KeyframeFile(path)
    for _ in range(3):
        file.append([b"a", b"b", b"c"])
    file.close(keep=True)
    execute(path, damage, *["CREATE TABLE other (id INTEGER)"] * damage.startswith("DROP"))
    with pytest.raises(sqlite3.DatabaseError, match="malformed"):
        KeyframeFile(path)
    path.write_bytes(b"no database " * 1000)
    with pytest.raises(sqlite3.DatabaseError, match="not a database"):
        KeyframeFile(path)


def test_text_in_place_of_a_message_is_an_error_when_it_is_read(tmp_path: Path) -> None:
    path = tmp_path / "drive.00000001.unsent"
    file = KeyframeFile(path)
    file.append([b"a", b"b", b"c"])
    file.close(keep=True)
    execute(path, "UPDATE keyframe SET cloud = 'text'")
    file = KeyframeFile(path)
    with pytest.raises(sqlite3.DatabaseError, match="keyframe 0 is damaged"):
        file.read(0)


def test_a_full_disk_costs_no_keyframe_without_a_file() -> None:
    """The process may write 1 MB of 5 MB; for one with a file see `WRITER`."""
    program = """
import os, resource, signal
from dpm2_ros.unsent import KeyframeFile
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
resource.setrlimit(resource.RLIMIT_FSIZE, (1 << 20, 1 << 20))
file = KeyframeFile()
sent = [[bytes([n]), b"", os.urandom(50_000)] for n in range(100)]
for parts in sent:
    file.append(parts)
print(sum(file.read(n) == parts for n, parts in enumerate(sent)), len(file))
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=120)
    assert done.stdout == "100 100\n", done.stderr


def test_what_found_no_room_is_in_the_file_once_there_is_some(tmp_path: Path) -> None:
    """Keyframes in memory are written once the disk has room. Previously, they stayed in memory to the end, but were
    reported as to be sent at the next start."""
    path = path_of(tmp_path, "", "5f3a9c01")
    file, sent = KeyframeFile(path), [[bytes([n]), b"", os.urandom(50_000)] for n in range(30)]
    with largest_file(600_000):
        for parts in sent[:20]:
            file.append(parts)
    stored = file.stored
    assert 0 < stored < len(file) == 20
    assert file.problem
    for parts in sent[20:]:
        file.append(parts)
    assert (file.stored, file.problem) == (30, "")
    file.close(keep=True)
    again = KeyframeFile(path)
    assert [again.read(n) for n in range(30)] == sent
    again.close(keep=False)


def test_what_holds_no_keyframe_holds_no_file() -> None:
    """Every start of the odometry makes a KeyframeFile, even if nothing will be kept: an empty one has no open file."""
    before = len(os.listdir("/proc/self/fd"))
    files = [KeyframeFile() for _ in range(10)]
    assert len(os.listdir("/proc/self/fd")) == before
    files[0].append([b"a", b"b", b"c"])
    assert files[0].read(0) == [b"a", b"b", b"c"]
