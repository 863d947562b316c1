# SPDX-License-Identifier: Apache-2.0
"""A training in a folder goes on from its checkpoint, unless something else is asked for now: then one of an experiment
begins anew, and one that a user resumes is an error."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from dpm2_core.config import Settings
from dpm2_core.errors import UsageError
from dpm2_core.files import file_digest, json_text, make_folder, write_json
from dpm2_core.learning.checkpoint import CHECKPOINT, LOG, WEIGHTS, held

_ASKED = "begun.json"
"""What was asked for when the training in this folder began."""
_FREE = {"workers", "save_every", "validate_every"}  # they do not change what is learned
_CONTENT = "content of "


def begin_training(
    folder: Path,
    settings: Settings,
    read: Sequence[Path] = (),
    data: dict[str, Any] | None = None,
    start: Path | None = None,
) -> None:
    """Ready a folder for a training: what one that was asked for otherwise has left there is removed.

    Args:
        read, data: as of `begin_or_resume`.
        start: folder of a training whose checkpoint and log a new one goes on from.

    Raises:
        UsageError: another training is writing there.
    """
    make_folder(folder)
    _check_free(folder)
    asked, now = folder / _ASKED, _asked(settings, [*read, *([] if start is None else [start / CHECKPOINT])], data)
    if not asked.is_file() or _before(asked) != now:
        for old in (CHECKPOINT, LOG, WEIGHTS):
            (folder / old).unlink(missing_ok=True)
        if start is not None:
            for kept in (CHECKPOINT, LOG):
                shutil.copy(start / kept, folder / kept)
        write_json(asked, now)  # the last: what is killed before is begun anew


def begin_or_resume(
    folder: Path, resume: bool, settings: Settings, read: Sequence[Path] = (), data: dict[str, Any] | None = None
) -> None:
    """Ready a folder for a training that a user asks for; with `resume`, for what was asked for when it began.

    Settings that do not change what is learned may differ. A folder that does not say what was asked for is gone on
    with.

    Args:
        read: files that the training begins with, such as weights; their content counts.
        data: what it learns from, beside the settings.

    Raises:
        UsageError: another training is writing there, there is one that is not to be resumed, there is none to resume,
            or it was asked for something else; the message names the first setting that differs, and both values, or
            one that there is no more.
    """
    _check_free(folder)
    asked, there = folder / _ASKED, (folder / CHECKPOINT).exists()
    if there and not resume:
        raise UsageError(f"{folder}: holds a training; --resume continues it, another --out keeps it")
    if resume and not there:
        raise UsageError(f"{folder}: no {CHECKPOINT} to resume")
    now = _asked(settings, read, data)
    if not resume or not asked.is_file():
        write_json(asked, now)
        return
    by_default = type(settings).model_construct()  # of the overlap's training, which needs `start`, all the others
    before = {**_plain(dict(_values(by_default))), **_before(asked)}  # a setting of later was as by default
    for key in [*now, *before]:
        if key in now and before.get(key, now[key]) != now[key]:
            name, old, new = _difference(key, before[key], now[key])
            raise UsageError(f"{folder}: began with {name} {old}, not {new}; --resume goes on with the same alone")
        if key not in now and not key.startswith(_CONTENT):  # that of other files is named by the settings
            raise UsageError(f"{folder}: began with {key} {before[key]}, a setting of another version of dpm2")


def check_one_process(command: str) -> None:
    """Raise UsageError under torchrun, for a command whose processes would all do the same, in the same folder."""
    if _processes() > 1:
        raise UsageError(f"dpm2 {command}: works in one process; torchrun is for dpm2 train image, phase1 and phase2")


def is_first_process() -> bool:
    """Whether this one says what is to be said once: the first of those that torchrun started, or the only one."""
    return os.environ.get("RANK", "0") == "0"


def _check_free(folder: Path) -> None:
    """Raise UsageError where a training is writing in a folder. The processes of one look before any of them writes."""
    if folder.is_dir():
        with held(folder, looking=True):
            pass


def _processes() -> int:
    return int(os.environ.get("WORLD_SIZE", "1"))


def _asked(settings: Settings, read: Sequence[Path], data: dict[str, Any] | None) -> dict[str, Any]:
    """All that changes what is learned, as it is read again."""
    content = {f"{_CONTENT}{path}": _content(path) for path in read}
    return _plain({**dict(_values(settings)), **content, **(data or {}), "processes": _processes()})


def _plain(tree: dict[str, Any]) -> dict[str, Any]:
    """As it is read from a file."""
    return dict(json.loads(json_text(tree)))


def _before(asked: Path) -> dict[str, Any]:
    """What was asked for when the training began.

    Raises:
        UsageError: the file is damaged.
    """
    try:
        return dict(json.loads(asked.read_text(encoding="utf-8")))
    except (OSError, ValueError, TypeError) as error:
        raise UsageError(f"{asked}: {error}") from None


def _content(path: Path) -> str:
    return file_digest(path) if path.is_file() else "missing"


def _values(settings: Settings, prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Dotted keys and values of what changes what is learned."""
    for name, value in settings:
        if isinstance(value, Settings):
            yield from _values(value, f"{prefix}{name}.")
        elif name not in _FREE:
            yield f"{prefix}{name}", settings.model_dump(mode="json", include={name})[name]


def _difference(name: str, before: Any, now: Any) -> tuple[str, Any, Any]:
    """The first key in which two values differ, at any depth, and its values."""
    if isinstance(before, dict) and isinstance(now, dict):
        for key in [*now, *before]:
            if before.get(key) != now.get(key):
                return _difference(f"{name}.{key}", before.get(key), now.get(key))
    return name, before, now
