# SPDX-License-Identifier: Apache-2.0
"""The noun of the network, free of torch: a set of neural descriptors, of one frame or merged from several."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


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
    def nbytes(self) -> int:
        """Bytes of the arrays."""
        return self.xyz.nbytes + self.features.nbytes + (0 if self.axis is None else self.axis.nbytes)

    @property
    def axes(self) -> NDArray[np.float32]:
        """(N, 2) `axis`, computed for a single frame."""
        if self.axis is not None:
            return self.axis
        length = np.linalg.norm(self.xyz[:, :2], axis=1, keepdims=True)
        unit = self.xyz[:, :2] / np.maximum(length, 1e-3)
        return np.where(length > 1e-3, unit, (1.0, 0.0)).astype(np.float32)

    def moved(self, T: NDArray[np.float64]) -> Descriptors:
        """The same descriptors in another frame; T (4, 4) is T_new_old."""
        R = T[:3, :3].astype(np.float32)
        axis = self.axes @ R[:2, :2].T
        axis /= np.maximum(np.linalg.norm(axis, axis=1, keepdims=True), 1e-6)
        return Descriptors(self.xyz @ R.T + T[:3, 3].astype(np.float32), self.features, axis)


class LazyDescriptors:
    """Descriptors of a scan, made when they are first needed: that takes the network as long as all else together."""

    def __init__(self, make: Callable[[], Descriptors | None]) -> None:
        """`make`: gives None for a scan that has too few points."""
        self._make: Callable[[], Descriptors | None] | None = make
        self._value: Descriptors | None = None

    @property
    def made(self) -> bool:
        """Whether they were needed."""
        return self._make is None

    def get(self) -> Descriptors | None:
        """The descriptors; None of a scan that has too few points."""
        if self._make is not None:
            self._value, self._make = self._make(), None  # which held the scan's points
        return self._value


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
