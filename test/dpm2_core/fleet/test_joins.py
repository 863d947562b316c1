# SPDX-License-Identifier: Apache-2.0
"""Loops between two drives in laps: what one cloud has seen once is counted once."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dpm2_core.descriptors import Descriptors
from dpm2_core.estimates import Edge, Keyframe
from dpm2_core.fleet import joins
from dpm2_core.fleet.places import describe, places_part, vectors_of
from dpm2_core.frame import Array, Points
from dpm2_core.geometry import se3
from dpm2_core.network.pretrained import load_network
from dpm2_core.sim.lidar import Lidar
from dpm2_core.sim.settings import LidarConfig
from dpm2_core.slam.loops.closure import LoopCloser
from dpm2_core.slam.loops.place_recognition import PlaceRecognition
from dpm2_core.slam.mapping.merge import loops_by
from dpm2_core.slam.settings import SlamSettings
from dpm2_core.slam.store.map_data import load_map, save_as
from dpm2_core.slam.store.map_store import MapStore

from ...helpers.drives import street
from ...helpers.maps import in_laps

LIDAR = Lidar(LidarConfig(columns=1024))


class Asked(LoopCloser):
    """Finds no loop, and records the keyframe of each call, and the keyframes with clouds of their own."""

    channels = None

    def __init__(self) -> None:
        self.asked: list[tuple[int, list[int]]] = []

    def close(self, keyframes: Sequence[Keyframe], *given: Any) -> list[Edge]:
        *_, own = given
        assert own is not None
        self.asked.append((len(keyframes) - 1, np.flatnonzero(own).tolist()))
        return []


def test_the_search_for_loops_and_the_index_know_which_keyframes_borrow(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, noise: np.random.Generator
) -> None:
    """Two drives of three laps past four places: all later keyframes show what the first lap has seen."""
    clouds = [noise.normal(size=(50, 4)).astype(np.float32) for _ in range(4)]
    looks = [Descriptors.of(*(noise.normal(size=(80, n)).astype(np.float32) for n in (3, 32))) for _ in range(4)]
    save_as(in_laps(clouds, np.tile(np.eye(4), (12, 1, 1)), 3, looks), path := tmp_path / "map.dpm2map")
    own = [0, 1, 2, 3, 12, 13, 14, 15]
    expected = [(node, [n for n in own if n <= node]) for node in range(12, 24)]
    closer = Asked()
    monkeypatch.setattr(joins, "make_loops", lambda settings: closer)
    joins.verify(tmp_path, lambda done, total: None, {"path": path}, {"path": path}, [range(12)] * 2, SlamSettings())
    assert closer.asked == expected
    closer = Asked()
    with MapStore.open(path) as store:
        assert loops_by(closer)(load_map(store), load_map(store)) == []
    assert closer.asked == expected
    part = places_part("a", path)
    (folder := tmp_path / part.name).mkdir(parents=True)
    describe(folder, lambda done, total: None, **part.arguments)
    assert vectors_of(tmp_path, "a").any(1).tolist() == [True] * 4 + [False] * 8


@pytest.mark.weights
@pytest.mark.slow
def test_a_drive_is_not_joined_where_another_place_that_was_passed_once_looks_alike(tmp_path: Path) -> None:
    """The street is twice in the map of the first drive: at one place driven eight times, and once where the other
    drive was. Previously, all keyframes of the other drive were joined to the first place, 500 m off."""
    at, world, describe = np.arange(55.0, 66.0, 5.0), street("suburb", 8), PlaceRecognition(load_network("small", 1))

    def seen(s: float, lateral: float, time: float) -> Points:
        return LIDAR.scan(world, world.pose_at(s, lateral), time, np.random.default_rng(int(10 * s))).points

    def made(name: str, places: Array, lateral: float, time: float, poses: Array, laps: int) -> dict[str, Path]:
        clouds = [seen(s, lateral, time) for s in places]
        looks = [describe.descriptors(Keyframe(0, 0, 0, np.eye(4), cloud)) for cloud in clouds]
        save_as(in_laps(clouds, poses, laps, looks), tmp_path / name)
        return {"path": tmp_path / name}

    streets, far = np.array([world.pose_at(s) for s in at]), se3.make(np.eye(3), np.array([0, 500.0, 0]))
    one = made("one", at, 0.0, 0.0, np.concatenate([*[streets] * 8, far @ streets]), 8)
    there = far @ np.array([world.pose_at(s + 1, 0.5) for s in at])
    other = made("other", at + 1, 0.5, 7.0, there, 1)
    nodes = [range(9 * len(at)), range(len(at))]
    found = joins.verify(tmp_path, lambda done, total: None, one, other, nodes, SlamSettings())["loops"]
    assert [loop["ends"][1] for loop in found] == [0, 1, 2]
    assert all(loop["reason"].startswith("two places of the map fit alike") for loop in found)
