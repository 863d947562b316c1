# SPDX-License-Identifier: Apache-2.0
"""A map file and the files that SQLite keeps next to it, mainly FILE-wal: copied, moved and removed together."""

from __future__ import annotations

import os
import shutil
from contextlib import suppress
from pathlib import Path

from dpm2_core.errors import Dpm2Error, UsageError
from dpm2_core.files import explaining

SUFFIX = ".dpm2map"
"""Suffix of a map file's name, unless another one is given."""

_WITHOUT_LOG, _WITH_LOG = 1, 2  # see `_write_version`
_ADVICE = "move it to where that map is, or remove it"


def copy_with_log(path: Path, copy: Path) -> None:
    """Copy a map file and its FILE-wal, as far as they exist, byte by byte.

    Raises:
        OSError: it could not be read or written.
    """
    source = path.resolve()  # SQLite names FILE-wal after the file, not after a link to it
    for suffix in ("",) if foreign_log(path) else ("", "-wal"):
        with suppress(FileNotFoundError):
            shutil.copyfile(f"{source}{suffix}", f"{copy}{suffix}")


def missing_log(path: Path) -> str:
    """Why the last keyframes of a map file may be missing, in words; empty if there is no sign of it.

    A closed map is one file, whose header states that there is no log. If the header states that there is one, the
    writer was killed and FILE-wal is needed. A map moved or copied without it opens as if nothing were missing.

    Raises:
        OSError: it could not be read.
    """
    wal = Path(f"{path.resolve()}-wal")
    if _write_version(path) != _WITH_LOG or wal.exists():
        return ""
    return f"its writer was killed, and {wal.name}, which may contain the last 4 MB or all of it, is not next to it"


def foreign_log(path: Path) -> str:
    """Why FILE-wal does not belong to the map file next to it, in words; empty if there is no sign of it.

    A closed map has no FILE-wal. If there is one, the map has replaced another one whose writer was killed, such as by
    a copy from a backup; SQLite would mix the pages of the two.

    Raises:
        OSError: it could not be read.
    """
    wal = Path(f"{path.resolve()}-wal")
    has_log = _is_not_empty(wal)
    # Checked again: a map may be closed meanwhile.
    if has_log and _write_version(path) == _WITHOUT_LOG and _is_not_empty(wal):
        return f"{wal} is not of this map, which was closed, but of one that was here before; {_ADVICE}"
    return ""


def _write_version(path: Path) -> int:
    """Whether a database has a log, from its header: see the SQLite file format. 0 for a file that is too short."""
    with path.open("rb") as file:
        return int.from_bytes(file.read(19)[18:])


def _is_not_empty(log: Path) -> bool:
    try:
        return log.stat().st_size > 0
    except OSError:  # it does not exist, or the map cannot be accessed either, which is reported for the map
        return False


def move_map(source: Path, target: Path) -> None:
    """Rename a closed map; an existing map of that name is replaced, with the files that SQLite keeps next to it. A
    symbolic link stays a link.

    Raises:
        Dpm2Error: the map is not complete in one file, since the disk was full, or does not exist; the existing map is
            kept.
    """
    _check_complete(source, target)
    with explaining(target):
        _remove_log(target.resolve())
        source.replace(target.resolve())


def name_map(source: Path, target: Path) -> None:
    """Rename a closed map to a name that no file has; if two programs want the same name, only one gets it.

    Raises:
        UsageError: the file, or a log of SQLite for it, exists already. Dpm2Error: as `move_map`.
    """
    _check_complete(source, target)
    check_new(target)
    try:
        os.link(source, target.resolve())
        source.unlink()
    except FileExistsError:
        raise already_there(target) from None
    except OSError:  # a file system without hard links, as on memory cards
        if target.exists():
            raise already_there(target) from None
        move_map(source, target)


def check_new(path: Path) -> None:
    """Raises UsageError if a new map cannot be made there: there is a file already, or a log that SQLite kept next to
    an old one and would use for the new one."""
    exists, log = path.exists(), left_log(path)  # an inaccessible path is reported as an error of that path
    if exists or path.exists():  # checked again: another program makes the file of a new map before its log
        raise already_there(path)
    if log is not None:
        raise UsageError(f"{log}: the last keyframes of a map that was moved or removed without them; {_ADVICE}")


def left_log(path: Path) -> Path | None:
    """A log that SQLite kept next to a map file, if there is one."""
    logs = (Path(f"{path.resolve()}{suffix}") for suffix in ("-wal", "-journal"))
    return next(filter(_is_not_empty, logs), None)


def already_there(path: Path) -> UsageError:
    """The error if a map is to be made where a file exists."""
    return UsageError(f"{path}: there is a file already")


def _check_complete(source: Path, target: Path) -> None:
    wal = Path(f"{source}-wal")
    if wal.exists() and wal.stat().st_size:  # see MapStore.close; renamed without it, the map would be damaged
        raise Dpm2Error(f"{target}: not written: the map could not be made one file; is the disk full?")


def remove_map(path: Path) -> None:
    """Remove a map file, if it exists, with the files that SQLite keeps next to it. Errors are ignored: the caller has
    the reason already, such as a read-only file system."""
    with suppress(OSError):
        path.unlink(missing_ok=True)
        _remove_log(path)


def _remove_log(path: Path) -> None:
    """Remove the files that SQLite keeps next to a map file: another map of that name would be damaged by them."""
    for suffix in ("-wal", "-shm", "-journal"):
        Path(f"{path}{suffix}").unlink(missing_ok=True)
