# SPDX-License-Identifier: Apache-2.0
"""Trajectory files keep their contents, and trajectories that do not belong together are rejected."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from dpm2_core.data.trajectory import (
    Trajectory,
    interpolate,
    matched,
    read_trajectory,
    same_stamps,
    write_kitti,
    write_tum,
)
from dpm2_core.errors import UsageError
from dpm2_core.geometry import se3

from ...helpers.trajectories import write_indexed

IDENTITY = "1 0 0 0 0 1 0 0 0 0 1 0"
EPOCH = 1_317_617_735_123_456_789  # ns; as a float64 in seconds it would lose 100 ns


def _poses(count: int, scale: float = 1000.0) -> np.ndarray:
    rng = np.random.default_rng(0)
    return se3.make(Rotation.random(count, random_state=0).as_matrix(), rng.normal(scale=scale, size=(count, 3)))


def test_kitti_keeps_poses_to_a_nanometer(tmp_path: Path) -> None:
    poses = _poses(20)
    write_kitti(tmp_path / "t.txt", poses)
    read = read_trajectory(tmp_path / "t.txt")
    np.testing.assert_allclose(read.poses, poses, atol=1e-9)  # 13 digits of about 1000 m
    np.testing.assert_array_equal(read.keys, range(20))
    assert read.kind == "kitti"


def test_kitti_keeps_frame_numbers(tmp_path: Path) -> None:
    numbers = [0, 3, 4, 999_999_999]
    write_indexed(tmp_path / "t.txt", _poses(4), numbers)
    read = read_trajectory(tmp_path / "t.txt")
    assert (read.kind, read.keys.tolist()) == ("kitti-indexed", numbers)
    np.testing.assert_allclose(read.poses, _poses(4), atol=1e-9)


def test_tum_keeps_stamps_exactly_and_poses_to_a_micrometer(tmp_path: Path) -> None:
    stamps = [-1, 0, 999_999_999, EPOCH, EPOCH + 1]
    write_tum(tmp_path / "t.tum", stamps, _poses(5))
    read = read_trajectory(tmp_path / "t.tum")
    assert (read.kind, read.keys.tolist()) == ("tum", stamps)
    np.testing.assert_allclose(read.poses, _poses(5), atol=1e-7)  # 12 digits of about 1000 m


def test_exponents_comments_and_blank_lines_are_read(tmp_path: Path) -> None:
    """numpy.savetxt, which many tools write with, uses exponents even for stamps and frame numbers."""
    path = tmp_path / "t.txt"
    path.write_text("# stamp ...\n\n1.5e+09 1e0 2 3 0 0 0 1\n  1500000000.25\t1 2 3 0 0 0 1  \n")
    assert read_trajectory(path).keys.tolist() == [1_500_000_000 * 10**9, 1_500_000_000 * 10**9 + 250_000_000]
    path.write_text(f"2.000e+01 {IDENTITY}\n2.1e+01 {IDENTITY}\n")
    assert read_trajectory(path).keys.tolist() == [20, 21]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "holds no pose"),
        ("# only a comment\n", "holds no pose"),
        ("1 2 3\n", ":1: 3 numbers; want 8"),
        (f"{IDENTITY}\n\n# gap\n{IDENTITY} 1\n", ":4: 13 numbers where the lines before have 12"),
        (f"{IDENTITY}\n{IDENTITY[:-1]}x\n", ":2: .*'x'"),
        (f"{IDENTITY}\n{IDENTITY[:-1]}nan\n", ":2: not a finite rigid transform"),
        (f"{IDENTITY}\n{IDENTITY[:-1]}1e308\n", ":2: not a finite rigid transform"),  # `dpm2 eval` never ended
        (f"{IDENTITY}\n{'0 ' * 12}\n", ":2: not a finite rigid transform"),
        (f"{IDENTITY}\n-1 0 0 0 0 1 0 0 0 0 1 0\n", ":2: not a finite rigid transform"),
        ("0 1 2 3 0 0 0 0\n", ":1: not a finite rigid transform"),
        ("nan 1 2 3 0 0 0 1\n", ":1: nan is not a time stamp"),
        ("1e300 1 2 3 0 0 0 1\n", ":1: 1e300 is not a time stamp"),
        (f"0 {IDENTITY}\n1.5 {IDENTITY}\n", ":2: 1.5 is not a frame number"),
        (f"0 {IDENTITY} 0 0 0 1\n1 1 0 0 0 0 1 0 0 0 0 1 0 5 6 7 1\n", ":2: not a finite .*transposed"),
        (f"7 {IDENTITY}\n7 {IDENTITY}\n", "frame numbers of its first column repeat"),
    ],
)
def test_a_damaged_file_is_an_error_that_names_file_and_line(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "t.txt"
    path.write_text(text)
    with pytest.raises(UsageError, match=f"t.txt.*{message}"):
        read_trajectory(path)


def test_what_is_no_text_file_is_rejected(tmp_path: Path) -> None:
    (tmp_path / "binary").write_bytes(bytes(range(256)))
    for path, reason in ((tmp_path / "none", "No such file"), (tmp_path, "directory"), (tmp_path / "binary", "text")):
        with pytest.raises(UsageError, match=f"{path}: .*{reason}"):
            read_trajectory(path)


def _trajectory(keys: list[int], kind: str) -> Trajectory:
    """Poses whose x is their key, so that a match can be identified."""
    poses = np.tile(np.eye(4), (len(keys), 1, 1))
    poses[:, 0, 3] = keys
    return Trajectory(poses, np.array(keys, np.int64), kind)


def _x(poses: np.ndarray) -> list[float | None]:
    return [None if np.isnan(x) else x for x in poses[:, 0, 3]]


def test_missing_frames_are_found_by_their_number() -> None:
    gt, est, _ = matched(_trajectory([0, 1, 2, 3, 4], "kitti"), _trajectory([3, 1], "kitti-indexed"))
    assert (_x(gt), _x(est)) == ([0, 1, 2, 3, 4], [None, 1, None, 3, None])


def test_lines_are_numbers_only_where_there_is_one_for_each() -> None:
    """An excerpt of frames 20 to 23. The same number of lines are its frames. Enough lines for all numbers are those of
    the whole drive. Other numbers of lines cannot be assigned."""
    gt = _trajectory([20, 21, 22, 23], "kitti-indexed")
    assert _x(matched(gt, _trajectory([0, 1, 2, 3], "kitti"))[1]) == [0, 1, 2, 3]
    assert _x(matched(gt, _trajectory(list(range(24)), "kitti"))[1]) == [20, 21, 22, 23]
    with pytest.raises(UsageError, match=r"4 poses \(kitti-indexed\), the estimate 3 "):
        matched(gt, _trajectory([0, 1, 2], "kitti"))


def test_nor_are_those_of_the_ground_truth() -> None:
    """The poses of an excerpt of frames 2 to 5, with an estimate that has the frame numbers: line 2 is frame 4."""
    truth = _trajectory([0, 1, 2, 3], "kitti")
    assert _x(matched(truth, _trajectory([2, 3, 4, 5], "kitti-indexed"))[1]) == [2, 3, 4, 5]
    with pytest.raises(UsageError, match=r"4 poses \(kitti\), the estimate 3 .*--gt DRIVE"):
        matched(truth, _trajectory([2, 3, 5], "kitti-indexed"))


def test_of_a_faster_estimate_the_nearest_counts() -> None:
    """At 200 Hz, two samples on either side are within the tolerance."""
    ms = 10**6
    gt = _trajectory([i * 100 * ms for i in range(11)], "tum")
    assert _x(matched(gt, _trajectory([i * 5 * ms for i in range(201)], "tum"))[1]) == _x(gt.poses)


def test_stamps_of_a_few_decimals_match_in_any_order() -> None:
    """Stamps of the same frames. The estimate lacks one frame: it has failed there."""
    s = 10**9
    gt = _trajectory([2 * s, 1 * s, 4 * s, 3 * s], "tum")
    _, est, _ = matched(gt, _trajectory([3 * s - 99_999, s + 50_000, 2 * s], "tum"))
    assert _x(est) == [s + 50_000, 2 * s, 3 * s - 99_999, None]


def test_frames_whose_stamps_differ_by_more_than_their_rounding_are_no_failures() -> None:
    """For example with another clock. Previously, 58 of 122 frames of an exact estimate with a jitter of 0.14 ms
    counted as failed."""
    gt = _clock(10, 60)
    jitter = np.random.default_rng(0).normal(0, 140_000, 60).astype(np.int64)
    kept = np.delete(np.arange(60), 20)
    true, found, stamps = matched(gt, _trajectory((gt.keys + jitter)[kept].tolist(), "tum"))
    assert np.count_nonzero(np.abs(jitter) > 100_000) > 20
    np.testing.assert_array_equal(true, gt.poses)
    np.testing.assert_array_equal(stamps, gt.keys)
    assert np.flatnonzero(np.isnan(found[:, 0, 3])).tolist() == [20]
    np.testing.assert_allclose(found[kept, 0, 3], true[kept, 0, 3], atol=100_001)  # within rounding: the pose itself


def test_the_way_across_a_gap_moves_no_frame() -> None:
    """In a bend, 8 s without a pose. Previously, the frames next to this gap were 0.23 m off."""

    def driven(stamps: np.ndarray) -> Trajectory:
        return Trajectory(se3.exp(stamps[:, None] * 1e-9 * np.array([0, 0, 0.5, 10, 0, 0])), stamps, "tum")

    numbers, gone = np.arange(200), np.arange(61, 141)
    stamps = numbers * 100_000_000
    late = stamps + np.where(numbers % 3 == 0, np.where(numbers < 90, -15_000_000, 15_000_000), 0)  # 60 and 141, too
    true, found, _ = matched(driven(stamps), driven(np.delete(late, gone)))
    assert np.flatnonzero(np.isnan(found[:, 0, 3])).tolist() == gone.tolist()
    np.testing.assert_allclose(np.delete(found, gone, 0), np.delete(true, gone, 0), atol=1e-9)


def _clock(hz: float, count: int, begin: float = 0.0) -> Trajectory:
    return _trajectory(np.round((begin + np.arange(count) / hz) * 1e9).astype(np.int64).tolist(), "tum")


@pytest.mark.parametrize(
    ("gt_hz", "est_hz"), [(25, 10), (12.5, 10), (30, 9.97), (15, 9.97), (10.05, 10), (10, 10), (9.97, 10)]
)
def test_ground_truth_of_other_stamps_is_interpolated(gt_hz: float, est_hz: float) -> None:
    """At a constant speed, an exact estimate has no error. Previously, the nearest pose was used: 0.15 m off at 15 m/s.
    Frames further than 10 ms from a pose were left out, up to 71 %, or an error, and poses in between counted as
    failed."""
    est = _clock(est_hz, 41, begin=0.047)
    true, found, stamps = matched(_clock(gt_hz, 5 * int(gt_hz)), est)
    np.testing.assert_array_equal(found, est.poses)
    np.testing.assert_array_equal(stamps, est.keys)
    np.testing.assert_allclose(true[:, 0, 3], found[:, 0, 3], atol=1e-3)  # ns; floats of 4e9 resolve 5e-7


@pytest.mark.parametrize("est_hz", [10, 200])
def test_a_slow_ground_truth_counts_at_its_own_stamps(est_hz: int) -> None:
    """At 1 Hz it does not show a bend in between, where an exact estimate would have 1 % of t_err on KITTI 00."""
    gt = _clock(1, 5)
    true, found, stamps = matched(gt, _clock(est_hz, 7 * est_hz // 2, begin=0.047))
    np.testing.assert_array_equal(true, gt.poses)
    assert _x(found)[::4] == [None, None]
    np.testing.assert_allclose(found[1:4, 0, 3], true[1:4, 0, 3], atol=1e-3)  # see above
    np.testing.assert_array_equal(stamps, gt.keys)


def test_a_gap_of_the_ground_truth_is_not_bridged() -> None:
    """A gap of more than 1 s, as in bags."""
    gt, est = _clock(25, 250), _clock(10, 90, begin=0.047)
    hole = (gt.keys > 3e9) & (gt.keys < 5e9)
    true, _, _ = matched(Trajectory(gt.poses[~hole], gt.keys[~hole], "tum"), est)
    assert [x is None for x in _x(true)] == [3e9 < key < 5e9 for key in est.keys]


def test_most_stamps_of_the_fewer_are_those_of_the_same_frames() -> None:
    """At 12.5 Hz, a quarter of the stamps are those of 10 Hz, by chance."""
    ten = _clock(10, 40).keys
    assert same_stamps(ten, ten[[3, 4, 7]] + 99_999)
    assert not same_stamps(ten, _clock(12.5, 60).keys)


def test_of_two_estimates_for_one_frame_the_first_counts() -> None:
    """A looped bag repeats its stamps."""
    gt, est = _trajectory([0, 10**9], "tum"), _trajectory([0, 10**9, 0], "tum")
    est.poses[2, 0, 3] = 77
    assert _x(matched(gt, est)[1]) == [0, 10**9]


def test_ground_truth_of_a_faster_clock_gives_one_frame_for_each_estimate() -> None:
    fast = _trajectory([i * 10**7 for i in range(101)], "tum")
    slow = _trajectory([i * 10**8 for i in range(11)], "tum")
    gt, est, _ = matched(fast, slow)
    assert _x(gt) == _x(est) == [float(i * 10**8) for i in range(11)]


def test_what_is_matched_line_by_line_has_the_keys_of_the_one_that_knows_them() -> None:
    lines = _trajectory([0, 1, 2], "kitti")
    numbers = _trajectory([0, 2, 5], "kitti-indexed")
    stamps = _trajectory([7, 8, 9], "tum")
    for knows, other in ((stamps, lines), (stamps, numbers), (numbers, lines)):
        assert matched(knows, other)[2].tolist() == matched(other, knows)[2].tolist() == knows.keys.tolist()


def test_lines_match_lines_only_if_there_are_as_many() -> None:
    kitti, tum = _trajectory([0, 1, 2], "kitti"), _trajectory([5, 6, 7], "tum")
    assert _x(matched(kitti, tum)[1]) == [5, 6, 7]
    for other in ("kitti", "tum"):
        with pytest.raises(UsageError, match=r"3 poses .* 2 "):
            matched(kitti, _trajectory([0, 1], other))


@pytest.mark.parametrize(("kind", "words"), [("tum", "no pose during"), ("kitti-indexed", "is one of")])
def test_nothing_in_common_is_an_error(kind: str, words: str) -> None:
    with pytest.raises(UsageError, match=f"{words} the ground truth"):
        matched(_trajectory([0, 10**9], kind), _trajectory([5 * 10**9], kind))


def test_interpolation_is_exact_where_known_and_nothing_outside() -> None:
    poses = se3.exp(np.random.default_rng(0).normal(size=(3, 6)))
    stamps = np.array([0, 10**9, 5 * 10**9])
    at = np.array([-1, 0, 10**9, 5 * 10**8, 2 * 10**9, 5 * 10**9, 6 * 10**9])
    out = interpolate(stamps, poses, at)
    np.testing.assert_array_equal(out[[1, 2, 5]], poses)
    assert np.isnan(out[[0, 4, 6]]).all()  # before, in a gap of 4 s, after
    half = se3.way(poses[0], out[3])
    np.testing.assert_allclose(half * 2, se3.way(poses[0], poses[1]), atol=1e-9)
    assert np.isnan(interpolate(np.empty(0, np.int64), np.empty((0, 4, 4)), at)).all()
