# SPDX-License-Identifier: Apache-2.0
"""Clouds that are parts of a sweep are joined to whole sweeps, and only those."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from dpm2_core.data.messages import decode_points, point_cloud
from dpm2_core.data.sweep_parts import SweepParts
from dpm2_core.estimates import BETWEEN, OdometryResult, Registration, State
from dpm2_core.frame import NO_POINTS, Camera, Frame, Guess, Image, Inertial
from dpm2_core.geometry import se3
from dpm2_core.slam.build import make_slam
from dpm2_core.slam.odometry.motion_state import MotionState
from dpm2_core.slam.odometry.settings import OdometrySettings
from dpm2_core.slam.settings import SlamSettings
from test.helpers import rooms
from test.helpers.drives import in_parts, make_drive, off

PERIOD = 10_000_000  # ns from one part to the next


def part(i: int, *, span: float = 0.01, period: int = PERIOD, points: int = 50) -> Frame:
    """A part of which each point has x = i and y = its time, s after the first part's stamp."""
    offset = np.linspace(0, span, points, dtype=np.float32)
    data = np.zeros((points, 4), np.float32)
    data[:, 0], data[:, 1] = i, i * period * 1e-9 + offset
    return Frame(i * period, data, offset, index=i)


def numbers(sweep: Frame | None) -> list[int]:
    """Which parts it consists of."""
    return [] if sweep is None else np.unique(sweep.points[:, 0]).tolist()


def joined(frames: Sequence[Frame]) -> list[Frame | None]:
    parts = SweepParts()
    return [parts.join(frame) for frame in frames]


def test_ten_parts_make_a_sweep_at_the_stamp_of_the_last() -> None:
    """The first part is handed on at once, as nothing tells yet that it is one, and is in the first sweep too."""
    first, *between, sweep = joined([part(i) for i in range(10)])
    assert numbers(first) == [0]
    assert between == [None] * 8
    assert numbers(sweep) == list(range(10))
    assert sweep is not None
    assert (sweep.stamp, sweep.index) == (9 * PERIOD, 9)
    assert sweep.time_offset is not None
    # float32 of 0.1 s
    np.testing.assert_allclose(sweep.time_offset + 9 * PERIOD * 1e-9, sweep.points[:, 1], atol=1e-7)


def test_each_part_is_in_one_sweep() -> None:
    sweeps = [sweep for sweep in joined([part(i) for i in range(40)])[1:] if sweep is not None]
    assert [sweep.index for sweep in sweeps] == [9, 19, 29, 39]
    assert [number for sweep in sweeps for number in numbers(sweep)] == list(range(40))


@pytest.mark.parametrize(
    "frames",
    [
        [part(i, span=0.1, period=100_000_000) for i in range(8)],  # a spinning LiDAR
        [part(i, span=0.001, period=100_000_000) for i in range(8)],  # a flash LiDAR
        [part(i, span=0.003, period=16_700_000) for i in range(8)],  # a fast one: parts would fill the period
        [part(i, span=0.1, period=2_000_000) for i in range(8)],  # whole sweeps that arrived together, stamped then
        [replace(part(i), time_offset=None) for i in range(8)],  # nothing shows whether these are parts
    ],
    ids=["spinning", "flash", "fast flash", "burst", "untimed"],
)
def test_whole_clouds_are_handed_on_as_they_are(frames: list[Frame]) -> None:
    assert all(out is frame for out, frame in zip(joined(frames), frames, strict=True))


@pytest.mark.parametrize("period", [0.033, 0.05, 0.1, 0.3])
def test_whole_clouds_of_which_two_once_followed_each_other_too_soon_are_joined_once(period: float) -> None:
    """All later ones were joined in twos, 0.1 s apart: a stamp by arrival, or a delay, is enough."""
    stamps = [0.0, 0.01, *(0.01 + period * np.arange(1, 12))]
    out = joined([replace(part(i, span=0.008), stamp=round(stamp * 1e9)) for i, stamp in enumerate(stamps)])
    joints = [sweep for sweep in out if sweep is not None and len(numbers(sweep)) > 1]
    assert len(joints) <= 1
    first = max((sweep.index for sweep in joints), default=1)
    assert all(numbers(sweep) == [i] for i, sweep in enumerate(out[first + 1 :], first + 1))


