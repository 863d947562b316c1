# SPDX-License-Identifier: Apache-2.0
"""KITTI folders: what is read, and how missing and damaged parts are handled."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Sequence
from pathlib import Path

import cv2
import numpy as np
import pytest

from dpm2_core.data.kitti import KittiSource
from dpm2_core.data.settings import InputSettings
from dpm2_core.data.vertical_angle import HDL64_CORRECTION_DEG, correct_vertical_angle, may_be_hdl64
from dpm2_core.errors import UsageError
from dpm2_core.frame import Points

MakeFolder = Callable[..., Path]
RAW = InputSettings(vertical_angle_correction_deg=0)


def scan(folder: Path, number: int) -> Points:
    return np.fromfile(folder / "velodyne" / f"{number:06d}.bin", "<f4").reshape(-1, 4)


def test_frames_carry_points_stamp_index_and_image(kitti_folder: MakeFolder) -> None:
    folder = kitti_folder()
    source = KittiSource(folder, RAW)
    frames = list(source.frames())
    assert (source.name, len(source), source.notes) == ("07", 5, [])
    assert [frame.index for frame in frames] == [0, 1, 2, 3, 4]
    assert [frame.stamp for frame in frames] == [0, 100_000_000, 200_000_000, 300_000_000, 400_000_000]
    np.testing.assert_array_equal(frames[3].points, scan(folder, 3))
    bgr = cv2.imread(str(folder / "image_2" / "000003.png"))
    np.testing.assert_array_equal(frames[3].images[0].pixels, bgr[..., ::-1])


@pytest.mark.parametrize(("start", "stop", "want"), [(1, 3, [1, 2]), (3, None, [3, 4]), (0, 99, [0, 1, 2, 3, 4])])
def test_any_subset(kitti_folder: MakeFolder, start: int, stop: int | None, want: list[int]) -> None:
    assert [frame.index for frame in KittiSource(kitti_folder()).frames(start, stop)] == want


def test_camera_and_poses_are_of_the_lidar(kitti_folder: MakeFolder) -> None:
    """The last column of P2 is the offset of the camera from camera 0. Poses are converted from camera to LiDAR
    axes."""
    source = KittiSource(kitti_folder())
    assert source.T_cam_lidar is not None
    point = np.array([8.0, 1.0, 0.5, 1.0])
    P2 = np.array([[50, 0, 20, 3], [0, 50, 15, 0.1], [0, 0, 1, 0.002]])
    want = P2 @ source.T_cam_lidar @ point  # KITTI's own projection of a LiDAR point
    got = source.camera.K @ (np.linalg.inv(source.camera.T_lidar_cam) @ point)[:3]
    np.testing.assert_allclose(got, want, atol=1e-12)
    np.testing.assert_allclose(source.poses[:, :3, 3], [[n, 0, 0] for n in range(5)], atol=1e-12)  # z of cam is x


def test_numbers_need_not_start_at_zero_nor_follow_each_other(kitti_folder: MakeFolder) -> None:
    folder = kitti_folder(numbers=[20, 21, 23])
    source = KittiSource(folder)
    assert [(f.index, f.stamp) for f in source.frames()] == [(20, 2 * 10**9), (21, 21 * 10**8), (23, 23 * 10**8)]
    np.testing.assert_allclose(source.poses[:, 0, 3], [20, 21, 23])
    # The full dataset's files have a line for every number instead of one for every scan.
    (folder.parents[1] / "poses" / "07.txt").write_text("".join(f"1 0 0 0 0 1 0 0 0 0 1 {2 * n}\n" for n in range(30)))
    poses = KittiSource(folder).poses
    np.testing.assert_allclose(poses[:, 0, 3], [40, 42, 46])


def rename_scans(folder: Path, names: Sequence[int]) -> None:
    for scan, name in zip(sorted((folder / "velodyne").iterdir()), names, strict=True):
        scan.rename(scan.with_name(f"{name}.bin"))


def test_numbers_without_zeros_before_them_are_in_their_order(kitti_folder: MakeFolder) -> None:
    folder = kitti_folder(numbers=range(12), images=False)
    rename_scans(folder, range(12))
    source = KittiSource(folder)
    assert [frame.index for frame in source.frames()] == list(range(12))
    np.testing.assert_array_equal(source.stamps, np.arange(12) * 100_000_000)
    assert source.notes == []


def test_names_that_are_times_are_the_stamps_where_there_is_no_times_txt(kitti_folder: MakeFolder) -> None:
    folder, times = kitti_folder(images=False), [1_700_000_000_000_000_000 + n * 104_000_000 for n in range(5)]
    rename_scans(folder, times)
    assert KittiSource(folder).stamps.tolist() == [0, 100_000_000, 200_000_000, 300_000_000, 400_000_000]
    (folder / "times.txt").unlink()
    source = KittiSource(folder)
    assert source.stamps.tolist() == times
    assert source.notes == []


def test_root_folder_with_one_and_several_sequences(kitti_folder: MakeFolder) -> None:
    folder = kitti_folder()
    root = folder.parents[1]
    assert KittiSource(root).path == folder
    (root / "sequences" / "08" / "velodyne").mkdir(parents=True)
    assert KittiSource(root, InputSettings(sequence="07")).path == folder
    with pytest.raises(UsageError, match=r"several sequences; choose one with input\.sequence: 07, 08"):
        KittiSource(root)
    with pytest.raises(UsageError, match=r"no sequence 11; .*: 07, 08"):
        KittiSource(root, InputSettings(sequence="11"))


def test_poses_beside_the_scans_come_first(kitti_folder: MakeFolder) -> None:
    folder = kitti_folder()
    (folder / "poses.txt").write_text("".join(f"1 0 0 0 0 1 0 0 0 0 1 {-n}\n" for n in range(3)))
    source = KittiSource(folder)
    np.testing.assert_allclose(source.poses[:3, 0, 3], [0, -1, -2])
    assert np.isnan(source.poses[3:]).all()
    assert "2 of 5 frames have no pose" in source.notes[0]


def test_vertical_angle_correction_raises_the_elevation_alone() -> None:
    rng = np.random.default_rng(0)
    points = rng.uniform(-40, 40, (1000, 4)).astype(np.float32)
    turned = correct_vertical_angle(points, 0.205).astype(np.float64)
    before = points.astype(np.float64)

    def spherical(p: np.ndarray) -> np.ndarray:
        rho = np.hypot(p[:, 0], p[:, 1])
        return np.stack([np.linalg.norm(p[:, :3], axis=1), np.arctan2(p[:, 1], p[:, 0]), np.arctan2(p[:, 2], rho)])

    change = spherical(turned) - spherical(before)
    np.testing.assert_allclose(change[:2], 0, atol=2e-5)  # float32 of 60 m
    np.testing.assert_allclose(change[2], np.radians(0.205), atol=1e-6)
    np.testing.assert_array_equal(turned[:, 3], before[:, 3])


@pytest.mark.filterwarnings("error")
def test_invalid_points_pass_the_correction() -> None:
    points = np.array([[np.nan, 1, 1, 0], [0, 0, 0, 0], [0, 0, 5, 0.5], [np.inf, 0, 0, 0]], np.float32)
    out = correct_vertical_angle(points, 0.205)
    assert np.isnan(out[0, 0])
    np.testing.assert_array_equal(out[1], 0)
    np.testing.assert_allclose(out[2], [0, 0, 5, 0.5], atol=1e-4)
    assert not np.isfinite(out[3, :3]).all()


def test_correction_is_on_for_kitti_and_off_where_the_simulator_says_so(kitti_folder: MakeFolder) -> None:
    folder = kitti_folder()
    want = correct_vertical_angle(scan(folder, 0), HDL64_CORRECTION_DEG)
    np.testing.assert_array_equal(next(KittiSource(folder).frames()).points, want)
    (folder / "dpm2_sim.json").write_text(json.dumps({"vertical_angle_correction_deg": 0, "seed": 1}))
    np.testing.assert_array_equal(next(KittiSource(folder).frames()).points, scan(folder, 0))
    chosen = InputSettings(vertical_angle_correction_deg=0.1)
    assert KittiSource(folder, chosen).vertical_angle_correction_deg == 0.1
    (folder / "dpm2_sim.json").write_text("{}")
    with pytest.raises(UsageError, match=r"dpm2_sim.json: no number vertical_angle_correction_deg"):
        KittiSource(folder)
    (folder / "dpm2_sim.json").write_text('{"vertical_angle_correction_deg": NaN}')
    with pytest.raises(
        UsageError, match=r"dpm2_sim.json: want a vertical angle correction of -5 to 5 degrees, got nan"
    ):
        KittiSource(folder)


def test_scans_of_another_lidar_in_its_layout_are_not_corrected(kitti_folder: MakeFolder) -> None:
    """A LiDAR with 16 beams up to 15 degrees, and objects 5 to 45 m away."""
    folder, noise = kitti_folder(), np.random.default_rng(0)
    angle, up = noise.uniform(-np.pi, np.pi, 8000), np.radians(noise.integers(-7, 8, 8000) * 2)
    away = np.where(up < 0, np.minimum(1.7 / np.maximum(np.tan(-up), 0.01), 45), noise.uniform(5, 45, 8000))
    other = np.column_stack([away * np.cos(angle), away * np.sin(angle), away * np.tan(up), 0 * up]).astype("<f4")
    other.tofile(folder / "velodyne" / "000004.bin")  # the last of five
    source = KittiSource(folder)
    assert source.vertical_angle_correction_deg == 0
    assert [note for note in source.notes if "000004.bin: beams that KITTI's LiDAR does not have" in note]
    assert KittiSource(folder, InputSettings(vertical_angle_correction_deg=0.205)).notes == []


@pytest.mark.parametrize("sequence", ["00", "04"])
def test_no_real_scan_is_taken_for_one_of_another_lidar(kitti_root: Path, sequence: str) -> None:
    scans = sorted((kitti_root / "sequences" / sequence / "velodyne").iterdir())[::5]
    assert all(may_be_hdl64(np.fromfile(path, "<f4").reshape(-1, 4)) for path in scans)


def test_intensities_of_other_recorders_become_one_at_most(kitti_folder: MakeFolder) -> None:
    folder = kitti_folder()
    points = scan(folder, 0)
    points[:, 3] *= 255
    points.tofile(folder / "velodyne" / "000000.bin")
    np.testing.assert_allclose(next(KittiSource(folder, RAW).frames()).points[:, 3], points[:, 3] / 255, rtol=1e-6)


def test_a_folder_without_scans(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="no KITTI sequence"):
        KittiSource(tmp_path)
    (tmp_path / "velodyne").mkdir()
    (tmp_path / "velodyne" / "readme.bin").touch()
    with pytest.raises(UsageError, match="no scans"):
        KittiSource(tmp_path)
    with pytest.raises(UsageError, match="no such folder"):
        KittiSource(tmp_path / "absent")


@pytest.mark.parametrize("size", [1, 100, 16 * 60 - 4])
def test_a_scan_of_a_wrong_size_costs_its_frame_alone(kitti_folder: MakeFolder, size: int) -> None:
    folder = kitti_folder()
    (folder / "velodyne" / "000002.bin").write_bytes(bytes(size))
    frames = list(KittiSource(folder).frames())
    assert [frame.problem is None for frame in frames] == [True, True, False, True, True]
    assert f"000002.bin: {size} bytes are no whole number of points" in str(frames[2].problem)
    assert frames[2].points.shape == (0, 4)


def test_a_scan_that_is_gone_or_a_folder_costs_its_frame_alone(kitti_folder: MakeFolder) -> None:
    folder = kitti_folder()
    source = KittiSource(folder)
    (folder / "velodyne" / "000001.bin").unlink()
    (folder / "velodyne" / "000002.bin").unlink()
    (folder / "velodyne" / "000002.bin").mkdir()
    problems = [frame.problem for frame in source.frames()]
    assert "No such file" in str(problems[1])
    assert "Is a directory" in str(problems[2])
    assert problems[3] is None


@pytest.mark.parametrize("count", [0, 1, 50])
def test_small_scans_are_frames_like_others(kitti_folder: MakeFolder, count: int) -> None:
    folder = kitti_folder()
    (folder / "velodyne" / "000001.bin").write_bytes(bytes(16 * count))
    frame = next(KittiSource(folder).frames(1))
    assert frame.points.shape == (count, 4)
    assert frame.problem is None


@pytest.mark.parametrize("calib", [None, "P2: 50 0 20 3 0 50 15 0.1 0 0 1 0.002\n"])
def test_without_tr_the_lidar_goes_on_alone(kitti_folder: MakeFolder, calib: str | None) -> None:
    """The extrinsics are never an identity: no camera, no ground truth, and the notes report why."""
    folder = kitti_folder()
    (folder / "calib.txt").unlink()
    if calib:
        (folder / "calib.txt").write_text(calib)
    source = KittiSource(folder)
    assert source.T_cam_lidar is None
    assert source.camera is None
    assert source.poses is None
    notes = " | ".join(source.notes)
    assert f"calib.txt {'has no Tr' if calib else 'is missing'}: poses are of the LiDAR" in notes
    assert "images are left out" in notes
    assert "no ground truth" in notes
    assert len(list(source.frames())) == 5


def test_images_need_p2(kitti_folder: MakeFolder) -> None:
    folder = kitti_folder()
    (folder / "calib.txt").write_text("Tr: 0 -1 0 0 0 0 -1 0 1 0 0 0\n")
    with pytest.raises(UsageError, match=r"calib.txt: no P2, which image_2 needs"):
        KittiSource(folder)
    assert KittiSource(folder, InputSettings(images=False)).T_cam_lidar is not None


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("P2: 1 2 3", r"calib.txt:1: P2: 3 numbers, want 12"),
        ("P2: 50 0 20 3 0 50 15 0 0 0 1 x", r"calib.txt:1: P2: .*'x'"),
        ("P2: 50 0 20 3 0 50 15 nan 0 0 1 0", r"calib.txt:1: P2: 12 numbers, want 12 finite ones"),
        ("P2: 0 0 0 0 0 0 0 0 0 0 0 0", r"calib.txt:1: P2 is no projection matrix"),
        ("Tr: 1 0 0 0 0 1 0 0 0 0", r"calib.txt:1: Tr: 10 numbers, want 12"),
        ("Tr: 2 0 0 0 0 1 0 0 0 0 1 0", r"calib.txt:1: Tr is no rigid transform"),
    ],
)
def test_a_damaged_calibration_is_named(kitti_folder: MakeFolder, line: str, message: str) -> None:
    folder = kitti_folder()
    (folder / "calib.txt").write_text(line + "\n")
    with pytest.raises(UsageError, match=message):
        KittiSource(folder)


def test_files_that_end_before_an_excerpt_does_are_not_shifted_to_its_start(kitti_folder: MakeFolder) -> None:
    """The rows are neither one for each scan nor enough for the scans' numbers, so they cannot be assigned."""
    folder = kitti_folder(numbers=[20, 21, 23])
    (folder / "times.txt").write_text("".join(f"{0.2 * n}\n" for n in range(22)))
    (folder / "poses.txt").write_text("".join(f"1 0 0 0 0 1 0 0 0 0 1 {n}\n" for n in range(22)))
    source = KittiSource(folder, InputSettings(kitti_poses="semantic_kitti"))
    assert source.poses is not None
    assert np.isnan(source.poses).all()
    np.testing.assert_array_equal(source.stamps, [0, 100_000_000, 300_000_000])
    assert any("3 of 3 frames have no pose" in note for note in source.notes)
    assert any("0.1 s apart" in note for note in source.notes)


