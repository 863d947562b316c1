# SPDX-License-Identifier: Apache-2.0
"""A map file and what SQLite keeps beside it, FILE-wal foremost: they are copied, moved and removed together."""

from __future__ import annotations

import os
import shutil
from contextlib import suppress
from pathlib import Path

from dpm2_core.errors import Dpm2Error, UsageError
from dpm2_core.files import explaining

SUFFIX = ".dpm2map"
"""Of the name of a map file, unless another one is given."""

_CLOSED, _LOGGED = 1, 2  # see `_write_version`
_WHAT_TO_DO = "move it to where that map is, or remove it"


def copy_with_log(path: Path, copy: Path) -> None:
    """Copy what of a map file and its FILE-wal is there, as it lies there.

    Raises:
        OSError: it could not be read or written.
    """
    source = path.resolve()  # SQLite names FILE-wal after the file, not after a link to it
    for suffix in ("",) if foreign_log(path) else ("", "-wal"):
        with suppress(FileNotFoundError):
            shutil.copyfile(f"{source}{suffix}", f"{copy}{suffix}")


def missing_log(path: Path) -> str:
    """Why the last keyframes of a map file may not be there, in words; empty where nothing says so.

    Who closes a map leaves one file, whose header says that there is no other. Where it says that there is, the writer
    was killed, and FILE-wal is needed; a map that is moved or copied without it opens as if nothing were missing.

    Raises:
        OSError: it could not be read.
    """
    wal = Path(f"{path.resolve()}-wal")
    if _write_version(path) != _LOGGED or wal.exists():
        return ""
    return f"who wrote it was killed, and {wal.name}, where the last 4 MB or all of it may be, is not beside it"


def foreign_log(path: Path) -> str:
    """Why FILE-wal is not that of the map file beside it, in words; empty where nothing says so.

    A map that was closed has none. So it lies there where one replaced, as a copy from before, another whose writer was
    killed; SQLite would read the one with the pages of the other.

    Raises:
        OSError: it could not be read.
    """
    wal = Path(f"{path.resolve()}-wal")
    there = _holds(wal)
    if there and _write_version(path) == _CLOSED and _holds(wal):  # asked again: a map may be closed meanwhile
        return f"{wal} is not of this map, which was closed, but of one that was here before; {_WHAT_TO_DO}"
    return ""


def _write_version(path: Path) -> int:
    """Of the header of a database, whether it has a log: see the SQLite file format. 0 of a file that is too short."""
    with path.open("rb") as file:
        return int.from_bytes(file.read(19)[18:])


def _holds(log: Path) -> bool:
    try:
        return log.stat().st_size > 0
    except OSError:  # there is none, or its map cannot be reached either, which is said of that
        return False


def move_map(source: Path, target: Path) -> None:
    """Give a map that was closed another name; the map that had it goes, with what SQLite keeps beside it. A symbolic
    link stays one.

    Raises:
        Dpm2Error: not all of it is in that one file, since the disk was full, or it is not there; the map that was
            there stays.
    """
    _check_whole(source, target)
    with explaining(target):
        _remove_log(target.resolve())
        source.replace(target.resolve())


def name_map(source: Path, target: Path) -> None:
    """Give a map that was closed a name that no file has; of two programs that want the same one, one gets it.

    Raises:
        UsageError: there is a file already, or what SQLite kept beside one. Dpm2Error: as `move_map`.
    """
    _check_whole(source, target)
    check_new(target)
    try:
        os.link(source, target.resolve())
        source.unlink()
    except FileExistsError:
        raise already_there(target) from None
    except OSError:  # a file system without hard links, as of memory cards
        if target.exists():
            raise already_there(target) from None
        move_map(source, target)


def check_new(path: Path) -> None:
    """Raises UsageError if a map that is made there would not be new: there is a file already, or what SQLite kept
    beside one, which it would take for the new one's."""
    there, left = path.exists(), left_log(path)  # a path that may not be entered is an error of that name
    if there or path.exists():  # asked again: of a map that another program makes now the file is there before its log
        raise already_there(path)
    if left is not None:
        raise UsageError(f"{left}: the last keyframes of a map that was moved or removed without them; {_WHAT_TO_DO}")


def left_log(path: Path) -> Path | None:
    """What SQLite kept beside a map file, if there is any of it."""
    logs = (Path(f"{path.resolve()}{suffix}") for suffix in ("-wal", "-journal"))
    return next(filter(_holds, logs), None)


def already_there(path: Path) -> UsageError:
    """What to raise where a map is to be made, and there is a file."""
    return UsageError(f"{path}: there is a file already")


def _check_whole(source: Path, target: Path) -> None:
    wal = Path(f"{source}-wal")
    if wal.exists() and wal.stat().st_size:  # see MapStore.close; renamed without it, the map would be damaged
        raise Dpm2Error(f"{target}: not written: the map could not be made one file; is the disk full?")


def remove_map(path: Path) -> None:
    """Remove a map file, if it is there, with what SQLite keeps beside it. What cannot be removed stays: whoever asks
    has the reason already, as that the file system can only be read."""
    with suppress(OSError):
        path.unlink(missing_ok=True)
        _remove_log(path)


def _remove_log(path: Path) -> None:
    """Remove what SQLite keeps beside a map file: another map of that name would be read with it, and be damaged."""
    for suffix in ("-wal", "-shm", "-journal"):
        Path(f"{path}{suffix}").unlink(missing_ok=True)
