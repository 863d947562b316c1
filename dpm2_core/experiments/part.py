# SPDX-License-Identifier: Apache-2.0
"""The parts of an experiment: each done once, in a folder of its own, so that what was stopped goes on."""

from __future__ import annotations

import hashlib
import json
import multiprocessing
import resource
import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass, field
from functools import partial
from importlib import import_module
from pathlib import Path
from time import perf_counter
from typing import Any

from dpm2_core.errors import Dpm2Error
from dpm2_core.evaluation.record import git_commit
from dpm2_core.files import atomic_write

_BEGUN, _CHECKPOINT, LOG = "begun.yaml", "checkpoint.pt", "log.jsonl"
DONE = "part.json"
"""In the folder of a part that ended: what it was asked for, and its figures."""

Figures = dict[str, Any]
Advance = Callable[[int, int], None]
"""Told how many frames are done, of how many."""


@dataclass(frozen=True)
class Part:
    """A piece of work.

    Attributes:
        name: also its folder below the experiment's, such as dpm2/06.
        work: MODULE:FUNCTION, called with the folder, a function to be told of the progress, and the arguments;
            returns figures.
        arguments: whatever JSON can hold.
        inputs: files that it reads and another part may write, such as weights; a part whose inputs changed is done
            again.
    """

    name: str
    work: str
    arguments: Mapping[str, Any]
    inputs: Sequence[Path] = field(default=())


@dataclass(frozen=True)
class Progress:
    """What is called as parts go on.

    Attributes:
        frame: name of the part, frames done, frames in all; only where one part runs at a time.
        part: name of the part that is done, parts done, parts in all.
    """

    frame: Callable[[str, int, int], None] = lambda name, done, total: None
    part: Callable[[str, int, int], None] = lambda name, done, total: None


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


def run_parts(
    parts: Sequence[Part], out: Path, workers: int = 1, progress: Progress | None = None
) -> dict[str, Figures]:
    """Figures of every part by its name. Those that are done, with the same arguments and inputs, are only read.

    Args:
        workers: parts at a time; more than one run in processes of their own.

    Raises:
        Dpm2Error: a part failed; it is named. Those that are done stay.
    """
    progress = progress or Progress()
    found = {part.name: figures for part in parts if (figures := _done(part, out)) is not None}
    missing = [part for part in parts if part.name not in found]
    for name, figures in _fresh(missing, out, workers, progress):
        found[name] = figures
        progress.part(name, len(found), len(parts))
    return {part.name: found[part.name] for part in parts}


def _fresh(parts: Sequence[Part], out: Path, workers: int, progress: Progress) -> Iterator[tuple[str, Figures]]:
    """Do the parts, each as it ends."""
    if workers < 2 or len(parts) < 2:
        for part in parts:
            yield part.name, _do(part, out, partial(progress.frame, part.name))
        return
    context = multiprocessing.get_context("spawn")  # a fork would inherit torch's threads half
    with ProcessPoolExecutor(workers, mp_context=context) as pool:
        running = {pool.submit(_do, part, out): part.name for part in parts}
        try:
            for future in as_completed(running):
                yield running[future], future.result()
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise


def _do(part: Part, out: Path, advance: Advance = lambda done, total: None) -> Figures:
    module, _, name = part.work.partition(":")
    work = getattr(import_module(module), name)
    folder = out / part.name
    folder.mkdir(parents=True, exist_ok=True)
    began = perf_counter()
    try:
        figures: Figures = work(folder, advance, **part.arguments)
    except Dpm2Error as error:
        raise type(error)(f"{part.name}: {error}") from error
    record = {
        **_asked(part),
        "commit": git_commit(),
        "seconds": round(perf_counter() - began, 1),
        "peak_memory_mb": round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024),  # of the process so far
        "figures": figures,
    }
    with atomic_write(folder / DONE) as file:
        file.write(json.dumps(record, indent=1) + "\n")
    return {**figures, "part": {key: record[key] for key in ("commit", "seconds", "peak_memory_mb")}}


def _done(part: Part, out: Path) -> Figures | None:
    """What a part that ended has found; None where it has not, or was asked for something else."""
    try:
        record = json.loads((out / part.name / DONE).read_text(encoding="utf-8"))
        if {key: record[key] for key in ("arguments", "inputs")} != json.loads(json.dumps(_asked(part))):
            return None
        return {**record["figures"], "part": {key: record[key] for key in ("commit", "seconds", "peak_memory_mb")}}
    except (OSError, ValueError, KeyError, TypeError):
        return None


def _asked(part: Part) -> dict[str, Any]:
    digests = {
        str(path): hashlib.sha256(path.read_bytes()).hexdigest() if path.is_file() else None for path in part.inputs
    }
    return {"arguments": dict(part.arguments), "inputs": digests}
