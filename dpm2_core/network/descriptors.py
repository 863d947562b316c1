# SPDX-License-Identifier: Apache-2.0
"""The noun of the network: a set of neural descriptors, of one frame or merged from several."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from dpm2_core.frame import Array


class Tokens(NamedTuple):
    """A batch of descriptor sets as tensors.

    Attributes:
        xyz: (B, N, 3) float32 m. features: (B, N, C).
        axis: (B, N, 2) horizontal unit vector from the sensor that saw a descriptor to it, (1, 0) in a network that
            works in the sensor's axes.
        mask: (B, N) True where valid.
    """

    xyz: Tensor
    features: Tensor
    axis: Tensor
    mask: Tensor


@dataclass(frozen=True, eq=False)
class Descriptors:
    """What is kept of a frame: about 68 kB for 256 descriptors.

    Attributes:
        xyz: (N, 3) float32 m, in the frame of the set.
        features: (N, 128) float16.
        axis: (N, 2) float32, horizontal unit vectors from the sensor to each descriptor; None for a single frame, where
            they follow from `xyz`.
    """

    xyz: NDArray[np.float32]
    features: NDArray[np.float16]
    axis: NDArray[np.float32] | None = None

    def __post_init__(self) -> None:
        n = len(self.xyz)
        if self.xyz.shape != (n, 3) or self.features.ndim != 2 or len(self.features) != n:
            raise ValueError(f"descriptors: xyz {self.xyz.shape}, features {self.features.shape}; want (N, 3), (N, C)")

    def __len__(self) -> int:
        return len(self.xyz)

    @property
    def axes(self) -> NDArray[np.float32]:
        """(N, 2) `axis`, computed for a single frame."""
        if self.axis is not None:
            return self.axis
        length = np.linalg.norm(self.xyz[:, :2], axis=1, keepdims=True)
        unit = self.xyz[:, :2] / np.maximum(length, 1e-3)
        return np.where(length > 1e-3, unit, (1.0, 0.0)).astype(np.float32)

    def moved(self, T: Array) -> Descriptors:
        """The same descriptors in another frame; T (4, 4) is T_new_old."""
        R = T[:3, :3].astype(np.float32)
        axis = self.axes @ R[:2, :2].T
        axis /= np.maximum(np.linalg.norm(axis, axis=1, keepdims=True), 1e-6)
        return Descriptors(self.xyz @ R.T + T[:3, 3].astype(np.float32), self.features, axis)


def merge(sets: Sequence[Descriptors]) -> Descriptors:
    """One set of several that are already in the same frame.

    Raises:
        ValueError: no set given.
    """
    if not sets:
        raise ValueError("merge: want at least one set of descriptors")
    return Descriptors(
        np.concatenate([s.xyz for s in sets]),
        np.concatenate([s.features for s in sets]),
        np.concatenate([s.axes for s in sets]),
    )


def to_tokens(sets: Sequence[Descriptors], view_aligned: bool, device: torch.device | str = "cpu") -> Tokens:
    """A padded batch."""
    longest = max(len(s) for s in sets)

    def padded(arrays: list[NDArray[np.float32]]) -> Tensor:
        out = np.zeros((len(arrays), longest, arrays[0].shape[1]), np.float32)
        for row, array in zip(out, arrays, strict=True):
            row[: len(array)] = array
        return torch.from_numpy(out).to(device)

    axis = padded([s.axes for s in sets]) if view_aligned else torch.zeros(len(sets), longest, 2, device=device)
    if not view_aligned:
        axis[..., 0] = 1
    mask = torch.arange(longest, device=device) < torch.tensor([[len(s)] for s in sets], device=device)
    return Tokens(padded([s.xyz for s in sets]), padded([s.features.astype(np.float32) for s in sets]), axis, mask)