def test_scans_with_a_ring_of_each_point_are_refused(kitti_folder: MakeFolder, noise: np.random.Generator) -> None:
    """Five numbers per point, as in nuScenes, would be read as four: rings and intensities as coordinates."""
    folder, count = kitti_folder(), 32 * 8
    points = np.c_[noise.uniform(-40, 40, (count, 3)), noise.uniform(0, 255, count), np.arange(count) % 32]
    points.astype("<f4").tofile(folder / "velodyne" / "000001.bin")
    frames = [*KittiSource(folder).frames()]
    assert frames[1].problem is not None
    assert "5 numbers per point" in frames[1].problem
    assert [frame.problem for frame in frames if frame.index != 1] == [None] * 4


def test_integers_are_no_floats(kitti_folder: MakeFolder, noise: np.random.Generator) -> None:
    """Four uint16 per point, as in NCLT. Previously, two points were read as one, 1e-38 m away, without a warning."""
    folder = kitti_folder()
    noise.integers(0, 2000, (400, 8)).astype("<u2").tofile(folder / "velodyne" / "000001.bin")
    frame = [*KittiSource(folder).frames()][1]
    assert frame.problem is not None
    assert "not the points of a LiDAR" in frame.problem
    assert not len(frame.points)


def test_times_that_end_early_continue_at_their_pace(kitti_folder: MakeFolder) -> None:
    folder = kitti_folder()
    (folder / "times.txt").write_text("0\n0.2\n0.4\n")
    source = KittiSource(folder)
    np.testing.assert_array_equal(source.stamps, np.arange(5) * 200_000_000)
    assert "3 times for 5 scans" in source.notes[0]


