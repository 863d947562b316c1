# SPDX-License-Identifier: Apache-2.0
"""One scan with the data that a task learns from: classes, and its twin without moving objects."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal, Protocol, Self

import torch
from torch import Tensor
from torch.utils.data import Dataset

from dpm2_core.errors import UsageError

RequiredData = Literal["labels", "static"]
"""Data that a task requires."""
UNCOUNTED = (0, 1)
"""Unlabeled, outlier: SemanticKITTI's classes of points that no task counts."""
_CLASSES = (
    *UNCOUNTED, 10, 11, 13, 15, 16, 18, 20, 30, 31, 32, 40, 44, 48, 49, 50, 51, 52, 60, 70, 71, 72, 80, 81, 99,
    *range(252, 260),
)  # fmt: skip


@dataclass(frozen=True, eq=False)
class TaskScan:
    """One scan.

    Attributes:
        points: (N, 4) float32 [x, y, z m, intensity 0..1] in the frame of the LiDAR.
        labels: (N,) int64 class as in SemanticKITTI, without the number of the object; None if there are none.
        static: (M, 4) float32, the same view without moving objects; None if there is none.
        sequence, number: which scan it is.
    """

    points: Tensor
    labels: Tensor | None
    static: Tensor | None
    sequence: str
    number: int

    def to(self, device: torch.device) -> Self:
        """The scan on a device."""
        moved: dict[str, Any] = {name: v.to(device) for name, v in vars(self).items() if isinstance(v, Tensor)}
        return replace(self, **moved)


def classes_of(scan: TaskScan, purpose: str) -> Tensor:
    """Classes (N,) of the points.

    Raises:
        UsageError: the scan has no labels, or some that are not SemanticKITTI's, such as the 0 to 19 that networks are
            trained on: a 10 is a car here, and a parking lot there. `purpose`: what the task needs them for.
    """
    where = f"{scan.sequence}, scan {scan.number}"
    if scan.labels is None:
        raise UsageError(f"{where}: no labels; this task needs them to know {purpose}")
    unknown = ~torch.isin(scan.labels, scan.labels.new_tensor(_CLASSES))
    if bool(unknown.any()):
        raise UsageError(
            f"{where}: a label has class {int(scan.labels[unknown][0])}, which SemanticKITTI does not have; "
            "want the numbers of its files, such as 40 for a road"
        )
    return scan.labels


class ScanSequence(Protocol):
    """Contiguous scans of one drive."""

    def __len__(self) -> int: ...

    def __getitem__(self, index: int) -> TaskScan: ...


class StoredSequence(ScanSequence, Protocol):
    """The same, in files."""

    def fingerprint(self, index: int) -> bytes:
        """Size and a part of the files of a scan, by which changed ones are detected without reading them."""


class TaskScans(Dataset[TaskScan]):
    """The scans of many sequences, numbered through.

    Attributes:
        lengths: of the sequences, for `ContiguousWindows`.
    """

    def __init__(self, sequences: Sequence[ScanSequence]) -> None:
        """Join sequences."""
        self._scan_index = [(sequence, i) for sequence in sequences for i in range(len(sequence))]
        self.lengths = [len(sequence) for sequence in sequences]

    def __len__(self) -> int:
        """Scans in all."""
        return len(self._scan_index)

    def __getitem__(self, index: int) -> TaskScan:
        """Read one scan.

        Raises:
            UsageError: a file is damaged, or was changed since it was opened.
        """
        sequence, i = self._scan_index[index]
        return sequence[i]
