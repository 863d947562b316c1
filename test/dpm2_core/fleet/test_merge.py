# SPDX-License-Identifier: Apache-2.0
"""Drives become one map without any prior; what does not belong stays out, with its reason; a later drive is added."""

from __future__ import annotations

import shutil
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from benchmarks.fleet_drives import write_drive
from dpm2_core.errors import UsageError
from dpm2_core.evaluation.metrics import ape_rmse
from dpm2_core.fleet.cluster import Cluster
from dpm2_core.fleet.drives import MAP
from dpm2_core.fleet.joins import ENOUGH, stretches
from dpm2_core.fleet.merge import merge
from dpm2_core.fleet.part import DONE
from dpm2_core.fleet.places import WIDTH, FleetIndex
from dpm2_core.fleet.regions import Join, regions_of, solve
from dpm2_core.frame import Array, Edge, Keyframe, Registration
from dpm2_core.geometry import se3
from dpm2_core.sim.world import build_world
from dpm2_core.slam.graph.pose_graph import PoseGraphSettings
from dpm2_core.slam.settings import SlamSettings
from dpm2_core.slam.store.check import check_map
from dpm2_core.slam.store.cloud_store import CloudStore
from dpm2_core.slam.store.map_data import NO_POINTS, MapData, load_map
from dpm2_core.slam.store.map_store import MapStore

NOISE = np.diag([1e-3] * 3 + [0.02] * 3) ** 2


@pytest.mark.slow
def test_drives_that_share_a_road_become_one_map_and_others_stay_out(tmp_path: Path) -> None:
    """A drive of another town, a poisonous map and one that is not whole are named; what is added later is found."""
    pytest.importorskip("ray", reason="no ray: pip install 'dpm2_ros[fleet]'")
    pytest.importorskip("faiss", reason="no faiss: pip install 'dpm2_ros[fleet]'")
    town, other = (build_world("loop", "suburb", seed=seed, length=260.0) for seed in (3, 8))
    fleet, out = tmp_path / "fleet", tmp_path / "town.dpm2map"
    truth = {"a": write_drive(fleet / "a", town, (0, 45), 1)}
    write_drive(fleet / "stranger", other, (0, 20), 3)
    shutil.copytree(fleet / "a", fleet / "poison")
    content = bytearray((fleet / "poison" / MAP).read_bytes())
    middle = len(content) // 2
    content[middle : middle + 4000] = bytes(4000)
    (fleet / "poison" / MAP).write_bytes(content)
    shutil.copytree(fleet / "a", fleet / "torn")
    (fleet / "torn" / MAP).write_bytes(content[:middle])
    with Cluster(workers=1) as cluster:
        cluster.start()
        first = merge(fleet, out, SlamSettings(), Cluster())
        assert first.drives == {"a": 9}
        assert set(first.left_out) == {"stranger", "poison", "torn"}
        assert "dpm2 map check" in first.left_out["poison"]
        assert first.left_out["torn"].startswith("not whole")
        (known,) = (fleet / ".merge" / "joins").glob(f"a/stranger/*/{DONE}")
        before = known.stat().st_mtime_ns
        truth["b"] = write_drive(fleet / "b", town, (15, 60), 2)
        both = merge(fleet, out, SlamSettings(), Cluster())
    assert both.drives == {"a": 9, "b": 9}
    assert both.left_out["stranger"] == "no place in common with a"
    assert known.stat().st_mtime_ns == before, "what was found before was searched again"
    accepted = {tuple(row["drives"]): row["accepted"] for row in both.joins}
    assert accepted["a", "b"] >= ENOUGH
    assert sum(accepted.values()) == accepted["a", "b"]
    assert sum(both.rejected.values()) == sum(row["rejected"] for row in both.joins)
    assert all(both.rejected)
    assert not check_map(out).problems
    with MapStore.open(out) as store:
        data = load_map(store)
        assert [keyframe.robot for keyframe in data.keyframes] == ["a"] * 9 + ["b"] * 9
        assert all(keyframe.descriptors is not None for keyframe in data.keyframes)
        assert all(len(data.clouds[node]) for node in range(18))
    assert ape_rmse(np.concatenate([truth["a"], truth["b"]]), data.poses) < 0.3


def test_a_file_that_is_no_merge_is_not_replaced(tmp_path: Path) -> None:
    (tmp_path / "mine").write_text("precious")
    with pytest.raises(UsageError, match="which is no merge of drives"):
        merge(tmp_path, tmp_path / "mine", SlamSettings(), Cluster())
    assert (tmp_path / "mine").read_text() == "precious"
    with pytest.raises(UsageError, match="no drive that is whole"):
        merge(tmp_path, tmp_path / "out", SlamSettings(), Cluster())


