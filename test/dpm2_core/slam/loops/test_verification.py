# SPDX-License-Identifier: Apache-2.0
"""The points believe a right pose, and no wrong one: not elsewhere, not on bare ground, not along a tunnel."""

from __future__ import annotations

import numpy as np
import pytest

from dpm2_core.frame import Array, Points
from dpm2_core.geometry import se3
from dpm2_core.sim.lidar import Lidar
from dpm2_core.sim.settings import LidarConfig, PresetName
from dpm2_core.sim.world import build_world
from dpm2_core.slam.loops.verification import VerificationSettings, Verifier, above_ground
from dpm2_core.slam.registration.icp import GeometricSettings


def street(preset: PresetName) -> tuple[list[Points], Array]:
    """Scans every 5 m along a street of 60 m."""
    world = build_world("straight", preset, seed=6, length=120.0)
    lidar, rng = Lidar(LidarConfig(columns=1024)), np.random.default_rng(0)
    poses = np.array([world.pose_at(s) for s in np.arange(40.0, 100.0, 5.0)])
    return [lidar.scan(world, T, 0.0, rng).points for T in poses], poses


@pytest.fixture(scope="module")
def suburb() -> tuple[list[Points], Array]:
    return street("suburb")


def verifier() -> Verifier:
    return Verifier(VerificationSettings(), GeometricSettings(), 2)


def test_a_right_pose_is_believed_and_improved(suburb: tuple[list[Points], Array]) -> None:
    clouds, poses = suburb
    v = verifier()
    around = v.surroundings(clouds[:6], se3.inverse(poses[3]) @ poses[:6])
    T = se3.inverse(poses[3]) @ poses[6]
    e = v.verify(clouds[6], around, T @ se3.exp(np.array([0, 0, 0.02, 0.4, -0.3, 0.1])))
    assert e.registration.ok, e.registration.reason
    off = se3.log(se3.inverse(T) @ e.registration.T_target_source)
    assert np.linalg.norm(off[3:]) < 0.05  # twice the noise of the range
    assert e.structure > 0.8
    assert 0.3 < e.moved < 0.8


@pytest.mark.parametrize("meters", [-15.0, 12.0, 25.0])
def test_a_wrong_place_in_the_same_street_is_not_believed(suburb: tuple[list[Points], Array], meters: float) -> None:
    """The road fits wherever one is put on it; what stands beside it does not."""
    clouds, poses = suburb
    v = verifier()
    around = v.surroundings(clouds[:6], se3.inverse(poses[3]) @ poses[:6])
    T = se3.inverse(poses[3]) @ poses[6] @ se3.exp(np.array([0, 0, 0, meters, 0, 0]))
    e = v.verify(clouds[6], around, T)
    assert not e.registration.ok
    assert e.registration.reason


def test_bare_ground_tells_nothing(suburb: tuple[list[Points], Array]) -> None:
    clouds, poses = suburb
    ground = [cloud[~above_ground(cloud[:, :3].astype(float))] for cloud in clouds]
    v = verifier()
    around = v.surroundings(ground[:6], se3.inverse(poses[3]) @ poses[:6])
    e = v.verify(ground[6], around, se3.inverse(poses[3]) @ poses[6])
    assert not e.registration.ok


def test_along_a_tunnel_no_pose_is_believed() -> None:
    clouds, poses = street("tunnel")
    v = verifier()
    around = v.surroundings(clouds[:6], se3.inverse(poses[3]) @ poses[:6])
    for meters in (0.0, 1.0, 8.0):
        T = se3.inverse(poses[3]) @ poses[6] @ se3.exp(np.array([0, 0, 0, meters, 0, 0]))
        assert not v.verify(clouds[6], around, T).registration.ok


def test_what_stands_is_told_from_the_ground_on_a_slope() -> None:
    x, y = np.meshgrid(np.arange(-20, 20, 0.5), np.arange(-20, 20, 0.5))
    ground = np.stack([x.ravel(), y.ravel(), 0.1 * x.ravel()], -1)  # 10 %: 0.2 m within a cell
    wall = np.stack([np.full(30, 5.0), np.zeros(30), 0.5 + np.linspace(0.6, 3, 30)], -1)
    standing = above_ground(np.concatenate([ground, wall]))
    assert not standing[: len(ground)].any()
    assert standing[len(ground) :].all()
