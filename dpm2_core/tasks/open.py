# SPDX-License-Identifier: Apache-2.0
"""Finds the scans below a folder."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from dpm2_core.errors import UsageError
from dpm2_core.tasks.pairs import open_pairs
from dpm2_core.tasks.scan import RequiredData, ScanSequence, TaskScans
from dpm2_core.tasks.semantic_kitti import kitti_runs, sequence_folders


def open_scans(path: Path | str, needs: Sequence[RequiredData] = ()) -> TaskScans:
    """The scans below a folder: a sequence, a data set of sequences/NN, or a folder of such; or pairs as DSLR has them.

    A gap in the numbers of the scans ends a sequence: what lies across it is no motion from one scan to the next.

    Raises:
        UsageError: no scans, something needed is missing, or a file of the wrong length; it names file and reason.
    """
    path = Path(path)
    if not path.is_dir():
        raise UsageError(f"{path}: no such folder")
    sequences: list[ScanSequence] = list(open_pairs(path))
    for folder in sequence_folders(path):
        sequences += kitti_runs(folder, path, needs)
    if not sequences:
        raise UsageError(f"{path}: no scans; want sequences/NN/velodyne/NNNNNN.bin in or below it, or DSLR's pairs")
    return TaskScans(sequences)