@pytest.mark.parametrize("wrong", [1.1, -0.9, 0.0, 1e6])
def test_a_time_that_is_not_between_its_neighbors_is_taken_to_be(kitti_folder: MakeFolder, wrong: float) -> None:
    """Previously, one such time moved a perfect drive by 2 to 18 m, over a break."""
    folder = kitti_folder(numbers=range(30))
    times = [0.1 * n + 5 for n in range(30)]
    times[12] = wrong
    (folder / "times.txt").write_text("".join(f"{t}\n" for t in times))
    source = KittiSource(folder)
    np.testing.assert_allclose(source.stamps * 1e-9, 0.1 * np.arange(30) + 5, atol=1e-9)
    assert any("1 times are not between their neighbors" in note and "of scan 12" in note for note in source.notes)


def test_poses_that_are_no_transforms_are_none(kitti_folder: MakeFolder) -> None:
    folder = kitti_folder()
    (folder / "poses.txt").write_text("".join(f"{1 + (n == 2)} 0 0 0 0 1 0 0 0 0 1 {n}\n" for n in range(5)))
    source = KittiSource(folder, InputSettings(kitti_poses="semantic_kitti"))
    np.testing.assert_array_equal(np.isnan(source.poses[:, 0, 0]), np.arange(5) == 2)
    assert any(
        "1 poses are not rigid transforms and left out, the first that of scan 2" in note for note in source.notes
    )


