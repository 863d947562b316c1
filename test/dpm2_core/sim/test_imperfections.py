# SPDX-License-Identifier: Apache-2.0
"""What a real LiDAR adds to exact ranges, and the sensors of the worlds for training."""

from __future__ import annotations

import numpy as np
import pytest

from dpm2_core.geometry import se3
from dpm2_core.sim.beams import Beams
from dpm2_core.sim.lidar import Lidar, Scan
from dpm2_core.sim.materials import Label
from dpm2_core.sim.sensors import drawn_sensor, real_sensor
from dpm2_core.sim.settings import HDL64E, Imperfections, LidarConfig
from dpm2_core.sim.world import World, build_world

EXACT = LidarConfig(noise=0.0, dropout=0.0, columns=720)
TWIST = np.array([0, 0, 0.2, 10.0, 0, 0])


def _with(**real: object) -> Lidar:
    return Lidar(EXACT.model_copy(update={"real": Imperfections(**real)}))


def _scan(world: World, lidar: Lidar, seed: int = 0) -> Scan:
    return lidar.scan(world, world.pose_at(130.0), 1.0, np.random.default_rng(seed))


def _road_error(scan: Scan) -> tuple[np.ndarray, np.ndarray]:
    """Height of road points above the flat road, m, and their ring."""
    road = np.isin(scan.label, [Label.ROAD, Label.MARKING])
    return scan.points[road, 2] + EXACT.height, scan.ring[road]


def test_points_of_beams_with_other_origins_lie_on_the_same_road(highway: World) -> None:
    """The nearer they are, the less they look down: 0.2 m higher than the direction of their beam."""
    plain, raised = (_scan(highway, lidar) for lidar in (_with(), _with(emitters=(0.2, 0.2))))
    assert np.abs(_road_error(plain)[0]).max() < 2e-3
    assert np.abs(_road_error(raised)[0]).max() < 2e-3
    ring, distance = 50, np.linalg.norm(raised.points[:, :3], axis=1)
    near = raised.ring == ring
    elevation = np.arcsin(raised.points[near, 2] / distance[near])
    straight = plain.points[plain.ring == ring]
    exact = np.arcsin(straight[:, 2] / np.linalg.norm(straight[:, :3], axis=1)).mean()
    assert np.median(elevation - exact) == pytest.approx(0.2 / np.median(distance[near]), rel=0.15)


def test_a_beam_has_one_error_and_another_sensor_others(highway: World) -> None:
    means = []
    for serial in (1, 2):
        error, ring = _road_error(_scan(highway, _with(range_bias=0.03, serial=serial)))
        rings = [k for k in np.unique(ring) if (ring == k).sum() > 300]
        assert max(error[ring == k].std() for k in rings) < 2e-3  # the same for all returns of the beam
        means.append({k: error[ring == k].mean() for k in rings})
    assert np.std(list(means[0].values())) > 3e-3
    both = sorted(set(means[0]) & set(means[1]))
    assert abs(np.corrcoef([[mean[k] for k in both] for mean in means])[0, 1]) < 0.7


def test_beams_that_point_elsewhere_than_believed_bend_the_road(highway: World) -> None:
    error, ring = _road_error(_scan(highway, _with(angle_bias=0.1, serial=3)))
    means = [error[ring == k].mean() for k in np.unique(ring) if (ring == k).sum() > 300]
    assert 0.005 < np.std(means) < 0.1


def test_noise_grows_with_range_and_grazing_incidence(highway: World) -> None:
    """2 mm per meter: a road 30 m away is noisier than one 6 m away by this amount, along the beam."""
    exact, noisy = (_scan(highway, _with(growth=growth, weak=0.0)) for growth in (0.0, 0.002))
    first, second = (
        dict(
            zip(np.round(np.arctan2(s.points[:, 1], s.points[:, 0]), 4) + 100.0 * s.ring, s.points[:, :3], strict=True)
        )
        for s in (exact, noisy)
    )
    ranges = np.array([[np.linalg.norm(first[k]), np.linalg.norm(second[k])] for k in first.keys() & second.keys()])
    for low, high in ((5, 8), (25, 35)):
        part = ranges[(ranges[:, 0] > low) & (ranges[:, 0] < high)]
        assert np.diff(part).std() == pytest.approx(0.002 * part[:, 0].mean(), rel=0.15)


def test_drops_return_from_the_air_alike_in_scan_and_twin(highway: World) -> None:
    """There are as many as their density gives. They are labeled as outliers, and none of them is moving."""
    scan = _scan(highway, _with(drops=0.01))
    stray = scan.label == Label.OUTLIER
    distance = np.linalg.norm(scan.points[:, :3], axis=1)
    assert distance[stray].max() < 25.0
    reach = np.minimum(np.linalg.norm(_scan(highway, _with()).points[:, :3], axis=1), 25)
    assert stray.mean() == pytest.approx((1 - np.exp(-0.01 * (reach - 1.2))).mean(), rel=0.15)
    assert not scan.moving[stray].any()
    twin = {row.tobytes() for row in scan.static}
    assert np.mean([row.tobytes() in twin for row in scan.points[stray]]) > 0.95


def test_no_drop_is_behind_what_the_pulse_met() -> None:
    """Whether or not the surface returns the pulse: windows and dark paint absorb many pulses."""
    world = build_world("loop", "indoor", seed=3, length=60)
    T = world.pose_at(20.0, height=1.0)
    scan = _with(drops=0.05).scan(world, T, 0.0, np.random.default_rng(0))
    drops = scan.points[scan.label == Label.OUTLIER, :3]
    distance = np.linalg.norm(drops, axis=1)
    assert len(drops) > 100
    toward = ((drops / distance[:, None]) @ T[:3, :3].T).astype(np.float32)
    met = world.scene.cast(np.tile(T[:3, 3].astype(np.float32), (len(drops), 1)), toward, 80.0).distance
    assert (distance - met).max() < 0.05  # surfaces are rough by 0.02 m


