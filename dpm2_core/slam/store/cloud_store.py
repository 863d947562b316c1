# SPDX-License-Identifier: Apache-2.0
"""Keyframe clouds on disk, so that the memory of a drive does not grow with its clouds."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from dpm2_core.errors import Dpm2Error
from dpm2_core.frame import NO_POINTS, Array, Points
from dpm2_core.geometry import se3
from dpm2_core.slam.store.cloud_codec import CodecError, origin_of, pack_mask, unpack_cloud, unpack_mask
from dpm2_core.slam.store.lazy import LazySequence

Reader = Callable[[int], bytes | None]


@dataclass(frozen=True, eq=False)
class Loan:
    """Loan of a redundant keyframe: it shows the cloud of `lender`, the revisited one, moved by T_kf_lender (4, 4)."""

    lender: int
    T_kf_lender: Array


class SpillFile:
    """Append-only pieces of bytes in an anonymous file, which is removed when the process ends.

    If the disk is full or missing, the pieces stay in memory, so that no map is lost.
    """

    def __init__(self) -> None:
        self._locations: list[tuple[int, int] | bytes] = []  # offset and length, or the bytes themselves
        self._end = 0
        self._file: BinaryIO | None = None  # None before the first piece

    def append(self, data: bytes) -> int:
        """Store a piece; returns its number."""
        try:
            if self._file is None:
                self._file = tempfile.TemporaryFile(prefix="dpm2_", buffering=0)  # noqa: SIM115
            self._file.seek(self._end)
            if self._file.write(data) != len(data):
                raise OSError("disk full")
            self._locations.append((self._end, len(data)))
            self._end += len(data)
        except OSError:
            self._locations.append(data)
        return len(self._locations) - 1

    def read(self, number: int) -> bytes:
        """A piece by its number."""
        location = self._locations[number]
        if isinstance(location, bytes):
            return location
        assert self._file is not None
        self._file.seek(location[0])
        return self._file.read(location[1])


class CloudStore(LazySequence[Points]):
    """The packed clouds of keyframes 0, 1, ...: in the map file if it has them, else in a temporary file.

    An item is the (M, 4) float32 cloud without moving points; `whole` includes them. A keyframe that is redundant, as a
    revisit, borrows the cloud of the older keyframe. Its own cloud shows how the place looks now, which navigation
    needs: it is kept until the next keyframe borrows there.

    Attributes:
        name: of the map, for errors.
    """

    def __init__(
        self,
        stored: Reader | None = None,
        moving: Sequence[bytes | None] = (),
        loans: Mapping[int, Loan] | None = None,
        name: str = "map",
    ) -> None:
        """Empty, or with the clouds of a map file.

        Args:
            stored: reads a packed cloud from the file.
            moving: packed mask, or None, of each keyframe in the file.
            loans: of those among them that borrow.
            name: of the map, for errors.
        """
        self.name = name
        self._read_stored = stored
        self._spill = SpillFile()
        self._locations: list[int | bytes | None] = [None] * len(moving)  # number in the temporary file; None: map file
        self._moving = {index: mask for index, mask in enumerate(moving) if mask is not None}
        self._loans = dict(loans or {})
        self._newest_borrower = {loan.lender: index for index, loan in sorted(self._loans.items())}  # of each lender

    def append(self, packed: bytes) -> None:
        """Add the cloud of the next keyframe: in memory until the map file has it, or until the next one is added."""
        if self._locations and isinstance(last := self._locations[-1], bytes):
            self._locations[-1] = self._spill.append(last)
        self._locations.append(packed)

    def set_stored(self, index: int) -> None:
        """The map file has this cloud now."""
        self._locations[index] = None

    def borrow(self, index: int, loan: Loan) -> int | None:
        """Let a keyframe borrow from an older one with its own cloud; returns the keyframe whose cloud is dropped."""
        previous = self._newest_borrower.get(loan.lender)
        self._loans[index] = loan
        if previous is None:
            self._newest_borrower[loan.lender] = index
            return None
        dropped, self._newest_borrower[loan.lender] = sorted((previous, index))
        self._locations[dropped] = None
        self._moving.pop(dropped, None)
        return dropped

    def may_borrow(self, index: int) -> bool:
        """Whether a keyframe neither borrows nor lends."""
        return index not in self._loans and index not in self._newest_borrower

    def loan(self, index: int) -> Loan | None:
        """The keyframe's loan; None if it shows its own cloud."""
        return self._loans.get(index)

    @property
    def own(self) -> NDArray[np.bool_]:
        """(N,) mask of keyframes that do not borrow."""
        own = np.ones(len(self), np.bool_)
        own[list(self._loans)] = False
        return own

    @property
    def kept(self) -> NDArray[np.bool_]:
        """(N,) mask of keyframes that have their own clouds: those that do not borrow, and the newest borrowers."""
        kept = self.own
        kept[list(self._newest_borrower.values())] = True
        return kept

    def keeps(self, index: int) -> bool:
        """Whether a keyframe has its own cloud."""
        loan = self._loans.get(index)
        return loan is None or self._newest_borrower[loan.lender] == index

    def set_moving(self, index: int, moving: NDArray[np.bool_]) -> None:
        """Leave out those points (M,) of a cloud from now on."""
        self._moving[index] = pack_mask(moving)

    def moving(self, index: int) -> bytes | None:
        """The packed mask of moving points; None if none are known."""
        return self._moving.get(index)

    def packed(self, index: int) -> bytes | None:
        """The bytes of a keyframe's own cloud; None if it was given up."""
        location = self._locations[index]
        if not self.keeps(index):
            return None
        if isinstance(location, int):
            return self._spill.read(location)
        return location if location is not None or self._read_stored is None else self._read_stored(index)

    def whole(self, index: int) -> Points:
        """A keyframe's own cloud (M, 4) with all its points; empty if it was given up.

        Raises:
            Dpm2Error: it is damaged.
        """
        data = self.packed(range(len(self))[index])
        with self._naming_keyframe(index):
            return NO_POINTS if data is None else unpack_cloud(data)

    def seen(self, index: int) -> Points:
        """A keyframe's own cloud (M, 4) without moving points; empty if it was given up.

        Raises:
            Dpm2Error: it is damaged.
        """
        cloud, moving = self.whole(index), self._moving.get(index)
        with self._naming_keyframe(index):
            return cloud if moving is None or not len(cloud) else cloud[~unpack_mask(moving, len(cloud))]

    def seen_from(self, index: int) -> Array:
        """(3,) m, position of the LiDAR for the keyframe's own cloud, in the keyframe's frame.

        Raises:
            Dpm2Error: it is damaged.
        """
        data = self.packed(index)
        with self._naming_keyframe(index):
            return np.zeros(3) if data is None else origin_of(data)

    def origin(self, index: int) -> Array:
        """(3,) m, position of the LiDAR for an item, in the keyframe's frame.

        Raises:
            Dpm2Error: it is damaged.
        """
        if (loan := self._loans.get(index)) is not None:
            return loan.T_kf_lender[:3, :3] @ self.seen_from(loan.lender) + loan.T_kf_lender[:3, 3]
        return self.seen_from(index)

    @contextmanager
    def _naming_keyframe(self, index: int) -> Iterator[None]:
        try:
            yield
        except CodecError as error:
            raise Dpm2Error(f"{self.name}: keyframe {index}: {error}; see dpm2 map check") from None

    def __len__(self) -> int:
        return len(self._locations)

    def item(self, index: int) -> Points:
        """(M, 4) without moving points.

        Raises:
            Dpm2Error: it is damaged.
        """
        if (loan := self._loans.get(index)) is not None:
            return se3.transform(loan.T_kf_lender, self.seen(loan.lender))
        return self.seen(index)
