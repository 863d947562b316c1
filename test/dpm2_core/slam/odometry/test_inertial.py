# SPDX-License-Identifier: Apache-2.0
"""An IMU makes fast rotations harmless and the map level. One that stops or is wrong costs no more than its benefit."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial, reduce
from itertools import pairwise

import numpy as np
import pytest

from dpm2_core.estimates import OdometryResult, State
from dpm2_core.frame import Array, Frame, Inertial
from dpm2_core.geometry import se3
from dpm2_core.sim.imu import GRAVITY, Imu
from dpm2_core.sim.settings import ImuConfig, LidarConfig
from dpm2_core.sim.simulated_drive import Ride, TurningRobot
from dpm2_core.sim.world import build_world
from dpm2_core.slam.odometry.inertial import InertialMotion

from ....helpers import rooms
from ....helpers.drives import off, track

COUNT = 40
run = partial(track, registration="geometric", preset="outdoor")


@pytest.fixture(scope="module")
def robot() -> tuple[list[Frame], Array]:
    """A robot that stands for 1 s, then swings at up to 100 deg/s while it drives at 1.5 m/s."""
    return rooms.turning(COUNT)


def error(tracked: list[OdometryResult], truth: Array) -> float:
    """Root mean square of the position errors, m."""
    return float(np.sqrt((off(tracked, truth) ** 2).mean()))


def without(frames: list[Frame], since: int = 0) -> list[Frame]:
    return [frame if frame.index < since else replace(frame, imu=None) for frame in frames]


def with_imu(frames: list[Frame], change: Callable[[Array, Array], tuple[Array, Array]]) -> list[Frame]:
    """Frames with changed rates and forces."""
    out = []
    for frame in frames:
        assert frame.imu is not None
        rates, forces = change(frame.imu.rates, frame.imu.forces)
        out.append(replace(frame, imu=replace(frame.imu, rates=rates, forces=forces)))
    return out


def every_third(frames: list[Frame]) -> list[Frame]:
    """Every third frame, with the samples of all frames."""
    out = []
    for three in zip(frames[::3], frames[1::3], frames[2::3], strict=False):
        imus = [frame.imu for frame in three if frame.imu is not None]
        out.append(replace(three[2], imu=reduce(Inertial.then, imus)))
    return out


@pytest.mark.slow
def test_samples_that_two_frames_share_count_once(robot: tuple[list[Frame], Array]) -> None:
    """For example samples at the exact time of a scan, in a user's own loader. Previously, they made time go back in
    each frame: neither bias nor level was kept, and rotations that contradict the scans were never reported."""
    wrong = with_imu(robot[0], lambda rates, forces: (rates * [1, 1, -1], forces))
    sharing = [wrong[0], *(shared(before, frame) for before, frame in pairwise(wrong))]
    plain, both = run(wrong), run(sharing)
    assert [t.T_odom_lidar.tolist() for t in both] == [t.T_odom_lidar.tolist() for t in plain]
    assert any("its rotations are not those of the scans" in (t.imu or "") for t in both)


def shared(before: Frame, frame: Frame) -> Frame:
    """The frame with the last two samples of the previous frame repeated."""
    assert before.imu is not None
    assert frame.imu is not None
    parts = (
        np.concatenate([getattr(before.imu, n)[-2:], getattr(frame.imu, n)]) for n in ("stamps", "rates", "forces")
    )
    return replace(frame, imu=Inertial(*parts))


@pytest.mark.slow
def test_rates_in_degrees_do_not_bend_the_first_map(robot: tuple[list[Frame], Array]) -> None:
    """Previously, a bias of 1 deg/s became 53. The first two scans were distorted alike, all others fitted badly, and
    the trajectory was lost."""
    frames, truth = robot[0][:24], robot[1][:24]
    in_degrees = run([*with_imu(frames[:3], lambda rates, forces: (np.degrees(rates), forces)), *without(frames[3:])])
    assert all(t.registration.ok for t in in_degrees)
    assert off(in_degrees, truth).max() < 0.03
    assert (in_degrees[2].imu or "").startswith("its rotations are not those of the scans")


@pytest.mark.slow
@pytest.mark.parametrize(("end", "more"), [(30, 6), (35, 13)])
def test_time_that_goes_back_may_be_another_drive(robot: tuple[list[Frame], Array], end: int, more: int) -> None:
    """A looped bag that jumps back by 2.1 and 2.9 m. Previously, all later poses were 2.2 and 2.6 m off, as
    `tracking`."""
    frames, truth = ([*part[:end], *part[:more]] for part in robot)
    tracked = run(frames, keyframes={"distance": 0.0})
    far = off(tracked, np.array(truth))
    assert far[[t.state == State.TRACKING for t in tracked]].max() < 0.05
    if end == 30:
        assert tracked[-1].state == State.TRACKING
        return
    # 2.9 m behind its last position: no scan shows the motion to there, which is arbitrary
    assert tracked[-1].breaks == 1
    edges = [t.keyframe.edge for t in tracked[end:] if t.keyframe is not None]
    assert edges[0] is not None
    assert edges[0].worst_sigma > 1000


@pytest.mark.slow
def test_few_scans_a_second_are_enough(robot: tuple[list[Frame], Array]) -> None:
    """3.3 per second: without an IMU, rotations begin and end unseen."""
    frames, truth = every_third(robot[0]), robot[1][2::3]
    plain, inertial = run(without(frames)), run(frames)
    assert all(t.registration.ok for t in inertial)
    assert error(inertial, truth) < 0.01 < 10 * error(inertial, truth) < error(plain, truth)


@pytest.mark.slow
def test_ten_samples_a_second_tell_the_turns(robot: tuple[list[Frame], Array]) -> None:
    """Bags of kitti2bag have samples 0.1036 s apart. Previously, none of them was used, as if there were none: 6 of
    these 13 scans were lost."""
    frames, truth = every_third(robot[0]), robot[1][2::3]
    samples = reduce(Inertial.then, [frame.imu for frame in frames if frame.imu is not None])
    some = samples[np.diff(samples.stamps // 103_600_000, prepend=-1) > 0]
    inertial = run(
        [
            replace(frame, imu=some[(some.stamps > before) & (some.stamps <= frame.stamp)])
            for before, frame in zip([0, *(frame.stamp for frame in frames)], frames, strict=False)
        ]
    )
    assert {t.imu for t in inertial} == {""}
    assert all(t.registration.ok for t in inertial)
    assert error(inertial, truth) < 0.01


@pytest.fixture(scope="module")
def plain(robot: tuple[list[Frame], Array]) -> list[OdometryResult]:
    """Odometry of this robot without the IMU."""
    return run(without(robot[0]))


@pytest.mark.slow
def test_fast_turns_cost_millimeters(robot: tuple[list[Frame], Array], plain: list[OdometryResult]) -> None:
    frames, truth = robot
    inertial = run(frames)
    assert all(t.registration.ok for t in inertial)
    assert max(error(inertial, truth), error(plain, truth)) < 0.01
    assert {t.imu for t in plain} == {None}
    assert {t.imu for t in inertial} == {""}


@pytest.mark.slow
def test_one_that_stops_is_missed_and_one_that_comes_late_is_used(robot: tuple[list[Frame], Array]) -> None:
    frames, truth = robot
    stops = run(without(frames, since=22))
    gone = ["no samples at the time of the scan"] * 17
    assert [t.imu for t in stops] == [""] * 23 + gone  # the last rate is extrapolated for 0.05 s
    assert all(t.registration.ok for t in stops)
    assert error(stops, truth) < 0.01
    late = run([replace(frame, imu=None) if frame.index < 20 else frame for frame in frames])
    assert [t.imu for t in late[:20]] == [None] * 20
    assert {t.imu for t in late[22:]} == {""}
    poses = np.array([t.T_odom_lidar for t in late])
    assert se3.magnitude(se3.inverse(poses[0]))[1] == 0  # the start is not leveled afterwards


@pytest.mark.slow
def test_a_wrong_orientation_is_noticed(robot: tuple[list[Frame], Array], plain: list[OdometryResult]) -> None:
    """According to /tf_static it is upside down, so it rotates the other way."""
    frames, truth = robot
    upside_down = np.diag([1.0, -1.0, -1.0])
    lies = run(with_imu(frames, lambda rates, forces: (rates @ upside_down, forces)))
    assert lies[-1].imu is not None
    assert lies[-1].imu.startswith("its rotations are not those of the scans")
    assert sum(t.imu == "" for t in lies) < 25  # nothing shows it at standstill
    assert error(lies, truth) < 3 * error(plain, truth)


@pytest.mark.slow
def test_where_a_sudden_turn_shows_a_wrong_orientation_no_scan_is_lost() -> None:
    """Previously, at the first sudden rotation the scan was prepared with the reversed rotation and fitted nowhere. No
    later scan fitted either."""
    world, lidar = build_world("random", "suburb", 2), LidarConfig(beams=16, columns=900, height=1.0)
    drive = TurningRobot(world, 32, Ride(3.0, turns=60.0), lidar, ImuConfig())
    frames, truth = list(drive.frames()), drive.poses
    lies = run(with_imu(frames, lambda rates, forces: (rates * [1, 1, -1], forces)))
    assert lies[-1].imu is not None
    assert lies[-1].imu.startswith("its rotations are not those of the scans")
    assert all(t.registration.ok for t in lies)
    assert error(lies, truth) < 3 * error(run(without(frames)), truth)


@pytest.fixture(scope="module")
def indoors() -> tuple[list[Frame], Array]:
    """Frames and true poses of a robot in a room. After 1 s at rest it rotates back and forth by up to 80 deg/s."""

    def poses(t: Array) -> Array:
        since = np.maximum(t - 1, 0)
        angle = 1.4 * np.sin(since) * np.minimum(since, 1)
        return se3.exp(angle[..., None] * np.eye(6)[2]) @ se3.make(np.eye(3), [0.7, 0, 0.6])

    stamps = 0.1 * np.arange(1, 80)
    imu, truth = Imu(ImuConfig(), np.random.default_rng(5)), poses(stamps)
    times = imu.times(0, stamps[-1] + 0.1)
    rates, forces = (measured @ imu.R_lidar_imu.T for measured in imu.measure(times, poses))
    frames = []
    for frame, stamp in zip(rooms.frames(truth), stamps, strict=True):
        used = (times > stamp - 0.1) & (times <= stamp)
        samples = Inertial(np.round(times[used] * 1e9).astype(np.int64), rates[used], forces[used])
        frames.append(replace(frame, stamp=round(stamp * 1e9), imu=samples))
    return frames, truth


@pytest.mark.slow
@pytest.mark.parametrize(
    "change",
    [
        lambda rates: rates * [1, 1, -1],
        lambda rates: rates * 0,
        lambda rates: rates + np.array([0, 0, 0.3]),
        lambda rates: rates + np.array([0, 0, 0.05]),
        lambda rates: rates * 0.9,
    ],
    ids=["mirrored", "zeros", "a large bias", "a small bias", "a wrong scale"],
)
def test_indoors_scans_know_the_heading_better(
    indoors: tuple[list[Frame], Array], change: Callable[[Array], Array]
) -> None:
    """Previously, each scan was constrained to the measured rotation, and so confirmed it: 50 to 95 deg off, as
    `tracking`. A small error accumulated in the map: 7 deg."""
    frames, truth = indoors
    sound, wrong = frames[:30], with_imu(frames[30:], lambda rates, forces: (change(rates), forces))
    tracked = run(sound + wrong, preset="auto")
    assert error(tracked, truth) < 0.03
    moved = se3.inverse(tracked[0].T_odom_lidar) @ tracked[-1].T_odom_lidar
    assert np.degrees(se3.angle(se3.inverse(se3.inverse(truth[0]) @ truth[-1]) @ moved)) < 1.5


@pytest.mark.slow
def test_a_gyroscope_that_repeats_its_last_rates_is_left_out_before_a_scan_is_lost(
    robot: tuple[list[Frame], Array], plain: list[OdometryResult]
) -> None:
    """The rates repeat in a bend of 100 deg/s, which ends. The scan that shows its end must not be distorted by these
    rates."""
    frames, truth = robot
    assert frames[20].imu is not None
    last = frames[20].imu.rates[-1]
    good, bad = frames[:20], with_imu(frames[20:], lambda rates, forces: (np.tile(last, (len(rates), 1)), forces))
    repeats = run(good + bad)
    assert all(t.registration.ok for t in repeats)
    assert repeats[-1].imu is not None
    assert repeats[-1].imu.startswith("its rotations are not those of the scans")
    assert error(repeats, truth) < 2 * error(plain, truth)


@pytest.mark.slow
def test_a_scan_that_was_registered_without_it_is_handed_out_without_it(robot: tuple[list[Frame], Array]) -> None:
    """One frame has rates in deg/s and is stamped at the start of the sweep. The scan's pose was right. But between the
    middle of the sweep and the stamp, the IMU still rotated it, here by 40 degrees."""
    frames = [frame.later(-0.05) for frame in robot[0][:17]]
    wrong = with_imu(frames[16:], lambda rates, forces: (np.degrees(rates), forces))
    told = run(without(frames[:13]) + frames[13:16] + wrong)[-1]
    plain = run(without(frames))[-1]
    assert told.registration.ok
    # Half a sweep from two measurements of one rotation at 100 deg/s, each accurate to some percent.
    assert np.degrees(se3.angle(se3.inverse(plain.T_odom_lidar) @ told.T_odom_lidar)) < 0.5


@pytest.mark.slow
def test_forces_that_are_not_known_cost_the_level_alone(robot: tuple[list[Frame], Array]) -> None:
    frames, truth = robot
    gyroscope = run(with_imu(frames, lambda rates, forces: (rates, np.full_like(forces, np.nan))))
    assert error(gyroscope, truth) < 0.02
    np.testing.assert_array_equal(gyroscope[0].T_odom_lidar, np.eye(4))


def at_rest(seconds: float, T: Array, config: ImuConfig) -> tuple[Array, Array, Array]:
    """Stamps, rates and forces, in the LiDAR's axes, of an IMU at rest at pose T."""
    imu = Imu(config, np.random.default_rng(3))
    times = imu.times(0, seconds)
    rates, forces = imu.measure(times, lambda at: np.tile(T, (len(at), 1, 1)))
    return np.round(times * 1e9).astype(np.int64), rates @ imu.R_lidar_imu.T, forces @ imu.R_lidar_imu.T


