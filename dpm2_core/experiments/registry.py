# SPDX-License-Identifier: Apache-2.0
"""The experiments of both papers by name, and the function that carries them out."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from pkgutil import resolve_name
from typing import Any

from dpm2_core.errors import UsageError
from dpm2_core.evaluation.record import write_record
from dpm2_core.evaluation.run_page import runs_page
from dpm2_core.experiments.request import Experiment, Findings, Request
from dpm2_core.experiments.table import shown
from dpm2_core.files import atomic_write
from dpm2_core.fleet.part import Figures, Part, Progress, run_parts
from dpm2_core.tables import FigureTable

_COMMON_OPTIONS = frozenset({"data", "out", "sequences", "workers", "overrides"})


@dataclass(frozen=True)
class Listed:
    """An experiment in the list: its place in a paper, what it measures, and its MODULE:NAME."""

    paper: str
    summary: str
    where: str


EXPERIMENTS: dict[str, Listed] = {
    "kitti": Listed(
        "DeepPointMap2, table 1", "t_rel and r_rel on KITTI 06 to 10, compared with other programs", "kitti:KITTI"
    ),
    "kitti360": Listed(
        "DeepPointMap2, section 5.2 and figure 5", "mean position error on KITTI-360 07 and 09", "kitti:KITTI_360"
    ),
    "robustness": Listed(
        "DeepPointMap2, table 2 and figure 6",
        "black images, or a box in front of the LiDAR, in 5 to 100 % of the frames",
        "robustness:ROBUSTNESS",
    ),
    "reference-points": Listed(
        "DeepPointMap2, table 3", "128 to 4096 reference points, from the scan or random", "variants:reference_points"
    ),
    "fusion": Listed("DeepPointMap2, table 4", "alternative fusions of LiDAR and image", "variants:fusion"),
    "attention": Listed(
        "DeepPointMap2, figure 7",
        "attention maps of the networks of `fusion`, one below the other",
        "variants:attention",
    ),
    "gndnet": Listed(
        "Differentiable SLAM, table 1", "ground height by GndNet, without and with the SLAM loss", "task_tables:gndnet"
    ),
    "dslr": Listed(
        "Differentiable SLAM, table 2",
        "scans without moving objects by DSLR, without and with the SLAM loss",
        "task_tables:dslr",
    ),
    "dslr-slam": Listed(
        "Differentiable SLAM, table 3 and figure 3",
        "odometry on the output of DSLR, without and with the SLAM loss",
        "task_tables:dslr_slam",
    ),
    "ae-lidar": Listed(
        "Differentiable SLAM, table 4",
        "scans reconstructed from short codes by AE_lidar, without and with the SLAM loss",
        "task_tables:ae_lidar",
    ),
    "ae-lidar-slam": Listed(
        "Differentiable SLAM, in addition to table 4",
        "odometry on the output of AE_lidar, without and with the SLAM loss",
        "task_tables:ae_lidar_slam",
    ),
}


def load(name: str) -> Experiment:
    """The experiment of that name; its module is imported now.

    Raises:
        UsageError: no such experiment.
    """
    if name not in EXPERIMENTS:
        raise UsageError(f"{name}: no such experiment; choose from {', '.join(EXPERIMENTS)}")
    found: Experiment = resolve_name(f"dpm2_core.experiments.{EXPERIMENTS[name].where}")
    return found


def tables_in(folder: Path) -> list[FigureTable]:
    """The tables of the experiments with results in a folder or below it; those below have the folder in their titles.

    Raises:
        UsageError: one is damaged.
    """
    tables = []
    for name in EXPERIMENTS:
        below = (page.with_suffix(".json") for page in sorted(folder.rglob(f"{name}.html")))  # `carry_out` writes both
        for path in dict.fromkeys([folder / f"{name}.json", *below]):
            prefix = "" if path.parent == folder else f"{path.parent.relative_to(folder)}: "
            tables += _read_tables(path, prefix)
    return tables


def _read_tables(path: Path, prefix: str) -> list[FigureTable]:
    """The tables in an experiment's JSON file, with `prefix` before their titles; none if there is no such file."""
    if not path.is_file():
        return []
    try:
        return [shown(record, prefix) for record in json.loads(path.read_text(encoding="utf-8"))["tables"]]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise UsageError(f"{path}: not a record of an experiment, or damaged: {error}") from None


def carry_out(name: str, request: Request, progress: Progress | None) -> Findings:
    """Do all parts that are not done yet, and write OUT/NAME.json and OUT/NAME.html.

    Raises:
        UsageError: an option that the experiment does not use, or data that it cannot use. Dpm2Error: a part failed.
    """
    experiment = load(name)
    _check_options(name, request, experiment)
    figures: dict[str, Figures] = {}
    stages = experiment.parts(request)
    _check_names(name, [part for stage in stages for part in stage])
    for stage in stages:
        figures |= run_parts(stage, request.out, request.workers, progress)
    findings = experiment.findings(request, figures)
    commits = sorted({str(part["part"]["commit"]) for part in figures.values()})
    if len(commits) > 1:
        findings.notes.append(f"the parts were made by dpm2 at several commits: {', '.join(commits)}")
    write_record(request.out / f"{name}.json", _record(request, findings, figures), threads=request.workers)
    tables = [shown(table.record()) for table in findings.tables]
    runs = [
        (f"{row}, {sequence}", path) for sequence, folders in findings.runs.items() for row, path in folders.items()
    ]
    with atomic_write(request.out / f"{name}.html") as file:
        file.write(runs_page(f"{name}: {EXPERIMENTS[name].paper}", runs, tables))
    return findings


def _check_options(name: str, request: Request, experiment: Experiment) -> None:
    unsupported = [
        field.name
        for field in fields(request)
        if field.name not in _COMMON_OPTIONS | experiment.uses and getattr(request, field.name) not in (None, ())
    ]
    if unsupported:
        raise UsageError(f"{name}: does not use --{unsupported[0]}")


def _check_names(name: str, parts: Sequence[Part]) -> None:
    """Reject two parts in one folder: the second would overwrite the first, and both rows would show its figures."""
    folders = Counter(part.name for part in parts)
    repeated = [folder for folder, count in folders.items() if count > 1]
    if repeated:
        raise UsageError(
            f"{name}: two results have the same name ({repeated[0]}); check --sequences, --registration and --peer"
        )


def _record(request: Request, findings: Findings, figures: dict[str, Figures]) -> dict[str, Any]:
    return {
        "request": {field.name: getattr(request, field.name) for field in fields(request)},
        "tables": [table.record() for table in findings.tables],
        "notes": findings.notes,
        **findings.extra,
        "parts": figures,
    }