def test_places_are_found_again_in_an_index_that_was_kept(tmp_path: Path, noise: np.random.Generator) -> None:
    """Also after one that was cut short, which counts as none."""
    pytest.importorskip("faiss", reason="no faiss: pip install 'dpm2_ros[fleet]'")
    drives = [noise.normal(size=(50, WIDTH)).astype(np.float32) for _ in range(2)]
    drives[1][7] = 0  # a keyframe without descriptors
    again = drives[0] + 0.05 * noise.normal(size=(50, WIDTH)).astype(np.float32)
    index = FleetIndex(tmp_path)
    assert (index.similar(again, 3) == -1).all()
    for name, vectors in zip("ab", drives, strict=True):
        index.add(name, [1, 2], vectors)
    index.save()
    kept = FleetIndex(tmp_path)
    assert kept.drives == [("a", [1, 2], 50), ("b", [1, 2], 50)]
    np.testing.assert_array_equal(kept.similar(again, 3)[:, 0], np.arange(50))
    assert (kept.similar(drives[1], 3)[7] == -1).all()
    (tmp_path / "index.faiss").write_bytes((tmp_path / "index.faiss").read_bytes()[:1000])
    assert not FleetIndex(tmp_path).drives


def test_stretches_hold_what_looks_alike_and_leave_out_single_keyframes() -> None:
    pairs = np.array([[3, 10], [40, 60], [4, 11], [5, 11], [5, 12], [90, 13]])
    (found,) = stretches("a", "b", pairs)
    assert found.other_nodes == (10, 11, 12, 13)
    assert {3, 4, 5, 90} <= set(found.one_nodes)
    assert 40 not in found.one_nodes
    long = np.stack([np.arange(100), np.arange(100)], 1)
    assert max(len(stretch.other_nodes) for stretch in stretches("a", "b", long)) <= 41


def _drive(poses: Array, seed: int) -> MapData:
    """The map of a drive whose odometry has drifted; it stands in a frame of its own."""
    rng = np.random.default_rng(seed)
    keyframes = [Keyframe(i, i, i, np.eye(4), NO_POINTS) for i in range(len(poses))]
    edges, own = [], [se3.exp(rng.normal(size=6) * [0, 0, 1, 50, 50, 0])]
    for i in range(1, len(poses)):
        T = se3.inverse(poses[i - 1]) @ poses[i] @ se3.exp(rng.normal(size=6) * np.sqrt(np.diag(NOISE)))
        edges.append(Edge("odometry", i - 1, i, Registration(T, NOISE)))
        own.append(own[-1] @ T)
    return MapData(keyframes, [1] * len(poses), np.array(own), edges, [], [], CloudStore(None, [None] * len(poses)))


def _fleet(count: int) -> tuple[dict[str, Array], dict[str, MapData], list[Join]]:
    """Drives along one way, each sharing its last 20 keyframes with the next; 10 true joins each, and a false one."""
    way = se3.exp(np.arange(40 * count + 40)[:, None] * np.array([0, 0, 0.01, 2.0, 0, 0]))
    names = [f"d{number}" for number in range(count)]
    truth = {name: way[40 * i : 40 * i + 60] for i, name in enumerate(names)}
    maps = {name: _drive(poses, i) for i, (name, poses) in enumerate(truth.items())}
    joins = []
    for one, other in pairwise(names):
        for k in range(0, 20, 2):
            T = se3.inverse(truth[one][40 + k]) @ truth[other][k]
            joins.append(Join(one, other, Edge("loop", 40 + k, k, Registration(T, NOISE))))
        wrong = T @ se3.exp(np.array([0, 0, 0.3, 8.0, 0, 0]))
        joins.append(Join(one, other, Edge("loop", 5, 5, Registration(wrong, NOISE))))
    return truth, maps, joins


def test_stages_give_the_poses_of_the_whole_and_refuse_what_cannot_be() -> None:
    """Regions of two drives, then their borders, as all at once: the wrong loops are told, the right ones kept."""
    truth, maps, joins = _fleet(5)
    sizes = {name: len(data) for name, data in maps.items()}
    assert [len(regions_of(sizes, joins, largest)) for largest in (1000, 130)] == [1, 3]
    whole, staged = (solve(maps, joins, PoseGraphSettings(), largest) for largest in (1000, 130))
    for region in (whole, staged):
        assert len(region.joins) == len(joins)
        for join in region.joins:
            right = (join.loop.from_node, join.loop.to_node) != (5, 5)
            assert join.loop.ok is right
            assert right or "sigma" in join.loop.registration.reason
    for name in maps:
        np.testing.assert_allclose(staged.poses[name], whole.poses[name], atol=0.02)
    true = np.concatenate(list(truth.values()))
    assert ape_rmse(true, np.concatenate(list(whole.poses.values()))) < 2.0  # 600 m, by 1 mrad a keyframe
