# SPDX-License-Identifier: Apache-2.0
"""Buildings: every room is reached through its doors, the path is free, and scans show walls on all sides."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import cKDTree

from dpm2_core.errors import UsageError
from dpm2_core.geometry import se3
from dpm2_core.sim.drive import simulate
from dpm2_core.sim.floorplan import FloorPlan, car_park, office
from dpm2_core.sim.lidar import Lidar
from dpm2_core.sim.materials import Label
from dpm2_core.sim.settings import DriveConfig, LidarConfig, PresetName
from dpm2_core.sim.world import World, build_world

SMALL = Lidar().config.model_copy(
    update={"beams": 16, "columns": 600, "height": 1.0, "car_body": False, "min_range": 0.3, "noise": 0.0}
)


@pytest.fixture(scope="module", params=["indoor", "car_park"])
def inside(request: pytest.FixtureRequest) -> World:
    preset: PresetName = request.param
    return build_world("loop", preset, seed=4, length=120)


def _plan(world: World) -> FloorPlan:
    assert world.road.plan is not None
    return world.road.plan


@pytest.mark.parametrize("seed", range(6))
def test_rooms_fill_the_floor_and_the_way_visits_each_through_doors_alone(seed: int) -> None:
    plan = office(150.0, np.random.default_rng(seed))
    low = np.min([room.low for room in plan.rooms], axis=0)
    high = np.max([room.high for room in plan.rooms], axis=0)
    assert sum(room.size.prod() for room in plan.rooms) == pytest.approx((high - low).prod())  # no two rooms overlap
    assert len(plan.doors) >= len(plan.rooms) - 1
    corners = np.concatenate([plan.way, plan.way[:1]])
    fine = np.concatenate([np.linspace(a, b, 60, endpoint=False) for a, b in pairwise(corners)])
    room_of = np.full(len(fine), -1)
    for k, room in enumerate(plan.rooms):
        room_of[((fine > room.low) & (fine < room.high)).all(1)] = k
    assert set(range(len(plan.rooms))) <= set(room_of.tolist())
    doors = {tuple(sorted(door.rooms)): door for door in plan.doors}
    inside = np.flatnonzero(room_of >= 0)
    for before, after in pairwise(inside):
        if room_of[before] != room_of[after]:
            door = doors[tuple(sorted((int(room_of[before]), int(room_of[after]))))]
            assert door.start < fine[before][1 - door.axis] < door.end


def test_the_way_is_free_of_all_that_stands_in_it(inside: World) -> None:
    """No object from 0.2 to 1.8 m high is nearer than the width of a narrow robot. Where cars drive, there is room for
    a car."""
    mesh = inside.static
    height = mesh.vertices[mesh.faces][:, :, 2]
    low = (height.min(1) < 1.8) & (height.max(1) > 0.2)
    T = [inside.pose_at(s, height=1.0) for s in np.arange(0, inside.road.drive.length, 1.0)]
    azimuth = np.linspace(0, 2 * np.pi, 72, endpoint=False)
    level = np.stack([np.cos(azimuth), np.sin(azimuth), 0 * azimuth], -1).astype(np.float32)
    nearest = []
    for pose in T:
        for z in (0.3, 1.0, 1.6):
            eye = (pose[:3, 3] * (1, 1, 0) + (0, 0, z)).astype(np.float32)
            nearest.append(inside.scene.cast(np.tile(eye, (len(level), 1)), level, 50.0).distance.min())
    assert low.any()
    assert min(nearest) > (0.25 if inside.preset == "indoor" else 0.9)


def test_a_scan_is_closed_in_by_walls_floor_and_ceiling(inside: World) -> None:
    lidar, T = Lidar(SMALL), inside.pose_at(20.0, height=1.0)
    scan = lidar.scan(inside, T, 0.0, np.random.default_rng(0))
    assert len(scan.points) > 0.8 * 16 * 600  # the rest is lost, or absorbed by windows and the paint of cars
    z = (se3.transform(T, scan.points))[:, 2]
    assert abs(np.quantile(z, 0.005)) < 0.02
    assert z.max() < 12
    assert {int(Label.BUILDING), int(Label.OBJECT) if inside.preset == "indoor" else int(Label.CAR)} <= set(scan.label)


def test_the_same_seed_gives_the_same_building_and_another_seed_another() -> None:
    worlds = [build_world("random", "indoor", seed, length=60) for seed in (1, 1, 2)]
    np.testing.assert_array_equal(worlds[0].static.vertices, worlds[1].static.vertices)
    assert worlds[0].static.vertices.shape != worlds[2].static.vertices.shape


def test_places_to_train_on_lie_on_the_way(inside: World) -> None:
    rng, way = np.random.default_rng(0), cKDTree(inside.road.drive.xy)
    at = np.array([inside.sample_pose(rng, height=0.8)[0][:3, 3] for _ in range(50)])
    assert way.query(at[:, :2])[0].max() < 0.45
    assert np.abs(at[:, 2] - 0.8).max() < 0.06
    assert np.ptp(at[:, :2], axis=0).max() > 5


@pytest.mark.parametrize("length", [20.0, 48.0, 150.0])
def test_every_seed_gives_a_building_with_a_way(length: float) -> None:
    """A single hall has no door to go through."""
    for seed in range(100):
        assert len(office(length, np.random.default_rng(seed)).way) > 1, seed


def test_a_building_too_short_for_two_rooms_is_rejected() -> None:
    with pytest.raises(UsageError, match="a route of 1 m has a single room"):
        office(1.0, np.random.default_rng(0))


def test_a_car_park_grows_with_the_way_asked_for() -> None:
    short, long = (car_park(length, np.random.default_rng(0)) for length in (80.0, 400.0))
    assert long.rooms[0].size.prod() > 2 * short.rooms[0].size.prod()


def test_what_there_is_not_indoors_is_rejected() -> None:
    with pytest.raises(UsageError, match="--road straight: indoors"):
        build_world("straight", "indoor", 0, 60)
    with pytest.raises(UsageError, match="--traffic 20: there is no traffic indoors"):
        build_world("loop", "car_park", 0, 60, traffic=20)


def test_the_way_is_free_below_the_headroom(inside: World) -> None:
    """A LiDAR that does not fit is an error: above a ceiling it sees nothing."""
    headroom = _plan(inside).headroom
    up = np.array([[0, 0, 1]], np.float32)
    for s in np.arange(0, inside.road.drive.length, 0.1):
        eye = inside.pose_at(s, height=1.0)[:3, 3].astype(np.float32)
        assert eye[2] + inside.scene.cast(eye[None], up, 50.0).distance[0] > headroom - 0.01


def test_a_lidar_that_does_not_fit_is_rejected(tmp_path: Path) -> None:
    tall = LidarConfig(beams=16, columns=360, height=3.0)
    with pytest.raises(UsageError, match=r"--height 3: the route passes under"):
        simulate(tmp_path / "d", DriveConfig(preset="indoor", frames=1, images=False, lidar=tall))
    assert not list(tmp_path.iterdir())
