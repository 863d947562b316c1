# SPDX-License-Identifier: Apache-2.0
"""A training in the folder of a part: it goes on from its checkpoint, unless something else is asked for now."""

from __future__ import annotations

import shutil
from pathlib import Path

from dpm2_core.files import atomic_write

_BEGUN, _CHECKPOINT, LOG = "begun.yaml", "checkpoint.pt", "log.jsonl"


def begin_training(folder: Path, text: str, weights: str, start: Path | None = None) -> bool:
    """Ready a folder for a training that is asked for by `text`; whether there is a checkpoint to go on from.

    What a training asked for by another text has left there, the file `weights` among it, is removed.

    Args:
        start: folder of a training whose checkpoint and log a new one goes on from.
    """
    begun = folder / _BEGUN
    if not (begun.is_file() and begun.read_text(encoding="utf-8") == text):
        for old in (_CHECKPOINT, LOG, weights):
            (folder / old).unlink(missing_ok=True)
        if start is not None:
            for kept in (_CHECKPOINT, LOG):
                shutil.copy(start / kept, folder / kept)
        with atomic_write(begun) as file:  # the last: what is killed before is begun anew
            file.write(text)
    return (folder / _CHECKPOINT).exists()
