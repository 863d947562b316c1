# SPDX-License-Identifier: Apache-2.0
"""Scans: beam pattern, noise, labels, twins, exact poses, motion during the rotation."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from scipy.spatial import cKDTree

from dpm2_core.geometry import se3
from dpm2_core.sim.beams import elevations
from dpm2_core.sim.lidar import Lidar, Scan
from dpm2_core.sim.materials import Label
from dpm2_core.sim.settings import LidarConfig
from dpm2_core.sim.world import World, build_world


def _scan(world: World, seed: int = 0, s: float = 40.0, time: float = 1.0, **config: object) -> Scan:
    return Lidar(LidarConfig(**config)).scan(world, world.pose_at(s), time, np.random.default_rng(seed))


def test_a_scan_is_as_large_as_a_real_one_and_in_order(city: World) -> None:
    scan = _scan(city)
    assert 95_000 < len(scan.points) < 130_000
    assert scan.points.dtype == np.float32
    assert len(scan.points) == len(scan.label) == len(scan.moving) == len(scan.ring) == len(scan.time_offset)
    distance = np.linalg.norm(scan.points[:, :3], axis=1)
    assert distance.min() >= 1.2 - 1e-5
    assert distance.max() <= 80 + 1e-3
    assert np.isfinite(scan.points).all()
    assert (np.diff(scan.ring.astype(int)) >= 0).all()
    assert 0 <= scan.points[:, 3].min() <= scan.points[:, 3].max() <= 1


@pytest.mark.parametrize("beams", [16, 32, 64, 128])
def test_every_point_lies_on_its_beam(city: World, beams: int) -> None:
    scan = _scan(city, beams=beams, columns=400)
    flat = np.hypot(scan.points[:, 0], scan.points[:, 1])
    np.testing.assert_allclose(np.arctan2(scan.points[:, 2], flat), elevations(beams)[scan.ring], atol=1e-5)
    azimuth = np.arctan2(scan.points[:, 1], scan.points[:, 0]) / (2 * np.pi / 400)
    np.testing.assert_allclose(azimuth, azimuth.round(), atol=1e-3)


def test_the_hdl64_reaches_from_2_up_to_24_8_down() -> None:
    degrees = np.degrees(elevations(64))
    assert (degrees[0], degrees[-1], len(degrees)) == pytest.approx((2.0, -24.8, 64))


def test_the_same_seed_gives_the_same_scan_from_any_thread(city: World) -> None:
    with ThreadPoolExecutor(4) as pool:
        scans = list(pool.map(lambda _: _scan(city, seed=5), range(4)))
    for scan in scans[1:]:
        np.testing.assert_array_equal(scan.points, scans[0].points)
        np.testing.assert_array_equal(scan.label, scans[0].label)
        np.testing.assert_array_equal(scan.static, scans[0].static)
    other = _scan(city, seed=6)
    assert other.points.shape != scans[0].points.shape or (other.points != scans[0].points).any()


def test_ranges_have_the_noise_that_is_asked_for(city: World) -> None:
    """On asphalt: zero mean and 2 cm. Without the noise, the scan equals the one with noise 0."""
    exact, noisy = (_scan(city, noise=noise, dropout=0.0, beams=64) for noise in (0.0, 0.02))
    key = [np.round(np.arctan2(s.points[:, 1], s.points[:, 0]), 5) + 100.0 * s.ring for s in (exact, noisy)]
    _, a, b = np.intersect1d(*key, return_indices=True)
    road = (exact.label[a] == Label.ROAD) & (noisy.label[b] == Label.ROAD)
    error = np.linalg.norm(noisy.points[b, :3], axis=1) - np.linalg.norm(exact.points[a, :3], axis=1)
    assert road.sum() > 5000
    assert abs(error[road].mean()) < 0.001
    assert error[road].std() == pytest.approx(0.02, rel=0.05)


def _busy(world: World) -> tuple[np.ndarray, float]:
    """A pose and a time with a dynamic object in view."""
    for time in np.arange(0.0, 20.0, 0.5):
        T = world.drive_pose(float(time))
        if _scan_at(world, T, float(time)).moving.sum() > 200:
            return T, float(time)
    raise AssertionError("no traffic in this world")


def _scan_at(world: World, T: np.ndarray, time: float) -> Scan:
    return Lidar().scan(world, T, time, np.random.default_rng(0))


def test_the_twin_is_the_scan_without_what_moves(city: World) -> None:
    scan = _scan_at(city, *_busy(city))
    still = {row.tobytes() for row in scan.static}
    moving = np.array([row.tobytes() not in still for row in scan.points])
    np.testing.assert_array_equal(moving, scan.moving)  # all others are there to the bit, and no dynamic object is
    assert scan.moving.sum() > 200


def test_dynamic_objects_are_labelled_as_in_semantic_kitti_and_numbered(city: World) -> None:
    scan = _scan_at(city, *_busy(city))
    kind, number = scan.label & 0xFFFF, scan.label >> 16
    np.testing.assert_array_equal(kind >= 252, scan.moving)
    assert set(np.unique(kind[scan.moving])) <= {252, 253, 254, 258}
    assert (number[scan.moving] > 0).all()
    assert (number[~scan.moving] == 0).all()
    for k in np.unique(number[scan.moving]):  # one dynamic object is one compact object
        extent = np.ptp(scan.points[number == k, :2], axis=0)
        assert np.hypot(*extent) < 14


def test_dynamic_objects_move_and_what_stands_does_not(city: World) -> None:
    xy = [city.traffic.poses(t)[0] for t in (2.0, 2.1)]
    steps = np.linalg.norm(xy[1] - xy[0], axis=1)
    assert 0.03 < np.median(steps) < 3.0
    early, late = (Lidar().scan(city, city.pose_at(40.0), t, np.random.default_rng(1)) for t in (0.0, 9.0))
    np.testing.assert_array_equal(early.static, late.static)


def test_one_place_seen_from_two_poses_agrees_within_the_noise(city: World) -> None:
    """Poses and points are exact: rays from the second pose to the first one's points end at these points."""
    T_world_a, T_world_b = city.pose_at(30.0), city.pose_at(34.0, lateral=0.5, heading=0.2)
    scan = Lidar().scan(city, T_world_a, 0.0, np.random.default_rng(0))
    smooth = np.isin(scan.label, [Label.ROAD, Label.SIDEWALK, Label.BUILDING])
    seen = se3.transform(T_world_a, scan.points[smooth, :3].astype(float))

    def miss(T: np.ndarray) -> float:
        towards = seen - T[:3, 3]
        expected = np.linalg.norm(towards, axis=1)
        origins = np.tile(T[:3, 3].astype(np.float32), (len(towards), 1))
        directions = (towards / expected[:, None]).astype(np.float32)
        return float(np.median(np.abs(city.scene.cast(origins, directions, 200.0).distance - expected)))

    assert miss(T_world_b) < 0.03  # 2 cm of range noise, at grazing incidence a little more
    shifted = scan.points[smooth, :3] + np.float32([0.3, 0.3, 0.1])
    seen = se3.transform(T_world_a, shifted.astype(float))
    assert miss(T_world_b) > 0.06  # so the check does detect an error of the pose


