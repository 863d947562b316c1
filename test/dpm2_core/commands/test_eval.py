# SPDX-License-Identifier: Apache-2.0
"""`dpm2 eval` prints the reference figures, reports how it evaluated, and rejects what it cannot evaluate."""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dpm2_core.commands.options import parse_lengths
from dpm2_core.data.convert import convert
from dpm2_core.data.kitti import read_calib
from dpm2_core.data.open import open_source
from dpm2_core.data.trajectory import read_trajectory, write_kitti, write_tum
from dpm2_core.errors import UsageError
from dpm2_core.evaluation.kitti_metric import OFFICIAL_LENGTHS
from dpm2_core.geometry import se3

from ...helpers.command import dpm2, refused, succeeded
from ...helpers.trajectories import write_indexed


def evaluated(gt: Path, est: Path, *options: object) -> dict[str, Any]:
    """The figures of `dpm2 eval`."""
    done = succeeded("eval", "--gt", gt, "--est", est, "--json", "-", *options)
    return json.loads(done.stdout)


@pytest.mark.parametrize(("name", "printed"), [("ORB", "0.006997 0.000044"), ("SPTAM", "0.014870 0.000097")])
def test_it_prints_what_the_development_kit_prints(kitti_excerpt: Path, name: str, printed: str) -> None:
    gt, est = kitti_excerpt / "gt_poses" / "00.txt", kitti_excerpt / "results" / f"KITTI_00_{name}.txt"
    shown = " ".join(dpm2("eval", "--gt", gt, "--est", est).stdout.replace("│", " ").split())
    assert "3283 segments" in shown
    for figure in printed.split():
        assert figure in shown
    assert "Umeyama" in shown
    assert "Sensor frame" in shown


def _drive(count: int = 60) -> np.ndarray:
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, 2, 3] = np.arange(count)  # the camera looks along z
    return poses


def test_frames_that_an_estimate_is_not_of_are_not_said_to_have_failed(tmp_path: Path) -> None:
    """For a run with `--frames`, the other frames did not fail, and do not count for the path. Previously, "10 failed,
    0 breaks" was reported, and the length of the whole drive."""
    write_kitti(tmp_path / "gt.txt", _drive())
    write_indexed(tmp_path / "est.txt", _drive()[:-10], range(50))
    shown = " ".join(succeeded("eval", "--gt", tmp_path / "gt.txt", "--est", tmp_path / "est.txt").stdout.split())
    assert "10 without a pose in the estimate; true path 59.0000 m" in shown
    assert "failed" not in shown
    assert "breaks" not in shown


def test_the_json_holds_the_fixed_keys_and_how_they_were_measured(tmp_path: Path) -> None:
    est = _drive()
    est[:, 2, 3] *= 1.01
    write_kitti(tmp_path / "gt.txt", _drive())
    write_indexed(tmp_path / "est.txt", est[:-10], range(50))
    gt, est, out = tmp_path / "gt.txt", tmp_path / "est.txt", tmp_path / "new" / "m.json"
    assert dpm2("eval", "--gt", gt, "--est", est, "--lengths", "10,20", "--json", out).returncode == 0
    result = json.loads(out.read_text())
    assert (result["frames"], result["failed_frames"], result["fps"]) == (60, 10, None)
    assert (result["lengths_m"], result["segments"]) == ([10, 20], 39 + 29)
    assert result["rpe_trans_m"] == pytest.approx(0.01)
    assert result["final_drift_percent"] == pytest.approx(1.0)
    assert result["t_err_percent"] == pytest.approx((39 * 1.1 + 29 * 1.05) / 68)
    assert "same sensor" in result["frame"]
    assert evaluated(gt, est)["t_err_percent"] is None


