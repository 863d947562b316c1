# SPDX-License-Identifier: Apache-2.0
"""Clouds are restored to half a centimeter, from disk or, if there is none, from memory."""

from __future__ import annotations

import struct
import subprocess
import sys
import tracemalloc
import zlib

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dpm2_core.errors import UsageError
from dpm2_core.geometry import se3
from dpm2_core.slam.store.cloud_codec import QUANTUM, origin_of, pack_cloud, pack_mask, unpack_cloud, unpack_mask
from dpm2_core.slam.store.cloud_store import CloudStore, Loan


def clouds() -> list[np.ndarray]:
    rng = np.random.default_rng(0)
    return [(rng.normal(size=(n, 4)) * [20, 20, 3, 0] + [0, 0, 0, 0.5]).astype(np.float32) for n in (100, 0, 7)]


@given(st.integers(0, 300), st.sampled_from([0.0, 1.0, 60.0, 327.0, 2000.0]), st.integers(0, 2**32 - 1))
def test_rounding_is_half_a_step(count: int, reach: float, seed: int) -> None:
    """Half a centimeter up to 327 m, proportional beyond. Order, number and dtype stay."""
    rng = np.random.default_rng(seed)
    cloud = rng.uniform(-1, 1, (count, 4)).astype(np.float32) * np.float32([reach, reach, reach, 1])
    cloud[:, 3] = np.abs(cloud[:, 3])
    back = unpack_cloud(pack_cloud(cloud))
    assert back.shape == cloud.shape
    assert back.dtype == np.float32
    step = max(QUANTUM, reach * 1.001 / 32767)
    np.testing.assert_allclose(back[:, :3], cloud[:, :3], atol=0.501 * step + 1e-6 * reach)
    np.testing.assert_allclose(back[:, 3], cloud[:, 3], atol=0.502 / 255)


def test_what_is_no_cloud_is_rejected() -> None:
    for bad in (np.full((1, 4), np.nan, np.float32), np.full((1, 4), 1e5, np.float32)):
        with pytest.raises(UsageError, match=r"a cloud .*(not finite|too large)"):
            pack_cloud(bad)
    good = pack_cloud(clouds()[0])
    for bad in (b"", good[:-5], good[:8] + b"garbage", good[:8], b"\xff" + good[1:], good + b"more"):
        with pytest.raises(UsageError, match=r"^not a packed cloud") as error:
            unpack_cloud(bad)
        assert "\n" not in str(error.value)


def test_where_the_lidar_was_goes_with_its_cloud() -> None:
    """It is behind the header. A LiDAR at the origin takes no byte, as in earlier maps."""
    cloud, there = clouds()[0], np.array([5.0, -0.25, 2.5])
    here, moved = pack_cloud(cloud), pack_cloud(cloud, there)
    assert pack_cloud(cloud, np.zeros(3)) == here
    assert len(moved) == len(here) + 12
    assert origin_of(here).tolist() == [0, 0, 0]
    assert origin_of(moved).tolist() == there.tolist()
    np.testing.assert_array_equal(unpack_cloud(moved), unpack_cloud(here))
    for bad in (np.array([np.nan, 0, 0]), np.array([0, 0, 1e5])):
        with pytest.raises(UsageError, match=r"^a cloud seen from .*: too far away"):
            pack_cloud(cloud, bad)
        forged = moved[:8] + struct.pack("<3f", *bad) + moved[20:]
        for read in (origin_of, unpack_cloud):
            with pytest.raises(UsageError, match=r"^not a packed cloud: seen from "):
                read(forged)
    with pytest.raises(UsageError, match=r"^not a packed cloud: 12 bytes"):
        origin_of(moved[:12])


@pytest.mark.parametrize("quantum", [np.inf, -np.inf, np.nan, 0.0, -0.01, 1e-5, 1.1, 3e38])
def test_a_step_that_no_cloud_has_is_rejected(quantum: float) -> None:
    good = pack_cloud(clouds()[0])
    with pytest.raises(UsageError, match=r"a step of .* m, 0.0001 to 1 are allowed"):
        unpack_cloud(good[:4] + struct.pack("<f", quantum) + good[8:])


