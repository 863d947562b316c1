# SPDX-License-Identifier: Apache-2.0
"""A sequence whose items are computed when they are accessed."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from typing import TypeVar, overload

T_co = TypeVar("T_co", covariant=True)


class LazySequence(Sequence[T_co]):
    """Sequence based on `__len__` and `item`; supports negative indices, and slices, which are lists."""

    @abstractmethod
    def item(self, index: int) -> T_co:
        """The item at an index, 0 <= index < len."""

    @overload
    def __getitem__(self, index: int) -> T_co: ...

    @overload
    def __getitem__(self, index: slice) -> list[T_co]: ...

    def __getitem__(self, index: int | slice) -> T_co | list[T_co]:
        at = range(len(self))[index]
        return self.item(at) if isinstance(at, int) else [self.item(i) for i in at]
