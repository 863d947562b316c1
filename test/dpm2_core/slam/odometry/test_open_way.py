# SPDX-License-Identifier: Apache-2.0
"""In directions that scans leave open, an IMU leads where it contradicts the scans, and only there."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from dpm2_core.estimates import OdometryResult, Registration, State
from dpm2_core.frame import Array, Frame, Guess
from dpm2_core.geometry import se3
from dpm2_core.sim.settings import ImuConfig, LidarConfig, PresetName
from dpm2_core.sim.simulated_drive import Ride, TurningRobot
from dpm2_core.sim.world import build_world
from dpm2_core.slam.odometry.inertial import Reckoned
from dpm2_core.slam.odometry.motion_state import MotionState
from dpm2_core.slam.odometry.open_way import OpenWay
from dpm2_core.slam.odometry.settings import OdometrySettings

from ....helpers.drives import off, track

KNOWN = 60
"""Frames for which another odometry measures the motion in the tunnel; after them there is none."""
AHEAD = np.diag([1.0, 0, 0])


def reckoned(acceleration: float, seconds: float = 0.1) -> Reckoned:
    """A step with a known forward acceleration, m/s2."""
    gained = acceleration * np.array([[0.5 * seconds**2, 0, 0], [seconds, 0, 0]])
    return Reckoned(np.eye(4), np.eye(6), gained, 0.05)


def driven(way: OpenWay, steps: Array, acceleration: float) -> Array:
    """How far the IMU leads after each step of the scans; a step is m ahead in 0.1 s."""
    places, offs = np.r_[0.0, np.cumsum(steps)], []
    for before, now in pairwise(places):
        T_before, T = (se3.make(np.eye(3), np.array([x, 0, 0])) for x in (before, now))
        offs.append(way.follow(T_before, T, AHEAD, reckoned(acceleration), 0.1)[0])
    return np.array(offs)


def test_scans_that_agree_are_believed_and_show_the_speed() -> None:
    """5 m/s with 5 cm of noise; the initial speed is 0.2 m/s off."""
    way = OpenWay(np.eye(4), np.array([5.2, 0, 0]))
    driven(way, 0.5 + 0.05 * np.random.default_rng(1).standard_normal(60), 0.0)
    assert not way.leads
    assert way.velocity[0] == pytest.approx(5.0, abs=0.15)


def test_scans_that_stop_without_a_deceleration_are_not() -> None:
    way = OpenWay(np.eye(4), np.array([5.0, 0, 0]))
    offs = driven(way, np.r_[np.full(12, 0.5), np.zeros(8)], 0.0)
    assert way.leads
    assert offs[-1] == pytest.approx(4.0, abs=0.01)
    np.testing.assert_allclose(way.velocity, [5.0, 0, 0], atol=0.01)


def test_braking_that_the_imu_feels_is_no_contradiction() -> None:
    way = OpenWay(np.eye(4), np.array([5.0, 0, 0]))
    speeds = np.maximum(5.0 - 0.3 * (np.arange(16) + 0.5), 0)
    offs = driven(way, 0.1 * speeds, -3.0)
    assert not way.leads
    assert np.abs(offs).max() < 0.02


@pytest.mark.parametrize("pull", [0.05, 0.15, 0.25, 0.4, 1.0, 3.0])
def test_its_sigma_covers_scans_that_pull_to_one_side(pull: float) -> None:
    """Scans pull by `pull` m/s for 5 s: unnoticed, or until the IMU leads. Without a pull, sigma is the sum of its
    gains."""
    way, off, whole = OpenWay(np.eye(4), np.array([5.0, 0, 0])), 0.0, 0.0
    for n, lead in enumerate(driven(way, np.full(50, 0.5 - 0.1 * pull), 0.0)):
        off = abs(0.1 * pull * (n + 1) - lead)
    assert off < way.sigma < 6.0
    way = OpenWay(np.eye(4), np.array([5.0, 0, 0]))
    for _ in range(50):
        driven(way, np.array([0.5]), 0.0)
        assert way.gained >= 0
        whole += way.gained
    assert whole == pytest.approx(way.sigma)


def left_open(speaks: list[bool]) -> float:
    """Final standard deviation, m, along a direction that has been open since the second of these scans at 5 m/s.
    `speaks`: whether an IMU measures the motion of each further scan."""
    motion, sigma = MotionState(OdometrySettings()), np.array([0.01, 0.01, 0.01, 1.0, 0.01, 0.01])
    for n, known in enumerate([False, False, *speaks]):
        T = se3.make(np.eye(3), np.array([0.5 * n, 0, 0]))
        covariance = np.diag(np.where(n < 2, 0.01, sigma) ** 2)
        motion.reckoned = reckoned(0.0) if known else None
        motion.advance(Registration(T, covariance, method="" if n else "first"), 0.1 if n else 0.0, None, False)
    return float(motion.covariance[3, 3] ** 0.5)


def test_an_imu_that_falls_silent_and_speaks_again_does_not_know_the_way_meanwhile() -> None:
    """Nor does it know the speed, which then only the scans show: they may have been pulled back for seconds."""
    known, unknown = left_open([True] * 30), left_open([False] * 30)
    assert known < 0.2 * unknown
    again = left_open([True] * 10 + [False] * 10 + [True] * 10)
    assert again == pytest.approx(unknown, rel=0.05)


def smooth(preset: PresetName, seed: int, count: int) -> tuple[list[Frame], Array]:
    """Frames without intensities of a car whose speed varies by up to 2 m/s2, and its true poses."""
    world = build_world("straight", preset, seed=seed, length=200.0)
    car = TurningRobot(world, count, Ride(10.0, slows=0.8), LidarConfig(beams=16, columns=512), ImuConfig())
    frames = [replace(frame, points=frame.points * np.array([1, 1, 1, 0], np.float32)) for frame in car.frames()]
    return frames, car.poses


def run(frames: list[Frame]) -> list[OdometryResult]:
    return track(frames, registration="geometric", threads=1)


def without_forces(frames: list[Frame]) -> list[Frame]:
    return [replace(f, imu=replace(f.imu, forces=np.full_like(f.imu.forces, np.nan))) for f in frames if f.imu]


@pytest.mark.slow
def test_it_leads_through_a_smooth_tunnel() -> None:
    """The points fit best where the map is as dense as they are, which is at the previous position of the car."""
    frames, truth = smooth("tunnel", 7, KNOWN + 40)
    frames = [replace(frame, guess=Guess(T)) for frame, T in zip(frames[:KNOWN], truth[:KNOWN], strict=True)] + frames[
        KNOWN:
    ]
    way = float(np.linalg.norm(truth[-1, :3, 3] - truth[KNOWN, :3, 3]))
    known = run(frames)
    assert {t.state for t in known[1:]} == {State.DEGRADED}  # nothing confirms it
    sigma = np.sqrt([np.linalg.eigvalsh(t.covariance[3:, 3:])[-1] for t in known[KNOWN:]])
    assert (off(known, truth)[KNOWN:] < 3 * sigma).all()
    unknown = run(without_forces(frames))
    assert off(known, truth)[-1] < 0.25 * off(unknown, truth)[-1]
    assert sigma[-1] < 0.2 * np.linalg.eigvalsh(unknown[-1].covariance[3:, 3:])[-1] ** 0.5
    assert off(known, truth)[-1] < 0.2 * way


@pytest.mark.slow
def test_along_a_road_that_seems_open_scans_are_believed() -> None:
    frames, truth = smooth("highway", 6, 60)
    tracked = run(frames)
    assert max(t.registration.worst_sigma for t in tracked) > 0.9
    assert off(tracked, truth).max() < off(run(without_forces(frames)), truth).max() + 0.05