@pytest.mark.slow
@pytest.mark.parametrize("count", [10, 1_000_000, 0xFFFFFFFF])
def test_a_bomb_is_not_inflated(count: int) -> None:
    """200 kB that would become 200 MB: no more memory is used than a million points need, whatever number is
    claimed."""
    bomb = zlib.compress(bytes(200_000_000), 9)
    tracemalloc.start()
    try:
        with pytest.raises(UsageError, match=r"^not a packed cloud"):
            unpack_cloud(struct.pack("<If", count, 0.01) + bomb)
        with pytest.raises(UsageError, match=r"^not a packed mask"):
            unpack_mask(bomb, min(count, 1_000_000))
        assert tracemalloc.get_traced_memory()[1] < 3 * 7 * 1_000_000 + 1_000_000  # zlib doubles its buffer
    finally:
        tracemalloc.stop()


@given(st.lists(st.booleans(), max_size=40))
def test_masks_come_back(bits: list[bool]) -> None:
    mask = np.array(bits, bool)
    np.testing.assert_array_equal(unpack_mask(pack_mask(mask), len(bits)), mask)


def check(store: CloudStore) -> None:
    for cloud in clouds():
        store.append(pack_cloud(cloud))
    assert len(store) == 3
    for cloud, stored in zip(clouds(), store, strict=True):
        np.testing.assert_allclose(cloud, stored, atol=0.0051)
    assert len(store[-1]) == 7
    assert len(store[:2]) == 2
    store[0][:] = 0  # a copy: the stored cloud stays
    assert store[0].any()
    with pytest.raises(IndexError):
        store[3]


def test_round_trip_on_disk() -> None:
    check(CloudStore())


def test_without_a_temporary_folder(monkeypatch: pytest.MonkeyPatch) -> None:
    def reject(**_: object) -> None:
        raise OSError("no space")

    monkeypatch.setattr("tempfile.TemporaryFile", reject)
    check(CloudStore())


def test_moving_points_are_left_out_and_a_borrowed_cloud_is_moved() -> None:
    store = CloudStore()
    for number, cloud in enumerate(clouds()):
        store.append(pack_cloud(cloud, np.array([1.0, 0, 2]) * number))
    moving = np.arange(100) % 3 == 0
    store.set_moving(0, moving)
    np.testing.assert_allclose(store[0], clouds()[0][~moving], atol=0.0051)
    assert len(store.whole(0)) == 100
    T = se3.exp([0, 0, 0.3, 1, 2, 3])
    assert [store.origin(n).tolist() for n in range(3)] == [[0, 0, 0], [1, 0, 2], [2, 0, 4]]
    store.borrow(2, Loan(0, T))
    np.testing.assert_allclose(store[2], se3.transform(T, store[0]), atol=1e-5)
    np.testing.assert_allclose(store.origin(2), T[:3, 3])  # the position of the lender's LiDAR


AHEAD = np.array([1, 0, 0, 0], np.float32)


def test_how_a_place_was_last_seen_is_kept() -> None:
    """In each place, the newest keyframe that borrows keeps its own cloud, without moving points. The one before gives
    its cloud up."""
    store, (cloud, *_) = CloudStore(), clouds()
    for number in range(4):
        store.append(pack_cloud(cloud + number * AHEAD, np.array([1.0, 0, 2]) * number))
        if number > 1:
            assert store.borrow(number, Loan(0, np.eye(4))) == (None if number == 2 else 2)
            store.set_moving(number, np.arange(100) % 3 == 0)
    assert store.own.tolist() == [True, True, False, False]
    assert store.kept.tolist() == [store.keeps(n) for n in range(4)] == [True, True, False, True]
    assert store.packed(2) is None
    assert len(store.whole(2)) == len(store.seen(2)) == 0
    np.testing.assert_allclose(store.seen(3), (cloud + 3 * AHEAD)[np.arange(100) % 3 > 0], atol=0.0051)
    assert store.seen_from(3).tolist() == [3, 0, 6]
    np.testing.assert_array_equal(store[3], store[0])


def test_disk_that_fills_up() -> None:
    """In a process that may write only 4 kB: the first clouds are on disk, the rest stay in memory, none is lost."""
    program = """
import resource, signal
import numpy as np
from dpm2_core.slam.store.cloud_codec import pack_cloud
from dpm2_core.slam.store.cloud_store import CloudStore
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
resource.setrlimit(resource.RLIMIT_FSIZE, (4096, 4096))
store = CloudStore()
clouds = [np.random.default_rng(i).uniform(0, 1, (300, 4)).astype(np.float32) for i in range(10)]
for cloud in clouds:
    store.append(pack_cloud(cloud))
assert all(np.abs(store[i] - cloud).max() < 0.0051 for i, cloud in enumerate(clouds))
print("whole")
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=60)
    assert done.stdout == "whole\n", done.stderr
