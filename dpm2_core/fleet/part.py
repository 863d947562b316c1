# SPDX-License-Identifier: Apache-2.0
"""Parts of a larger work: each is done once, in its own folder, so that a stopped work can be continued."""

from __future__ import annotations

import glob
import json
import multiprocessing
import resource
import shutil
import uuid
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import as_completed
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import lru_cache, partial
from pathlib import Path
from pkgutil import resolve_name
from time import perf_counter
from typing import Any, Literal, NamedTuple

from dpm2_core.config import Settings
from dpm2_core.console import Advance, untold
from dpm2_core.errors import Dpm2Error
from dpm2_core.evaluation.record import git_commit
from dpm2_core.files import atomic_write, explaining, file_digest, make_folder
from dpm2_core.workers import worker_pool

DONE = "part.json"
"""The record in the folder of a part that ended: its request and its figures."""

Figures = dict[str, Any]


@dataclass(frozen=True)
class Part:
    """A piece of work.

    Attributes:
        name: also its folder below that of the whole work, such as dpm2/06.
        work: MODULE:FUNCTION, called with the folder, a function for the progress, and the arguments; returns figures.
        arguments: anything that JSON can represent, paths and settings.
        inputs: files that it reads and another part may write, such as weights; a part whose inputs changed is done
            again.
        fresh: it begins with an empty folder, which gets its name once it is complete. Otherwise the work continues
            from the files of an earlier attempt.
        cores: processors that it uses.
        content: content of other data that it reads, such as the digest of a drive; a part is done again when it
            changed, except one that ended without a record of the content.
    """

    name: str
    work: str
    arguments: Mapping[str, Any]
    inputs: Sequence[Path] = field(default=())
    fresh: bool = False
    cores: int = 1
    content: str = ""


class Outcome(NamedTuple):
    """The outcome of a part: done now, kept from before, failed with the reason, or not done when it was stopped."""

    name: str
    state: Literal["done", "kept", "failed", "stopped"]
    figures: Figures | None = None
    reason: str = ""


@dataclass(frozen=True)
class Progress:
    """Functions that are called with the progress of the parts.

    Attributes:
        frame: name of the part, frames done, total frames; only if one part runs at a time.
        part: name of the part that is done, parts done, total parts.
    """

    frame: Callable[[str, int, int], None] = lambda name, done, total: None
    part: Callable[[str, int, int], None] = lambda name, done, total: None


def run_parts(
    parts: Sequence[Part], out: Path, workers: int = 1, progress: Progress | None = None
) -> dict[str, Figures]:
    """Figures of every part by its name. Those already done, with the same arguments and inputs, are only read.

    Args:
        workers: parts at a time; if more than one, each runs in its own process.

    Raises:
        Dpm2Error: a part failed; it is named. Or its process was killed. Parts that are done are kept.
    """
    progress = progress or Progress()
    found = {part.name: figures for part in parts if (figures := figures_of(part, out)) is not None}
    missing = [part for part in parts if part.name not in found]
    for name, figures in _do_missing(missing, out, workers, progress):
        found[name] = figures
        progress.part(name, len(found), len(parts))
    return {part.name: found[part.name] for part in parts}


def _do_missing(parts: Sequence[Part], out: Path, workers: int, progress: Progress) -> Iterator[tuple[str, Figures]]:
    """Do the parts, and yield the figures of each as it ends."""
    if workers < 2 or len(parts) < 2:
        for part in parts:
            yield part.name, _do_with_named_errors(part, out, partial(progress.frame, part.name))
        return
    context = multiprocessing.get_context("spawn")  # a fork would inherit torch's threads only partly
    with worker_pool(workers, context) as pool:
        running = {pool.submit(_do_with_named_errors, part, out): part.name for part in parts}
        for future in as_completed(running):
            yield running[future], future.result()


def _do_with_named_errors(part: Part, out: Path, advance: Advance = untold) -> Figures:
    try:
        return do_part(part, out, advance)
    except Dpm2Error as error:
        raise type(error)(f"{part.name}: {error}") from error


