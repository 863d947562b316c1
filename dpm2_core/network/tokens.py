# SPDX-License-Identifier: Apache-2.0
"""Sets of descriptors as tensors."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from dpm2_core.descriptors import Descriptors


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

    def at(self, index: Tensor) -> Tokens:
        """The sets with these numbers, one after the other; `index` has any shape."""
        return Tokens(*(field[index.flatten()] for field in self))


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
    return Tokens(padded([s.xyz for s in sets]), padded([s.values for s in sets]), axis, mask)
