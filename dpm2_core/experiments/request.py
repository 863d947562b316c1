# SPDX-License-Identifier: Apache-2.0
"""The options of `dpm2 experiment`, the definition of an experiment, and its findings."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from dpm2_core.data.source import Span
from dpm2_core.experiments.table import ResultTable
from dpm2_core.extras import MissingPackageError
from dpm2_core.fleet.part import Figures, Part


@dataclass(frozen=True)
class Request:
    """Options of `dpm2 experiment`; None or empty if they were not given.

    Attributes:
        data: root of the data set. out: folder of the results.
        sequences: to test on; by default those of the paper that the data set has.
        learn: to learn from, likewise.
        weights: a name or a file. registrations: of the SLAM, one row each.
        peers: other programs, or NAME=FILE with their trajectories.
        lengths: segment lengths of the KITTI metric, m. frames: of each sequence.
        seeds: trainings of each arm. config: YAML of the training. overrides: KEY=VALUE.
    """

    data: Path
    out: Path
    sequences: tuple[str, ...] = ()
    learn: tuple[str, ...] = ()
    weights: str | None = None
    registrations: tuple[str, ...] = ()
    peers: tuple[str, ...] = ()
    lengths: tuple[float, ...] | None = None
    frames: Span | None = None
    seeds: int | None = None
    config: Path | None = None
    overrides: tuple[str, ...] = ()
    workers: int = 1

    @property
    def config_files(self) -> list[Path]:
        """The YAML of the training, if any: the inputs of a part, which is done again when its content changes."""
        return [] if self.config is None else [self.config]


@dataclass
class Findings:
    """The results of an experiment.

    Attributes:
        tables: those of the paper, with our rows. notes: what a reader must know, in words.
        runs: folders of runs by sequence and name, for the report.
    """

    tables: list[ResultTable]
    notes: list[str] = field(default_factory=list)
    runs: dict[str, dict[str, Path]] = field(default_factory=dict)
    extra: dict[str, Any] = field(default_factory=dict)


def draw_if_possible(path: Path, notes: list[str], draw: Callable[[Path], None]) -> bool:
    """Draw an image; False, and a note, if a package for it is not installed."""
    try:
        draw(path)
    except MissingPackageError as error:
        notes.append(f"no {path.name}: {error}")
        return False
    return True


@dataclass(frozen=True)
class Experiment:
    """A table or figure of a paper, as parts and a function that makes the findings from them.

    Attributes:
        uses: the options of `Request` that it uses in addition to data, out, sequences, workers and overrides; any
            other given option is an error.
        parts: stages; the parts of a stage may read what earlier stages have written.
        findings: the tables, from the figures of all parts by their names.
    """

    uses: frozenset[str]
    parts: Callable[[Request], Sequence[Sequence[Part]]]
    findings: Callable[[Request, Mapping[str, Figures]], Findings]
