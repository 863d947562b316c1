# SPDX-License-Identifier: Apache-2.0
"""Common parts of the experiments with the SLAM: our rows and other programs' rows, on every sequence."""

from __future__ import annotations

import os
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from dpm2_core.errors import UsageError
from dpm2_core.evaluation.kitti_metric import OFFICIAL_LENGTHS, in_words
from dpm2_core.experiments.request import Request
from dpm2_core.experiments.slam_part import GIVEN, OWN, PEER, drive_content, has_sequence
from dpm2_core.experiments.table import ResultTable
from dpm2_core.fleet.part import Figures, Part

SHOWN = {"t_err_percent": ".3f", "r_err_deg_per_100m": ".3f"}
"""Figures of the KITTI metric, and how they are printed."""
FAILED = "Failed: frames that were only predicted, or have no pose and so no part in the figures."
"""Explanation of the note that `add_runs` adds to a row."""


def reading(request: Request, sequence: str, settings: Sequence[str] = ()) -> list[str]:
    """The settings for reading a sequence. The user's settings override `settings`; those of the SLAM and of trainings
    are left out."""
    return [f"input.sequence='{sequence}'", *settings, *(s for s in request.overrides if s.startswith("input."))]


def present(request: Request, paper: Sequence[str], more: Sequence[str] = ()) -> list[str]:
    """The sequences to test on: the requested ones, or those of the paper that the data set has.

    Raises:
        UsageError: a requested sequence is missing, or all of the paper's are.
    """
    if request.sequences:
        for sequence in request.sequences:
            if problem := has_sequence(request.data, reading(request, sequence, more)):
                raise UsageError(problem)
        return list(request.sequences)
    problems = {sequence: has_sequence(request.data, reading(request, sequence, more)) for sequence in paper}
    found = [sequence for sequence, problem in problems.items() if not problem]
    if not found:
        raise UsageError(f"{next(iter(problems.values()))}; choose other sequences with --sequences")
    return found


def paper_notes(request: Request, found: Sequence[str], paper: Sequence[str]) -> list[str]:
    """Notes if other sequences, frames or segments than the paper's are measured, or not all of them."""
    missing = [sequence for sequence in paper if sequence not in found]
    notes = [f"not measured, since they are missing or were not requested: {', '.join(missing)}"] if missing else []
    if not set(found) <= set(paper) or request.frames or request.lengths:
        notes.append("other sequences, frames or lengths than the paper's: do not compare with its rows")
    return notes


def segments(request: Request) -> str:
    """The segments over which the KITTI metric of a table is averaged, for its caption."""
    return "all segments" if request.lengths is None else f"all segments of {in_words(request.lengths)}"


def learned_note(learned: Sequence[str], tested: Sequence[str]) -> list[str]:
    """A note if sequences that were learned from are tested on."""
    both = [sequence for sequence in tested if sequence in learned]
    return [f"tested on sequences that were used for training: {', '.join(both)}"] if both else []


def registrations(request: Request) -> list[tuple[str, list[str]]]:
    """Name and settings of each of our rows."""
    chosen = request.registrations or ("",)
    return [(f"dpm2 {name}".strip(), [f"slam.registration={name}"] if name else []) for name in chosen]


def own_part(name: str, sequence: str, request: Request, settings: Sequence[str], **more: Any) -> Part:
    """The part of our SLAM on a sequence; the user's settings override `settings`."""
    weights = [] if request.weights is None else [f"slam.neural.weights={request.weights}"]
    all_settings = [f"input.sequence='{sequence}'", *settings, *weights, *request.overrides]
    weight_files = [setting.partition("=")[2] for setting in all_settings if setting.endswith(".safetensors")]
    files = [Path(os.path.expanduser(path)) for path in weight_files]
    arguments, content = (
        {"drive": _drive_arguments(request, all_settings), **more},
        drive_content(request.data, all_settings),
    )
    return Part(f"{_folder_name(name)}/{sequence}", OWN, arguments, files, content=content)


def peer_parts(sequences: Sequence[str], request: Request, settings: Sequence[str]) -> list[Part]:
    """The parts of what `--peer` names, on every sequence.

    Raises:
        UsageError: a file's name does not contain the sequence.
    """
    parts = []
    for text in request.peers:
        name, equals, file = text.partition("=")
        if equals and "{sequence}" not in file and len(sequences) > 1:
            raise UsageError(
                f"--peer {text}: is one file for {len(sequences)} sequences; write {{sequence}} in place of their names"
            )
        for sequence in sequences:
            drive_settings = reading(request, sequence, settings)
            drive, content = _drive_arguments(request, drive_settings), drive_content(request.data, drive_settings)
            folder, path = f"{_folder_name(name)}/{sequence}", Path(file.replace("{sequence}", sequence))
            if equals:
                parts.append(Part(folder, GIVEN, {"drive": drive, "file": path}, [path], content=content))
            else:
                parts.append(Part(folder, PEER, {"drive": drive, "name": name}, content=content))
    return parts


def peer_names(request: Request) -> list[str]:
    """Names of the rows of other programs."""
    return [text.partition("=")[0] for text in request.peers]


def add_runs(
    table: ResultTable,
    name: str,
    sequences: Sequence[str],
    figures: Mapping[str, Figures],
    label: str = "",
    about: str = "",
) -> None:
    """Add the row of a method on the sequences, with a note on how many frames have no pose of their own, see `FAILED`.

    Args:
        label: of the row; `name` by default. about: further note on the row.
    """
    by_sequence = {sequence: figures[f"{_folder_name(name)}/{sequence}"] for sequence in sequences}
    failed = [
        f"{f['failed_frames']} of {f['frames']} frames of {s}" for s, f in by_sequence.items() if f["failed_frames"]
    ]
    notes = [about, f"failed: {', '.join(failed)}" if failed else ""]
    cells = {sequence: {figure: f.get(figure) for figure in table.figures} for sequence, f in by_sequence.items()}
    table.add(label or name, cells, note="; ".join(filter(None, notes)))


def run_folders(names: Sequence[str], sequences: Sequence[str], out: Path) -> dict[str, dict[str, Path]]:
    """Folders of the runs by sequence and name."""
    return {sequence: {name: out / _folder_name(name) / sequence for name in names} for sequence in sequences}


def _drive_arguments(request: Request, settings: Sequence[str]) -> dict[str, Any]:
    return {
        "data": request.data,
        "settings": list(settings),
        "frames": list(request.frames or (0, None)),
        "lengths": list(request.lengths or OFFICIAL_LENGTHS),
    }


def _folder_name(name: str) -> str:
    return re.sub(r"[^\w.+-]+", "_", name)