def test_halves_that_span_as_long_as_a_part_may_are_all_joined() -> None:
    """Of a LiDAR that turns 20 times per second: a half that spanned 0.1 ms more discarded the halves before it."""
    spans = [0.0249, 0.0251, 0.0249, 0.0249, 0.0251, 0.0249, 0.0251, 0.0251, 0.0251, 0.0249, 0.0251, 0.0249]
    stamps = np.cumsum([0.0, *spans[:-1]])
    halves = [part(i, span=span, points=9) for i, span in enumerate(spans)]
    out = joined([replace(half, stamp=round(at * 1e9)) for half, at in zip(halves, stamps, strict=True)])
    assert [numbers(sweep) for sweep in out] == [[0], [1], [2], [], [], [2, 3, 4, 5], [], [], [], [6, 7, 8, 9], [], []]


def test_a_node_that_is_too_slow_for_each_part_still_joins_them() -> None:
    """It drops three of four: those that are left follow each other after 40 ms, and alone each takes it longer."""
    out = joined([replace(part(i), dropped=3 if i else 0) for i in range(0, 60, 4)])
    assert [len(numbers(sweep)) for sweep in out[1:]] == [0, 0, 4] + [0, 0, 0, 4] * 2 + [0, 0, 0]


def test_a_stamp_that_repeats_or_goes_back_ends_the_joining() -> None:
    """No sweep was ever complete where the stamps stood still, and all clouds stayed in memory."""
    for stamps in ([3] * 50, [3, 2]):
        *before, back = [part(0), part(1), part(2), *(replace(part(i), index=i) for i in stamps)]
        out = joined([*before, back])
        assert out[-1] is not None
        assert numbers(out[-1]) == numbers(back)


def test_a_second_lidar_that_sends_whole_sweeps_discards_no_part() -> None:
    """Its cloud is in one of ten frames, which then spans a sweep."""
    both = [part(i, span=0.1 if i % 10 == 5 else 0.01) for i in range(40)]
    sweeps = [sweep for sweep in joined(both)[1:] if sweep is not None]
    assert [sweep.index for sweep in sweeps] == [5, 15, 25, 35]
    assert [number for sweep in sweeps for number in numbers(sweep)] == list(range(36))


def test_what_a_pause_interrupts_is_not_joined_across_it() -> None:
    *_, sweep = joined([part(i) for i in (*range(5), *range(200, 210))])
    assert numbers(sweep) == list(range(200, 210))


def test_what_a_pause_of_the_node_interrupts_is_not_joined_across_it() -> None:
    """It has dropped all parts in between, and those that follow are parts as before."""
    after = [replace(part(i), dropped=194 if i == 200 else 0) for i in range(200, 210)]
    out = joined([*(part(i) for i in range(5)), *after])
    assert out[5:-1] == [None] * 9
    assert numbers(out[-1]) == list(range(200, 210))


def test_parts_before_a_dropped_sweep_are_not_joined_with_those_after_it() -> None:
    """They made a sweep with a single part of the next one."""
    after = [replace(part(i), dropped=10 if i == 15 else 0) for i in range(15, 25)]
    out = joined([*(part(i) for i in range(5)), *after])
    assert out[5:-1] == [None] * 9
    assert numbers(out[-1]) == list(range(15, 25))


def test_lost_parts_leave_a_hole() -> None:
    """A node that is too slow drops clouds: the sweep ends where it would have ended."""
    *_, sweep = joined([part(i) for i in (0, 1, 2, 6, 9)])
    assert numbers(sweep) == [0, 1, 2, 6, 9]


