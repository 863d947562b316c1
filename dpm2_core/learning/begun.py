# SPDX-License-Identifier: Apache-2.0
"""A training continues from the checkpoint in its folder, unless its settings or inputs have changed. Then the training
of an experiment starts again, and resuming one as a user is an error."""

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
from dpm2_core.learning.checkpoint import CHECKPOINT, LOG, WEIGHTS, folder_lock

_RECORD_FILE = "begun.json"
"""Settings and inputs with which the training in this folder began."""
_IGNORED_KEYS = {"workers", "save_every", "validate_every"}  # they do not change what is learned
_CONTENT_PREFIX = "content of "


def begin_training(
    folder: Path,
    settings: Settings,
    read: Sequence[Path] = (),
    data: dict[str, Any] | None = None,
    start: Path | None = None,
) -> None:
    """Prepare a folder for a training: files of a training with other settings or inputs are removed.

    Args:
        read, data: as of `begin_or_resume`.
        start: folder of a training from whose checkpoint and log a new one continues.

    Raises:
        UsageError: another training is writing there.
    """
    make_folder(folder)
    _check_unlocked(folder)
    record, current = (
        folder / _RECORD_FILE,
        _current_record(settings, [*read, *([] if start is None else [start / CHECKPOINT])], data),
    )
    if not record.is_file() or _read_record(record) != current:
        for name in (CHECKPOINT, LOG, WEIGHTS):
            (folder / name).unlink(missing_ok=True)
        if start is not None:
            for name in (CHECKPOINT, LOG):
                shutil.copy(start / name, folder / name)
        write_json(record, current)  # last: if killed before this, the training starts again


def begin_or_resume(
    folder: Path, resume: bool, settings: Settings, read: Sequence[Path] = (), data: dict[str, Any] | None = None
) -> None:
    """Prepare a folder for a user's training; with `resume`, check that settings and inputs are those it began with.

    Settings that do not change what is learned may differ. A folder without a record of settings and inputs is
    accepted.

    Args:
        read: files that the training begins with, such as weights; their content is compared.
        data: what it learns from, in addition to the settings.

    Raises:
        UsageError: another training is writing there, there is a training but no `resume`, there is none to resume, or
            it began with something else. The message names the first setting that differs, and both values, or a
            setting that no longer exists.
    """
    _check_unlocked(folder)
    record, has_checkpoint = folder / _RECORD_FILE, (folder / CHECKPOINT).exists()
    if has_checkpoint and not resume:
        raise UsageError(f"{folder}: contains a training; continue it with --resume, or choose another --out")
    if resume and not has_checkpoint:
        raise UsageError(f"{folder}: no {CHECKPOINT} to resume")
    current = _current_record(settings, read, data)
    if not resume or not record.is_file():
        write_json(record, current)
        return
    defaults = type(settings).model_construct()  # for the overlap training, which needs `start`: the others
    # A setting that was added later had its default.
    before = {**_as_read(dict(_relevant_values(defaults))), **_read_record(record)}
    for key in [*current, *before]:
        if key in current and before.get(key, current[key]) != current[key]:
            name, old, new = _difference(key, before[key], current[key])
            raise UsageError(f"{folder}: began with {name} {old}, not {new}; --resume needs the same settings")
        if key not in current and not key.startswith(_CONTENT_PREFIX):  # content of files that the settings name
            raise UsageError(f"{folder}: began with {key} {before[key]}, a setting of another version of dpm2")


def check_one_process(command: str) -> None:
    """Raise UsageError under torchrun, for a command whose processes would all do the same work in the same folder."""
    if _processes() > 1:
        raise UsageError(
            f"dpm2 {command}: start it without torchrun, which works only with dpm2 train image, phase1 and phase2"
        )


def is_first_process() -> bool:
    """Whether this process prints what is printed only once: the first one that torchrun started, or the only one."""
    return os.environ.get("RANK", "0") == "0"


def _check_unlocked(folder: Path) -> None:
    """Raise UsageError if a training is writing in a folder. Its own processes check this before any of them writes."""
    if folder.is_dir():
        with folder_lock(folder, shared=True):
            pass


def _processes() -> int:
    return int(os.environ.get("WORLD_SIZE", "1"))


def _current_record(settings: Settings, read: Sequence[Path], data: dict[str, Any] | None) -> dict[str, Any]:
    """Everything that changes what is learned, in the form in which it is read from a file."""
    content = {f"{_CONTENT_PREFIX}{path}": _digest(path) for path in read}
    return _as_read({**dict(_relevant_values(settings)), **content, **(data or {}), "processes": _processes()})


def _as_read(tree: dict[str, Any]) -> dict[str, Any]:
    """The tree in the form in which it is read from a file."""
    return dict(json.loads(json_text(tree)))


def _read_record(path: Path) -> dict[str, Any]:
    """The settings and inputs with which the training began.

    Raises:
        UsageError: the file is damaged.
    """
    try:
        return dict(json.loads(path.read_text(encoding="utf-8")))
    except (OSError, ValueError, TypeError) as error:
        raise UsageError(f"{path}: {error}") from None


def _digest(path: Path) -> str:
    return file_digest(path) if path.is_file() else "missing"


def _relevant_values(settings: Settings, prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Dotted keys and values of the settings that change what is learned."""
    for name, value in settings:
        if isinstance(value, Settings):
            yield from _relevant_values(value, f"{prefix}{name}.")
        elif name not in _IGNORED_KEYS:
            yield f"{prefix}{name}", settings.model_dump(mode="json", include={name})[name]


def _difference(name: str, before: Any, after: Any) -> tuple[str, Any, Any]:
    """The first key in which two values differ, at any depth, and its values."""
    if isinstance(before, dict) and isinstance(after, dict):
        for key in [*after, *before]:
            if before.get(key) != after.get(key):
                return _difference(f"{name}.{key}", before.get(key), after.get(key))
    return name, before, after
