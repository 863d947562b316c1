# SPDX-License-Identifier: Apache-2.0
"""`dpm2 run` as a user calls it: every file is written, every error is one line and an exit code, nothing is lost."""

from __future__ import annotations

import json
import os
import shutil
import signal
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest

from dpm2_core.data.convert import convert
from dpm2_core.data.kitti import KittiSource
from dpm2_core.data.trajectory import read_trajectory
from dpm2_core.errors import Dpm2Error
from dpm2_core.geometry import se3
from dpm2_core.sim.imu import Imu
from dpm2_core.sim.settings import ImuConfig
from dpm2_core.slam.store.map_data import load_map
from dpm2_core.slam.store.map_store import MapStore

from ...helpers.command import dpm2, refused, started, succeeded
from ...helpers.drives import first_scans
from ...helpers.full_disk import largest_file

pytestmark = pytest.mark.slow

FRAMES = 12
QUICK = ("--set", "slam.registration=geometric", "--set", "slam.loops.descriptors=false")
"""Without the network."""
RESULTS = {
    "trajectory_kitti.txt", "trajectory.tum", "map.ply", "trajectory.png", "timing.json", "config.yaml",
    "metrics.json", "pose_graph.g2o", "frames.csv", "loops.csv", "ground_truth.tum",
}  # fmt: skip


