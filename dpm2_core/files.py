# SPDX-License-Identifier: Apache-2.0
"""Results reach the disk whole or not at all: a full disk or a kill leaves the file that was there before. And what
tells files apart."""

from __future__ import annotations

import hashlib
import json
import os
import re
import shutil
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from itertools import count
from math import isfinite
from pathlib import Path
from typing import IO, Any, Literal

from dpm2_core.errors import Dpm2Error, UsageError


@contextmanager
def explaining(path: Path | str, what: str = "not written") -> Iterator[None]:
    """What the system refuses within is an error that names `path`, and says `what` became of it and why.

    Raises:
        Dpm2Error: in the place of an OSError.
    """
    try:
        yield
    except OSError as error:
        raise Dpm2Error(f"{path}: {what}: {error.strerror or error}") from error


@contextmanager
def atomic_write(path: Path | str, mode: Literal["w", "wb"] = "w") -> Iterator[IO[Any]]:
    """A file that takes the name `path` when the block ends well, and vanishes when it does not.

    Folders on the way are made. A pipe or device (`/dev/stdout`) is written to directly: it cannot be replaced.

    Raises:
        Dpm2Error: the file could not be written; it names `path`, and what was there is untouched.
    """
    path = Path(path)
    target = path.resolve()  # a symbolic link stays one
    encoding = None if "b" in mode else "utf-8"
    with explaining(path):
        if path.exists() and not path.is_file() and not path.is_dir():
            with path.open(mode, encoding=encoding) as file:
                yield file
            return
        target.parent.mkdir(parents=True, exist_ok=True)
        part = part_beside(target)  # same folder: replacing is then atomic
        try:
            with part.open(mode, encoding=encoding) as file:
                yield file
                file.flush()
                os.fsync(file.fileno())
            part.replace(target)
        finally:
            with suppress(OSError):
                part.unlink()


def part_beside(path: Path) -> Path:
    """The hidden file or folder beside `path` in which this process writes what takes that name once it is whole; where
    `path` is a symbolic link, beside what it leads to, which may be on another disk.

    Those of processes that were killed are removed, with what SQLite keeps beside them.
    """
    own, path = os.getpid(), path.resolve()
    for left in path.parent.glob(".*.part*"):
        # a map that was to take that name began as another part, of this one
        part = re.fullmatch(rf"\.+{re.escape(path.name)}(?:\.\d+\.part)?\.(\d+)\.part(-\w+)?", left.name)
        if part and (int(part[1]) == own or not _alive(int(part[1]))):
            with suppress(OSError):
                shutil.rmtree(left) if left.is_dir() else left.unlink()
    return path.with_name(f".{path.name}.{own}.part")


@contextmanager
def named(path: Path, part: Path) -> Iterator[None]:
    """What fails while `part` is written names the file or folder at `path` that was asked for."""
    try:
        yield
    except Dpm2Error as error:
        error.args = (str(error).replace(str(part), str(path)),)
        raise


@contextmanager
def new_folder(path: Path, replace: bool = False) -> Iterator[Path]:
    """A folder that is named `path` when the block ends well, and is gone when it does not.

    An empty one that is there is filled in the order of the names: it stays, since a shell may be in it. With `replace`
    another one is there until then.

    Raises:
        Dpm2Error: it could not be written.
    """
    path = path.resolve()
    part = part_beside(path)
    replaced = part.with_name(f"{part.name}-replaced")
    try:
        with explaining(path):
            part.mkdir(parents=True)
            with named(path, part):
                yield part
            if path.is_dir() and not any(path.iterdir()):
                for entry in sorted(part.iterdir()):
                    entry.rename(path / entry.name)
            else:
                if replace and path.exists():
                    path.rename(replaced)
                part.rename(path)
    finally:
        shutil.rmtree(part, ignore_errors=True)
        shutil.rmtree(replaced, ignore_errors=True)


def _alive(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except PermissionError:
        return True
    except (OSError, OverflowError):
        return False
    return True


def write_json(path: Path | str, content: object) -> None:
    """JSON for people, too: indented, as one file.

    Raises:
        Dpm2Error: as `atomic_write`.
    """
    with atomic_write(path) as file:
        file.write(json_text(content))


def json_text(content: object, indent: int = 2) -> str:
    """Content as JSON; a number that is not finite becomes null, since JSON has no NaN, and a path text."""
    return json.dumps(_known(content), indent=indent, allow_nan=False, default=str) + "\n"


def _known(content: object) -> object:
    if isinstance(content, dict):
        return {key: _known(value) for key, value in content.items()}
    if isinstance(content, (list, tuple)):
        return [_known(value) for value in content]
    return None if isinstance(content, float) and not isfinite(content) else content


def make_folder(path: Path) -> None:
    """Make a folder for results, and those above it; one that is there stays.

    Raises:
        UsageError: there can be none; it names `path` and says why.
    """
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UsageError(f"{path}: no folder can be made there: {error.strerror or error}") from error


def numbered(path: Path, suffix: str = "") -> Iterator[Path]:
    """The path, and without end the same with -2, -3, ... before that suffix; a folder has none, though its name may
    have a dot."""
    yield path
    stem = path.name.removesuffix(suffix)
    yield from (path.with_name(f"{stem}-{n}{suffix}") for n in count(2))


def file_digest(path: Path) -> str:
    """SHA-256 of what a file holds.

    Raises:
        OSError: it cannot be read.
    """
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
