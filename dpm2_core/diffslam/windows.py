# SPDX-License-Identifier: Apache-2.0
"""Batches of contiguous scans for a torch DataLoader, from which a trajectory can be estimated."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import torch
from torch.utils.data import Sampler

from dpm2_core.errors import UsageError


class ContiguousWindows(Sampler[list[int]]):
    """Windows of consecutive scans, none across the border of a sequence, in an order that is shuffled each epoch.

    Use: `DataLoader(scans, batch_sampler=ContiguousWindows(lengths, 8))`. Scans are numbered through all sequences.
    """

    def __init__(self, lengths: Sequence[int], window: int, every: int = 1, seed: int | None = None) -> None:
        """Cut sequences of these lengths into windows that do not overlap; scans left at an end are not used.

        Args:
            window: scans of a window. every: distance of its scans (the paper: 2). seed: of the order; None: in order.

        Raises:
            UsageError: no sequence is long enough.
        """
        if window < 2 or every < 1:
            raise UsageError(f"windows: {window} scans, every {every}; want at least 2, every 1")
        extent = (window - 1) * every + 1
        if not any(length >= extent for length in lengths):
            longest = max(lengths, default=0)
            raise UsageError(
                f"window {window}, every {every}: no sequence has the {extent} scans of it, {longest} at most"
            )
        self._seed, self._epoch, self.windows = seed, 0, list[list[int]]()
        begin = 0
        for length in lengths:
            for block in range(0, length, window * every):  # every-th scans of a block, from each of its first ones
                for start in range(block, min(block + every, length - extent + 1)):
                    self.windows.append([begin + start + i * every for i in range(window)])
            begin += length

    def set_epoch(self, epoch: int) -> None:
        """Choose the order of an epoch, which is the same for the same number."""
        self._epoch = epoch

    def __len__(self) -> int:
        return len(self.windows)

    def __iter__(self) -> Iterator[list[int]]:
        if self._seed is None:
            return iter(self.windows)
        generator = torch.Generator().manual_seed(self._seed * 1_000_003 + self._epoch)
        return iter([self.windows[i] for i in torch.randperm(len(self.windows), generator=generator)])