def test_parts_without_a_return_and_unreadable_ones_are_waited_through() -> None:
    """A part that looks at the sky has no point, or few, which then have the same time."""
    camera = Camera(np.array([[10.0, 0, 4], [0, 10, 4], [0, 0, 1]]), np.eye(4), (8, 8))
    image = Image(np.zeros((8, 8, 3), np.uint8), camera)
    empty = replace(part(4), points=NO_POINTS, time_offset=None, images=(image,), dropped=2)
    bad = replace(part(5), points=NO_POINTS, time_offset=None, problem="cut off")
    out = joined([*(part(i) for i in range(4)), empty, bad, part(6), part(7, points=1), part(8), part(9)])
    assert out[4] is None
    assert out[5] is None
    assert numbers(out[9]) == [0, 1, 2, 3, 6, 7, 8, 9]
    assert out[9] is not None
    assert (len(out[9].images), out[9].dropped) == (1, 2)


def test_a_sweep_that_ends_with_an_unreadable_part_has_its_points() -> None:
    bad = replace(part(9), points=NO_POINTS, time_offset=None, problem="cut off")
    out = joined([*(part(i) for i in range(9)), bad, replace(bad, stamp=10 * PERIOD)])
    assert numbers(out[-1]) == list(range(9))
    assert out[-1] is not None
    assert out[-1].problem is None
    unreadable = [replace(bad, stamp=i * PERIOD) for i in range(10, 21)]
    out = joined([*(part(i) for i in range(10)), *unreadable])
    assert [one.problem for one in out[1:] if one is not None] == [None, "cut off"]


def test_a_part_with_wrong_times_leaves_out_itself_alone() -> None:
    """The parts before it were discarded, and it was registered alone."""
    wrong = part(6, span=1.5)
    out = joined([wrong if i == 6 else part(i) for i in range(10)])
    assert out[1:9] == [None] * 8
    assert numbers(out[9]) == [0, 1, 2, 3, 4, 5, 7, 8, 9]


def test_a_part_with_a_single_return_leaves_out_itself_alone() -> None:
    """Such a cloud is read without times. In each sweep it discarded the parts before it, and was registered alone: no
    sweep was complete, and the odometry was lost."""
    one = point_cloud({name: np.ones(1, np.float32) for name in ("x", "y", "z", "time")}, 0)
    points, offset = decode_points(one)
    lone = [replace(part(i), points=points, time_offset=offset) if i % 10 == 5 else part(i) for i in range(40)]
    sweeps = [sweep for sweep in joined(lone)[1:] if sweep is not None]
    assert [sweep.index for sweep in sweeps] == [9, 19, 29, 39]
    assert [number for sweep in sweeps for number in numbers(sweep)] == [i for i in range(40) if i % 10 != 5]


def test_clouds_that_no_longer_have_times_are_handed_on_as_they_are() -> None:
    untimed = [replace(part(i), time_offset=None) for i in range(10, 40)]
    out = joined([*(part(i) for i in range(10)), *untimed])
    assert all(sweep is frame for sweep, frame in zip(out[21:], untimed[11:], strict=True))


def test_sweeps_without_a_return_are_joined_too() -> None:
    sky = [replace(part(i), points=NO_POINTS, time_offset=None) for i in range(10, 40)]
    out = joined([*(part(i) for i in range(10)), *sky, *(part(i) for i in range(40, 61))])
    assert [sweep.index for sweep in out[10:40] if sweep is not None] == [20, 31]
    assert all(sweep is None or len(numbers(sweep)) > 7 for sweep in out[43:])


def test_the_first_part_after_a_pause_waits_for_its_sweep() -> None:
    """It was handed on alone, a tenth of the scene, was registered as a sweep, and became a keyframe."""
    kept = [*range(23), *range(35, 55)]  # 12 parts are lost
    found = dict(zip(kept, joined([part(i) for i in kept]), strict=True))
    assert {i: numbers(sweep) for i, sweep in found.items() if sweep is not None and i} == {
        end: list(range(end - 9, end + 1)) for end in (9, 19, 44, 54)
    }


