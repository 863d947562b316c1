# SPDX-License-Identifier: Apache-2.0
"""A set of neural descriptors, of one frame or merged from several; independent of torch."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from dpm2_core.errors import Dpm2Error

_MIN_LEVEL_COSINE = np.cos(np.radians(5))  # smaller tilts are those of the road


@dataclass(frozen=True, eq=False)
class Descriptors:
    """The descriptors that are stored for a frame: 46 kB for 320 descriptors.

    Attributes:
        xyz: (N, 3) float32 m, in the frame of the set.
        features: (N, 128) int8, in units of `step`; with more bits no pose differs by more than chance.
        step: (N,) float32, of each descriptor.
        axis: (N, 2) float32, horizontal unit vectors from the sensor to each descriptor, in level axes; None for a
            single frame, where they follow from `xyz`.
        up: (3,) float32 up vector in the frame of the set, if the sensor was tilted: the features are then those of
            its scan in level axes. None: the frame of the set counts as level.
        scale: the features are those of the scan enlarged by this factor: see `geometry.scale.scale_of`. Sets of
            different scales cannot be compared.
    """

    xyz: NDArray[np.float32]
    features: NDArray[np.int8]
    step: NDArray[np.float32]
    axis: NDArray[np.float32] | None = None
    up: NDArray[np.float32] | None = None
    scale: float = 1.0

    def __post_init__(self) -> None:
        n = len(self.xyz)
        shapes = self.xyz.shape, self.features.shape, self.step.shape
        if self.xyz.shape != (n, 3) or self.features.ndim != 2 or len(self.features) != n or self.step.shape != (n,):
            raise ValueError("descriptors: xyz {}, features {}, step {}; want (N, 3), (N, C), (N,)".format(*shapes))

    @classmethod
    def of(cls, xyz: NDArray[np.float32], values: NDArray[np.floating]) -> Descriptors:
        """The descriptors of a single frame with positions (N, 3) and features (N, C)."""
        return cls(xyz, *quantized(values))

    def __len__(self) -> int:
        return len(self.xyz)

    @property
    def nbytes(self) -> int:
        """Bytes of the arrays."""
        arrays = self.xyz, self.features, self.step, self.axis
        return sum(array.nbytes for array in arrays if array is not None)

    @property
    def values(self) -> NDArray[np.float32]:
        """(N, C) features as float32."""
        return self.features * self.step[:, None]

    @property
    def axes(self) -> NDArray[np.float32]:
        """(N, 2) `axis`, computed for a single frame."""
        if self.axis is not None:
            return self.axis
        xy = self.as_encoded().xyz[:, :2]
        length = np.linalg.norm(xy, axis=1, keepdims=True)
        unit = xy / np.maximum(length, 1e-3)
        return np.where(length > 1e-3, unit, (1.0, 0.0)).astype(np.float32)

    def moved(self, T: NDArray[np.float64]) -> Descriptors:
        """The same descriptors in another frame; T (4, 4) is T_new_old."""
        R = T[:3, :3].astype(np.float32)
        up = None if self.up is None or is_level(R @ self.up) else R @ self.up
        rotation = R if self.up is None else R @ self.R_level_set.T
        rotation = rotation if up is None else levelling(up) @ rotation
        axis = _rotated(self.axes, rotation.astype(np.float32))
        xyz = self.xyz @ R.T + T[:3, 3].astype(np.float32)
        return replace(self, xyz=xyz, axis=axis, up=up)

    @property
    def R_level_set(self) -> NDArray[np.float32]:
        """(3, 3) rotates the frame of the set into the nearest level axes."""
        return levelling(self.up)

    def as_encoded(self) -> Descriptors:
        """The same descriptors as the network saw them: in level axes, `R_level_set`, and enlarged by `scale`."""
        if self.up is None and self.scale == 1:
            return self
        xyz = self.xyz @ self.R_level_set.T * np.float32(self.scale)
        return Descriptors(xyz, self.features, self.step, self.axis)


def quantized(values: NDArray[np.floating]) -> tuple[NDArray[np.int8], NDArray[np.float32]]:
    """Features (N, C) as int8 in units of a step (N,), so that the largest of each descriptor is 127.

    A step is not finite if a feature is not.
    """
    step = np.abs(values).max(1).astype(np.float32) / np.float32(127)
    with np.errstate(invalid="ignore"):
        return np.rint(values / np.maximum(step, 1e-30)[:, None]).astype(np.int8), step


def is_level(up: NDArray[np.floating]) -> bool:
    """Whether a unit vector (3,) is so close to the z axis that its frame counts as level."""
    return bool(up[2] >= _MIN_LEVEL_COSINE)


def levelling(up: NDArray[np.floating] | None) -> NDArray[np.float32]:
    """(3, 3) smallest rotation of a unit vector (3,) to the z axis; identity for None, which is level.

    A vector that points down is first rotated by half a turn about x: for straight down there is no single smallest
    rotation, and rounding would decide.
    """
    if up is None:
        return np.eye(3, dtype=np.float32)
    x, y, z = (float(value) for value in up)
    if z < 0:
        return levelling(np.array([x, -y, -z])) * np.array([1, -1, -1], np.float32)
    c = 1 / (1 + z)
    R = [[1 - c * x * x, -c * x * y, -x], [-c * x * y, 1 - c * y * y, -y], [x, y, z]]
    return np.array(R, np.float32)


def _rotated(axis: NDArray[np.float32], R: NDArray[np.float32]) -> NDArray[np.float32]:
    """Horizontal unit vectors (N, 2) rotated by the heading of R (3, 3)."""
    rotated = axis @ R[:2, :2].T
    rotated /= np.maximum(np.linalg.norm(rotated, axis=1, keepdims=True), 1e-6)
    return rotated


class LazyDescriptors:
    """Descriptors of a scan, computed when they are first needed: the network takes as long as all else together.

    Attributes:
        problem: why there are none; empty if there are some, or if they were not needed yet.
    """

    def __init__(self, make: Callable[[], Descriptors]) -> None:
        """`make` raises Dpm2Error for a scan that has no descriptors, such as one of too few points."""
        self._make: Callable[[], Descriptors] | None = make
        self._value: Descriptors | None = None
        self.problem = ""

    @property
    def made(self) -> bool:
        """Whether they were computed, or tried."""
        return self._make is None

    def get(self) -> Descriptors | None:
        """The descriptors; None if the scan has none, for the reason in `problem`."""
        if self._make is not None:
            try:
                self._value = self._make()
            except Dpm2Error as error:
                self.problem = str(error)
            self._make = None  # it refers to the scan's points
        return self._value


def merge(sets: Sequence[Descriptors]) -> Descriptors:
    """Merge sets that are already in the same frame; sets of another scale than the first are left out.

    Raises:
        ValueError: no set given.
    """
    if not sets:
        raise ValueError("merge: want at least one set of descriptors")
    sets = [s for s in sets if s.scale == sets[0].scale]
    up = next((s.up for s in sets if s.up is not None), None)
    axes = [s.axes for s in sets]
    if up is not None:  # each set estimated its own
        axes = [_rotated(axis, levelling(up) @ s.R_level_set.T) for axis, s in zip(axes, sets, strict=True)]
    xyz, features, step = (np.concatenate([getattr(s, name) for s in sets]) for name in ("xyz", "features", "step"))
    return Descriptors(xyz, features, step, np.concatenate(axes), up, sets[0].scale)