@pytest.mark.parametrize("faster", [1, 4])
def test_speeds_are_those_of_the_stamps(tmp_path: Path, faster: int) -> None:
    """1 m in 0.2 s; a truth with more poses is read at the estimate's. Class of 2 m/s: 11 m in 12 frames is 4.2 m/s."""
    est = _drive()
    truth = np.repeat(est, faster, axis=0)
    truth[:, 2, 3] = np.arange(len(truth)) / faster
    write_tum(tmp_path / "gt.txt", np.arange(len(truth)) * (200_000_000 // faster), truth)
    write_tum(tmp_path / "est.txt", np.arange(len(est)) * 200_000_000, est)
    found = evaluated(tmp_path / "gt.txt", tmp_path / "est.txt", "--lengths", "10")
    assert [row["speed_mps"] for row in found["per_speed"]] == [4.0]


@pytest.mark.parametrize("stamped", [True, False])
def test_a_gap_makes_no_drive_faster(tmp_path: Path, stamped: bool) -> None:
    """At 10 m/s, two missing seconds do not change the speed; previously, the estimate seemed to be up to 30 m/s
    fast."""
    poses, there = _drive(), np.r_[0:20, 40:60]
    if stamped:
        write_tum(tmp_path / "gt.txt", np.arange(60) * 100_000_000 + 3_000_000, poses)
        write_tum(tmp_path / "est.txt", there * 100_000_000, poses[there])
    else:
        write_indexed(tmp_path / "gt.txt", poses[there], there.tolist())
        write_kitti(tmp_path / "est.txt", poses[there])
    found = evaluated(tmp_path / "gt.txt", tmp_path / "est.txt", "--lengths", "10")
    assert [(row["speed_mps"], row["segments"]) for row in found["per_speed"]] == [(8.0, found["segments"])]


def test_lidar_poses_meet_camera_ground_truth_through_the_calibration(tmp_path: Path, kitti_excerpt: Path) -> None:
    """With the calibration, the error is zero. Without it, a drive that rotates by 90 degrees seems to be decimeters
    off."""
    folder = kitti_excerpt / "00"
    T_cam_lidar = read_calib(folder / "calib.txt")["Tr"]
    T_lidar = se3.inverse(T_cam_lidar) @ read_trajectory(folder / "poses.txt").poses @ T_cam_lidar
    write_tum(tmp_path / "est.tum", np.arange(len(T_lidar)) * 10**8, T_lidar)
    for calib, least, most in ((("--calib", folder / "calib.txt"), 0, 1e-5), ((), 0.1, 10)):
        assert least <= evaluated(folder / "poses.txt", tmp_path / "est.tum", *calib)["ape_rmse_m"] <= most


@pytest.mark.parametrize("turned", [False, True], ids=["straight", "round"])
def test_poses_along_other_axes_are_said(tmp_path: Path, turned: bool) -> None:
    """A warning is given if LiDAR poses, as examples/odometry_of_a_folder.py writes them, are compared with camera
    poses. Previously, the drift was 140 % for an odometry with an error of 0.7 %, or 0 % for a drive that ends where it
    began, without a message."""
    T_cam_lidar = np.array([[0, -1, 0, 0.1], [0, 0, -1, -0.2], [1, 0, 0, -0.3], [0, 0, 0, 1]])
    step = se3.exp([0, 2 * np.pi / 60 * turned, 0, 0, 0, 1.0])
    poses = np.stack([np.linalg.matrix_power(step, n) for n in range(61)])
    world = se3.exp([0.1, -2.0, 0.3, 5.0, 6.0, 7.0])  # the two world frames may differ
    drifting = np.stack([np.linalg.matrix_power(se3.exp([0, 0.002, 0, 0, 0, 0.02]) @ step, n) for n in range(61)])
    for name, of in (
        ("gt", poses),
        ("same", world @ drifting),
        ("other", se3.inverse(T_cam_lidar) @ poses @ T_cam_lidar),
    ):
        write_kitti(tmp_path / f"{name}.txt", of)
    for name, said in (("same", False), ("other", True)):
        done = succeeded("eval", "--gt", tmp_path / "gt.txt", "--est", tmp_path / f"{name}.txt")
        assert ("the axes of their poses differ" in " ".join(done.stderr.split())) == said


def test_different_lengths_are_rejected_naming_both(tmp_path: Path) -> None:
    write_kitti(tmp_path / "gt.txt", _drive(60))
    write_kitti(tmp_path / "est.txt", _drive(50))
    error = refused("eval", "--gt", tmp_path / "gt.txt", "--est", tmp_path / "est.txt")
    assert re.search("60 poses .* 50 ", error)


def test_a_run_of_some_frames_is_told_which_of_its_files_a_drive_is_the_truth_of(tmp_path: Path) -> None:
    """The message names trajectory.tum. Previously, it suggested to use the drive as ground truth, which had been
    done."""
    folder, poses = drive_with_truth(tmp_path)
    write_kitti(tmp_path / "est.txt", poses[2:5])
    assert "trajectory.tum" in refused("eval", "--gt", folder, "--est", tmp_path / "est.txt")


def test_lengths_count_once_in_any_order() -> None:
    """A length given twice counts once, and the benchmark's lengths in another order are the benchmark's. Previously,
    the first had twice the weight in the mean, and the others had segments from each frame instead of every tenth."""
    assert parse_lengths("20,10,10") == (10, 20)
    assert parse_lengths("800,700,600,500,400,300,200,100") == OFFICIAL_LENGTHS


@pytest.mark.parametrize("text", ["", "ten", "10,,20", "0", "-5", "inf", "nan"])
def test_lengths_that_are_none_are_rejected(text: str) -> None:
    with pytest.raises(UsageError, match=f"--lengths {text}"):
        parse_lengths(text)


def test_a_calibration_without_tr_or_that_is_not_there_is_rejected(tmp_path: Path) -> None:
    write_kitti(tmp_path / "gt.txt", _drive())
    (tmp_path / "calib.txt").write_text("P0: 1 0 0 0 0 1 0 0 0 0 1 0\n")
    for name, reason in (("calib.txt", "no Tr"), ("none.txt", "no such file")):
        error = refused("eval", "--gt", tmp_path / "gt.txt", "--est", tmp_path / "gt.txt", "--calib", tmp_path / name)
        assert f"{name}: {reason}" in error


def drive_with_truth(root: Path, numbers: Sequence[int] = range(6)) -> tuple[Path, np.ndarray]:
    """A KITTI sequence of scans with these numbers, and the poses (N, 4, 4) of its left camera."""
    folder, poses = root / "sequences" / "07", np.stack([se3.exp([0, 0.02 * n, 0, 0, 0, n]) for n in numbers])
    (folder / "velodyne").mkdir(parents=True)
    for n in numbers:
        np.zeros(4, "<f4").tofile(folder / "velodyne" / f"{n:06d}.bin")
    (folder / "calib.txt").write_text("Tr: 0 -1 0 0.1 0 0 -1 -0.2 1 0 0 -0.3\n")
    write_kitti(folder / "poses.txt", poses)
    return folder, poses


def test_a_drive_is_its_own_ground_truth(tmp_path: Path) -> None:
    """--gt may be a drive of any layout: it evaluates an estimate of the left camera with frame numbers."""
    folder, poses = drive_with_truth(tmp_path)
    write_indexed(tmp_path / "est.txt", poses[1:], range(1, 6))
    for drive, options in ((folder, ()), (tmp_path, ("--set", "input.sequence=07"))):
        assert evaluated(drive, tmp_path / "est.txt", *options)["ape_rmse_m"] < 1e-6
    (folder / "poses.txt").unlink()
    assert "no ground truth" in dpm2("eval", "--gt", folder, "--est", tmp_path / "est.txt").stderr


def test_a_drive_is_the_truth_of_stamped_poses_of_its_lidar(tmp_path: Path) -> None:
    """Stamped poses, as in trajectory.tum of `dpm2 run`, the only file of --localise, are compared with poses of the
    LiDAR; previously, with those of the camera."""
    folder, poses = drive_with_truth(tmp_path)
    (folder / "times.txt").write_text("".join(f"{0.1 * n}\n" for n in range(6)))
    T_cam_lidar = np.array([[0, -1, 0, 0.1], [0, 0, -1, -0.2], [1, 0, 0, -0.3], [0, 0, 0, 1]])
    stamps = [100_000_000 * n for n in range(1, 6)]
    of_lidar = se3.inverse(T_cam_lidar) @ poses @ T_cam_lidar
    write_tum(tmp_path / "est.tum", stamps, of_lidar[1:])
    for options, frame in (((), "LiDAR, as"), (("--calib", folder / "calib.txt"), "left camera; the estimate")):
        figures = evaluated(folder, tmp_path / "est.tum", *options)
        assert figures["ape_rmse_m"] < 1e-6
        assert figures["frame"].startswith(frame)


def test_a_drive_that_is_one_file_is_its_own_ground_truth(tmp_path: Path) -> None:
    folder, poses = drive_with_truth(tmp_path)
    convert(open_source(folder), tmp_path / "bag")
    write_kitti(tmp_path / "est.txt", poses)
    (bag,) = (tmp_path / "bag").glob("*.mcap")
    for drive in (bag.parent, bag):
        assert evaluated(drive, tmp_path / "est.txt")["frames"] == 6


def test_frames_of_a_drive_without_a_pose_stay(tmp_path: Path) -> None:
    """Frames keep their numbers if scans 3 and 4 are missing and the poses end at frame 6. Previously, the estimate's
    ten lines were taken for frames 0 to 9, since there are more lines than known poses; an exact estimate had a t_err
    of 28 %."""
    folder, poses = drive_with_truth(tmp_path, range(12))
    for n in (3, 4):
        (folder / "velodyne" / f"{n:06d}.bin").unlink()
    write_kitti(folder / "poses.txt", poses[:7])
    write_kitti(tmp_path / "est.txt", np.delete(poses, (3, 4), axis=0))
    found = evaluated(tmp_path, tmp_path / "est.txt")
    assert found["ape_rmse_m"] < 1e-6  # the file has 13 digits
    assert (found["frames"], found["failed_frames"]) == (10, 0)