@pytest.mark.parametrize("text", [None, ""])
def test_without_times_frames_are_a_tenth_apart(kitti_folder: MakeFolder, text: str | None) -> None:
    folder = kitti_folder(numbers=[3, 4, 6])
    (folder / "times.txt").unlink()
    if text is not None:
        (folder / "times.txt").write_text(text)
    source = KittiSource(folder)
    np.testing.assert_array_equal(source.stamps, [0, 100_000_000, 300_000_000])
    assert "0.1 s apart" in source.notes[0]


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("times.txt", "0\nten\n", r"times.txt:2: .*'ten'"),
        ("times.txt", "0\n\n1 2\n", r"times.txt:3: 2 numbers, want 1"),
        ("times.txt", "0\n1e300\n", r"times.txt:2: 1e\+300 is too large for a time"),
        ("imu.txt", "0 0 0 0 0 0 1e300\n", r"imu.txt:1: 1e\+300 is too large"),
        ("imu.txt", "0 1 2 3\n", "imu.txt:1: 4 numbers, want 7"),
        ("imu.txt", "0 0 0 0 0 0 9\n0 0 0 0 0 0 9\n", "imu.txt:2: times do not"),
        ("gnss.txt", "1e20 49 8 100 1 1 1\n", r"gnss.txt:1: 1e\+20 is too large for a time"),
        ("gnss.txt", "0 49 8\n", "gnss.txt:1: 3 numbers, want 7"),
        ("gnss.txt", "0 49 8 0 1 1 1\n1 99 8 0 1 1 1\n", "gnss.txt:2: fix: .* no place on Earth"),
        ("gnss.txt", "0 49 8 0 1 1 0\n", "gnss.txt:1: fix: .* no covariance"),
        ("poses.txt", "1 0 0 0 0 1 0 0 0 0 1\n", r"poses.txt:1: 11 numbers, want 12"),
    ],
)
def test_a_damaged_text_file_is_named(kitti_folder: MakeFolder, name: str, text: str, message: str) -> None:
    folder = kitti_folder()
    (folder / name).write_text(text)
    with (folder / "calib.txt").open("a") as file:
        file.write("Tr_imu_to_velo: 1 0 0 0 0 1 0 0 0 0 1 0\n")
    with pytest.raises(UsageError, match=message):
        KittiSource(folder)


