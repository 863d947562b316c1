# SPDX-License-Identifier: Apache-2.0
"""Another odometry leads where the scene is uninformative and is outweighed where it slips or jumps. The drive
continues without it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from dpm2_core.estimates import State
from dpm2_core.frame import Array, Frame, Guess, Inertial
from dpm2_core.geometry import se3
from dpm2_core.sim.lidar import Lidar
from dpm2_core.sim.settings import LidarConfig
from dpm2_core.sim.simulated_drive import wheel_odometry
from dpm2_core.sim.world import build_world
from dpm2_core.slam.odometry.other import OtherMotion

from ....helpers.drives import Drive, off, track

run = partial(track, registration="geometric")
pytestmark = pytest.mark.slow
JUMP = 15  # frame, in the middle
TURN = [0, 0, np.radians(1), 0, 0, 0]


def beside(drive: Drive, **wrong: float) -> list[Frame]:
    frames, truth = drive
    poses = wheel_odometry(truth, **wrong)
    return [replace(frame, guess=Guess(T)) for frame, T in zip(frames, poses, strict=True)]


def test_in_a_tunnel_it_tells_the_way(tunnel_drive: Drive) -> None:
    """Where the points do not: only the 2 % of slip remain of the error, and each result shows that it was used."""
    truth = tunnel_drive[1]
    alone, led = run(tunnel_drive[0]), run(beside(tunnel_drive, slip=0.02))
    way = np.linalg.norm(truth[-1, :3, 3])
    assert off(led, truth)[-1] < 0.03 * way
    assert off(led, truth)[-1] < 0.5 * off(alone, truth)[-1]
    assert all(t.comparison is not None and t.comparison.used for t in led[2:])


def test_one_that_repeats_its_last_pose_is_no_halt() -> None:
    """For example from a driver that keeps sending its last pose. Where all directions are open, the speed is soon
    unknown, and previously the halt was accepted."""
    other, twist = OtherMotion(steadiness=10.0), np.array([0, 0, 0, 8.0, 0, 0])
    sent, sigmas = [0.0, 0.8, 0.8, 0.8, 1.6], [0.1, 0.1, 0.1, 1.0, 1.0]  # m; sigma: of the previous motion
    led = []
    for x, sigma in zip(sent, sigmas, strict=True):
        other.look(Guess(se3.make(np.eye(3), [x, 0, 0])), twist, 0.1, sigma**2 * np.eye(6))
        led.append(other.step is not None)
        other.keep()
    assert led == [False, True, False, False, True]


@pytest.mark.parametrize(("sent", "used"), [(0.0, False), (-0.05, False), (0.05, True)])
def test_of_a_slow_robot_it_is_judged_over_a_longer_way(sent: float, used: bool) -> None:
    """A step may be 0.05 m off per scan. Previously, wheels that stand still or rotate backwards were therefore always
    accepted."""
    other, step = OtherMotion(steadiness=10.0), se3.make(np.eye(3), [0.05, 0, 0])
    known = 0.01**2 * np.eye(6)
    for i in range(60):
        other.look(Guess(se3.make(np.eye(3), [sent * i, 0, 0])), np.array([0, 0, 0, 0.5, 0, 0]), 0.1, known)
        other.compare(step, known, 0.1, True)
        other.keep()
    assert (other.step is not None) == used


@pytest.mark.parametrize("jump", [0.5, 1000.0])
def test_slip_and_jumps_are_outweighed_and_told(suburb_drive: Drive, jump: float) -> None:
    """The error is that without another odometry. The jump, and no other frame, is reported as one."""
    truth = suburb_drive[1]
    alone, led = run(suburb_drive[0]), run(beside(suburb_drive, slip=0.02, jump=jump))
    assert off(led, truth).max() < off(alone, truth).max() + 0.01
    assert [t.index for t in led[1:] if t.comparison is None or not t.comparison.used] == [JUMP]
    at_jump = led[JUMP].comparison
    assert at_jump is not None
    assert not at_jump.unsure
    apart = np.linalg.norm(at_jump.T_other[:3, 3]) - np.linalg.norm(at_jump.T_scans[:3, 3])
    assert apart == pytest.approx(jump, rel=0.1, abs=0.05)
    assert at_jump.doubt > led[JUMP - 1].comparison.doubt  # type: ignore[union-attr]
    assert all(t.state is State.TRACKING for t in led[2:])


def test_one_that_turns_wheels_on_the_spot_is_doubted(suburb_drive: Drive) -> None:
    """Each step is half as long again: within what a vehicle can do, and wrong by 0.4 m per frame."""
    truth = suburb_drive[1]
    led = run(beside(suburb_drive, slip=0.5))
    assert off(led, truth).max() < 0.05
    assert led[-1].comparison is not None
    assert led[-1].comparison.doubt > 2


@pytest.mark.parametrize("present", [lambda n: n % 3, lambda n: n < 8, lambda n: n > 8], ids=["gaps", "ends", "late"])
def test_without_it_the_drive_goes_on(suburb_drive: Drive, present: Callable[[int], bool]) -> None:
    truth = suburb_drive[1]
    led = run([f if present(f.index) else replace(f, guess=None) for f in beside(suburb_drive)])
    assert off(led, truth).max() < 0.05
    assert all(t.comparison is None for t in led if not present(t.index))
    assert all(t.registration.ok for t in led)


def test_scans_that_fail_are_bridged_by_it(suburb_drive: Drive) -> None:
    """The pose follows the wheels while no scan can be read, with the uncertainty of the wheels."""
    truth = suburb_drive[1]
    frames = beside(suburb_drive)
    blind = [replace(f, points=f.points[:0], problem="unreadable") if 8 <= f.index < 13 else f for f in frames]
    led = run(blind)
    assert off(led, truth).max() < 0.05
    assert [t.registration.ok for t in led[8:13]] == [False] * 5
    sigmas = [float(np.sqrt(np.linalg.eigvalsh(t.covariance[3:, 3:])[-1])) for t in led[8:13]]
    assert sigmas == sorted(sigmas)
    assert sigmas[-1] > 0.05


@pytest.mark.parametrize(("since", "jump"), [(8, 50.0), (10, 3.0), (10, 50.0)])
def test_one_that_jumps_while_no_scan_can_be_read_is_not_followed(suburb_drive: Drive, since: int, jump: float) -> None:
    """Less and less is known of the previous motion, and a jump was soon plausible. Previously, the pose was 10 m off
    at a stated 0.3 m."""
    frames, truth = suburb_drive
    back = se3.exp([0, 0, 0, -jump, 0, 0])
    guesses = [Guess(T if i < since else T @ back) for i, T in enumerate(truth)]
    blind = [f if f.index < 8 else replace(f, points=f.points[:0], problem="unreadable") for f in frames]
    led = run([replace(f, guess=guess) for f, guess in zip(blind, guesses, strict=True)])
    for result, T in list(zip(led, truth, strict=True))[8:]:
        error = se3.way(T, result.T_odom_lidar)
        assert error @ np.linalg.solve(result.covariance, error) < 20  # with 6 degrees of freedom


def test_one_that_says_it_does_not_know_is_not_followed(suburb_drive: Drive) -> None:
    """It reports a covariance that grows by 9 m2 per frame: the previous motion is more certain."""
    frames = beside(suburb_drive)[:8]
    unsure = [
        replace(f, guess=Guess(f.guess.T_other_lidar, 9.0 * (f.index + 1) * np.eye(6))) for f in frames if f.guess
    ]
    told = [t.comparison for t in run(unsure) if t.comparison][1:]
    assert [(c.used, c.unsure) for c in told] == [(False, True)] * 6
    constant = [replace(f, guess=Guess(f.guess.T_other_lidar, 9.0 * np.eye(6))) for f in frames if f.guess]
    assert [t.comparison.used for t in run(constant) if t.comparison] == [True] * 7  # a constant one shows nothing


@pytest.mark.parametrize(
    ("T", "covariance"),
    [(np.full((4, 4), np.nan), None), (np.eye(3), None), (np.eye(4), np.full((6, 6), np.inf)), (np.eye(4), np.eye(3))],
)
def test_what_is_no_pose_is_refused(T: Array, covariance: Array | None) -> None:
    with pytest.raises(ValueError, match="finite numbers"):
        Guess(T, covariance)


def test_from_rest_in_a_tunnel_it_leads() -> None:
    """The map was made at standstill, and 99 % of each scan fit there. Previously, the pose was 10 of 23 m off."""
    world, lidar = build_world("straight", "tunnel", seed=11, length=200.0), Lidar(LidarConfig(beams=32, columns=240))
    rng, times = np.random.default_rng(0), 2 + np.cumsum(np.minimum(0.02 * np.maximum(np.arange(25) - 4, 0), 0.1))
    poses = np.array([world.drive_pose(time) for time in times])
    truth = se3.inverse(poses[0]) @ poses
    frames = [
        Frame(i * 10**8, lidar.scan(world, poses[i], times[i], rng).points, index=i, guess=Guess(truth[i]))
        for i in range(len(times))
    ]
    assert off(run(frames), truth).max() < 0.03 * np.linalg.norm(truth[-1, :3, 3])


@pytest.mark.parametrize("wrong", ["still", "backwards"])
def test_one_that_is_wrong_from_the_start_does_not_lead(suburb_drive: Drive, wrong: str) -> None:
    """An encoder without a cable, or with a reversed sign. Previously, it held each scan at its prediction, and then
    its map did."""
    frames, truth = suburb_drive
    guesses = [np.eye(4) if wrong == "still" else se3.inverse(T) for T in wheel_odometry(truth)]
    alone, led = run(frames), run([replace(f, guess=Guess(T)) for f, T in zip(frames, guesses, strict=True)])
    assert off(led, truth).max() < off(alone, truth).max() + 0.01
    assert all(t.state is State.TRACKING for t in led[2:])


@pytest.mark.parametrize(
    ("step", "sensor"),
    [([0, 0, 0, 0.1, 0, 0], "wheels"), (TURN, "wheels"), (TURN, "imu")],
)
def test_a_cloud_that_is_sent_again_to_a_slow_robot_is_no_halt(
    suburb_drive: Drive, step: list[float], sensor: str
) -> None:
    """At 1 m/s, or 10 deg/s on the spot, the scans alone may show a halt. Wheels and an IMU show that the robot
    moves."""
    first, truth, frames = suburb_drive[0][0], [se3.exp(i * np.array(step)) for i in range(20)], []
    for i, T in enumerate(truth):
        seen, stamps = se3.inverse(truth[min(i, 8)]), (np.arange(-9, 1) + 10 * i) * 10**7
        rates, forces = np.tile(10 * np.array(step[:3]), (10, 1)), np.tile([0, 0, 9.81], (10, 1))
        frames.append(Frame(i * 10**8, np.asarray(se3.transform(seen, first.points), np.float32), index=i))
        beside = {"guess": Guess(T)} if sensor == "wheels" else {"imu": Inertial(stamps, rates, forces)}
        frames[-1] = replace(frames[-1], **beside)
    results = run(frames)
    assert [result.state for result in results[2:9]] == [State.TRACKING] * 7
    for result in results[12:]:  # after 0.3 m or 3 deg
        assert "same cloud as before" in result.registration.reason
        assert result.state is not State.TRACKING
    meters, degrees = se3.apart(truth[-1], results[-1].T_odom_lidar)
    assert meters < 0.35  # the motion needed to detect it; 1.1 m or 11 deg if the robot were assumed to stand
    assert degrees < (3.5 if sensor == "wheels" else 6)  # until then, the halt is taken for a gyroscope bias