def test_dirt_hides_always_the_same_directions(highway: World) -> None:
    lidar, clean = _with(dirt=0.2, serial=5), _with()

    def seen(lidar: Lidar, s: float) -> set[tuple[int, int]]:
        scan = lidar.scan(highway, highway.pose_at(s), 0.0, np.random.default_rng(0))
        azimuth = np.rint(np.arctan2(scan.points[:, 1], scan.points[:, 0]) / (2 * np.pi) * EXACT.columns).astype(int)
        return set(zip(scan.ring.tolist(), azimuth.tolist(), strict=True))

    lost = [seen(clean, s) - seen(lidar, s) for s in (120.0, 150.0)]
    assert 0.01 < len(lost[0]) / len(seen(clean, 120.0)) < 0.2
    assert len(lost[0] & lost[1]) > 0.6 * min(map(len, lost))


def test_glare_is_beside_retro_reflectors_only(city: World) -> None:
    exact, lit = (
        Lidar(config).scan(city, city.pose_at(40.0), 1.0, np.random.default_rng(0))
        for config in (EXACT, EXACT.model_copy(update={"real": Imperfections(glare=1.0)}))
    )
    stray = lit.points[lit.label == Label.OUTLIER]
    bright = [Label.SIGN, Label.CAR, Label.TRUCK, 252, 258]  # signs, and the lights and plates of cars
    sign = np.concatenate([s.points[np.isin(s.label & 0xFFFF, bright)] for s in (exact, lit)])
    assert len(stray) > 0
    away = np.linalg.norm(stray[:, None, :3] - sign[None, :, :3], axis=2).min(1)
    assert (away < 0.06 * np.linalg.norm(stray[:, :3], axis=1)).all()  # two beams and columns are at most 3 deg


def test_a_driver_that_knows_the_motion_undoes_it_and_another_leaves_its_share(tunnel: World) -> None:
    """With the right twist, the walls of the tunnel are at their positions; with half of it they are bent."""
    lidar, T = _with(), tunnel.pose_at(130.0)
    width = []
    for believed in (TWIST, 0.5 * TWIST):
        scan = lidar.scan(tunnel, T, 1.0, np.random.default_rng(0), TWIST, believed)
        still = lidar.scan(tunnel, T, 1.0, np.random.default_rng(0))
        low = [
            np.abs(s.points[(s.label == Label.STRUCTURE) & (np.abs(s.points[:, 0]) < 30)][:, 1]) for s in (scan, still)
        ]
        width.append(abs(np.quantile(low[0], 0.95) - np.quantile(low[1], 0.95)))
    assert width[0] < 0.02
    assert width[1] > 3 * width[0]


def test_the_real_sensor_scans_deterministically_and_its_mount_does_not_move_the_world(city: World) -> None:
    tilted = Lidar(real_sensor(LidarConfig(columns=720)).model_copy(update={"pitch": 15.0, "roll": 3.0}))
    T = city.pose_at(40.0) @ tilted.T_level_lidar
    first, second = (tilted.drive_scan(city, T, 1.0, np.random.default_rng(3)) for _ in range(2))
    np.testing.assert_array_equal(first.points, second.points)
    level = se3.transform(tilted.T_level_lidar, first.points)
    road = (first.label == Label.ROAD) & (np.hypot(level[:, 0], level[:, 1]) < 12)
    assert road.sum() > 500
    assert abs(np.median(level[road, 2]) + 1.73) < 0.08
    forward = first.points[road & (level[:, 0] > 5), 2]
    assert np.median(forward) > -1.0  # in the sensor's own axes the road ahead rises, as it looks down


def test_the_rosette_never_repeats_and_stays_in_its_cone() -> None:
    beams = Beams(LidarConfig(pattern="rosette", beams=16, columns=500), np.eye(4))
    first, second = beams.directions(0.0), beams.directions(0.1)
    assert first.shape == (16 * 500, 3)
    np.testing.assert_allclose(np.linalg.norm(first, axis=1), 1, atol=1e-5)
    assert np.degrees(np.arccos(first[:, 0])).max() < 38.0
    cells = [set(map(tuple, np.floor(rays[:, 1:] / 0.01).astype(int))) for rays in (first, second)]
    assert len(cells[0] | cells[1]) > 1.5 * len(cells[0])
    np.testing.assert_array_equal(first, beams.directions(0.0))


def test_drawn_sensors_are_as_often_real_and_others_as_asked_and_the_same_by_seed() -> None:
    usual = LidarConfig()
    drawn = [drawn_sensor(usual, 0.5, 0.4, np.random.default_rng(seed)) for seed in range(200)]
    assert drawn[:5] == [drawn_sensor(usual, 0.5, 0.4, np.random.default_rng(seed)) for seed in range(5)]
    assert 0.4 < np.mean([config.real != Imperfections() for config in drawn]) < 0.6
    assert 0.3 < np.mean([config.car_body is False or config.min_range == 0.4 for config in drawn]) < 0.5
    assert {(config.pattern, config.beams) for config in drawn} >= {("rosette", 16), ("spinning", 128)}
    assert drawn_sensor(usual, 0, 0, np.random.default_rng(0)) == usual
    assert all(config.real.emitters == (0, 0) for config in drawn if config.beams != 64)
    assert real_sensor(usual) == HDL64E
    for config in drawn:
        LidarConfig.model_validate(config.model_dump())  # within the bounds of the settings