def test_a_pipe_or_device_in_place_of_a_file_is_named(kitti_folder: MakeFolder) -> None:
    """To read it would take forever, or all of the memory."""
    folder = kitti_folder()
    (folder / "velodyne" / "000001.bin").unlink()
    (folder / "velodyne" / "000001.bin").symlink_to("/dev/zero")
    (folder / "velodyne" / "000002.bin").unlink()
    os.mkfifo(folder / "velodyne" / "000002.bin")
    scan = folder / "velodyne" / "000001.bin"
    problems = [frame.problem for frame in KittiSource(folder).frames()]
    assert problems == [None, f"{scan}: not a file", f"{scan.with_name('000002.bin')}: not a file", None, None]
    (folder / "calib.txt").unlink()
    os.mkfifo(folder / "calib.txt")
    with pytest.raises(UsageError, match=r"calib\.txt: not a file$"):
        KittiSource(folder)


def test_binary_instead_of_text_is_named(kitti_folder: MakeFolder) -> None:
    folder = kitti_folder()
    (folder / "times.txt").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(UsageError, match=r"times.txt: not a text file"):
        KittiSource(folder)


def test_images_that_cannot_be_used_cost_the_image_alone(kitti_folder: MakeFolder) -> None:
    folder = kitti_folder()
    cv2.imwrite(str(folder / "image_2" / "000001.png"), np.zeros((31, 40, 3), np.uint8))
    (folder / "image_2" / "000002.png").write_bytes(b"no image")
    (folder / "image_2" / "000003.png").unlink()
    source = KittiSource(folder)
    frames = list(source.frames())
    assert [len(frame.images) for frame in frames] == [1, 0, 0, 0, 1]
    assert all(len(frame.points) == 60 and frame.problem is None for frame in frames)
    assert "000001.png is 40x31 (others are 40x30)" in source.notes[0]
    assert "000002.png cannot be read" in source.notes[1]