@pytest.mark.slow
def test_a_turn_in_motion_is_undone_by_the_twist(tunnel: World) -> None:
    world = build_world("straight", "city", seed=1, length=60)
    lidar, T = Lidar(LidarConfig(noise=0.0, dropout=0.0)), world.pose_at(130.0)
    twist = np.array([0, 0, 0.5, 12.0, 0, 0])
    still = lidar.scan(world, T, 1.0, np.random.default_rng(0))
    moved = lidar.scan(world, T, 1.0, np.random.default_rng(0), twist)
    assert moved.time_offset.min() >= np.float32(-0.05)  # numpy before 2 does not treat it as equal to -0.05
    assert moved.time_offset.max() <= np.float32(0.05)
    ahead = np.abs(np.arctan2(moved.points[:, 1], moved.points[:, 0])) < 0.01
    assert np.abs(moved.time_offset[ahead]).max() < 0.001  # the stamp is the time at which it looks ahead
    wall = moved.label == Label.BUILDING
    tree = cKDTree(still.points[still.label == Label.BUILDING, :3])
    points = moved.points[wall, :3].astype(float)
    T_stamp_point = se3.exp(twist * moved.time_offset[wall, None])
    undone = np.einsum("nij,nj->ni", T_stamp_point[:, :3, :3], points) + T_stamp_point[:, :3, 3]
    raw, corrected = (np.median(tree.query(p)[0]) for p in (points, undone))
    assert corrected < 0.05  # the error due to the sampling of the walls
    assert raw > 3 * corrected


def test_the_car_hides_the_lowest_beams_ahead_and_behind_only() -> None:
    with_car, without = (Lidar(LidarConfig(car_body=body)) for body in (True, False))
    assert len(with_car.beams.directions(0.0)) < len(without.beams.directions(0.0)) == 64 * 2170
    hidden = np.setdiff1d(
        without.beams.ring.astype(int) * 4096 + without.beams.column,
        with_car.beams.ring.astype(int) * 4096 + with_car.beams.column,
    )
    rings, columns = np.divmod(hidden, 4096)
    side = np.abs(np.abs(np.remainder(columns / 2170 * 360 + 90, 180) - 90) - 90) < 25
    assert rings.min() > 45
    assert not side.any()


def test_losses_are_as_on_a_road(city: World) -> None:
    """Nearly all pulses onto near asphalt return; many onto glass and cars do not."""
    lidar = Lidar()
    T = city.pose_at(40.0)
    scan = lidar.scan(city, T, 1.0, np.random.default_rng(0))
    directions = (lidar.beams.directions(0.0) @ T[:3, :3].T).astype(np.float32)
    hits = city.scene.cast(np.tile(T[:3, 3].astype(np.float32), (len(directions), 1)), directions, 20.0)
    road = (hits.face >= 0) & (city.static.label[np.maximum(hits.face, 0)] == Label.ROAD)
    near = np.linalg.norm(scan.points[:, :3], axis=1) < 20
    assert 0.93 < (near & (scan.label == Label.ROAD)).sum() / road.sum() < 1.0
