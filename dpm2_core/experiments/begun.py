# SPDX-License-Identifier: Apache-2.0
"""A training in the folder of a part: it goes on from its checkpoint, unless something else is asked for now."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from pathlib import Path

from dpm2_core.files import atomic_write, file_digest, make_folder

_BEGUN, _CHECKPOINT, LOG = "begun.yaml", "checkpoint.pt", "log.jsonl"


def begin_training(folder: Path, text: str, weights: str, read: Sequence[Path] = (), start: Path | None = None) -> bool:
    """Ready a folder for a training that is asked for by `text`; whether there is a checkpoint to go on from.

    What a training that was asked for by another text, or from other files, has left there is removed, the file
    `weights` among it.

    Args:
        read: files that the training begins with, such as weights.
        start: folder of a training whose checkpoint and log a new one goes on from.
    """
    make_folder(folder)
    begun = folder / _BEGUN
    files = [*read, *([] if start is None else [start / _CHECKPOINT])]
    text += "".join(f"# {path}: {file_digest(path) if path.is_file() else 'missing'}\n" for path in files)
    if not (begun.is_file() and begun.read_text(encoding="utf-8") == text):
        for old in (_CHECKPOINT, LOG, weights):
            (folder / old).unlink(missing_ok=True)
        if start is not None:
            for kept in (_CHECKPOINT, LOG):
                shutil.copy(start / kept, folder / kept)
        with atomic_write(begun) as file:  # the last: what is killed before is begun anew
            file.write(text)
    return (folder / _CHECKPOINT).exists()
