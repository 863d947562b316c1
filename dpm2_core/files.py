# SPDX-License-Identifier: Apache-2.0
"""Writes results whole or not at all: after a full disk or a kill the previous file is still there. Also digests and
file names."""

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
    """Replace an OSError within the block by an error with `path`, `what` became of it, and the reason.

    Raises:
        Dpm2Error: instead of an OSError.
    """
    try:
        yield
    except OSError as error:
        raise Dpm2Error(f"{path}: {what}: {error.strerror or error}") from error


@contextmanager
def atomic_write(path: Path | str, mode: Literal["w", "wb"] = "w") -> Iterator[IO[Any]]:
    """A file that gets the name `path` when the block ends without an error, and is removed otherwise.

    Missing parent folders are made. A pipe or device (`/dev/stdout`) is written directly: it cannot be replaced.

    Raises:
        Dpm2Error: the file could not be written; it names `path`, and the previous file is unchanged.
    """
    path = Path(path)
    target = path.resolve()  # a symbolic link stays a link
    encoding = None if "b" in mode else "utf-8"
    with explaining(path):
        if is_stream(path):
            with path.open(mode, encoding=encoding) as file:
                yield file
            return
        target.parent.mkdir(parents=True, exist_ok=True)
        part = part_beside(target)  # in the same folder, so that replacing is atomic
        try:
            with part.open(mode, encoding=encoding) as file:
                yield file
                file.flush()
                os.fsync(file.fileno())
            part.replace(target)
        finally:
            with suppress(OSError):
                part.unlink()


def is_stream(path: Path) -> bool:
    """Whether a path is that of a pipe, a socket or a device, whose content may have no end."""
    return path.exists() and not path.is_file() and not path.is_dir()


def part_beside(path: Path) -> Path:
    """The hidden file or folder next to `path` where this process writes the content until it is complete. If `path` is
    a symbolic link, it is next to the link's target, which may be on another disk.

    Those of killed processes are removed, with the files that SQLite keeps next to them.
    """
    own, path = os.getpid(), path.resolve()
    for leftover in path.parent.glob(".*.part*"):
        # a map under construction is written through a part of its own, whose name is then that of a part of a part
        part = re.fullmatch(rf"\.+{re.escape(path.name)}(?:\.\d+\.part)?\.(\d+)\.part(-\w+)?", leftover.name)
        if part and (int(part[1]) == own or not _is_alive(int(part[1]))):
            with suppress(OSError):
                shutil.rmtree(leftover) if leftover.is_dir() else leftover.unlink()
    return path.with_name(f".{path.name}.{own}.part")


@contextmanager
def named(path: Path, part: Path) -> Iterator[None]:
    """Errors while `part` is written name the file or folder at `path` that was requested."""
    try:
        yield
    except Dpm2Error as error:
        error.args = (str(error).replace(str(part), str(path)),)
        raise


@contextmanager
def new_folder(path: Path, replace: bool = False) -> Iterator[Path]:
    """A folder that gets the name `path` when the block ends without an error, and is removed otherwise.

    If `path` is an empty folder, it is filled in the order of the names and not replaced, since a shell may be in it.
    With `replace`, a folder with content stays until the new one is complete.

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


def _is_alive(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except PermissionError:
        return True
    except (OSError, OverflowError):
        return False
    return True


def write_json(path: Path | str, content: object) -> None:
    """Write indented JSON, which people can read too, as one file.

    Raises:
        Dpm2Error: as `atomic_write`.
    """
    with atomic_write(path) as file:
        file.write(json_text(content))


def json_text(content: object, indent: int = 2) -> str:
    """Content as JSON: numbers that are not finite become null, since JSON has no NaN, and paths become text."""
    return json.dumps(_finite_or_null(content), indent=indent, allow_nan=False, default=str) + "\n"


def _finite_or_null(content: object) -> object:
    if isinstance(content, dict):
        return {key: _finite_or_null(value) for key, value in content.items()}
    if isinstance(content, (list, tuple)):
        return [_finite_or_null(value) for value in content]
    return None if isinstance(content, float) and not isfinite(content) else content


def make_folder(path: Path) -> None:
    """Make a folder for results and its parents; an existing folder is kept.

    Raises:
        UsageError: the folder cannot be made; the message has `path` and the reason.
    """
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UsageError(f"{path}: no folder can be made there: {error.strerror or error}") from error


def numbered(path: Path, suffix: str = "") -> Iterator[Path]:
    """The path, then without end the same with -2, -3, ... before `suffix`; a folder has no suffix, though its name may
    contain a dot."""
    yield path
    stem = path.name.removesuffix(suffix)
    yield from (path.with_name(f"{stem}-{n}{suffix}") for n in count(2))


def file_digest(path: Path) -> str:
    """SHA-256 of the content of a file.

    Raises:
        OSError: it cannot be read.
    """
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