def test_short_clouds_that_come_no_sooner_than_sweeps_are_whole_ones_again() -> None:
    """As of another driver on the topic: only the first of them waits, for a part that follows it."""
    later = [part(100 + 12 * i) for i in range(4)]
    first, *rest = joined([*(part(i) for i in range(20)), *later])[20:]
    assert first is None
    assert rest == later[1:]


@pytest.mark.parametrize("kept", [range(10), (0, 1, 2, 3, 5, 6, 9), (0, 1, 2, 4, 6, 9)])
def test_the_pose_of_another_odometry_is_that_at_the_middle_of_the_sweep(kept: Sequence[int]) -> None:
    """Parts are lost, and part 5 has no pose. The pose of the nearest part was used: of ten parts one of the two middle
    ones, by chance, at 36 m/s up to 0.36 m more or less than the true motion from sweep to sweep."""
    T = [se3.make(np.eye(3), [float(i), 0, 0]) for i in range(10)]  # at the middle of each part
    *_, sweep = joined([replace(part(i), guess=None if i == 5 else Guess(T[i])) for i in kept])
    assert sweep is not None
    assert sweep.guess is not None
    assert sweep.guess.T_other_lidar[0, 3] == pytest.approx(4.5, abs=1e-4)


def test_poses_of_another_odometry_that_ends_in_a_sweep_are_not_extrapolated() -> None:
    """Nor is one that begins in it."""
    for known, expected in ((range(3), 2.0), (range(7, 10), 7.0)):
        T = se3.make(np.eye(3), [expected, 0, 0])
        far = Guess(se3.make(np.eye(3), [expected + 100, 0, 0]))
        nearest = known[-1] if known[0] == 0 else known[0]
        parts = [replace(part(i), guess=Guess(T) if i == nearest else far if i in known else None) for i in range(10)]
        *_, sweep = joined(parts)
        assert sweep is not None
        assert sweep.guess is not None
        assert sweep.guess.T_other_lidar[0, 3] == expected


def test_a_sweep_has_what_the_other_sensors_measured_during_it() -> None:
    """The nearest image of each camera timed from the new stamp, and what was dropped. The samples of an IMU are those
    of the last part: the odometry has those before already."""
    camera = Camera(np.array([[10.0, 0, 4], [0, 10, 4], [0, 0, 1]]), np.eye(4), (8, 8))
    frames = []
    for i in range(10):
        imu = Inertial(np.array([i * PERIOD]), np.zeros((1, 3)), np.zeros((1, 3)))
        pixels = np.full((8, 8, 3), i, np.uint8)
        images = (Image(pixels, camera, 0.002),) if i in (2, 7) else ()
        frames.append(replace(part(i), imu=imu, images=images, dropped=int(i == 3), stepped=i == 4))
    sweep = joined(frames)[-1]
    assert sweep is not None
    assert sweep.imu is not None
    assert sweep.imu.stamps.tolist() == [9 * PERIOD]
    assert [image.pixels[0, 0, 0] for image in sweep.images] == [7]
    assert sweep.images[0].time_offset == pytest.approx(-0.018)
    assert (sweep.dropped, sweep.stepped) == (1, True)


def test_the_arrays_of_a_part_may_be_used_again() -> None:
    parts, buffer = SweepParts(), part(0)
    for i in range(10):
        buffer.points[:, 0] = i
        sweep = parts.join(replace(buffer, stamp=i * PERIOD, index=i))
    assert numbers(sweep) == list(range(10))


