# SPDX-License-Identifier: Apache-2.0
"""A keyframe that would spoil a map is rejected before it changes anything. The map then continues as if nothing had
arrived."""

from __future__ import annotations

import tracemalloc
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from dpm2_core.descriptors import Descriptors
from dpm2_core.estimates import Keyframe, Registration
from dpm2_core.frame import Array
from dpm2_core.geometry import se3
from dpm2_core.slam.build import make_mapper
from dpm2_core.slam.loops.closure import LoopCloser
from dpm2_core.slam.mapping.admission import RejectedError, check_keyframe
from dpm2_core.slam.mapping.mapper import Mapper
from dpm2_core.slam.settings import SlamSettings
from dpm2_core.slam.store.map_data import load_map
from dpm2_core.slam.store.map_store import MapStore

STEP = se3.exp([0, 0, 0.05, 2.0, 0, 0])
SIGMA = np.diag([1e-3, 1e-3, 1e-3, 0.02, 0.02, 0.02]) ** 2
SETTINGS = SlamSettings.model_validate({"loops": {"descriptors": False}})


def descriptors(channels: int = 128) -> Descriptors:
    rng = np.random.default_rng(0)
    return Descriptors.of(rng.normal(size=(256, 3)).astype("f4"), rng.normal(size=(256, channels)))


def keyframe(id: int) -> Keyframe:
    cloud = np.random.default_rng(id).uniform(0, 1, (500, 4)).astype(np.float32) * np.float32([20, 20, 5, 1])
    edge = Registration(STEP, SIGMA, 0.9, 0.05, "test") if id else None
    return Keyframe(id, 1000 + id, id, np.linalg.matrix_power(STEP, id), cloud, edge, descriptors=descriptors())


def with_cloud(value: float) -> Callable[[Keyframe], Keyframe]:
    def change(k: Keyframe) -> Keyframe:
        cloud = k.cloud.copy()
        cloud[3, 1] = value
        return replace(k, cloud=cloud)

    return change


def with_pose(T: Array) -> Callable[[Keyframe], Keyframe]:
    return lambda k: replace(k, T_odom_kf=T)


def with_covariance(covariance: Array) -> Callable[[Keyframe], Keyframe]:
    return lambda k: replace(k, edge=Registration(STEP, covariance, 0.9, 0.05, "test"))


def with_features(value: float) -> Callable[[Keyframe], Keyframe]:
    def change(k: Keyframe) -> Keyframe:
        d = descriptors()
        d.step[7] = value / abs(int(d.features[7].max()))
        return replace(k, descriptors=d)

    return change


UNSOUND = {
    "id: negative": lambda k: replace(k, id=-1),
    "id: no 31 bits": lambda k: replace(k, id=2**31),
    "pose: NaN": with_pose(np.full((4, 4), np.nan)),
    "pose: scaled": with_pose(np.diag([1.1, 1.1, 1.1, 1.0])),
    "pose: mirrored": with_pose(np.diag([1.0, 1.0, -1.0, 1.0])),
    "pose: on another planet": with_pose(se3.exp([0, 0, 0, 1e8, 0, 0])),
    "cloud: NaN": with_cloud(np.nan),
    "cloud: inf": with_cloud(np.inf),
    "cloud: too far": with_cloud(1e6),
    "cloud: shape": lambda k: replace(k, cloud=k.cloud[:, :3]),
    "covariance: NaN": with_covariance(SIGMA * np.nan),
    "covariance: zero": with_covariance(SIGMA * 0),
    "covariance: negative": with_covariance(-SIGMA),
    "covariance: huge": with_covariance(SIGMA * 1e20),
    "covariance: indefinite": with_covariance(SIGMA + np.fliplr(SIGMA) * 1e4),
    "descriptors: NaN": with_features(np.nan),
    "descriptors: inf": with_features(np.inf),
    "descriptors: too large": with_features(60000),
}


@pytest.mark.parametrize("name", UNSOUND)
def test_an_unsound_keyframe_is_rejected_with_its_reason_and_the_map_goes_on(name: str, tmp_path: Path) -> None:
    with MapStore.create(tmp_path / "map.dpm2map") as store:
        store.begin_session("", "")
        mapper = make_mapper(SETTINGS, store)
        mapper.add(keyframe(0))
        with pytest.raises(RejectedError) as rejected:
            mapper.add(UNSOUND[name](keyframe(1)))
        assert rejected.value.reason == name.split(":")[0]
        assert len(str(rejected.value)) < 200
        for id in (1, 2):
            mapper.add(keyframe(id))
        mapper.finish()
        assert mapper.store_problem == ""
        np.testing.assert_allclose(mapper.poses, [np.linalg.matrix_power(STEP, n) for n in range(3)], atol=1e-9)
        assert len(mapper.cloud()) > 1000
        assert [k.id for k in load_map(store).keyframes] == [0, 1, 2]


def test_a_cloud_that_reaches_far_takes_no_memory() -> None:
    """Three points 6 km apart, 37 bytes in a message, must not take 500 MB."""
    mapper, few = make_mapper(SETTINGS), np.float32([[3000, 3000, 0, 0], [-3000, -3000, 1, 0], [1, 0, 0, 0]])
    tracemalloc.start()
    mapper.add(replace(keyframe(0), cloud=few))
    mapper.add(keyframe(1))
    mapper.finish()
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 60e6  # cells of 1 m within the range of a LiDAR


def test_descriptors_of_another_network_never_reach_the_search() -> None:
    with pytest.raises(RejectedError, match="8 channels, the map's network makes 128") as rejected:
        check_keyframe(replace(keyframe(1), descriptors=descriptors(8)), channels=128)
    assert rejected.value.reason == "descriptors"
    check_keyframe(keyframe(1), channels=128)


def test_a_step_that_fails_leaves_no_node_behind(monkeypatch: pytest.MonkeyPatch) -> None:
    """Any step and error. If the search for loops fails, the keyframe is completely in the map."""
    mapper: Mapper = make_mapper(SETTINGS)
    mapper.add(keyframe(0))

    def broken(*_: object) -> None:
        raise MemoryError("no room")

    for target, in_map in (("described", 1), ("close", 2)):
        with monkeypatch.context() as patch:
            patch.setattr(LoopCloser, target, broken)
            with pytest.raises(MemoryError):
                mapper.add(keyframe(1))
        assert len(mapper.keyframes) == len(mapper.poses) == len(mapper.clouds) == in_map
    mapper.add(keyframe(2))
    assert [(e.from_node, e.to_node) for e in mapper.edges] == [(0, 1), (1, 2)]