def standing(T: Array, count: int, config: ImuConfig | None = None) -> list[Frame]:
    """Frames from 1 s on at 10 Hz, each with the samples since the previous one."""
    stamps, rates, forces = at_rest(1 + 0.1 * count, T, config or ImuConfig())
    out = []
    for i in range(count):
        stamp = 10**9 + i * 10**8
        used = (stamps <= stamp) & (stamps > (stamp - 10**8 if i else 0))
        samples = Inertial(stamps[used], rates[used], forces[used])
        out.append(Frame(stamp, np.zeros((0, 4), np.float32), imu=samples))
    return out


def test_the_bias_is_known_after_some_seconds_at_rest() -> None:
    motion, T = InertialMotion(), np.eye(4)
    frames = standing(T, 40, ImuConfig(gyro_bias=0.02))
    for frame in frames:
        corrected = motion.look(frame)
        motion.registered(T, T, frame.stamp, np.zeros(6) if frame is not frames[0] else None)
    assert corrected.imu is not None
    assert frame.imu is not None
    assert np.abs(frame.imu.rates.mean(0)).max() > 0.01
    assert np.abs(corrected.imu.rates[-100:].mean(0)).max() < 0.0015
    assert motion.turn is not None
    assert motion.covariance(0.1)[0, 0] ** 0.5 < np.radians(0.15)


