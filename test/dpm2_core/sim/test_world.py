# SPDX-License-Identifier: Apache-2.0
"""Worlds: equal for equal arguments, free roads, the ground as in the map, degenerate where they should be."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import cKDTree

from dpm2_core.errors import UsageError
from dpm2_core.sim.lidar import Lidar
from dpm2_core.sim.materials import Label
from dpm2_core.sim.settings import PresetName
from dpm2_core.sim.world import World, build_world

GROUND = [Label.ROAD, Label.PARKING, Label.SIDEWALK, Label.OTHER_GROUND, Label.TERRAIN]


@cache
def built(road: str | Path, preset: PresetName) -> World:
    """150 m of a road, or a road along the poses of a file."""
    return build_world(str(road), preset, seed=2, length=150)


@pytest.mark.slow
def test_equal_arguments_give_equal_worlds_and_other_seeds_others() -> None:
    one, same, other = (build_world("random", "suburb", seed, 60) for seed in (5, 5, 6))
    for name in ("vertices", "faces", "label", "material", "color", "uv", "texture"):
        np.testing.assert_array_equal(getattr(one.static, name), getattr(same.static, name))
    for time in (0.0, 3.3):
        np.testing.assert_array_equal(one.traffic.poses(time)[0], same.traffic.poses(time)[0])
    assert one.static.vertices.shape != other.static.vertices.shape


def _low_vertices(world: World, labels: list[Label] | None = None) -> np.ndarray:
    """Positions (N, 2) of objects on the ground, up to the height of a car's sensor."""
    mesh = world.static
    requested = ~np.isin(mesh.label, GROUND) if labels is None else np.isin(mesh.label, labels)
    vertices = mesh.vertices[np.unique(mesh.faces[requested])]
    return vertices[vertices[:, 2] < world.terrain.height_at(vertices[:, :2]) + 2.2, :2]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("road", "preset"),
    [("loop", "city"), ("figure8", "suburb"), ("random", "rural"), ("straight", "tunnel"),
     ("file", "city"), ("file", "highway")],
)  # fmt: skip
def test_nothing_stands_in_the_way(road: str, preset: PresetName, poses_file: Path) -> None:
    world = built(poses_file if road == "file" else road, preset)
    drive = world.road.drive.xy
    assert cKDTree(drive).query(_low_vertices(world))[0].min() > 1.1  # half a car and a margin
    assert world.terrain.edge_at(drive).max() < 0.3  # it stays on the roads


@pytest.mark.slow
@pytest.mark.parametrize(("road", "preset"), [("loop", "city"), ("figure8", "suburb"), ("file", "city")])
def test_no_building_reaches_onto_any_street(road: str, preset: PresetName, poses_file: Path) -> None:
    world = built(poses_file if road == "file" else road, preset)
    footprints = _low_vertices(world, [Label.BUILDING])
    assert len(footprints) > 100
    assert world.terrain.edge_at(footprints).min() > 0.3


def test_the_ground_is_where_the_map_says(city: World) -> None:
    """Rays straight down meet the ground at the height that the elevation map gives."""
    terrain = city.terrain
    rng = np.random.default_rng(0)
    drive = city.road.drive.xy
    xy = drive[rng.integers(0, len(drive), 3000)] + rng.uniform(-9, 9, (3000, 2))
    origins = np.column_stack([xy, np.full(3000, 60.0)]).astype(np.float32)
    hits = city.scene.cast(origins, np.tile(np.float32([0, 0, -1]), (3000, 1)))
    label = city.static.label[hits.face]
    height = 60.0 - hits.distance
    edge = terrain.edge_at(xy)
    step = np.minimum(np.abs(edge), np.abs(edge - terrain.preset.sidewalk)) < 0.8  # the map's cells are 0.5 m
    for kinds, tolerance in (([Label.ROAD], 0.02), (GROUND, 0.05)):
        on = np.isin(label, kinds) & ~step
        assert on.sum() > 500
        assert np.quantile(np.abs(height - terrain.surface_at(xy))[on], 0.99) < tolerance
    rows, columns = (((xy - terrain.origin) / terrain.resolution).round().astype(int).T)[::-1]
    grid = terrain.origin + np.column_stack([columns, rows]) * terrain.resolution
    np.testing.assert_allclose(terrain.elevation()[rows, columns], terrain.surface_at(grid), atol=1e-4)


def _information(world: World) -> tuple[float, float]:
    """Mean squared components, along and across the road, of the normals of the static surfaces that a sensor sees."""
    T = world.pose_at(150.0)
    lidar = Lidar()
    directions = (lidar.beams.directions(0.0) @ T[:3, :3].T).astype(np.float32)
    origins = np.tile(T[:3, 3].astype(np.float32), (len(directions), 1))
    hits = world.scene.cast(origins, directions, 80.0)
    normals = hits.normal[hits.face >= 0] @ T[:3, :3].astype(np.float32)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return float((normals[:, 0] ** 2).mean()), float((normals[:, 1] ** 2).mean())


@pytest.mark.slow
def test_highway_and_tunnel_are_degenerate_along_the_road_and_a_city_is_not(tunnel: World, highway: World) -> None:
    for world in (tunnel, highway):
        along, across = _information(world)
        assert across > 0.05
        assert along < 1e-6 * across
    along, across = _information(build_world("straight", "city", seed=1, length=60))
    assert along > 0.05 * across


def test_a_degenerate_scan_does_not_change_along_the_road(tunnel: World) -> None:
    """Two positions 3 m apart: the same noise-free ranges, to the last digits of a float."""
    directions = Lidar().beams.directions(0.0)
    ranges = []
    for s in (120.0, 123.0):
        T = tunnel.pose_at(s)
        origins = np.tile(T[:3, 3].astype(np.float32), (len(directions), 1))
        turned = np.ascontiguousarray(directions @ T[:3, :3].T.astype(np.float32))
        ranges.append(tunnel.scene.cast(origins, turned, 80.0).distance)
    seen = np.isfinite(ranges).all(0)
    assert seen.mean() > 0.9
    assert np.quantile(np.abs(np.subtract(*np.stack(ranges)[:, seen])), 0.99) < 2e-3


def test_poses_stand_on_the_ground_and_vary(city: World) -> None:
    rng = np.random.default_rng(0)
    for _ in range(20):
        T, time = city.sample_pose(rng)
        assert 0 <= time <= city.road.times[-1]
        (nominal,), (yaw,) = city.road.drive.at(city.road.distance(time))
        assert np.linalg.norm(T[:2, 3] - nominal) < 1.1
        turn = np.arctan2(T[1, 0], T[0, 0]) - yaw
        assert abs((turn + np.pi) % (2 * np.pi) - np.pi) < 0.11
        assert abs(T[2, 3] - city.terrain.height_at(T[None, :2, 3])[0] - 1.73) < 0.1
        np.testing.assert_allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=1e-12)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"preset": "moon"}, "city, suburb, rural, highway, tunnel"),
        ({"road": "nowhere.txt"}, "nowhere.txt"),
        ({"length": 5.0}, "60 to 20000"),
        ({"seed": -1}, "0 or more"),
    ],
)
def test_bad_arguments_are_rejected(arguments: dict, message: str) -> None:
    with pytest.raises(UsageError, match=message):
        build_world(**arguments)
