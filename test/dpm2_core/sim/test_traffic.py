# SPDX-License-Identifier: Apache-2.0
"""Traffic as dense as requested: none at all, or columns on every lane without overlaps."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import cKDTree

from dpm2_core.errors import UsageError
from dpm2_core.sim.drive import NOTE, simulate
from dpm2_core.sim.lidar import Lidar
from dpm2_core.sim.materials import Label
from dpm2_core.sim.settings import DriveConfig, LidarConfig
from dpm2_core.sim.world import World, build_world

LIDAR = LidarConfig(columns=256)


@pytest.fixture(scope="module")
def dense() -> World:
    return build_world("straight", "city", seed=2, length=200, traffic=20)


def _share_moving(world: World) -> float:
    lidar, ratios = Lidar(LIDAR), []
    for time in np.linspace(1, 9, 5):
        scan = lidar.scan(world, world.drive_pose(time), time, np.random.default_rng(0))
        ratios.append(scan.moving.mean())
    return float(np.mean(ratios))


@pytest.mark.long
def test_dense_traffic_takes_a_third_of_the_points(dense: World) -> None:
    assert 0.2 < _share_moving(dense) < 0.55
    usual = build_world("straight", "city", seed=2, length=200)
    assert _share_moving(usual) < 0.1
    none = build_world("straight", "city", seed=2, length=60, traffic=0)
    assert none.traffic.dynamic_objects(3.0, none.drive_pose(3.0)[:3, 3]) is None


@pytest.mark.slow
def test_columns_keep_clear_of_each_other_of_the_car_and_of_what_stands(dense: World) -> None:
    """Vehicles are lines of points along their center lines: apart from each other, 3 m from the sensor, half a truck
    from static objects."""
    traffic = dense.traffic
    vehicles = np.flatnonzero([np.ptp(model.vertices[:, 0]) > 3 for model in traffic.models])
    assert len(vehicles) > 40
    lengths = np.array([np.ptp(traffic.models[k].vertices[:, 0]) for k in vehicles])
    static = dense.static
    parked = static.vertices[np.unique(static.faces[np.isin(static.label, [Label.CAR, Label.BUILDING])])]
    parked = parked[parked[:, 2] < dense.terrain.height_at(parked[:, :2]) + 3]
    for time in (0.0, 4.0, 9.0):
        xy, yaw = (each[vehicles] for each in traffic.poses(time))
        along = np.linspace(-0.5, 0.5, 9)[None, :, None] * lengths[:, None, None]
        ahead = np.stack([np.cos(yaw), np.sin(yaw)], -1)[:, None]
        lines = (xy[:, None] + along * ahead).reshape(-1, 2)
        owner = np.repeat(np.arange(len(vehicles)), 9)
        pairs = cKDTree(lines).query_pairs(0.9, output_type="ndarray")
        touching = owner[pairs[:, 0]] != owner[pairs[:, 1]]
        # at the ends of an open road the columns wrap around, out of sight
        ends = dense.road.drive.xy[[0, -1]]
        inside = (np.linalg.norm(xy[:, None] - ends, axis=-1) > 25).all(1)
        assert not (touching & inside[owner[pairs[:, 0]]] & inside[owner[pairs[:, 1]]]).any()
        assert np.linalg.norm(lines - dense.drive_pose(time)[:2, 3], axis=1).min() > 3.0
        assert cKDTree(parked[:, :2]).query(lines)[0].min() > 1.3  # half a truck


@pytest.mark.slow
def test_the_note_of_a_drive_names_its_traffic_and_another_one_is_rejected(tmp_path: Path) -> None:
    out = tmp_path / "drive"
    assert simulate(
        out, DriveConfig(frames=2, seed=3, road="straight", preset="highway", images=False, lidar=LIDAR, traffic=5)
    )
    assert json.loads((out / "sequences" / "00" / NOTE).read_text())["traffic"] == 5
    assert not simulate(
        out, DriveConfig(frames=2, seed=3, road="straight", preset="highway", images=False, lidar=LIDAR, traffic=5)
    )
    with pytest.raises(UsageError, match="other traffic"):
        simulate(out, DriveConfig(frames=2, seed=3, road="straight", preset="highway", images=False, lidar=LIDAR))


@pytest.mark.parametrize("traffic", [-1.0, 2000.0, float("nan")])
def test_a_factor_that_cannot_be_is_rejected(traffic: float) -> None:
    with pytest.raises(UsageError, match="--traffic"):
        build_world("straight", "city", traffic=traffic)