@pytest.mark.parametrize("up", [(0.0, 0.0, 1.0), None], ids=["base known", "base unknown"])
def test_the_bias_is_known_from_the_first_frame_of_a_start_at_rest(up: tuple[float, float, float] | None) -> None:
    motion, T = InertialMotion(), np.eye(4)
    first, second = (
        replace(frame, imu=replace(frame.imu, up=up))
        for frame in standing(T, 2, ImuConfig(gyro_bias=0.02))
        if frame.imu is not None
    )
    motion.look(first)
    motion.registered(T, T, first.stamp, None)
    motion.look(second)
    assert motion.turn is not None
    assert np.degrees(se3.angle(se3.make(motion.turn, np.zeros(3)))) < 0.02  # the bias alone would be 0.2


def test_a_slow_turn_at_the_start_is_no_bias_for_long() -> None:
    """A robot that rotates at 1 deg/s looks as if it were at rest; the scans show its rotation."""
    motion, rate, before = InertialMotion(), np.radians(1.0), np.eye(4)
    for i, frame in enumerate(standing(np.eye(4), 100, ImuConfig(gyro_bias=0.0))):
        assert frame.imu is not None
        motion.look(replace(frame, imu=replace(frame.imu, rates=frame.imu.rates + np.array([0, 0, rate]))))
        T = se3.exp([0, 0, 0.1 * i * rate, 0, 0, 0])
        motion.registered(before, T, frame.stamp, np.r_[0, 0, rate, 0, 0, 0] if i else None)
        before = T
    assert motion.turn is not None
    assert se3.rotation_vector(motion.turn)[2] == pytest.approx(0.1 * rate, rel=0.1)