def test_a_drive_of_parts_is_as_accurate_as_one_of_sweeps() -> None:
    """Each sweep of a simulated drive sent in ten parts: a pose for each part, those between two sweeps predicted."""
    frames, poses = make_drive("city", 20, deskewed=False)
    slam = make_slam(SlamSettings())
    tracked = [slam.process(frame).odometry for frame in in_parts(frames)]
    assert [t.index for t in tracked] == list(range(200))
    assert [t.registration.method == BETWEEN for t in tracked[10:]] == ([True] * 9 + [False]) * 19
    assert not any(t.failed for t in tracked)
    assert tracked[-1].state is State.TRACKING
    # of sweeps; those of whole clouds are 0.018 m off, and the parts' stamps are later by nine tenths of a sweep
    assert off(tracked[9::10], poses).max() < 0.06


def test_an_unreadable_part_does_not_change_the_speed() -> None:
    """Right before the end of a sweep it was a failed scan of its own, and the sweep was then taken to be 0.1 s later:
    0.2 m off, and the next poses 0.6 m, at a standard deviation of 0.04 m."""
    frames, poses = make_drive("city", 12, deskewed=False)
    parts = in_parts(frames)
    bad = [i for i in range(40, 120) if i % 10 == 8]
    slam, cut = make_slam(SlamSettings()), {"points": NO_POINTS, "time_offset": None, "problem": "cut off"}
    tracked = [slam.process(replace(one, **cut) if i in bad else one).odometry for i, one in enumerate(parts)]
    assert [tracked[i].registration.reason for i in bad] == ["cut off"] * 8
    assert not any(t.failed or t.state is State.DEGRADED for t in tracked)
    assert off(tracked[9::10], poses).max() < 0.06  # as without


@pytest.mark.parametrize(("imu", "most"), [(True, 0.3), (False, 1.0)])
def test_the_poses_between_two_sweeps_follow_a_fast_rotation(imu: bool, most: float) -> None:
    """Of a robot that swings at up to 100 deg/s. The samples of an IMU were not used, and the rotation was taken to be
    that of the middle of the last sweep: 1.1 deg off in the middle of the next one, without an IMU 1.2 deg."""
    frames, poses = rooms.turning(40)
    slam, middle = make_slam(SlamSettings()), []
    for frame in frames:
        assert frame.time_offset is not None
        assert frame.imu is not None
        seconds = (frame.imu.stamps - frame.stamp) * 1e-9
        for k in range(10):
            start, end = 0.01 * k - 0.05, 0.01 * k - 0.04
            inside = (frame.time_offset >= start) & (frame.time_offset < end)
            samples = frame.imu[((seconds > start) | (k == 0)) & ((seconds <= end) | (k == 9))]
            cloud = replace(frame, points=frame.points[inside], time_offset=frame.time_offset[inside])
            tracked = slam.process(replace(cloud, imu=samples if imu else None).later(start)).odometry
            assert tracked.stamp != frame.stamp or k == 5
            if k == 5:
                middle.append(tracked.T_odom_lidar)
    T = np.array(middle)[15:]
    steps, true = se3.inverse(T[:-1]) @ T[1:], se3.inverse(poses[15:-1]) @ poses[16:]
    off = [se3.apart(one, other)[1] for one, other in zip(steps, true, strict=True)]
    assert max(off) < most


def test_after_a_pause_a_predicted_pose_is_no_more_certain_than_the_sweep_before_it() -> None:
    """That sweep was not confirmed in the map before the pause: its covariance is in meters, and was taken to be that
    of a motion for 10 ms, 0.002 m."""
    motion, far = MotionState(OdometrySettings()), 9.0 * np.eye(6)
    motion.velocity_covariance = 1e-4 * np.eye(3)
    rejected = Registration(np.eye(4), far, ok=False)
    last = OdometryResult(0, 0, np.eye(4), far, np.zeros(6), State.DEGRADED, rejected)
    for ok in (True, False):
        found = motion.between(replace(last, registration=replace(rejected, ok=ok)), part(1))
        assert found.covariance[3, 3] == (pytest.approx(0.0, abs=1e-4) if ok else 9.0)
