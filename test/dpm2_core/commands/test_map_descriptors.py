# SPDX-License-Identifier: Apache-2.0
"""Tools that copy a map read its descriptors one keyframe at a time, and name those that are damaged."""

from __future__ import annotations

import tracemalloc
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from dpm2_core.descriptors import Descriptors
from dpm2_core.slam.store.map_data import load_map, save_as
from dpm2_core.slam.store.map_store import MapStore
from dpm2_core.slam.store.rows import pack_descriptors, with_crc

from ...helpers.command import dpm2, succeeded
from ...helpers.maps import execute, ring

COMMANDS = {
    "prune": ("map", "prune", "MAP", "--out", "OUT"),
    "merge": ("map", "merge", "MAP", "MAP", "--transform", "0 0 0 0", "--out", "OUT"),
    "recover": ("map", "check", "MAP", "--recover", "OUT"),
    "tiles": ("map", "export", "MAP", "OUT", "--tiles", 1000),
}


def made(path: Path, count: int, number: int) -> Path:
    """A ring of keyframes with that number of descriptors each."""
    rng, data = np.random.default_rng(0), ring(count, points=10)
    xyz, values = rng.normal(size=(number, 3)).astype("f4"), rng.normal(size=(number, 128))
    save_as(
        replace(data, keyframes=[replace(k, descriptors=Descriptors.of(xyz, values)) for k in data.keyframes]), path
    )
    return path


def command(name: str, path: Path, out: Path) -> tuple[object, ...]:
    return tuple({"MAP": path, "OUT": out}.get(str(word), word) for word in COMMANDS[name])


@pytest.mark.parametrize("name", COMMANDS)
def test_one_set_of_descriptors_at_a_time_is_in_memory(tmp_path: Path, name: str) -> None:
    path = made(tmp_path / "map", 100, 1000)
    succeeded(*command(name, made(tmp_path / "small", 3, 5), tmp_path / "first"))  # imports all modules
    tracemalloc.start()
    try:
        succeeded(*command(name, path, tmp_path / "out"))
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert path.stat().st_size > 14e6
    assert peak < 5e6  # some sets of 144 kB at once, and the poses, edges and clouds of 100 or 200 keyframes


@pytest.mark.parametrize("name", ["prune", "merge", "tiles"])
def test_descriptors_that_cannot_be_used_are_named(tmp_path: Path, name: str) -> None:
    path = made(tmp_path / "map", 4, 5)
    with MapStore.open(path) as store:
        data = load_map(store)
        cloud, good = store.payload(2, "cloud"), data.keyframes[2].descriptors
    assert good is not None
    narrow = pack_descriptors(replace(good, features=good.features[:, :64]))
    for packed, problem in ((b"garbage99", "no descriptors: 9 bytes"), (narrow, "descriptors of 64, 128 channels")):
        execute(path, ("REPLACE INTO payloads VALUES (?, ?, ?, ?, ?)", with_crc(2, cloud, packed, None)))
        done = dpm2(*command(name, path, tmp_path / "out"))
        errors = [line for line in done.stderr.splitlines() if line.startswith("dpm2: ")]
        assert (done.returncode, len(errors)) == (1, 1), done
        assert errors[0].startswith(f"dpm2: {path}: keyframe 2: {problem}")
        assert not (tmp_path / "out").exists()


def test_descriptors_of_another_network_are_not_recovered(tmp_path: Path) -> None:
    """The map of such descriptors is opened by nothing: the check must not call it undamaged."""
    path = made(tmp_path / "map", 4, 5)
    with MapStore.open(path) as store:
        cloud, good = store.payload(0, "cloud"), load_map(store).keyframes[0].descriptors
    assert good is not None
    assert cloud is not None
    narrow = pack_descriptors(replace(good, features=good.features[:, :64]))
    execute(path, ("REPLACE INTO payloads VALUES (?, ?, ?, ?, ?)", with_crc(0, cloud, narrow, None)))
    done = dpm2("map", "check", path)
    assert done.returncode == 1
    assert done.stdout == "keyframe 0: its descriptors are lost: 64 channels, most have 128\n"
    succeeded("map", "check", path, "--recover", tmp_path / "good")
    with MapStore.open(tmp_path / "good") as store:
        data = load_map(store)
        assert [keyframe.descriptors is not None for keyframe in data.keyframes] == [False, True, True, True]
        assert store.payload(0, "cloud") == cloud