@pytest.mark.parametrize("unit", [1.0, 1 / GRAVITY], ids=["m/s2", "g"])
@pytest.mark.parametrize("axis", [(0.0, 0.0, 1.0), (np.sin(0.3), 0.0, np.cos(0.3))], ids=["LiDAR", "tilted mount"])
def test_a_start_at_rest_is_level(axis: tuple[float, float, float], unit: float) -> None:
    """The LiDAR is pitched by 0.2 rad. The true up direction becomes the axis that must be up, that of the base."""
    motion, T = InertialMotion(), np.eye(4)
    frame = standing(se3.exp([0.05, 0.2, 0, 0, 0, 0]), 1, ImuConfig(acceleration_bias=0.02, misaligned=0.0))[0]
    assert frame.imu is not None
    frame = replace(frame, imu=replace(frame.imu, forces=unit * frame.imu.forces, up=axis))
    motion.look(frame)
    motion.registered(T, T, frame.stamp, None)
    up = se3.exp([0.05, 0.2, 0, 0, 0, 0])[2, :3]  # along the LiDAR's axes
    assert np.degrees(np.arccos(motion.T_level_odom[:3, :3] @ up @ np.array(axis))) < 0.3


@pytest.mark.parametrize("unit", [1.0, 1 / GRAVITY], ids=["m/s2", "g"])
def test_a_start_in_motion_or_without_a_known_base_is_not(unit: float) -> None:
    """Previously, with forces in g every motion looked like rest: odom was tilted by 4 to 9 deg."""
    frame, T = standing(se3.exp([0, 0.2, 0, 0, 0, 0]), 1)[0], np.eye(4)
    assert frame.imu is not None
    shaken = frame.imu.forces + np.random.default_rng(0).normal(0, 2, frame.imu.forces.shape)
    for changed in ({"forces": shaken}, {"up": None}):
        motion, imu = InertialMotion(), replace(frame.imu, **changed)
        motion.look(replace(frame, imu=replace(imu, forces=unit * imu.forces)))
        motion.registered(T, T, frame.stamp, None)
        np.testing.assert_array_equal(motion.T_level_odom, np.eye(4))


