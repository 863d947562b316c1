# SPDX-License-Identifier: Apache-2.0
"""Written drives: a plain KITTI data set, complete or absent, the same for any number of workers."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from dpm2_core.config import settings_from
from dpm2_core.data.kitti import KittiSource
from dpm2_core.errors import Dpm2Error, UsageError
from dpm2_core.geometry import se3
from dpm2_core.sim.drive import simulate
from dpm2_core.sim.materials import Label
from dpm2_core.sim.settings import CameraConfig, DriveConfig, GnssConfig, LidarConfig

LIDAR = LidarConfig(beams=16, columns=360)
CAMERA = CameraConfig(width=160, height=48, focal=95)


def _files(root: Path) -> dict[str, bytes]:
    return {str(p.relative_to(root)): p.read_bytes() for p in sorted(root.rglob("*")) if p.is_file()}


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("sim") / "drive"
    assert simulate(out, DriveConfig(frames=4, seed=3, road="loop", lidar=LIDAR, camera=CAMERA), workers=2)
    return out


def test_any_kitti_reader_reads_it(recording: Path) -> None:
    source = KittiSource(recording)
    assert source.notes == []
    assert source.vertical_angle_correction_deg == 0  # simulated beams have exact angles
    frames = list(source.frames())
    assert [f.index for f in frames] == [0, 1, 2, 3]
    np.testing.assert_allclose(np.diff([f.stamp for f in frames]), 1e8, rtol=1e-6)
    sequence = recording / "sequences" / "00"
    for frame in frames:
        assert frame.problem is None
        assert len(frame.points) > 2000
        assert frame.images[0].pixels.shape == (48, 160, 3)
        label = np.fromfile(sequence / "labels" / f"{frame.index:06d}.label", np.uint32)
        assert len(label) == len(frame.points)
        static = np.fromfile(sequence / "static" / f"{frame.index:06d}.bin", np.float32).reshape(-1, 4)
        assert abs(len(static) - len(frame.points)) < 0.05 * len(static)
    np.testing.assert_allclose(source.camera.T_lidar_cam[:3, 3], [0.27, 0.06, -0.08], atol=1e-9)
    np.testing.assert_allclose(source.camera.K[:2, 2], [79.5, 23.5])


def test_poses_are_relative_to_the_first_camera_and_line_the_scans_up(recording: Path) -> None:
    source = KittiSource(recording)
    rows = np.loadtxt(recording / "poses" / "00.txt")
    np.testing.assert_allclose(rows[0].reshape(3, 4), np.eye(4)[:3], atol=1e-8)
    np.testing.assert_array_equal(rows, np.loadtxt(recording / "sequences" / "00" / "poses.txt"))
    assert (rows[1:, 11] > 0).all()  # camera z is ahead
    world = np.load(recording / "sequences" / "00" / "ground.npz")
    T_grid_lidar0 = world["T_grid_cam0"] @ source.T_cam_lidar
    for frame, T in zip(source.frames(), source.poses, strict=True):
        label = np.fromfile(recording / "sequences" / "00" / "labels" / f"{frame.index:06d}.label", np.uint32)
        points = se3.transform(T_grid_lidar0 @ T, frame.points[label == Label.ROAD, :3].astype(float))
        column, row = ((points[:, :2] - world["origin"]) / world["resolution"]).round().astype(int).T
        assert np.median(np.abs(world["elevation"][row, column] - points[:, 2])) < 0.03  # except curbs and noise


def test_the_number_of_workers_changes_nothing(recording: Path, tmp_path: Path) -> None:
    simulate(tmp_path / "one", DriveConfig(frames=4, seed=3, road="loop", lidar=LIDAR, camera=CAMERA), workers=1)
    assert _files(tmp_path / "one") == _files(recording)


def test_a_complete_drive_is_reused_and_another_one_rejected(recording: Path) -> None:
    before = _files(recording)
    assert not simulate(recording, DriveConfig(frames=4, seed=3, road="loop", lidar=LIDAR, camera=CAMERA))
    assert _files(recording) == before
    with pytest.raises(UsageError, match="other seed, or of another version"):  # which may not have noted all settings
        simulate(recording, DriveConfig(frames=4, seed=4, road="loop", lidar=LIDAR, camera=CAMERA))


def test_another_folder_is_never_touched(tmp_path: Path) -> None:
    (tmp_path / "thesis.tex").write_text("words")
    with pytest.raises(UsageError, match="not a simulated drive"):
        simulate(tmp_path, DriveConfig(frames=2, lidar=LIDAR, images=False))
    assert _files(tmp_path) == {"thesis.tex": b"words"}


def test_without_images_there_are_none(tmp_path: Path) -> None:
    (tmp_path / "out").mkdir()  # an empty folder counts as none
    simulate(tmp_path / "out", DriveConfig(frames=1, preset="tunnel", images=False, lidar=LIDAR))
    assert not (tmp_path / "out" / "sequences" / "00" / "image_2").exists()
    assert len(KittiSource(tmp_path / "out")) == 1


def test_a_drive_too_short_for_a_fix_into_the_folder_one_is_in(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    simulate(Path("."), DriveConfig(frames=1, preset="tunnel", images=False, lidar=LIDAR, gnss=GnssConfig()))
    assert len(KittiSource(Path("."))) == 1
    assert (tmp_path / "here" / "sequences" / "00" / "gnss.txt").read_text() == ""
    assert [p.name for p in tmp_path.iterdir()] == ["here"]


@pytest.mark.slow
def test_a_failure_leaves_nothing(tmp_path: Path) -> None:
    def fail(done: int, total: int) -> None:
        raise RuntimeError("no more")

    with pytest.raises(RuntimeError, match="no more"):
        simulate(tmp_path / "out", DriveConfig(frames=5, preset="tunnel", images=False, lidar=LIDAR), progress=fail)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
def test_a_killed_run_leaves_nothing_that_looks_whole_and_the_next_one_cleans_up(tmp_path: Path) -> None:
    program = (
        "import sys, pathlib; from dpm2_core.sim.drive import simulate; from dpm2_core.sim.settings import DriveConfig;"
        "drive = DriveConfig(frames=300, preset='tunnel', images=False, lidar={'beams': 16, 'columns': 360});"
        "simulate(pathlib.Path(sys.argv[1]), drive)"
    )
    child = subprocess.Popen([sys.executable, "-c", program, str(tmp_path / "out")])
    try:
        deadline = time.monotonic() + 120
        while not list(tmp_path.glob(".out.*.part/sequences/00/velodyne/*.bin")):
            assert child.poll() is None
            assert time.monotonic() < deadline
            time.sleep(0.02)
    finally:
        child.send_signal(signal.SIGKILL)
        child.wait()
    assert not (tmp_path / "out").exists()
    assert list(tmp_path.glob(".out.*.part"))
    assert simulate(tmp_path / "out", DriveConfig(frames=1, preset="tunnel", images=False, lidar=LIDAR))
    assert [p.name for p in tmp_path.iterdir()] == ["out"]


@pytest.mark.slow
def test_a_file_gives_its_own_frames_and_rejects_more(poses_file: Path, tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="has 235"):
        simulate(tmp_path / "out", DriveConfig(frames=236, road=str(poses_file), images=False, lidar=LIDAR))
    simulate(tmp_path / "out", DriveConfig(frames=60, road=str(poses_file), images=False, lidar=LIDAR))
    file = np.loadtxt(poses_file).reshape(-1, 3, 4)[:60, :, 3]
    written = KittiSource(tmp_path / "out").poses[:, :3, 3]
    steps = np.linalg.norm(np.diff(written, axis=0), axis=1)
    np.testing.assert_allclose(steps.sum(), np.linalg.norm(np.diff(file, axis=0), axis=1).sum(), rtol=0.05)
    note = json.loads((tmp_path / "out" / "sequences" / "00" / "dpm2_sim.json").read_text())
    assert str(poses_file.parent) not in json.dumps(note)  # a name and a checksum, but no path of this machine


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"frames": 0}, "at least 1"),
        ({"preset": "moon"}, "should be 'city'"),
        ({"road": "no/such/file"}, "or a file of KITTI poses"),
        ({"seed": -3}, "0 or more"),
    ],
)
def test_bad_arguments_are_rejected_before_anything_is_written(tmp_path: Path, arguments: dict, message: str) -> None:
    with pytest.raises(UsageError, match=message):
        simulate(tmp_path / "out", settings_from(DriveConfig, {"frames": 2, **arguments}))
    assert list(tmp_path.iterdir()) == []


def test_a_place_that_cannot_be_written_is_a_failure_of_the_work(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(Dpm2Error, match="not written"):
        simulate(tmp_path / "file" / "out", DriveConfig(frames=1, preset="tunnel", images=False, lidar=LIDAR))
