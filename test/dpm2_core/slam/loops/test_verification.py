# SPDX-License-Identifier: Apache-2.0
"""A right pose is accepted and no wrong one: neither elsewhere, nor on bare ground, nor along a tunnel."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

from dpm2_core.estimates import Registration
from dpm2_core.frame import Array, Points
from dpm2_core.geometry import se3
from dpm2_core.geometry.ground import height_above_ground
from dpm2_core.sim.lidar import Lidar
from dpm2_core.sim.settings import LidarConfig, PresetName
from dpm2_core.sim.world import build_world
from dpm2_core.slam.loops.verification import VerificationSettings, Verifier, objection_of_others
from dpm2_core.slam.preprocess import PreprocessSettings
from dpm2_core.slam.registration.icp import GeometricSettings


@pytest.mark.parametrize(
    ("best", "others", "objection"),
    [
        (0.96, [0.9], ""),
        (0.94, [0.9], "two places of the map fit alike: 94% and 90% of the points"),
        (0.91, [], ""),
        (1.0, [0.95], ""),
        (1.0, [1.0], "two places of the map fit alike: 100% and 100% of the points"),
        (1.0, [0.97], "two places of the map fit alike: 100% and 97% of the points"),
        (0.89, [], "89% of the points fit: no more than at a place that looks alike"),
        (0.80, [], "80% of the points fit: no more than at a place that looks alike"),
        (0.80, [0.2, 0.4], "80% of the points fit: no more than at a place that looks alike"),
    ],
)
def test_a_place_must_fit_clearly_better_than_others(best: float, others: list[float], objection: str) -> None:
    """The fraction of points that do not fit must be at most half of that at the next best place. A place that was not
    tried is assumed to fit to 80 %."""
    fits = [Registration(np.eye(4), np.eye(6), confidence) for confidence in (best, *others)]
    assert objection_of_others(fits[0], fits[1:]) == objection


@cache
def scans_along(preset: PresetName) -> tuple[list[Points], Array]:
    """Scans every 5 m along a street of 60 m."""
    world = build_world("straight", preset, seed=6, length=120.0)
    lidar, rng = Lidar(LidarConfig(columns=1024)), np.random.default_rng(0)
    poses = np.array([world.pose_at(s) for s in np.arange(40.0, 100.0, 5.0)])
    return [lidar.scan(world, T, 0.0, rng).points for T in poses], poses


@pytest.fixture
def suburb_scans() -> tuple[list[Points], Array]:
    return scans_along("suburb")


def verifier() -> Verifier:
    return Verifier(VerificationSettings(), GeometricSettings(), PreprocessSettings())


@pytest.mark.slow
def test_a_right_pose_is_accepted_and_improved(suburb_scans: tuple[list[Points], Array]) -> None:
    clouds, poses = suburb_scans
    v = verifier()
    around = v.surroundings(clouds[:6], se3.inverse(poses[3]) @ poses[:6])
    T = se3.inverse(poses[3]) @ poses[6]
    T_proposed = T @ se3.exp(np.array([0, 0, 0.02, 0.4, -0.3, 0.1]))
    found = v.verify(clouds[6], around, T_proposed)
    assert found.ok, found.reason
    off = se3.way(T, found.T_target_source)
    assert np.linalg.norm(off[3:]) < 0.05  # twice the range noise
    assert found.confidence > 0.8  # the smaller of the fraction above the ground and the fraction of all points
    assert 0.3 < se3.apart(T_proposed, found.T_target_source)[0] < 0.8


@pytest.mark.slow
@pytest.mark.parametrize("meters", [-15.0, 12.0, 25.0])
def test_a_wrong_place_in_the_same_street_is_rejected(suburb_scans: tuple[list[Points], Array], meters: float) -> None:
    """The road fits wherever a pose is on it; the objects next to it do not."""
    clouds, poses = suburb_scans
    v = verifier()
    around = v.surroundings(clouds[:6], se3.inverse(poses[3]) @ poses[:6])
    T = se3.inverse(poses[3]) @ poses[6] @ se3.exp(np.array([0, 0, 0, meters, 0, 0]))
    found = v.verify(clouds[6], around, T)
    assert not found.ok
    assert found.reason


@pytest.mark.slow
def test_bare_ground_is_rejected(suburb_scans: tuple[list[Points], Array]) -> None:
    clouds, poses = suburb_scans
    ground = [cloud[height_above_ground(cloud, 2.0, 0) <= 0.5] for cloud in clouds]
    v = verifier()
    around = v.surroundings(ground[:6], se3.inverse(poses[3]) @ poses[:6])
    found = v.verify(ground[6], around, se3.inverse(poses[3]) @ poses[6])
    assert not found.ok


def test_along_a_tunnel_no_pose_is_accepted() -> None:
    clouds, poses = scans_along("tunnel")
    v = verifier()
    around = v.surroundings(clouds[:6], se3.inverse(poses[3]) @ poses[:6])
    for meters in (0.0, 1.0, 8.0):
        T = se3.inverse(poses[3]) @ poses[6] @ se3.exp(np.array([0, 0, 0, meters, 0, 0]))
        assert not v.verify(clouds[6], around, T).ok


@pytest.mark.slow
@pytest.mark.parametrize(("preset", "i", "meters"), [("city", 5, 1.5), ("suburb", 8, -2.5), ("suburb", 4, 2.5)])
def test_a_proposal_that_is_off_along_a_street_is_moved_to_its_place(preset: PresetName, i: int, meters: float) -> None:
    """A proposal would stay where the covariance leaves the street open, or where half of the points above the ground
    fit. Both are reasons to search 1 m to either side."""
    clouds, poses = scans_along(preset)
    v = Verifier(VerificationSettings(max_moved=3.0), GeometricSettings(), PreprocessSettings())
    others = [k for k in range(i - 3, min(i + 4, len(clouds))) if k != i]
    around = v.surroundings([clouds[k] for k in others], se3.inverse(poses[i]) @ poses[others])
    found = v.verify(clouds[i], around, se3.exp(np.array([0, 0, 0, meters, 0, 0])))
    assert found.ok, found.reason
    assert np.linalg.norm(found.T_target_source[:3, 3]) < 0.05  # twice the range noise
