# SPDX-License-Identifier: Apache-2.0
"""Rotations and jolts that begin or end between two scans: the points still fit, but at walls next to their own."""

from __future__ import annotations

import numpy as np
import pytest

from dpm2_core.frame import Array, Frame
from dpm2_core.geometry import se3
from dpm2_core.sim.lidar import Lidar
from dpm2_core.sim.settings import LidarConfig
from dpm2_core.sim.world import World, build_world
from dpm2_core.slam.build import make_odometry
from dpm2_core.slam.settings import SlamSettings

pytestmark = pytest.mark.slow
# From scan to scan, in units of the largest step. When shaken, a pose is up to four of them from the prediction.
TURNS = [0.0] * 5 + [1, 1, 1, 0, 0, -1, -1, 0, 1, -1, -1, 0]
SHAKES = np.diff([0.0] * 6 + [1, 0, -1, 1, -1, 0, 1, -1, -1, 0, 1, 0])


@pytest.fixture(scope="module")
def corridors() -> World:
    return build_world("loop", "indoor", seed=1)


@pytest.fixture(scope="module")
def street() -> World:
    return build_world("straight", "suburb", seed=3, length=80.0)


def errors(world: World, motions: Array, registration: str) -> Array:
    """Errors (N, 2), m and degrees, of a robot with these motions (N, 6) from scan to scan, at 5 scans per second."""
    lidar, rng = Lidar(LidarConfig(beams=32, columns=360)), np.random.default_rng(0)
    T = world.drive_pose(5.0, 0.6)
    truth, odometry, off = T, make_odometry(SlamSettings(registration=registration)), []
    for i, motion in enumerate(motions):
        truth = truth @ se3.exp(motion)
        scan = lidar.scan(world, truth, 5.0, rng)
        T_found = odometry.process(Frame(i * 2 * 10**8, scan.points, index=i)).T_odom_lidar
        off.append(se3.apart(se3.inverse(T) @ truth, T_found))
    return np.array(off)


@pytest.mark.parametrize("registration", ["geometric", "adaptive"])
@pytest.mark.parametrize("degrees", [6, 8, 10, 12, 15, 20])
def test_a_turn_may_begin_and_end_between_two_scans(corridors: World, degrees: float, registration: str) -> None:
    """At 50 to 100 deg/s, typical of robots. Previously, the odometry was up to 180 degrees off, as `tracking`."""
    off = errors(corridors, np.array(TURNS)[:, None] * np.radians(degrees) * np.eye(6)[2], registration)
    assert off[:, 1].max() < 1
    assert off[:, 0].max() < 0.05


@pytest.mark.parametrize("axis", [0, 1])
def test_it_may_be_shaken(corridors: World, axis: int) -> None:
    """Roll or pitch by 8 degrees to both sides."""
    off = errors(corridors, np.array(SHAKES)[:, None] * np.radians(8) * np.eye(6)[axis], "geometric")
    assert off[:, 1].max() < 1


@pytest.mark.parametrize(("axis", "degrees"), [(1, 18), (2, 12), (2, 15)])
def test_what_swings_too_fast_is_found_again(street: World, axis: int, degrees: float) -> None:
    """Outdoors no other headings are tried. Previously, a scan was searched for where the rotation led, farther and
    farther away. In the end the odometry was 90 to 161 degrees off."""
    off = errors(street, np.array(SHAKES)[:, None] * np.radians(degrees) * np.eye(6)[axis], "geometric")
    assert off[-1, 1] < 0.5
    assert off[-1, 0] < 0.05


def test_the_network_is_not_outweighed_by_a_doubt_about_the_points(corridors: World) -> None:
    """0.3 m to both sides: half of the points fit next to their true position. Previously, their uncertainty was as
    large as the distance to the network's pose, so that the network agreed with them."""
    assert errors(corridors, np.array(SHAKES)[:, None] * 0.3 * np.eye(6)[4], "adaptive")[:, 0].max() < 0.05
