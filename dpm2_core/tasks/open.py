# SPDX-License-Identifier: Apache-2.0
"""Finds the scans below a folder."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Sequence
from pathlib import Path

from dpm2_core.errors import UsageError
from dpm2_core.tasks.pairs import ArrayPair, open_pairs
from dpm2_core.tasks.scan import RequiredData, StoredSequence, TaskScans
from dpm2_core.tasks.semantic_kitti import kitti_runs, sequence_folders


class OpenedScans(TaskScans):
    """Scans in files."""

    def __init__(self, sequences: Sequence[StoredSequence]) -> None:
        super().__init__(sequences)
        self._sequences = sequences

    def digest(self) -> str:
        """Identifier of these scans, 16 characters, from the size and a part of every file.

        Raises:
            UsageError: a file cannot be read.
        """
        digest = hashlib.sha256()
        for sequence in self._sequences:
            digest.update(str(len(sequence)).encode())
            for index in range(len(sequence)):
                digest.update(sequence.fingerprint(index))
        return digest.hexdigest()[:16]


def open_scans(path: Path | str, needs: Sequence[RequiredData] = (), sequences: Sequence[str] = ()) -> OpenedScans:
    """The scans below a folder: a sequence, a data set of sequences/NN, or a folder of such; or pairs as DSLR has them.

    A gap in the numbers of the scans ends a sequence: across it the motion is not that of consecutive scans.

    Args:
        sequences: names of their folders, such as 05, or of folders above; or numbers of pairs; empty: all.

    Raises:
        UsageError: no scans, something needed is missing, or a file of the wrong length; it names file and reason.
    """
    path = Path(path)
    if not path.is_dir():
        raise UsageError(f"{path}: no such folder")
    found: list[StoredSequence] = [*pairs_of(path, sequences)]
    for folder in folders_of(path, sequences):
        found += kitti_runs(folder, path, needs)
    if sequences:
        _check_found(path, sequences, found)
    if not found:
        raise UsageError(f"{path}: no scans; want sequences/NN/velodyne/NNNNNN.bin in or below it, or DSLR's pairs")
    return OpenedScans(found)


def pairs_of(path: Path, sequences: Sequence[str]) -> list[ArrayPair]:
    """The pairs of arrays in a folder that have one of these numbers; all if none is given."""
    numbers = {int(name) for name in sequences if name.isdecimal()}
    return [pair for pair in open_pairs(path) if not sequences or pair.number in numbers]


def folders_of(path: Path, sequences: Sequence[str]) -> list[Path]:
    """The sequence folders below `path` that have one of these names, or are below such a folder; all if none is given.

    A name refers to the outermost folders that have it: of train/00/sequences/00 and train/01/sequences/00, 00 is the
    first.
    """
    names = {folder: names_of(folder, path) for folder in sequence_folders(path)}
    chosen = set(names) if not sequences else set()
    for name in sequences:
        level = {folder: parts.index(name) for folder, parts in names.items() if name in parts}
        chosen |= {folder for folder in level if level[folder] == min(level.values())}
    return [folder for folder in names if folder in chosen]


def sequence_names(path: Path, sequences: Sequence[str]) -> list[str]:
    """Names of the sequences and pairs that `open_scans` opens, however they were given."""
    return [name for _, name in _places_and_names(path, sequences)]


def sequence_places(path: Path, sequences: Sequence[str]) -> dict[Path, str]:
    """Name of each of these by its resolved folder, or the resolved file of its pair."""
    return {place.resolve(): name for place, name in _places_and_names(path, sequences)}


def _places_and_names(path: Path, sequences: Sequence[str]) -> Iterator[tuple[Path, str]]:
    yield from ((pair.path, pair.name) for pair in pairs_of(path, sequences))
    yield from ((folder, "/".join(names_of(folder, path))) for folder in folders_of(path, sequences))


def names_of(folder: Path, path: Path) -> list[str]:
    """The names by which a sequence folder below `path` can be chosen: those of the folders above it, its own last."""
    return [name for name in folder.relative_to(path).parts if name != "sequences"] or [folder.resolve().name]


def _check_found(path: Path, sequences: Sequence[str], found: Sequence[StoredSequence]) -> None:
    folders = {name for folder in sequence_folders(path) for name in names_of(folder, path)}
    pairs = {pair.number for pair in found if isinstance(pair, ArrayPair)}
    missing = [name for name in sequences if name not in folders and not (name.isdecimal() and int(name) in pairs)]
    if missing:
        available = sorted(folders) + sorted(str(pair.number) for pair in open_pairs(path))
        raise UsageError(f"{path}: no sequence {missing[0]}; there are {', '.join(available) or 'none'}")
