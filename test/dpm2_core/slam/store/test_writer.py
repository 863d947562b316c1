# SPDX-License-Identifier: Apache-2.0
"""A map file that catches up is valid after each of its transactions: the disk may be full again before the next
one."""

from __future__ import annotations

import sqlite3
from contextlib import closing
from pathlib import Path
from time import monotonic

import numpy as np
import pytest

from dpm2_core.errors import Dpm2Error
from dpm2_core.estimates import Keyframe
from dpm2_core.frame import NO_POINTS
from dpm2_core.slam.store.check import check_map
from dpm2_core.slam.store.cloud_codec import pack_cloud
from dpm2_core.slam.store.cloud_store import CloudStore, Loan
from dpm2_core.slam.store.map_store import Change, MapStore
from dpm2_core.slam.store.writer import MapWriter

WRITTEN, WAITING = 4, 25


def test_a_cloud_stays_in_the_file_until_that_is_there_for_which_it_is_given_up(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """1 borrows from 0. The last of the waiting keyframes borrows there, too, so that the cloud of 1 is given up. So is
    that of 2, which borrows there later, because its loop waited for that of the last one."""
    path, room = tmp_path / "a.dpm2map", [100]
    write = MapStore.write

    def limited(store: MapStore, change: Change, wait: float) -> None:
        if not room[0]:
            raise Dpm2Error("the disk is full")
        room[0] -= 1
        write(store, change, wait)

    monkeypatch.setattr(MapStore, "write", limited)
    with MapStore.create(path) as store:
        store.begin_session()
        clouds = CloudStore(lambda node: store.payload(node, "cloud"))
        writer = MapWriter(store, clouds, np.zeros((0, 4, 4)))
        keyframes = [Keyframe(n, n, n, np.eye(4), NO_POINTS) for n in range(WRITTEN + WAITING)]

        def add(node: int, lender: int | None = None) -> None:
            if node == len(clouds):
                clouds.append(pack_cloud(np.full((5, 4), 0.1 * node, np.float32)))
            if lender is not None and (gone := clouds.borrow(node, Loan(lender, np.eye(4)))) is not None:
                writer.give_up(gone)
            writer.add(node, keyframes[node], None, [])

        def sync() -> None:
            writer.sync(np.tile(np.eye(4), (len(clouds), 1, 1)), None)

        def there() -> set[int]:
            return {node for (node,) in store.rows("payloads", "node")}

        for node, lender in enumerate([None, 0, None, None]):
            add(node, lender)
            sync()
        room[0] = 0
        for node in range(WRITTEN, len(keyframes) - 1):
            add(node)
            sync()
        add(len(keyframes) - 1, 0)  # the place of 1 as it was last seen
        add(2, 0)  # its loop waited
        sync()
        assert "in memory only" in writer.problem
        room[0] = 1
        sync()
        assert "in memory only" in writer.problem
        assert there() == set(range(WRITTEN + 20))
        assert not check_map(path).problems
        room[0] = 100
        sync()
        assert not writer.problem
        assert there() == set(range(len(keyframes))) - {1, 2}
        assert not check_map(path).problems


def test_a_file_that_another_program_locks_for_long_delays_only_the_first_keyframe(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Previously each keyframe waited 5 s, and the end of a node 25 s: `ros2 launch` kills it after 10."""
    monkeypatch.setattr("dpm2_core.slam.store.writer.BUSY", 2.0)
    path = tmp_path / "a.dpm2map"
    with MapStore.create(path) as store, closing(sqlite3.connect(path, isolation_level=None)) as other:
        store.begin_session()
        clouds = CloudStore(lambda node: store.payload(node, "cloud"))
        writer = MapWriter(store, clouds, np.zeros((0, 4, 4)))
        seconds = []
        other.execute("BEGIN IMMEDIATE")
        for node in range(4):
            clouds.append(pack_cloud(np.full((5, 4), 0.1 * node, np.float32)))
            writer.add(node, Keyframe(node, node, node, np.eye(4), NO_POINTS), None, [])
            started = monotonic()
            writer.sync(np.tile(np.eye(4), (node + 1, 1, 1)), None)
            seconds.append(monotonic() - started)
            assert writer.problem == f"{path}: database is locked; {node + 1} keyframes are in memory only"
        assert seconds[0] > 1.9
        assert sum(seconds[1:]) < 2.0  # 0.2 s each, and a busy machine
        other.execute("COMMIT")
        writer.sync(np.tile(np.eye(4), (4, 1, 1)), None)
        assert writer.problem == ""
    assert check_map(path).problems == []