def do_part(part: Part, out: Path, advance: Advance = untold) -> Figures:
    """Do a part in this process, whether it was done before or not; returns its figures.

    Raises:
        Dpm2Error: it failed, or its results could not be written. A fresh part then leaves no files.
    """
    began = perf_counter()
    with _work_folder(part, out) as folder:
        figures: Figures = resolve_name(part.work)(folder, advance, **part.arguments)
        record = {
            **_request(part),
            "commit": git_commit(),
            "seconds": round(perf_counter() - began, 1),
            "peak_memory_mb": round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024),  # of the process so far
            "files": _sizes(folder) if part.fresh else {},
            "figures": figures,
        }
        with atomic_write(folder / DONE) as file:
            file.write(json.dumps(record, indent=1, default=_json_value) + "\n")
    return _figures_in(record)


def figures_of(part: Part, out: Path) -> Figures | None:
    """Figures of a part that ended; None if it has not ended, had another request, or is not complete."""
    try:
        request = json.loads(json.dumps(_request(part), default=_json_value))
        record = {"content": part.content, **json.loads((out / part.name / DONE).read_text(encoding="utf-8"))}
        if any(record[key] != request[key] for key in request):
            return None
        return _figures_in(record) if is_whole(out / part.name) else None
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        return None


def is_whole(folder: Path) -> bool:
    """Whether a fresh part that ended still has all its files, none of them truncated since."""
    try:
        listed = json.loads((folder / DONE).read_text(encoding="utf-8"))["files"].items()
        return all((folder / name).stat().st_size == size for name, size in listed)
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        return False


def remove_attempts(part: Part, out: Path) -> None:
    """Remove the files of killed attempts; none may be running."""
    folder = out / part.name
    for attempt in folder.parent.glob(f".{glob.escape(folder.name)}.*.attempt"):
        shutil.rmtree(attempt, ignore_errors=True)


@contextmanager
def _work_folder(part: Part, out: Path) -> Iterator[Path]:
    """The folder to work in: the part's own, or one that replaces it at the end of the block.

    No two attempts work in the same folder: a worker that was considered dead may still be running.
    """
    folder = out / part.name
    if not part.fresh:
        make_folder(folder)
        yield folder
        return
    attempt, old = (folder.with_name(f".{folder.name}.{uuid.uuid4().hex}.attempt") for _ in range(2))
    try:
        with explaining(folder):
            attempt.mkdir(parents=True)
            inode = attempt.stat().st_ino
        yield attempt
        with explaining(folder):
            if attempt.stat().st_ino != inode:  # removed meanwhile, and made again by a later write
                raise Dpm2Error(f"{attempt}: removed while it was written to")
            if figures_of(part, out) is None:  # else another attempt with the same result was first
                if folder.exists():
                    folder.rename(old)
                attempt.rename(folder)
    finally:
        shutil.rmtree(attempt, ignore_errors=True)
        shutil.rmtree(old, ignore_errors=True)


def _sizes(folder: Path) -> dict[str, int]:
    """Bytes of each file in a folder and below."""
    return {str(path.relative_to(folder)): path.stat().st_size for path in sorted(folder.rglob("*")) if path.is_file()}


def _figures_in(record: Mapping[str, Any]) -> Figures:
    return {**record["figures"], "part": {key: record[key] for key in ("commit", "seconds", "peak_memory_mb")}}


def _json_value(argument: object) -> object:
    """Convert an object that JSON cannot represent."""
    return argument.model_dump(mode="json") if isinstance(argument, Settings) else str(argument)


def _request(part: Part) -> dict[str, Any]:
    inputs = {str(path): _digest(path) for path in part.inputs}
    return {"arguments": dict(part.arguments), "inputs": inputs, "content": part.content}


def _digest(path: Path) -> str | None:
    if not path.is_file():
        return None
    stat = path.stat()
    return _file_hash(path, stat.st_mtime_ns, stat.st_size)


@lru_cache
def _file_hash(path: Path, mtime_ns: int, size: int) -> str:
    """SHA-256 of a file, cached: many parts read the same weights. `mtime_ns` and `size`: its current ones."""
    return file_digest(path)
