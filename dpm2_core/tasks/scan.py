# SPDX-License-Identifier: Apache-2.0
"""One scan with the data that a task learns from: classes, and its twin without moving objects."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal, Protocol, Self

import torch
from torch import Tensor
from torch.utils.data import Dataset

RequiredData = Literal["labels", "static"]
"""Data that a task requires."""


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