@pytest.mark.parametrize("gravity", [0.0, 0.05], ids=["zeros", "taken out"])
def test_forces_without_gravity_make_nothing_level(gravity: float) -> None:
    """The remaining forces point in an arbitrary direction. The gyroscope is still usable."""
    motion, T = InertialMotion(), np.eye(4)
    first, second = standing(T, 2, ImuConfig(gyro_bias=0.02))
    for frame, twist in ((first, None), (second, np.zeros(6))):
        assert frame.imu is not None
        forces = np.tile([gravity, 0, 0], (len(frame.imu), 1))
        motion.look(replace(frame, imu=replace(frame.imu, forces=forces)))
        motion.registered(T, T, frame.stamp, twist)
        if frame is first:
            assert motion.problem == "its acceleration at rest is not gravity: odom is not level"
    assert motion.problem == ""
    assert motion.turn is not None
    assert np.degrees(se3.angle(se3.make(motion.turn, np.zeros(3)))) < 0.02  # the bias would be 0.2, but it is known
    np.testing.assert_array_equal(motion.T_level_odom, np.eye(4))


@pytest.mark.parametrize("rest", [2.0, 0.0], ids=["start at rest", "start in motion"])
def test_accelerations_without_gravity_are_not_taken_for_gravity_in_g(rest: float) -> None:
    """Previously, an acceleration of 1.1 m/s2 looked like 1.1 g: odom was rotated by up to 0.02 degrees for each
    meter."""
    motion, before, rng = InertialMotion(), np.eye(4), np.random.default_rng(1)
    for i in range(400):
        stamp, time = 10**9 + i * 10**8, 0.1 * i
        ahead = np.where((time - rest) % 24 < 12, 1.1, -1.1) if time > rest else 0.0
        speed = 1.1 * (12 - abs((time - rest) % 24 - 12)) if time > rest else 0.0
        forces = rng.normal([ahead, 0, 0], 0.03, (10, 3))
        samples = Inertial(np.arange(stamp - 9 * 10**7, stamp + 1, 10**7), rng.normal(0, 0.002, (10, 3)), forces)
        T = before @ se3.exp([0, 0, 0, 0.1 * speed, 0, 0])
        motion.look(Frame(stamp, np.zeros((0, 4), np.float32), imu=samples))
        motion.registered(before, T, stamp, np.array([0, 0, 0, speed, 0, 0]) if i else None)
        before = T
    np.testing.assert_array_equal(motion.T_level_odom, np.eye(4))