def test_no_image_at_all_can_be_read(kitti_folder: MakeFolder) -> None:
    folder = kitti_folder()
    for path in (folder / "image_2").iterdir():
        path.write_bytes(b"")
    source = KittiSource(folder)
    assert source.camera is None
    assert "none of its images can be read" in source.notes[0]


def test_real_excerpts(kitti_root: Path) -> None:
    """Sequence 00 contains frames 20-141, with one line for each in its text files; 04 has images."""
    source = KittiSource(kitti_root, InputSettings(sequence="00"))
    assert (len(source), source.numbers[0], source.numbers[-1]) == (122, 20, 141)
    assert source.stamps[0] == 2_073_666_000
    assert source.poses is not None
    whole = KittiSource(kitti_root, InputSettings(sequence="00"))
    (whole.path / "poses.txt").rename(whole.path / "poses.bak")
    try:  # the 4541 lines of the whole drive must give the same poses, selected by frame number
        picked = KittiSource(whole.path).poses
    finally:
        (whole.path / "poses.bak").rename(whole.path / "poses.txt")
    assert picked is not None
    np.testing.assert_allclose(picked, source.poses, atol=1e-6)
    frame = next(KittiSource(kitti_root, InputSettings(sequence="04")).frames(50))
    assert len(frame.points) > 100_000
    assert frame.images[0].pixels.shape == (370, 1226, 3)
    assert 0 <= frame.points[:, 3].min() <= frame.points[:, 3].max() <= 1


def test_semantic_kitti_poses_are_a_choice(kitti_folder: Callable[..., Path]) -> None:
    """poses.txt of the sequence's folder, or poses/NN.txt. If the requested file is missing, it is named."""
    folder = kitti_folder(images=False)
    kitti = KittiSource(folder, InputSettings(kitti_poses="kitti")).poses
    with pytest.raises(UsageError, match=r"poses.txt: no such file .*semantic_kitti"):
        KittiSource(folder, InputSettings(kitti_poses="semantic_kitti"))
    (folder / "poses.txt").write_text("".join(f"1 0 0 0 0 1 0 0 0 0 1 {2 * n}\n" for n in range(5)))
    suma = KittiSource(folder, InputSettings(kitti_poses="semantic_kitti")).poses
    np.testing.assert_allclose(suma[4, :3, 3] - suma[0, :3, 3], 2 * (kitti[4, :3, 3] - kitti[0, :3, 3]), atol=1e-12)
    np.testing.assert_array_equal(KittiSource(folder).poses, suma)
    again = KittiSource(folder, InputSettings(kitti_poses="kitti")).poses
    np.testing.assert_array_equal(again, kitti)
