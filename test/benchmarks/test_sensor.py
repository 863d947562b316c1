# SPDX-License-Identifier: Apache-2.0
"""Figures of scans recover the parameters of a simulated sensor; and reference points that are found again."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.reference_points import shares
from benchmarks.scan_statistics import RANGES, rings_of, statistics
from dpm2_core.frame import Frame
from dpm2_core.geometry import se3
from dpm2_core.sim.lidar import Lidar
from dpm2_core.sim.settings import Imperfections, LidarConfig
from dpm2_core.sim.world import World, build_world

from ..helpers.networks import tiny


@pytest.fixture(scope="module")
def street() -> World:
    return build_world("straight", "suburb", seed=2, length=60)


def _scans(world: World, **changes: object) -> list[np.ndarray]:
    real = Imperfections(**changes.pop("real", {}))  # type: ignore[arg-type]
    lidar = Lidar(LidarConfig(columns=1024, real=real, **changes))  # type: ignore[arg-type]
    return [lidar.scan(world, world.pose_at(s), 0.0, np.random.default_rng(0)).points for s in (120.0, 140.0)]


@pytest.mark.slow
def test_the_figures_find_what_a_sensor_was_given(street: World) -> None:
    """White noise, lost pulses, the height of the upper beams' origins and uneven gaps between rings."""
    exact = statistics(_scans(street, noise=0.0, dropout=0.0))
    rough = statistics(_scans(street, noise=0.03, dropout=0.1))
    near = slice(0, 3)
    assert exact["ring_range_noise_m"][0] < 1e-3
    assert rough["ring_range_noise_m"][0] == pytest.approx(0.03, rel=0.2)  # with the contribution of leaves and grass
    assert np.median(np.subtract(rough["lost"][near], exact["lost"][near])) == pytest.approx(0.1, abs=0.03)
    assert abs(exact["upper_origin_m"]) < 1e-3
    shifted = statistics(_scans(street, noise=0.0, real={"emitters": (0.2, 0.1), "uneven": 0.04}))
    assert shifted["upper_origin_m"] == pytest.approx(0.2, rel=0.05)
    assert exact["ring_gap_deg"][0][1] < 1e-3 < 0.03 < shifted["ring_gap_deg"][0][1]
    assert len(exact["lost"]) == len(RANGES) - 1


def test_rings_are_told_apart_where_azimuth_starts_again() -> None:
    azimuth = np.concatenate([np.linspace(0, 2 * np.pi, 100, endpoint=False)] * 3)
    azimuth[100] -= 0.005  # a little before straight ahead: corrected for motion
    points = np.stack([np.cos(azimuth), np.sin(azimuth), 0 * azimuth, 0 * azimuth], -1).astype(np.float32)
    np.testing.assert_array_equal(np.bincount(rings_of(points)), [100, 100, 100])


@pytest.mark.slow
def test_reference_points_of_the_same_scan_meet_and_of_another_place_do_not(street: World) -> None:
    """The same cloud twice: all; 20 m apart with a wrong motion: hardly any."""
    frame = Frame(0, _scans(street)[0])
    poses = np.stack([np.eye(4)] * 10)
    same = shares([frame] * 10, poses, tiny(), 5)
    assert {row["1 apart"]["0.2 m"] for row in same.values()} == {1.0}
    poses[:, 0, 3] = 20.0 * np.arange(10)
    moved = shares([frame] * 10, poses, tiny(), 5)
    assert all(row["1 apart"]["0.2 m"] < 0.2 for row in moved.values())
    assert se3.inverse(poses[1])[0, 3] == -20.0
