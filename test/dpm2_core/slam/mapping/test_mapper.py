# SPDX-License-Identifier: Apache-2.0
"""Keyframes become a consistent map: loops remove drift, wrong loops are rejected, corrections reach every frame."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from dpm2_core.estimates import Keyframe, Registration, isotropic
from dpm2_core.evaluation.metrics import ape_rmse
from dpm2_core.fleet.regions import side_by_side
from dpm2_core.frame import Array
from dpm2_core.geometry import se3
from dpm2_core.sim.lidar import Lidar
from dpm2_core.sim.settings import LidarConfig
from dpm2_core.sim.world import build_world
from dpm2_core.slam.build import make_mapper
from dpm2_core.slam.mapping.admission import RejectedError
from dpm2_core.slam.mapping.merge import merge_maps
from dpm2_core.slam.mapping.occupancy import occupancy_grid
from dpm2_core.slam.mapping.occupancy_map import OCCUPIED, OccupancyMap, OccupancySettings
from dpm2_core.slam.output import save_map
from dpm2_core.slam.settings import SlamSettings
from dpm2_core.slam.store.check import check_map
from dpm2_core.slam.store.map_data import load_map, save_as, subset
from dpm2_core.slam.store.map_store import MapStore
from test.helpers.fleets import fleet_maps

# Loops by descriptors have their own tests. Here the poses select the candidates, which is faster.
BY_POSE = SlamSettings.model_validate({"loops": {"descriptors": False}})
SIGMA = np.diag([1e-3, 1e-3, 1e-3, 0.02, 0.02, 0.02]) ** 2


def found(T: Array, ok: bool = True) -> Registration:
    return Registration(T, SIGMA, 0.9, 0.05, "test", ok)


def drifting(poses: Array, drift: Array, cloud: np.ndarray) -> list[Keyframe]:
    """Keyframes whose odometry has an error of the tangent `drift` (6,) per step, all with the same cloud."""
    T_odom, keyframes = np.eye(4), []
    for i in range(len(poses)):
        edge = None
        if i:
            T = se3.inverse(poses[i - 1]) @ poses[i] @ se3.exp(drift)
            T_odom, edge = T_odom @ T, found(T)
        keyframes.append(Keyframe(i, i * 10**8, i, T_odom, cloud, edge))
    return keyframes


def circle(count: int, radius: float = 20.0) -> Array:
    """A lap of `count` poses that ends where it began."""
    turn = np.linspace(0, 2 * np.pi, count)
    return se3.exp(np.array([0, 0, 1.0, radius, 0, 0]) * turn[:, None])


@pytest.fixture(scope="module")
def lap() -> tuple[list[Keyframe], Array]:
    """Keyframes of a lap through a suburb that ends 15 m beyond its start, with an odometry that drifts by 2 m."""
    world = build_world("loop", "suburb", seed=4, length=220.0)
    lidar, rng = Lidar(LidarConfig(columns=1024)), np.random.default_rng(0)
    at = np.arange(0.0, world.road.drive.length + 15, 5.0)
    poses = np.array([world.pose_at(float(s)) for s in at])
    scans = [lidar.scan(world, T, 0.0, rng).points for T in poses]
    keyframes = drifting(poses, np.array([0, 0, 5e-4, 0.03, 0.01, 0.01]), scans[0])
    keyframes = [replace(k, cloud=points) for k, points in zip(keyframes, scans, strict=True)]
    return keyframes, se3.inverse(poses[0]) @ poses


@pytest.mark.slow
def test_an_odometry_that_starts_again_is_no_witness_of_what_moved(lap: tuple[list[Keyframe], Array]) -> None:
    """Previously, the clouds before and after were superimposed at arbitrary poses, and up to 15 % of the static points
    counted as moving."""

    def moving(keyframes: list[Keyframe]) -> list[int]:
        mapper = make_mapper(BY_POSE)
        for keyframe in keyframes:
            mapper.add(keyframe)
        mapper.finish()
        return [len(mapper.clouds.whole(i)) - len(mapper.clouds[i]) for i in range(len(keyframes))]

    keyframes, _ = lap
    first, second = keyframes[:7], keyframes[20:27]
    start = se3.inverse(second[0].T_odom_kf)
    second = [replace(k, id=i, T_odom_kf=start @ k.T_odom_kf, edge=k.edge if i else None)
              for i, k in enumerate(second)]  # fmt: skip
    assert moving(first + second) == moving(first) + moving(second)


@pytest.mark.slow
def test_a_lap_is_closed(lap: tuple[list[Keyframe], Array]) -> None:
    keyframes, truth = lap
    mapper = make_mapper(BY_POSE)
    for keyframe in keyframes:
        mapper.add(keyframe)
    open_ended = make_mapper(SlamSettings.model_validate({"loops": {"enabled": False}}))
    for keyframe in keyframes:
        open_ended.add(keyframe)
    assert open_ended.loops == []
    accepted = [loop for loop in mapper.loops if loop.ok]
    assert accepted
    for loop in accepted:  # each has the true relative pose
        true = se3.inverse(truth[loop.from_node]) @ truth[loop.to_node]
        assert se3.apart(true, loop.T_from_to)[0] < 0.1
    end, open_end = (np.linalg.norm((m.poses[-1] - truth[-1])[:3, 3]) for m in (mapper, open_ended))
    assert end < 0.1 * open_end
    assert ape_rmse(truth, mapper.poses) < 0.8 * ape_rmse(truth, open_ended.poses)  # the drift is the same in each step
    # The odometry is not changed: T_map_odom contains the correction.
    assert mapper.T_map_odom is not None
    last = mapper.T_map_odom @ keyframes[-1].T_odom_kf
    np.testing.assert_allclose(last, mapper.poses[-1], atol=1e-6)


@pytest.mark.slow
def test_look_alikes_are_rejected_with_a_reason(lap: tuple[list[Keyframe], Array]) -> None:
    """By the odometry the drive is back at the start, but the points come from elsewhere."""
    keyframes, _ = lap
    mapper = make_mapper(BY_POSE)
    for keyframe in keyframes[:-4]:
        mapper.add(keyframe)
    elsewhere = keyframes[len(keyframes) // 2].cloud
    for keyframe in keyframes[-4:]:
        for closure in mapper.add(replace(keyframe, cloud=elsewhere)):
            assert not closure.registration.ok
            assert closure.registration.reason


@pytest.mark.slow
def test_map_is_one_point_a_voxel_in_the_map_frame(lap: tuple[list[Keyframe], Array]) -> None:
    mapper = make_mapper(BY_POSE)
    assert mapper.cloud().shape == (0, 4)
    for keyframe in lap[0][:3]:
        mapper.add(keyframe)
    cloud = mapper.cloud(1.0)
    assert len(np.unique(np.floor(cloud[:, :3]).astype(int), axis=0)) == len(cloud)
    assert len(mapper.cloud(2.0)) < len(cloud)
    assert cloud[:, 0].max() > lap[0][0].cloud[:, 0].max() + 4  # the later keyframes reach further


@pytest.mark.slow
def test_saved_map_holds_all_of_it(tmp_path: Path, lap: tuple[list[Keyframe], Array]) -> None:
    from dpm2_core.data.trajectory import read_trajectory

    mapper = make_mapper(BY_POSE)
    for keyframe in lap[0][:4]:
        mapper.add(keyframe)
    save_map(mapper, tmp_path / "map")
    trajectory = read_trajectory(tmp_path / "map" / "trajectory.tum")
    np.testing.assert_allclose(trajectory.poses, mapper.poses, atol=1e-9)
    header = (tmp_path / "map" / "map.ply").read_bytes()[:200].decode("ascii", "replace")
    assert f"element vertex {len(mapper.cloud())}" in header
    assert (tmp_path / "map" / "pose_graph.g2o").read_text().count("EDGE_SE3:QUAT") == 3


def test_each_robot_has_its_own_odometry_and_is_placed_when_tied() -> None:
    """Interleaved keyframes of two robots and a restart of one. Edges connect keyframes of the same drive, and ids
    continue."""
    mapper = make_mapper(BY_POSE)
    poses, cloud = circle(6), np.zeros((0, 4), np.float32)
    for one in drifting(poses, np.zeros(6), cloud):
        for robot in ("red", "blue"):
            mapper.add(replace(one, robot=robot))
    assert [(e.from_node, e.to_node) for e in mapper.edges] == [(n, n + 2) for n in range(10)]
    np.testing.assert_allclose(mapper.T_map_odom_of("red"), np.eye(4), atol=1e-9)
    assert mapper.T_map_odom_of("blue") is None  # its position in red's map is not known
    assert mapper.T_map_odom_of("green") is None
    for one in drifting(poses, np.zeros(6), cloud)[:2]:  # red again
        mapper.add(replace(one, robot="red"))
    assert [k.id for k in mapper.keyframes if k.robot == "red"] == list(range(8))
    assert (mapper.edges[-1].from_node, mapper.edges[-1].to_node) == (12, 13)
    assert mapper.T_map_odom_of("red") is None


def test_a_robot_that_nothing_ties_is_not_drawn_into_the_map_of_another() -> None:
    """Blue sees a wall 6 m ahead of its start, on red's free road. It is not in the grid and the cloud before a loop
    connects the two."""
    x, y = (v.ravel() for v in np.meshgrid(np.arange(-20, 20, 0.4), np.arange(-20, 20, 0.4)))
    road = np.column_stack([x, y, np.full(len(x), -1.7), np.zeros(len(x))]).astype(np.float32)
    y, z = (v.ravel() for v in np.meshgrid(np.arange(-8, 8, 0.1), np.arange(-1.6, 1, 0.2)))
    wall = np.column_stack([np.full(len(y), 6.0), y, z, np.zeros(len(y))]).astype(np.float32)
    settings = SlamSettings.model_validate({"loops": {"enabled": False}})
    mapper, grid = make_mapper(settings), OccupancyMap(OccupancySettings(), 10**7)
    mapper.add(replace(drifting(circle(1), np.zeros(6), road)[0], robot="red"))
    mapper.update_grid(grid, np.inf)
    cells, cloud = grid.grid().cells, mapper.cloud()
    assert (cells != OCCUPIED).all()
    for one in drifting(circle(2), np.zeros(6), np.concatenate([road[road[:, 0] < 6], wall])):
        mapper.add(replace(one, robot="blue"))
    mapper.update_grid(grid, np.inf)
    assert mapper.placed.tolist() == [True, False, False]
    np.testing.assert_array_equal(grid.grid().cells, cells)
    np.testing.assert_array_equal(mapper.cloud(), cloud)


def test_where_the_lidar_was_stays_with_its_cloud(tmp_path: Path) -> None:
    """The position is in the map file, and in merged, partial and recovered copies. The rays of the grid start
    there."""
    x, y = (v.ravel() for v in np.meshgrid(np.arange(-5, 5, 0.25), np.arange(-5, 5, 0.25)))
    floor = np.column_stack([x + 2, y, np.full(len(x), -0.5), np.zeros(len(x))]).astype(np.float32)
    off, mount = SlamSettings.model_validate({"loops": {"enabled": False}}), np.array([2.0, 0.0, 0.5])
    with MapStore.create(tmp_path / "map") as store:
        store.begin_session()
        mapper, grid = make_mapper(off, store), OccupancyMap(OccupancySettings(), 10**7)
        for number, keyframe in enumerate(drifting(circle(3), np.zeros(6), floor)):
            mapper.add(replace(keyframe, origin=number * mount))
        mapper.update_grid(grid, np.inf)
        mapper.finish()
        drawn = grid.grid()
    assert check_map(tmp_path / "map", tmp_path / "recovered").problems == []
    for path in (tmp_path / "map", tmp_path / "recovered"):
        with MapStore.open(path) as store:
            data = load_map(store)
            for made in (data, merge_maps(data, data, np.eye(4)), subset(data, [0, 1, 2], data.edges, [])):
                assert [made.clouds.origin(n).tolist() for n in range(3)] == [(n * mount).tolist() for n in range(3)]
            seen = occupancy_grid(data.clouds, data.poses, OccupancySettings())
            np.testing.assert_array_equal(seen.cells, drawn.cells)


@pytest.mark.parametrize("origin", [[np.nan, 0.0, 0.0], [0.0, 0.0, 1e6]])
def test_a_cloud_that_is_seen_from_nowhere_is_rejected(origin: list[float]) -> None:
    mapper, keyframe = make_mapper(BY_POSE), drifting(circle(1), np.zeros(6), np.zeros((0, 4), np.float32))[0]
    with pytest.raises(RejectedError, match="its cloud is seen from"):
        mapper.add(replace(keyframe, origin=np.array(origin)))
    assert not mapper.keyframes


def test_another_drive_is_placed_where_one_says_where_it_begins(tmp_path: Path) -> None:
    """It is not placed just because it extends an existing map: with `dpm2 run --extend` its position is not known
    before a loop."""
    _, maps, _ = fleet_maps(1)
    for place, expected in ((None, False), (np.eye(4), True)):
        save_as(maps["d0"], tmp_path / f"map {expected}")
        with MapStore.open(tmp_path / f"map {expected}") as store:
            mapper = make_mapper(SlamSettings.model_validate({"loops": {"enabled": False}}), store)
            if place is not None:
                mapper.start_session(place, 0.1**2 * np.eye(6))
            assert (mapper.T_map_odom is not None) == expected
            mapper.add(drifting(circle(1), np.zeros(6), np.zeros((0, 4), np.float32))[0])
            assert mapper.placed.tolist() == [True] * 60 + [expected]
            assert (mapper.T_map_odom_of("") is not None) == (mapper.T_map_odom is not None) == expected


def test_a_session_whose_odometry_breaks_before_its_first_keyframe_is_tied_loosely(tmp_path: Path) -> None:
    """Its edge includes the covariance of the break. Previously, the edge only had the covariance of the localization
    before the break."""
    _, maps, _ = fleet_maps(1)
    save_as(maps["d0"], tmp_path / "map")
    broken = Registration(np.eye(4), isotropic(1.0, 30.0), 0.9, 0.05, "test")
    with MapStore.open(tmp_path / "map") as store:
        mapper = make_mapper(SlamSettings.model_validate({"loops": {"enabled": False}}), store)
        mapper.start_session(np.eye(4), SIGMA)
        mapper.add(replace(drifting(circle(1), np.zeros(6), np.zeros((0, 4), np.float32))[0], edge=broken))
        np.testing.assert_allclose(mapper.edges[-1].covariance, SIGMA + broken.covariance)


def test_a_map_of_several_drives_is_loaded_with_the_poses_of_its_file(tmp_path: Path) -> None:
    """The poses are kept however far the loops are from them: the loops have been weighed against each other before."""
    _, maps, joins = fleet_maps(3)
    poses = {name: se3.exp(np.full(6, 0.01 * i)) @ data.poses for i, (name, data) in enumerate(maps.items())}
    data = replace(side_by_side(maps, joins), poses=np.concatenate(list(poses.values())))
    save_as(data, tmp_path / "map")
    with MapStore.open(tmp_path / "map") as store:
        settings = SlamSettings.model_validate({"loops": {"descriptors": False}})
        np.testing.assert_array_equal(make_mapper(settings, store).poses, data.poses)
