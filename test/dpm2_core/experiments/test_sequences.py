# SPDX-License-Identifier: Apache-2.0
"""The experiments with the SLAM, called as a user calls them, on small trees in the layout of each data set."""

from __future__ import annotations

import json
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest

from dpm2_core.data.trajectory import read_trajectory, write_kitti, write_tum
from dpm2_core.experiments.kitti import KITTI
from dpm2_core.experiments.request import Request
from dpm2_core.experiments.sequences import paper_notes, segments
from dpm2_core.experiments.slam_part import Drive, given
from dpm2_core.geometry import se3

from ...helpers.command import dpm2
from ...helpers.experiments import first_table
from ...helpers.layouts import DRIVE_360, kitti_360, kitti_odometry

QUICK = ("--registration", "geometric", "--set", "slam.loops.enabled=false", "--set", "slam.threads=1")
"""No network is loaded."""


@pytest.fixture(scope="module")
def kitti(recording: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Sequences 06 and 10, six scans each, with images."""
    return kitti_odometry(recording, tmp_path_factory.mktemp("kitti"), ("06", "10"), 6, images=True)


def test_what_is_measured_otherwise_than_in_the_paper_is_said(tmp_path: Path) -> None:
    """A note states that the paper's rows are not comparable, and which segments were used. Previously, only KITTI's
    table had such a note."""
    request, paper = Request(tmp_path, tmp_path), ("06", "10")
    assert (paper_notes(request, paper, paper), segments(request)) == ([], "all segments")
    (missing,) = paper_notes(request, ("10",), paper)
    assert missing.endswith("requested: 06")
    for other in (replace(request, lengths=(50.0, 100.0)), replace(request, frames=(0, 400))):
        (note,) = paper_notes(other, paper, paper)
        assert note.endswith("do not compare with its rows")
    (note,) = paper_notes(request, (*paper, "07"), paper)
    assert note.endswith("do not compare with its rows")
    assert segments(replace(request, lengths=(50.0, 100.0))) == "all segments of 50, 100 m"


@pytest.mark.slow
def test_kitti_beside_other_programs(kitti: Path, tmp_path: Path) -> None:
    """Table 1 with a peer, a trajectory from a file (the shifted ground truth), and the paper's row; then again."""
    out = tmp_path / "out"
    for name in ("06", "10"):
        truth = read_trajectory(kitti / "poses" / f"{name}.txt").poses
        rows_of = [" ".join(f"{x:.9g}" for x in (se3.exp([0, 0, 0, 5, 0, 0]) @ T)[:3].ravel()) for T in truth]
        (tmp_path / f"given_{name}.txt").write_text("\n".join(rows_of) + "\n")
    programs = [name for name in ("kiss-icp", "small_gicp") if find_spec(name.replace("-", "_"))]  # of the extra bench
    peers = [word for name in programs for word in ("--peer", name)]
    call = ("experiment", "kitti", kitti, "--out", out, "--lengths", "2,3", *QUICK, *peers,
            "--peer", f"other-slam={tmp_path}/given_{{sequence}}.txt")  # fmt: skip
    done = dpm2(*call)
    assert done.returncode == 0, done.stderr
    found = first_table(out / "kitti.json")
    assert list(found) == ["dpm2 geometric", *programs, "other-slam", "DeepPointMap2"]
    assert found["other-slam"]["06"]["t_err_percent"] == pytest.approx(0, abs=1e-4)
    assert 0 < found["dpm2 geometric"]["mean"]["t_err_percent"] < 5
    assert found["DeepPointMap2"]["06"] == {"t_err_percent": 0.47, "r_err_deg_per_100m": 0.20}
    assert "07, 08, 09" in done.stderr
    assert "do not compare with" in done.stderr
    record = json.loads((out / "kitti.json").read_text())
    speeds = {row["name"]: row["cells"]["10"] for row in record["tables"][1]["rows"]}
    assert speeds["dpm2 geometric"]["fps"] > 0
    assert speeds["other-slam"] == {"ape_rmse_m": pytest.approx(0, abs=1e-4), "fps": None}  # a file has no times
    assert record["request"]["lengths"] == [2.0, 3.0]
    assert record["parts"]["dpm2_geometric/06"]["truth"] == "poses/06.txt"
    assert (out / "trajectories_10.png").stat().st_size > 5000
    assert "DeepPointMap2" in (out / "kitti.html").read_text()
    page = tmp_path / "report.html"
    assert dpm2("report", out, "--out", page).returncode == 0
    assert "other-slam/10" in page.read_text()
    assert "KITTI odometry: t_err" in page.read_text()  # the experiment's table
    before = {path: path.stat().st_mtime_ns for path in out.rglob("part.json")}
    assert len(before) == 2 * (2 + len(programs))
    again = dpm2(*call)
    assert first_table(out / "kitti.json") == found
    assert again.stdout == done.stdout
    assert {path: path.stat().st_mtime_ns for path in before} == before


@pytest.mark.slow
def test_a_program_that_was_lost_has_no_better_row_without_a_word(kitti: Path, tmp_path: Path) -> None:
    """The rows name the missing frames. Previously, figures of half a drive were listed with those of whole drives."""
    truth = read_trajectory(kitti / "poses" / "06.txt").poses
    for name, count in (("whole", 6), ("lost", 4)):
        write_tum(tmp_path / f"{name}.tum", np.arange(count) * 10**8, truth[:count])
    peers = [word for name in ("whole", "lost") for word in ("--peer", f"{name}={tmp_path}/{name}.tum")]
    out = tmp_path / "out"
    done = dpm2("experiment", "kitti", kitti, "--out", out, "--lengths", "2", "--sequences", "06", *QUICK, *peers)
    assert done.returncode == 0, done.stderr
    for table in json.loads((out / "kitti.json").read_text())["tables"]:
        notes = {row["name"]: row["note"] for row in table["rows"]}
        assert (notes["whole"], notes["lost"]) == ("", "failed: 2 of 6 frames of 06")
    assert "2 of 6 frames of 06" in done.stdout


@pytest.mark.slow
def test_kitti_360_by_mean_position_error(recording: Path, tmp_path: Path) -> None:
    data = kitti_360(recording, tmp_path / "data", ("0007",), 8)
    out = tmp_path / "out"
    done = dpm2("experiment", "kitti360", data, "--out", out, "--lengths", "2", *QUICK)
    assert done.returncode == 0, done.stderr
    found = first_table(out / "kitti360.json")
    cell = found["dpm2 geometric"]["0007"]
    assert 0 < cell["ape_mean_m"] <= cell["ape_rmse_m"] < 0.3
    assert found["DeepPointMap2"]["0007"]["ape_mean_m"] == 26.00
    assert json.loads((out / "kitti360.json").read_text())["parts"]["dpm2_geometric/0007"]["truth"].startswith(
        f"data_poses/{DRIVE_360.format('0007')}"
    )


@pytest.mark.slow
def test_robustness_at_every_share(kitti: Path, tmp_path: Path) -> None:
    """Both kinds, with the change relative to the unmodified drive."""
    done = dpm2("experiment", "robustness", kitti, "--out", tmp_path, "--sequences", "10", "--lengths", "2",
                "--frames", "0:4", *QUICK)  # fmt: skip
    assert done.returncode == 0, done.stderr
    record = json.loads((tmp_path / "robustness.json").read_text())
    ours = [row["name"] for row in record["tables"][0]["rows"] if row["origin"] == "this run"]
    assert len(ours) == 9
    whole = record["parts"]["dpm2_geometric_whole/10"]
    assert record["parts"]["dpm2_geometric_camera_black_100_/10"]["ape_rmse_m"] == whole["ape_rmse_m"]
    assert record["parts"]["dpm2_geometric_box_before_the_LiDAR_100_/10"]["ape_rmse_m"] != whole["ape_rmse_m"]
    assert set(record["change_percent"]) == set(ours[1:])
    assert "all segments of 2 m;" in record["tables"][0]["caption"]
    assert "the paper's means are over the sequences 06, 07, 08, 09, 10" in record["notes"]
    assert any("do not compare with" in note for note in record["notes"])
    assert (tmp_path / "corrupted_10.png").stat().st_size > 5000


@pytest.mark.parametrize(
    ("arguments", "problem"),
    [
        (("kiti", "DATA", "--out", "OUT"), "kiti: no such experiment; choose from kitti, "),
        (("kitti", "DATA"), "give NAME DATA --out DIR, or --list"),
        (("kitti", "DATA", "--out", "OUT", "--sequences", "42"), "42"),
        (("kitti", "DATA", "--out", "OUT", "--seeds", "3"), "kitti: does not use --seeds"),
        (("robustness", "DATA", "--out", "OUT", "--peer", "kiss-icp"), "robustness: does not use --peer"),
        (("kitti", "DATA", "--out", "OUT", "--lengths", "0"), "--lengths 0"),
        (("kitti", "DATA", "--out", "OUT", "--peer", "x=a.txt"), "write {sequence} in place of their names"),
        (("kitti", "DATA", "--out", "OUT", "--sequences", "10,10"), "kitti: two results have the same name (dpm2/10)"),
        (("kitti360", "DATA", "--out", "OUT"), "choose other sequences with --sequences"),
    ],
)
def test_what_cannot_be_done_is_said_in_one_line(
    kitti: Path, tmp_path: Path, arguments: tuple[str, ...], problem: str
) -> None:
    places = {"DATA": kitti, "OUT": tmp_path / "out"}
    done = dpm2("experiment", *(places.get(argument, argument) for argument in arguments))
    assert done.returncode == 2
    assert done.stderr.strip().count("\n") <= 1  # the bar, and the line
    assert problem in done.stderr


def test_two_peers_in_one_folder_are_refused(kitti: Path, tmp_path: Path) -> None:
    """This is an error, since the second would overwrite the first, and both rows would show its figures."""
    peers = ("--peer", "my slam=a.txt", "--peer", "my_slam=b.txt")
    done = dpm2("experiment", "kitti", kitti, "--out", tmp_path, "--sequences", "10", *peers)
    assert (done.returncode, "two results have the same name (my_slam/10)" in done.stderr) == (2, True)


@pytest.mark.slow
def test_a_peer_or_a_file_that_is_not_there_is_named_with_its_part(kitti: Path, tmp_path: Path) -> None:
    call = ("experiment", "kitti", kitti, "--out", tmp_path, "--sequences", "10", *QUICK, "--frames", "0:2")
    assert "nobody/10: --peer nobody: want kiss-icp" in dpm2(*call, "--peer", "nobody").stderr
    assert "x/10: no.txt: No such file" in dpm2(*call, "--peer", "x=no.txt").stderr
    write_tum(tmp_path / "other.tum", [10**12, 2 * 10**12], np.stack([np.eye(4)] * 2))
    assert "other.tum" in dpm2(*call, "--peer", f"x={tmp_path}/other.tum").stderr
    assert "10: fewer than two frames with a ground truth to compare with" in dpm2(*call[:-1], "0:1").stderr


def ahead(t: np.ndarray) -> np.ndarray:
    """(N, 4, 4) poses of a car that accelerates, at times in s."""
    return se3.make(np.eye(3), np.column_stack([10 * t**2, 0 * t, 0 * t]))


def gathering_speed(root: Path) -> tuple[Drive, np.ndarray]:
    """A drive with twelve frames of that car in KITTI's layout, and their times, s."""
    folder, t = root / "sequences" / "10", np.arange(12) * 0.1
    (folder / "velodyne").mkdir(parents=True)
    for n in range(12):
        np.zeros(4, "<f4").tofile(folder / "velodyne" / f"{n:06d}.bin")
    (folder / "calib.txt").write_text("Tr: 1 0 0 0 0 1 0 0 0 0 1 0\n")
    np.savetxt(folder / "times.txt", t, "%.9e")
    write_kitti(folder / "poses.txt", ahead(t))
    return Drive(data=folder, settings=(), frames=(0, None), lengths=(1.0,)), t


def test_a_file_of_every_second_frame_is_of_these_frames(tmp_path: Path) -> None:
    """A program may write only the poses of its keyframes. Previously, a file with every second frame was rejected, but
    one with two of three frames was not."""
    drive, t = gathering_speed(tmp_path)
    write_tum(tmp_path / "peer.tum", np.round(t * 1e9).astype(np.int64)[::2], ahead(t[::2]))
    found = given(tmp_path, lambda *_: None, drive, tmp_path / "peer.tum")
    assert (found["frames"], found["failed_frames"]) == (12, 6)
    assert found["ape_rmse_m"] < 1e-9
    assert len(read_trajectory(tmp_path / "trajectory.tum")) == 6


def test_a_file_of_other_stamps_is_read_at_those_of_the_frames(tmp_path: Path) -> None:
    """Poses 8 ms after the frames, as from a program with other stamps, are interpolated. For an accelerating car the
    nearest pose was up to 0.2 m off."""
    drive, t = gathering_speed(tmp_path)
    write_tum(tmp_path / "peer.tum", np.round((t + 0.008) * 1e9).astype(np.int64), ahead(t + 0.008))
    found = given(tmp_path, lambda *_: None, drive, tmp_path / "peer.tum")
    assert (found["frames"], found["failed_frames"]) == (12, 1)  # none at or before the first
    assert found["ape_rmse_m"] < 1e-3  # linear interpolation is 7 mm off at this acceleration, equally at each frame


def test_a_file_of_a_whole_sequence_is_read_at_the_frames_of_an_excerpt(tmp_path: Path) -> None:
    """Of scans 3 to 8 of twelve, frames 1 to 4 are selected, and the file's poses of these frames are used. Previously,
    this was an error whose advice did not apply."""
    folder, at = tmp_path / "sequences" / "10", np.arange(12.0) ** 2
    (folder / "velodyne").mkdir(parents=True)
    for n in range(3, 9):
        np.zeros(4, "<f4").tofile(folder / "velodyne" / f"{n:06d}.bin")
    (folder / "calib.txt").write_text("Tr: 1 0 0 0 0 1 0 0 0 0 1 0\n")
    for name in (folder / "poses.txt", tmp_path / "peer.txt"):
        write_kitti(name, se3.make(np.eye(3), np.column_stack([at, 0 * at, 0 * at])))
    drive = Drive(data=folder, settings=(), frames=(1, 5), lengths=(1.0,))
    found = given(tmp_path, lambda *_: None, drive, tmp_path / "peer.txt")
    assert (found["frames"], found["failed_frames"]) == (4, 0)
    assert found["ape_rmse_m"] < 1e-9


def test_a_sequence_that_has_more_scans_or_another_truth_is_driven_again(tmp_path: Path) -> None:
    """A sequence whose scans or ground truth changed is processed again. Previously, for a sequence that was still
    being downloaded, the figures of its first scans were listed as those of the whole, also next to a peer's row with
    all of them."""
    folder, request = tmp_path / "sequences" / "06", Request(tmp_path, tmp_path / "out", peers=("kiss-icp", "x=x.txt"))
    (folder / "velodyne").mkdir(parents=True)
    (tmp_path / "poses").mkdir()
    (folder / "calib.txt").write_text("Tr: 1 0 0 0 0 1 0 0 0 0 1 0\n")
    along = se3.make(np.eye(3), np.c_[np.arange(9.0), np.zeros((9, 2))])

    def contents(scans: int, truth: np.ndarray, first: float = 5.0) -> list[str]:
        write_kitti(tmp_path / "poses" / "06.txt", truth)
        for n in range(scans):
            np.array([first, 0, 0, 0], "<f4").tofile(folder / "velodyne" / f"{n:06d}.bin")
        return [part.content for stage in KITTI.parts(request) for part in stage]

    found = [contents(4, along), contents(9, along), contents(9, along[::-1]), contents(9, along, first=6.0)]
    assert len({content for row in found for content in row}) == len(found)
    assert contents(9, along, first=6.0) == found[-1]
    assert len(found[0]) == 3  # ours, a program and a file


def test_weights_in_the_home_folder_are_an_input_of_the_drives(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """If weights in the home folder change, the drives are processed again; previously, the earlier figures were
    kept."""
    monkeypatch.setenv("HOME", str(tmp_path))
    (tmp_path / "sequences" / "06" / "velodyne").mkdir(parents=True)
    np.zeros(4, "<f4").tofile(tmp_path / "sequences" / "06" / "velodyne" / "000000.bin")
    (tmp_path / "poses").mkdir()
    write_kitti(tmp_path / "poses" / "06.txt", np.eye(4)[None])
    request = Request(tmp_path, tmp_path / "out", overrides=("slam.neural.weights=~/mine.safetensors",))
    ((part,),) = KITTI.parts(request)
    assert part.inputs == [tmp_path / "mine.safetensors"]


def test_the_list_has_every_experiment() -> None:
    done = dpm2("experiment", "--list", "--json", "-")
    assert done.returncode == 0
    assert list(json.loads(done.stdout)) == [
        "kitti", "kitti360", "robustness", "reference-points", "fusion", "attention", "gndnet", "dslr", "dslr-slam",
        "ae-lidar", "ae-lidar-slam",
    ]  # fmt: skip
    lines = [line.split("  ") for line in dpm2("experiment", "--list").stdout.splitlines()]
    named = {
        words[1]: " ".join(words[2:]) for words in lines if len(words) > 1
    }  # a line begins with each, in 80 columns
    assert "DeepPointMap2, table 1" in named["kitti"]
    assert set(json.loads(done.stdout)) <= set(named)
