# SPDX-License-Identifier: Apache-2.0
"""Common parts of the benchmarks: drives to run on, the same processors for all methods, and the record."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from itertools import count
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from rich.console import RenderableType

from dpm2_core.config import load_settings
from dpm2_core.data.open import open_source
from dpm2_core.data.source import Source
from dpm2_core.errors import Dpm2Error, UsageError
from dpm2_core.evaluation.record import REPOSITORY, write_record
from dpm2_core.extras import MissingPackageError
from dpm2_core.frame import Array
from dpm2_core.openmp import allowed
from dpm2_core.slam.settings import Config, SlamSettings

T = TypeVar("T")


@dataclass(frozen=True)
class Options:
    """Options of `dpm2 bench`.

    Attributes:
        sources: KITTI sequences or bags; by default the KITTI excerpt.
        repetitions: number of runs of every method on every drive.
        threads: processors that every method may use.
        overrides: `key=value` settings of the SLAM, and of how drives are read.
        unseen: packed drives of worlds that the network has not been trained on; None makes some.
        pairs: number of frame pairs of each kind.
        only: part of a benchmark that has several; None: all parts that are not in its file yet.
        out: folder of NAME.json. cache: folder where simulated drives are kept for later runs.
    """

    sources: Sequence[Path] = ()
    repetitions: int = 3
    threads: int = 2
    overrides: Sequence[str] = ()
    unseen: Path | None = None
    pairs: int = 60
    only: str | None = None
    out: Path = Path("benchmarks")
    cache: Path = Path("out/bench")


def excerpt() -> Path:
    """Folder of the KITTI excerpt, packed (with unpack.py) or in KITTI layout: $DPM2_KITTI, or a folder next to the
    repository."""
    return Path(os.environ.get("DPM2_KITTI", REPOSITORY.parent / "shared" / "kitti"))


def settings_of(options: Options, *more: str) -> SlamSettings:
    """Settings of the SLAM for the options, with `more` settings such as `slam.registration=neural`."""
    return configuration_of(options, *more).slam


def configuration_of(options: Options, *more: str) -> Config:
    """The same, with the settings for reading drives."""
    return load_settings(Config, None, [f"slam.threads={options.threads}", *options.overrides, *more])


def requested(options: Options, parts: Collection[str]) -> list[str]:
    """The part of a benchmark that `--only` names, else all parts.

    Raises:
        UsageError: there is no such part.
    """
    if options.only is None:
        return list(parts)
    if options.only not in parts:
        raise UsageError(f"--only {options.only}: no such part; choose from {', '.join(parts)}")
    return [options.only]


def installed(methods: Mapping[str, Callable[[], T]]) -> dict[str, T]:
    """Call the constructor of each method; methods whose package is missing are left out."""
    made: dict[str, T] = {}
    for name, make in methods.items():
        with suppress(MissingPackageError):
            made[name] = make()
    return made


@dataclass(frozen=True)
class Report:
    """A benchmark's outcome: `results` for JSON, `view` for the terminal."""

    results: dict[str, Any]
    view: RenderableType


@contextmanager
def drives(options: Options, more: Sequence[Source] = ()) -> Iterator[dict[str, Source]]:
    """The drives to run on, by name, followed by `more`; a packed excerpt is unpacked for the duration of the block.

    A drive with the same name as an earlier one, such as a second folder `00`, is named `00 (2)`.

    Raises:
        UsageError: there are no drives.
    """
    how = configuration_of(options).input
    if options.sources:
        yield _named([*(open_source(path, how) for path in options.sources), *more])
        return
    kitti = excerpt()
    if not kitti.is_dir():
        raise UsageError(
            f"{kitti}: no KITTI excerpt; set DPM2_KITTI, or give --source with a drive such as `dpm2 sim` makes"
        )
    with tempfile.TemporaryDirectory(prefix="dpm2_bench_") as folder:
        root = kitti
        if (kitti / "unpack.py").is_file():
            root = Path(folder)
            done = subprocess.run([sys.executable, str(kitti / "unpack.py"), folder], capture_output=True, text=True)
            if done.returncode:
                raise Dpm2Error(f"{kitti / 'unpack.py'}: {done.stderr.strip().splitlines()[-1:]}")
        sequences = sorted(path for path in (root / "sequences").glob("*") if (path / "velodyne").is_dir())
        if not sequences:
            raise UsageError(f"{kitti}: contains neither unpack.py nor sequences/NN/velodyne")
        yield _named([*(open_source(path, how) for path in sequences), *more])


def truth_of(source: Source) -> Array:
    """True poses (N, 4, 4) of a drive.

    Raises:
        UsageError: the drive has no ground truth.
    """
    if source.poses is None:
        raise UsageError(f"{source.name}: the drive has no ground truth to compare with")
    return source.poses


def _named(sources: Iterable[Source]) -> dict[str, Source]:
    found: dict[str, Source] = {}
    for source in sources:
        names = (source.name if n == 1 else f"{source.name} ({n})" for n in count(1))
        found[next(name for name in names if name not in found)] = source
    return found


@contextmanager
def processors(number: int) -> Iterator[None]:
    """Bind this process to `number` processors, so that every library has the same number."""
    if not hasattr(os, "sched_setaffinity"):  # not Linux: only each method's own thread setting applies
        yield
        return
    before = os.sched_getaffinity(0)
    os.sched_setaffinity(0, sorted(before)[:number])
    try:
        yield
    finally:
        os.sched_setaffinity(0, before)


@contextmanager
def torch_threads(number: int) -> Iterator[None]:
    """Set the number of torch's threads for the duration of the block."""
    import torch

    before = torch.get_num_threads()
    torch.set_num_threads(allowed(number))
    try:
        yield
    finally:
        torch.set_num_threads(before)


def write_report(path: Path, report: Report, options: Options, program: str = "dpm2") -> None:
    """Write the results of a benchmark; see `write_record`."""
    results = {"overrides": list(options.overrides), **report.results}
    write_record(path, results, program, options.threads)


def earlier(path: Path, key: str, **same: Any) -> dict[str, Any]:
    """The value of a key in the JSON of an earlier run; {} if it is missing, damaged, or differs in `same`."""
    try:
        record = json.loads(path.read_text(encoding="utf-8"))
        as_written = json.loads(json.dumps(same))  # converts tuples to lists
        return dict(record[key]) if all(record[name] == value for name, value in as_written.items()) else {}
    except (OSError, ValueError, KeyError, TypeError):
        return {}


def rounded(x: float) -> float:
    """Round to four digits."""
    return float(f"{x:.4g}")


def quantiles_ms(seconds: Sequence[float] | Array) -> dict[str, float]:
    """Median and 95th percentile of (N,) seconds, ms."""
    median, p95 = np.percentile(1e3 * np.asarray(seconds), [50, 95])
    return {"median": round(float(median), 2), "p95": round(float(p95), 2)}
