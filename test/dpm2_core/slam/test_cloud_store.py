# SPDX-License-Identifier: Apache-2.0
"""Clouds come back as they were, from disk or, without one, from memory."""

from __future__ import annotations

import resource
import subprocess
import sys

import numpy as np
import pytest

from dpm2_core.slam.cloud_store import CloudStore


def clouds() -> list[np.ndarray]:
    rng = np.random.default_rng(0)
    return [rng.normal(size=(n, 4)).astype(np.float32) for n in (100, 0, 7)]


def check(store: CloudStore) -> None:
    for cloud in clouds():
        store.append(cloud)
    assert len(store) == 3
    for cloud, stored in zip(clouds(), store, strict=True):
        np.testing.assert_array_equal(cloud, stored)
    np.testing.assert_array_equal(store[-1], clouds()[-1])
    assert len(store[:2]) == 2
    store[0][:] = 0  # a copy: what is stored stays
    with pytest.raises(IndexError):
        store[3]


def test_round_trip_on_disk() -> None:
    check(CloudStore())


def test_without_a_temporary_folder(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(**_: object) -> None:
        raise OSError("no space")

    monkeypatch.setattr("tempfile.TemporaryFile", refuse)
    check(CloudStore())


def test_disk_that_fills_up() -> None:
    """In a process that may write 4 kB: the first clouds are on disk, the rest stay in memory, none is lost."""
    program = """
import resource, signal
import numpy as np
from dpm2_core.slam.cloud_store import CloudStore
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
resource.setrlimit(resource.RLIMIT_FSIZE, (4096, 4096))
store = CloudStore()
for i in range(10):
    store.append(np.full((50, 4), i, np.float32))
assert all((store[i] == i).all() and store[i].shape == (50, 4) for i in range(10))
print("whole")
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=60)
    assert done.stdout.strip() == "whole", done.stderr


def test_memory_does_not_grow_with_clouds() -> None:
    store = CloudStore()
    cloud = np.ones((50_000, 4), np.float32)
    for _ in range(10):
        store.append(cloud)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    for _ in range(100):
        store.append(cloud)
    grown = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before
    assert grown < 20_000  # kB; the clouds are 80,000