@pytest.mark.parametrize("sign", [1.0, -1.0], ids=["as they are", "reversed"])
def test_a_start_upside_down_is_said(sign: float) -> None:
    """A reversed sign and a LiDAR that hangs upside down without a known mounting look alike."""
    motion, T = InertialMotion(), np.eye(4)
    frame = standing(T, 1)[0]
    assert frame.imu is not None
    motion.look(replace(frame, imu=replace(frame.imu, forces=sign * frame.imu.forces)))
    motion.registered(T, T, frame.stamp, None)
    upwards = motion.T_level_odom[:3, :3] @ (sign * frame.imu.forces.mean(0))
    np.testing.assert_allclose(upwards / np.linalg.norm(upwards), [0, 0, 1], atol=1e-9)
    assert ("deg away from up" in motion.problem) == (sign < 0)


def test_one_that_is_left_out_does_not_tilt_the_frame() -> None:
    """A circle of 20 m; /tf_static rotates the IMU by 90 degrees about the forward axis."""
    motion, twist, before = InertialMotion(), np.array([0, 0, 0.25, 5.0, 0, 0]), np.eye(4)
    rates, forces = np.tile([0, -0.25, 0], (10, 1)), np.tile([0, -9.81, 1.25], (10, 1))
    tilt, left_out = [], []
    for i in range(300):
        stamp = 10**9 + i * 10**8
        samples = Inertial(np.arange(stamp - 9 * 10**7, stamp + 1, 10**7), rates, forces)
        T = se3.exp(0.1 * i * twist)
        motion.look(Frame(stamp, np.zeros((0, 4), np.float32), imu=samples))
        motion.registered(before, T, stamp, twist if i else None)
        left_out.append("odom may be tilted" in motion.problem)
        tilt.append(se3.angle(motion.T_level_odom))
        before = T
    assert left_out[10:] == [True] * 290
    assert np.degrees(tilt[10]) < 0.1  # 5 m, at most 0.02 degrees for each
    assert tilt[-1] == tilt[10]  # 1.3 degrees more if its forces were still used


@pytest.mark.parametrize("unit", [1.0, 1 / GRAVITY], ids=["m/s2", "g"])
def test_the_level_follows_a_drifting_odometry_without_a_jump(unit: float) -> None:
    """The odometry tilts by 0.004 deg in each frame of 0.5 m, five times as fast as by the uncorrected angles of
    KITTI's LiDAR, while the robot stays level."""
    motion, drift = InertialMotion(), np.radians(0.004)
    frames = with_imu(
        standing(np.eye(4), 1000, ImuConfig(acceleration_bias=0.0, misaligned=0.0)),
        lambda rates, forces: (rates, unit * forces),
    )
    before, outs = np.eye(4), []
    step = se3.exp([0, drift, 0, 0.5, 0, 0])
    for i, frame in enumerate(frames):
        # Only the axes of the odometry tilt: neither gyroscope nor forces show it.
        T = before @ step if i else before
        motion.look(frame)
        motion.registered(before, T, frame.stamp, np.r_[0, 0, 0, 5.0, 0, 0] if i else None)
        outs.append(motion.T_level_odom @ T)
        before = T
    tilt = np.degrees(np.arccos(np.array(outs)[:, 2, 2]))
    assert np.degrees(np.arccos(before[2, 2])) > 3.9
    assert tilt[-1] < 2.0  # the filter lags, by 1.7 at most
    steps = se3.inverse(np.array(outs)[:-1]) @ np.array(outs)[1:]
    np.testing.assert_allclose(np.linalg.norm(steps[:, :3, 3], axis=1), 0.5, atol=1e-6)
    assert np.degrees(se3.angle(steps)).max() < 0.05


def test_samples_from_before_time_went_back_are_forgotten() -> None:
    motion, T = InertialMotion(), np.eye(4)
    frames = standing(T, 10)
    for i in (5, 6, 0, 1):
        motion.look(frames[i])
        assert motion.problem == ""
        motion.registered(T, T, frames[i].stamp, np.zeros(6))
    assert motion.turn is not None
