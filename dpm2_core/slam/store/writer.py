# SPDX-License-Identifier: Apache-2.0
"""Keeps a map file up to date with the mapper; if writing fails, the map continues in memory and is written later."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from dpm2_core.errors import Dpm2Error
from dpm2_core.estimates import Edge, Keyframe
from dpm2_core.frame import Array, Georeference
from dpm2_core.slam.store.cloud_store import CloudStore
from dpm2_core.slam.store.map_connection import BRIEFLY, BUSY
from dpm2_core.slam.store.map_store import Change, MapStore
from dpm2_core.slam.store.rows import array_bytes, edge_of

_BATCH = 20  # keyframes per transaction while catching up; their clouds are in memory
STILL = 1e-4
"""m and rad: poses that move by less are not written."""


class MapWriter:
    """The changes that the file does not have yet.

    Attributes:
        problem: why the last attempt to write failed, in words, or that the file is no longer at its path; empty if it
            is up to date.
    """

    def __init__(self, store: MapStore, clouds: CloudStore, poses: Array) -> None:
        """`poses` (N, 4, 4) are those in the file."""
        self.problem = ""
        self._store, self._clouds = store, clouds
        self._written_poses = poses
        self._keyframes: list[tuple[int, Keyframe, bytes | None]] = []
        self._edges: list[Edge] = []
        self._moving: set[int] = set()
        self._given_up: set[int] = set()

    def add(self, node: int, keyframe: Keyframe, thumbnail: bytes | None, edges: Sequence[Edge]) -> None:
        """Add a keyframe, whose cloud is in the cloud store, and its edges; or update one that borrows by now."""
        self._keyframes.append((node, keyframe, thumbnail))
        self._edges += edges

    def set_moving(self, node: int) -> None:
        """The cloud store has a mask of moving points for that node."""
        self._moving.add(node)

    def give_up(self, node: int) -> None:
        """The cloud store no longer has that node's own cloud."""
        self._given_up.add(node)

    def sync(self, poses: Array, georeference: Georeference | None, judged: Sequence[Edge] = ()) -> None:
        """Write all changes; (N, 4, 4) are the optimized poses. Never raises: see `problem`.

        `judged`: loops with their current verdict; loops in the file with a different one are rewritten.
        """
        try:
            while len(self._keyframes) > _BATCH:
                self._write(self._keyframes[:_BATCH], poses, georeference)
            self._write(self._keyframes, poses, georeference)
            self._update_loops(judged)
            self.problem = "" if self._store.in_place else f"{self._store.path}: removed or moved since it was opened"
        except Dpm2Error as error:
            self.problem = f"{error}; {len(self._keyframes)} keyframes are in memory only"

    @property
    def _wait(self) -> float:
        """s to wait for another program. If the last attempt failed, it may write for long: each keyframe, and the end
        of a node, would wait in vain, and `ros2 launch` kills a node that takes more than 10 s to end."""
        return BRIEFLY if self.problem else BUSY

    def _write(
        self, keyframes: list[tuple[int, Keyframe, bytes | None]], poses: Array, georeference: Georeference | None
    ) -> None:
        """Write the first of the new keyframes, with all changes of them and of earlier ones."""
        ends = max([len(self._written_poses), *(node + 1 for node, *_ in keyframes)])
        change, poses = Change(georeference=georeference), poses[:ends]
        for node, keyframe, thumbnail in keyframes:
            change.keyframes.append((node, keyframe, self._clouds.packed(node), thumbnail))
            if (loan := self._clouds.loan(node)) is not None:
                change.loans[node] = loan
        change.edges = [edge for edge in self._edges if max(edge.from_node, edge.to_node) < ends]
        change.poses = self._moved_poses(poses)
        masks = {node: self._clouds.moving(node) for node in self._moving if node < ends}
        change.moving = {node: mask for node, mask in masks.items() if mask is not None}
        if len(keyframes) == len(self._keyframes):  # else the keyframes that replace them are not in the file yet
            change.given_up = list(self._given_up)
        self._store.write(change, self._wait)
        for node, *_ in keyframes:
            self._clouds.set_stored(node)
        self._keyframes = self._keyframes[len(keyframes) :]
        self._edges = [edge for edge in self._edges if max(edge.from_node, edge.to_node) >= ends]
        self._moving -= masks.keys()
        self._given_up -= set(change.given_up)
        written = poses.copy()
        unchanged = [node for node in range(min(len(self._written_poses), len(written))) if node not in change.poses]
        written[unchanged] = self._written_poses[unchanged]  # small moves add up until they are written
        self._written_poses = written

    def _update_loops(self, judged: Sequence[Edge]) -> None:
        """Update the verdicts of loops in the file."""
        # Identified by the measurement, too: the search may have rejected another loop of the same two keyframes.
        judged_by_key = {_loop_key(loop): loop for loop in judged if loop.kind == "loop"}
        rows = self._store.rows("edges", where="kind = 'loop'") if judged_by_key else ()
        # The last of equal keys: a loop that waited for a second one has two rows, rejected and later accepted.
        stored = {_loop_key(edge): (int(row[0]), edge) for row in rows for edge in [edge_of(row)]}
        known = [(number, loop, judged_by_key[key]) for key, (number, loop) in stored.items() if key in judged_by_key]
        if changed := {number: new for number, loop, new in known if new.ok != loop.ok}:
            self._store.write(Change(judged=changed), self._wait)

    def _moved_poses(self, poses: Array) -> dict[int, Array]:
        """Poses that are not in the file, by node."""
        known = min(len(self._written_poses), len(poses))
        moved = np.abs(poses[:known] - self._written_poses[:known]).max((1, 2), initial=0.0) > STILL
        return {int(node): poses[node] for node in (*np.flatnonzero(moved), *range(known, len(poses)))}


def _loop_key(loop: Edge) -> tuple[int, int, bytes]:
    return loop.from_node, loop.to_node, array_bytes(loop.T_from_to)