@pytest.fixture(scope="module")
def recording(recording: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The first scans of the recording."""
    return first_scans(recording, FRAMES, tmp_path_factory.mktemp("first"))


@pytest.fixture
def sequence(recording: Path, tmp_path: Path) -> Path:
    """A copy of its sequence folder, which a test may damage."""
    copy = tmp_path / "sequence"
    shutil.copytree(recording / "sequences" / "00", copy)
    return copy


def test_the_imu_of_a_bag_is_used(sequence: Path, tmp_path: Path) -> None:
    """Its samples stop 0.05 s before the ninth frame, which still has some; the drive continues, and both are
    reported."""
    poses, imu = KittiSource(sequence).poses, Imu(ImuConfig(), np.random.default_rng(0))
    steps, times = se3.way(poses[:-1], poses[1:]), imu.times(0.0, 0.75)

    def pose(t: np.ndarray) -> np.ndarray:
        k = np.clip(np.floor(t / 0.1).astype(int), 0, len(steps) - 1)
        return poses[k] @ se3.exp((t / 0.1 - k)[:, None] * steps[k])

    np.savetxt(sequence / "imu.txt", np.column_stack([times, *imu.measure(times, pose)]), "%.9e")
    with (sequence / "calib.txt").open("a") as file:
        file.write("Tr_imu_to_velo: 0 -1 0 0 1 0 0 0 0 0 1 0\n")
    convert(KittiSource(sequence), tmp_path / "bag")
    done = succeeded("run", tmp_path / "bag", "--out", tmp_path / "out", "--set", "slam.registration=geometric")
    assert "/imu: no samples at the time of the scan; going on without the IMU" in " ".join(done.stderr.split())
    timing = json.loads((tmp_path / "out" / "timing.json").read_text())
    assert timing["imu"] == {"used": 9, "no samples at the time of the scan": 3}
    assert "IMU: no samples at the time of the scan (3 of 12 frames)" in " ".join(done.stderr.split())
    assert "IMU: used" not in done.stderr
    assert json.loads((tmp_path / "out" / "metrics.json").read_text())["ape_rmse_m"] < 0.1


def test_writes_everything_and_is_right(recording: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    done = succeeded("run", recording, "--out", out)
    assert {path.name for path in out.iterdir()} == RESULTS
    metrics = json.loads((out / "metrics.json").read_text())
    assert metrics["frames"] == FRAMES
    assert metrics["truth"] == "00/poses.txt"
    assert "Truth: 00/poses.txt" in done.stdout
    assert metrics["failed_frames"] == 0
    assert metrics["t_err_percent"] is None  # 12 m are too short for 100 m segments
    assert metrics["ape_rmse_m"] < 0.03
    assert metrics["rpe_trans_m"] < 0.02
    assert metrics["fps"] > 0
    estimate = read_trajectory(out / "trajectory_kitti.txt")
    truth = read_trajectory(recording / "poses" / "00.txt")
    assert len(estimate) == FRAMES
    np.testing.assert_allclose(estimate.poses[:, :3, 3], truth.poses[:, :3, 3], atol=0.05)  # camera frame, as KITTI's
    assert (out / "trajectory.png").read_bytes()[1:4] == b"PNG"
    succeeded(
        "eval", "--gt", recording / "poses" / "00.txt", "--est", out / "trajectory_kitti.txt", "--json", out / "e"
    )
    assert json.loads((out / "e").read_text())["ape_rmse_m"] == pytest.approx(metrics["ape_rmse_m"], rel=1e-6)


def test_a_bag_gives_the_same(recording: Path, tmp_path: Path) -> None:
    convert(KittiSource(recording), tmp_path / "bag")
    for source, out in ((recording, "folder"), (tmp_path / "bag", "bag_out")):
        succeeded("run", source, "--out", tmp_path / out, "--frames", "2:9", *QUICK)
    # The bag's stamps are absolute, so intervals differ in the last digits of a float: not equal to the bit.
    folder, bag = (read_trajectory(tmp_path / out / "trajectory_kitti.txt").poses for out in ("folder", "bag_out"))
    assert len(folder) == 7
    np.testing.assert_allclose(folder, bag, atol=1e-6)
    assert json.loads((tmp_path / "bag_out" / "metrics.json").read_text())["ape_rmse_m"] < 0.03


def test_resolved_configuration_is_written_and_reads_back(recording: Path, tmp_path: Path) -> None:
    first = tmp_path / "first"
    assert dpm2("run", recording, "--out", first, "--frames", ":3", "--set", "slam.map.voxel=0.7").returncode == 0
    assert "voxel: 0.7" in (first / "config.yaml").read_text()
    second = tmp_path / "second"
    succeeded("run", recording, "--out", second, "--frames", ":3", "--config", first / "config.yaml")
    assert (second / "config.yaml").read_text() == (first / "config.yaml").read_text()


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["/nowhere"], "/nowhere: no such file"),
        (["SRC", "--frames", "5"], "--frames 5: want a:b"),
        (["SRC", "--frames", "50:60"], "12 frames"),
        (
            ["SRC", "--set", "slam.registraton=neural"],
            "unknown key slam.registraton; allowed here: preset, registration",
        ),
        (["SRC", "--set", "slam.registration=magic"], "slam.registration"),
        (["SRC", "--set", "slam.map.voxel=coarse"], "slam.map.voxel"),
        (["SRC", "--config", "/nowhere.yaml"], "/nowhere.yaml"),
        (["SRC", "--gt", "/nowhere.txt"], "/nowhere.txt"),
        (["SRC", "--colour", "red"], "--colour"),
    ],
)
def test_errors_of_use(recording: Path, tmp_path: Path, arguments: list[str], words: str) -> None:
    error = refused("run", *[recording if a == "SRC" else a for a in arguments], "--out", tmp_path / "out")
    assert words in error
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    "arguments",
    [
        ["--out", "FILE"],
        ["--out", "FILE/below"],
        pytest.param(
            ["--record", "/nowhere/run.rrd"],
            marks=pytest.mark.skipif(find_spec("rerun") is None, reason="needs the extra view"),
        ),
    ],
)
def test_what_cannot_be_written_is_an_error_of_use_and_leaves_no_map_and_no_settings(
    recording: Path, tmp_path: Path, arguments: list[str]
) -> None:
    """Otherwise the same command, once corrected, would find a map there."""
    (tmp_path / "file").write_text("mine")
    given = [text.replace("FILE", str(tmp_path / "file")) for text in arguments]
    out, path = ([] if "--out" in given else ["--out", tmp_path / "out"]), tmp_path / "drive.dpm2map"
    assert given[1] in refused("run", recording, *given, *out, "--map", path, "--frames", ":3", *QUICK)
    assert not path.exists()
    assert not (tmp_path / "out" / "config.yaml").exists()
    assert (tmp_path / "file").read_text() == "mine"


def test_a_run_leaves_nothing_of_the_one_before(sequence: Path, tmp_path: Path) -> None:
    """Otherwise, errors of another drive would be shown as its own."""
    out = tmp_path / "out"
    run = ("run", sequence, "--out", out, "--frames", ":3", *QUICK)
    assert dpm2(*run).returncode == 0
    (out / "localisation.json").write_text("{}")  # left by a localization in a map
    assert (out / "metrics.json").exists()
    (sequence / "poses.txt").unlink()
    assert dpm2(*run).returncode == 0
    assert {path.name for path in out.iterdir()} == RESULTS - {"metrics.json", "ground_truth.tum"}


def test_damaged_scans_fail_alone(sequence: Path, tmp_path: Path) -> None:
    """A truncated scan, one of NaN and an empty one: each affects only its own frame, and is named."""
    (sequence / "velodyne" / "000004.bin").write_bytes(b"\0" * 1003)
    np.full((500, 4), np.nan, np.float32).tofile(sequence / "velodyne" / "000006.bin")
    (sequence / "velodyne" / "000008.bin").write_bytes(b"")
    done = succeeded("run", sequence, "--out", tmp_path / "out")
    metrics = json.loads((tmp_path / "out" / "metrics.json").read_text())
    assert (metrics["frames"], metrics["failed_frames"]) == (FRAMES, 3)
    assert metrics["ape_rmse_m"] < 0.1
    assert len(read_trajectory(tmp_path / "out" / "trajectory_kitti.txt")) == FRAMES
    for number in (4, 6, 8):
        assert f"frame {number}:" in done.stderr
    assert "1003" in done.stderr


def test_without_calibration_poses_stay_in_the_lidar_frame(sequence: Path, tmp_path: Path) -> None:
    (sequence / "calib.txt").unlink()
    (sequence / "poses.txt").unlink(missing_ok=True)
    done = succeeded("run", sequence, "--out", tmp_path / "out")
    assert "not of the left camera" in done.stderr
    assert not (tmp_path / "out" / "metrics.json").exists()
    poses = read_trajectory(tmp_path / "out" / "trajectory_kitti.txt").poses
    assert poses[-1, 0, 3] > 5  # x is ahead: the LiDAR's axes, not the camera's


def test_given_ground_truth(recording: Path, sequence: Path, tmp_path: Path) -> None:
    (sequence / "poses.txt").unlink(missing_ok=True)
    succeeded("run", sequence, "--out", tmp_path / "out", "--gt", recording / "poses" / "00.txt", "--frames", "1:10")
    assert json.loads((tmp_path / "out" / "metrics.json").read_text())["ape_rmse_m"] < 0.03
    short = tmp_path / "short.txt"
    short.write_text("\n".join((recording / "poses" / "00.txt").read_text().splitlines()[:5]) + "\n")
    assert "5 poses" in refused("run", sequence, "--out", tmp_path / "out2", "--gt", short)


def test_full_disk_keeps_the_old_map(recording: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    assert dpm2("run", recording, "--out", out, "--frames", ":4", *QUICK).returncode == 0
    before = (out / "map.ply").read_bytes()
    with largest_file(50_000):
        done = dpm2("run", recording, "--out", out, *QUICK)
    assert done.returncode == 1
    assert "map.ply" in done.stderr
    assert (out / "map.ply").read_bytes() == before
    assert not [path for path in out.iterdir() if path.suffix == ".part"]
    # Errors next to the new trajectory must not be those of the previous run, either.
    frames = len(read_trajectory(out / "trajectory_kitti.txt"))
    assert frames == json.loads((out / "timing.json").read_text())["frames"] == FRAMES
    assert json.loads((out / "metrics.json").read_text())["frames"] == FRAMES
    assert len((out / "frames.csv").read_text().splitlines()) == 1 + FRAMES


def test_a_run_that_is_killed_leaves_results_and_settings_of_the_one_before(sequence: Path, tmp_path: Path) -> None:
    out, path = tmp_path / "out", tmp_path / "drive.dpm2map"
    _stand_still(sequence)
    assert dpm2("run", sequence, "--out", out, "--frames", ":3", *QUICK).returncode == 0
    before = {file.name: file.read_bytes() for file in out.iterdir()}
    run = ("run", sequence, "--out", out, "--map", path, *QUICK, "--set", "slam.map.voxel=0.7")
    with started(*run, until=lambda: _keyframes(path)):
        pass  # and kill -9
    assert {file.name: file.read_bytes() for file in out.iterdir()} == before


def _stand_still(sequence: Path) -> None:
    """The robot stands still at the end of the drive, for longer than a test."""
    for i in range(FRAMES, 2000):
        (sequence / "velodyne" / f"{i:06d}.bin").symlink_to(sequence / "velodyne" / f"{FRAMES - 1:06d}.bin")
    (sequence / "times.txt").write_text("".join(f"{0.1 * i:.1f}\n" for i in range(2000)))
    (sequence / "poses.txt").unlink(missing_ok=True)


@pytest.mark.parametrize("another", [False, True])
def test_interrupted_run_writes_what_there_is(sequence: Path, tmp_path: Path, another: bool) -> None:
    """All is written; if another program writes to the map file, all except that file, and this is reported."""
    _stand_still(sequence)
    out, path = tmp_path / "out", tmp_path / "drive.dpm2map"
    run = ("run", sequence, "--out", out, "--map", path, *QUICK)
    with started(*run, until=lambda: _keyframes(path)) as process:
        if another:
            with MapStore.open(path, read_only=False) as store:
                store.begin_session("", "")
        process.send_signal(signal.SIGINT)
        _, stderr = process.communicate(timeout=60)
    assert process.returncode == another, stderr
    assert (f"map file incomplete: {path}: another program has begun to write to it" in stderr) == another
    assert "interrupted after" in stderr
    assert 1 <= len(read_trajectory(out / "trajectory_kitti.txt")) < 2000


def test_an_interrupt_after_the_last_frame_costs_nothing(sequence: Path, tmp_path: Path) -> None:
    """The results are being written, the last of them into a pipe that nobody has read so far."""
    out, pipe = tmp_path / "out", tmp_path / "figures"
    os.mkfifo(pipe)
    with started("run", sequence, "--out", out, "--json", pipe, *QUICK) as process:
        next(line for line in process.stderr if f"{FRAMES}/{FRAMES}" in line)
        process.send_signal(signal.SIGINT)
        with open(os.open(pipe, os.O_RDONLY | os.O_NONBLOCK)) as reader:
            rest = process.communicate(timeout=60)[1]
            assert json.load(reader)["metrics"]
    assert process.returncode == 0, rest
    assert {file.name for file in out.iterdir()} == RESULTS


def _keyframes(path: Path) -> int:
    """Number of keyframes in the map file so far."""
    try:
        with MapStore.open(path) as store:
            return len(load_map(store))
    except Dpm2Error:  # it does not exist yet, or is being made
        return 0


def test_config_dump_shows_every_key() -> None:
    done = succeeded("config", "dump", "--set", "slam.threads=1")
    assert "threads: 1" in done.stdout
    assert "# Spacing of the points that are registered, m; at least `map_voxel`." in done.stdout
    assert dpm2("config", "dump", "--set", "nonsense=1").returncode == 2


def test_corrupted_sensors_on_request(recording: Path, tmp_path: Path) -> None:
    for ratio in (0.0, 1.0):
        out = tmp_path / str(ratio)
        succeeded("run", recording, "--out", out, "--frames", "0:4", "--corrupt", f"beams={ratio},seed=1")
        results = json.loads((out / "timing.json").read_text())["answers"]
        assert results == ({"first": 1, "geometric": 3} if ratio == 0 else {"failed": 4})
    error = refused("run", recording, "--out", tmp_path / "no", "--corrupt", "camera=2")
    assert "--corrupt camera=2: camera" in error
    assert not (tmp_path / "no").exists()


def test_a_network_without_weights_is_an_error_of_use(recording: Path, tmp_path: Path) -> None:
    settings = ("--set", "slam.registration=neural", "--set", f"slam.neural.weights={tmp_path}/none.safetensors")
    error = refused("run", recording, "--out", tmp_path / "no", *settings)
    assert "none.safetensors: no such file; weights shipped with dpm2:" in error
    assert not (tmp_path / "no").exists()
