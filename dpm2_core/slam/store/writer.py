# SPDX-License-Identifier: Apache-2.0
"""Keeps a map file up to date with the mapper; when it cannot, the drive goes on in memory and the file catches up."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from dpm2_core.errors import Dpm2Error
from dpm2_core.estimates import Edge, Keyframe
from dpm2_core.frame import Array, Georeference
from dpm2_core.slam.store.cloud_store import CloudStore
from dpm2_core.slam.store.map_store import Change, MapStore
from dpm2_core.slam.store.rows import array_bytes, edge_of

_BATCH = 20  # keyframes a transaction while catching up: memory is that of so many clouds
STILL = 1e-4
"""m and rad: poses that move by less are not worth writing."""


class MapWriter:
    """What the file does not have yet.

    Attributes:
        problem: why the last attempt to write failed, in words, or that the file is no longer at its path; empty when
            it is up to date.
    """

    def __init__(self, store: MapStore, clouds: CloudStore, poses: Array) -> None:
        """`poses` (N, 4, 4) are those that the file has."""
        self.problem = ""
        self._store, self._clouds = store, clouds
        self._written = poses
        self._keyframes: list[tuple[int, Keyframe, bytes | None]] = []
        self._edges: list[Edge] = []
        self._moving: set[int] = set()
        self._given_up: set[int] = set()

    def add(self, node: int, keyframe: Keyframe, thumbnail: bytes | None, edges: Sequence[Edge]) -> None:
        """A keyframe, whose cloud is in the cloud store, and the edges that came with it; or one anew, which borrows by
        now."""
        self._keyframes.append((node, keyframe, thumbnail))
        self._edges += edges

    def set_moving(self, node: int) -> None:
        """The cloud store has a mask for that node."""
        self._moving.add(node)

    def give_up(self, node: int) -> None:
        """The cloud store no longer has that node's own cloud."""
        self._given_up.add(node)

    def sync(self, poses: Array, georeference: Georeference | None, judged: Sequence[Edge] = ()) -> None:
        """Write all that is new; (N, 4, 4) are the optimized poses. Never raises: see `problem`.

        `judged`: loops as they are now: those of the file whose verdict is another one are rewritten.
        """
        try:
            while len(self._keyframes) > _BATCH:
                self._write(self._keyframes[:_BATCH], poses, georeference)
            self._write(self._keyframes, poses, georeference)
            self._rewrite(judged)
            self.problem = "" if self._store.in_place else f"{self._store.path}: removed or moved since it was opened"
        except Dpm2Error as error:
            self.problem = f"{error}; {len(self._keyframes)} keyframes are in memory only"

    def _write(
        self, keyframes: list[tuple[int, Keyframe, bytes | None]], poses: Array, georeference: Georeference | None
    ) -> None:
        """The first of the keyframes that are new, with all that is new of them and of those before."""
        ends = max([len(self._written), *(node + 1 for node, *_ in keyframes)])
        change, poses = Change(georeference=georeference), poses[:ends]
        for node, keyframe, thumbnail in keyframes:
            change.keyframes.append((node, keyframe, self._clouds.packed(node), thumbnail))
            if (loan := self._clouds.loan(node)) is not None:
                change.loans[node] = loan
        change.edges = [edge for edge in self._edges if max(edge.from_node, edge.to_node) < ends]
        change.poses = self._moved(poses)
        masks = {node: self._clouds.moving(node) for node in self._moving if node < ends}
        change.moving = {node: mask for node, mask in masks.items() if mask is not None}
        if len(keyframes) == len(self._keyframes):  # else those for which they are given up are not in the file yet
            change.given_up = list(self._given_up)
        self._store.write(change)
        for node, *_ in keyframes:
            self._clouds.set_stored(node)
        self._keyframes = self._keyframes[len(keyframes) :]
        self._edges = [edge for edge in self._edges if max(edge.from_node, edge.to_node) >= ends]
        self._moving -= masks.keys()
        self._given_up -= set(change.given_up)
        written = poses.copy()
        still = [node for node in range(min(len(self._written), len(written))) if node not in change.poses]
        written[still] = self._written[still]  # small moves add up until they are worth writing
        self._written = written

    def _rewrite(self, judged: Sequence[Edge]) -> None:
        """Bring the verdicts in the file up to date."""
        # By the measurement, too: the search may have rejected another loop between the same two keyframes.
        now = {_key(loop): loop for loop in judged if loop.kind == "loop"}
        rows = self._store.rows("edges", where="kind = 'loop'") if now else ()
        # The last of those: one that waited for a second loop stands there as it was rejected, and as it was accepted.
        file = {_key(edge): (int(row[0]), edge) for row in rows for edge in [edge_of(row)]}
        known = [(number, loop, now[key]) for key, (number, loop) in file.items() if key in now]
        if changed := {number: new for number, loop, new in known if new.ok != loop.ok}:
            self._store.write(Change(judged=changed))

    def _moved(self, poses: Array) -> dict[int, Array]:
        """Poses that the file does not have, by node."""
        known = min(len(self._written), len(poses))
        moved = np.abs(poses[:known] - self._written[:known]).max((1, 2), initial=0.0) > STILL
        return {int(node): poses[node] for node in (*np.flatnonzero(moved), *range(known, len(poses)))}


def _key(loop: Edge) -> tuple[int, int, bytes]:
    return loop.from_node, loop.to_node, array_bytes(loop.T_from_to)
