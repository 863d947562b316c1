# SPDX-License-Identifier: Apache-2.0
"""`dpm2 train pack`: recorded drives are converted to training data, and mixed by weight."""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
import tracemalloc
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from scipy.spatial import cKDTree
from typer.testing import CliRunner

from dpm2_core.cli import app
from dpm2_core.config import load_settings
from dpm2_core.data.open import open_source
from dpm2_core.data.packed import PackedDrive, Sample, open_packed, write_packed
from dpm2_core.data.source import IndexedSource
from dpm2_core.errors import Dpm2Error, UsageError
from dpm2_core.frame import Array, Camera, Frame, Image
from dpm2_core.geometry import se3
from dpm2_core.geometry.scale import ROOM_SCALE
from dpm2_core.learning.dataset import DataSettings, GroupDataset, Mixture
from dpm2_core.learning.generate import GenerateSettings, generate, pack
from dpm2_core.pipeline import OfflineRun
from dpm2_core.slam.settings import Config, SlamSettings

from ...helpers import rooms
from ...helpers.command import dpm2
from ...helpers.drives import InMemory
from ...helpers.networks import tiny
from ...helpers.scenes import boxes, make_image


class Sweeps(IndexedSource):
    """Six sweeps of a street at 10 m/s in a bend; each point is relative to the LiDAR's pose at the point's time."""

    def __init__(self, world: np.ndarray, images: bool = True) -> None:
        super().__init__("sweeps", 6)
        self.world, self.images = world, images
        self.poses = np.stack([self.at(0.1 * n) for n in range(6)])
        self.poses[2] = np.nan

    @staticmethod
    def at(seconds: float) -> Array:
        return se3.exp(np.array([0, 0, 0.3, 10, 0, 0]) * seconds)

    def frame(self, position: int) -> Frame:
        offsets = np.linspace(-0.05, 0.05, len(self.world)).astype(np.float32)
        T = np.stack([se3.inverse(self.at(0.1 * position + t)) for t in offsets])
        seen = np.einsum("nij,nj->ni", T[:, :3, :3], self.world) + T[:, :3, 3]
        images = (make_image(np.random.default_rng(position)),) if self.images or position == 3 else ()
        points = np.c_[seen, np.ones(len(seen))].astype(np.float32)
        return Frame(position * 10**8, points, offsets, images, index=position)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda poses: poses[:5], r"sweeps: poses of shape \(5, 4, 4\), want \(6, 4, 4\)"),
        (lambda poses: poses[:, :3], r"sweeps: poses of shape \(6, 3, 4\)"),
        (lambda poses: poses.transpose(0, 2, 1), r"sweeps: pose 1 is no rigid transform \(is it transposed\?\)"),
    ],
)
def test_wrong_poses_of_a_source_are_named_at_once(
    change: Callable[[Array], Array], message: str, tmp_path: Path
) -> None:
    """By pack and by a run. Previously transposed ones were packed and trained on, and the others were an error of
    NumPy, of a run at its end."""
    source = Sweeps(np.zeros((100, 3)))
    source.poses = change(source.poses)
    with pytest.raises(UsageError, match=message):
        pack(source, tmp_path / "packed", tiny())
    with pytest.raises(UsageError, match=message):
        OfflineRun(source, Config(slam=SlamSettings(registration="geometric")))
    assert not (tmp_path / "packed").exists()


def test_a_room_is_packed_as_the_network_sees_it(tmp_path: Path) -> None:
    """A room is enlarged, including its trajectory."""
    poses = rooms.walk(5)
    source = InMemory(rooms.frames(poses))
    source.poses = poses
    pack(source, tmp_path / "d", tiny())
    drive = PackedDrive(tmp_path / "d")
    assert drive.about["scale"] == ROOM_SCALE
    for n, frame in enumerate(source.frames()):
        np.testing.assert_allclose(drive[n].pose[:3, 3], ROOM_SCALE * poses[n, :3, 3])
        np.testing.assert_array_equal(drive[n].pose[:3, :3], poses[n, :3, :3])
        reach = np.abs(frame.points[:, :3]).max(0)
        np.testing.assert_allclose(np.abs(drive[n].cloud).max(0), ROOM_SCALE * reach, rtol=0.1)


class Leaning(IndexedSource):
    """Two scans of a street by a sensor that is pitched forward by 20 degrees, with images."""

    def __init__(self) -> None:
        super().__init__("leaning", 2)
        level = np.stack([np.eye(4), se3.exp([0, 0, 0.1, 1, 0, 0])])
        self.poses = level @ se3.exp([0, np.radians(20), 0, 0, 0, 0])
        world = boxes(np.random.default_rng(0), 20_000)
        self.world = world[world[:, 2] >= -1.7]  # nothing below the ground

    def frame(self, position: int) -> Frame:
        seen = se3.transform(se3.inverse(self.poses[position]), self.world)
        points = np.c_[seen, np.ones(len(seen))].astype(np.float32)
        return Frame(position * 10**8, points, None, (make_image(np.random.default_rng(position)),), index=position)


def test_scans_of_a_sensor_that_leans_are_packed_in_level_axes(tmp_path: Path) -> None:
    """Points are in level axes, as the network receives them; poses and cameras are transformed with them."""
    source = Leaning()
    pack(source, tmp_path / "d", tiny())
    drive = PackedDrive(tmp_path / "d")
    for n, frame in enumerate(source.frames()):
        sample = drive[n]
        assert sample.pose[2, 2] > np.cos(np.radians(2))  # the street is level
        there = se3.transform(sample.pose, sample.cloud.astype(np.float64))
        gap = cKDTree(source.world).query(there)[0]
        assert gap.max() < 0.01  # packing: 2 mm
        of_camera = source.poses[n] @ frame.images[0].camera.T_lidar_cam
        np.testing.assert_allclose(sample.pose @ sample.images[0].camera.T_lidar_cam, of_camera, atol=1e-6)


@pytest.mark.slow
def test_packed_sweeps_are_rigid_and_fit_each_other(tmp_path: Path) -> None:
    """After de-skewing by the true motion, points of all frames coincide in the world; frames without a pose are left
    out."""
    world = boxes(np.random.default_rng(0), 1000)
    seen: list[tuple[int, int]] = []
    assert pack(Sweeps(world), tmp_path / "d", tiny(), progress=lambda *done: seen.append(done)) == 5
    assert seen == [(n, 6) for n in range(1, 7)]
    drive = PackedDrive(tmp_path / "d")
    height, width = tiny().image.size
    for n in range(5):
        sample = drive[n]
        assert sample.images[0].pixels.shape == (height, width, 3)
        there = se3.transform(sample.pose, sample.cloud.astype(np.float64))
        gap = np.linalg.norm(there[:, None] - world[None], axis=2).min(1)
        # 2 mm of packing, and steps of a millisecond at 10 m/s; without de-skewing it is half a meter.
        assert np.quantile(gap, 0.99) < 0.02


def test_a_scan_that_shows_hardly_anything_is_left_out_and_said(kitti: Path, tmp_path: Path) -> None:
    """An empty file, and a scan that shows only the sensor's own housing, are left out. Previously, the first
    validation pair with such a scan ended the training, and also every resumed one."""
    drive, out = kitti / "sequences" / "03", tmp_path / "d"
    (drive / "velodyne" / "000000.bin").write_bytes(b"")
    np.full((500, 4), 0.2, np.float32).tofile(drive / "velodyne" / "000002.bin")
    done = CliRunner().invoke(app, ["train", "pack", str(drive), str(out)])
    assert done.exit_code == 0, done.output
    assert f"{out}: 2 of 4 frames packed; the others have no pose, cannot be read or have too few points" in done.stderr
    np.testing.assert_allclose(PackedDrive(out).poses[:, 0, 3], [1, 3])
    for name in ("000001.bin", "000003.bin"):
        (drive / "velodyne" / name).write_bytes(b"")
    with pytest.raises(UsageError, match="no readable frame with a pose"):
        pack(open_source(drive), tmp_path / "none", tiny())


def test_what_cannot_be_packed(tmp_path: Path) -> None:
    """No poses; no pose in the range; images in some frames only."""
    source = Sweeps(boxes(np.random.default_rng(0), 200), images=False)
    with pytest.raises(UsageError, match="sweeps: frame 0 has no usable image of camera, frame 3 has one"):
        pack(source, tmp_path / "d", tiny())
    with pytest.raises(UsageError, match="no readable frame with a pose"):
        pack(source, tmp_path / "d", tiny(), range(2, 3))
    source.poses = None
    with pytest.raises(UsageError, match="no ground truth"):
        pack(source, tmp_path / "d", tiny())
    assert not (tmp_path / "d").exists()


@pytest.fixture
def kitti(tmp_path: Path) -> Path:
    """sequences/03 with four scans, 1 m apart."""
    folder = tmp_path / "kitti" / "sequences" / "03"
    (folder / "velodyne").mkdir(parents=True)
    points = np.c_[boxes(np.random.default_rng(0)), np.full(4000, 0.5)].astype(np.float32)
    for n in range(4):
        (points - np.array([n, 0, 0, 0], np.float32)).tofile(folder / "velodyne" / f"{n:06d}.bin")
    (folder / "calib.txt").write_text("Tr: 0 -1 0 0 0 0 -1 0 1 0 0 0\n")
    (folder / "poses.txt").write_text("".join(f"1 0 0 0 0 1 0 0 0 0 1 {n}\n" for n in range(4)))
    return tmp_path / "kitti"


def test_command_and_mixture(kitti: Path, packed: Path, tmp_path: Path) -> None:
    """`dpm2 train pack`, then training data by weight: 0.9 of the groups come from a folder, whatever its size."""
    out = tmp_path / "real" / "03"
    arguments = ["train", "pack", str(kitti), str(out), "--frames", "1:", "--set", "input.sequence=03"]
    done = CliRunner().invoke(app, arguments)
    assert done.exit_code == 0, done.output
    assert f"{out}: 3 frames" in done.stderr
    arguments[3], arguments[-1] = str(tmp_path / "quiet"), "input.sequence=03"  # as in dpm2 run; and its errors
    assert CliRunner().invoke(app, [*arguments, "--quiet"]).stderr == ""
    assert PackedDrive(out).about["source"] == "03"
    assert len(PackedDrive(out)) == 3
    settings = DataSettings(packed={str(out.parent): 0.9, str(packed): 0.1}, workers=0)
    mixture = Mixture(settings)
    chances = dict(zip((drive.name for drive in mixture.drives), mixture.chances, strict=True))
    assert chances == pytest.approx({"03": 0.9, "world": 0.1})
    assert np.isfinite(GroupDataset(settings, tiny(), settings.draw, seed=0)[0, 0].poses.numpy()).all()
    again = CliRunner().invoke(app, arguments)
    assert isinstance(again.exception, UsageError)
    assert "exists already" in str(again.exception)


def test_a_bag_with_poses_packs_like_its_drive(kitti: Path, tmp_path: Path) -> None:
    """Ground truth in an Odometry topic is used like a poses.txt."""
    runner = CliRunner()
    bag, drive = tmp_path / "bag", str(kitti)
    arguments = {
        "bag": ["train", "pack", str(bag), str(tmp_path / "of_bag")],
        "drive": ["train", "pack", drive, str(tmp_path / "of_drive"), "--set", "input.sequence=03"],
    }
    made = runner.invoke(app, ["convert", drive, str(bag), "--set", "input.sequence=03"])
    assert made.exit_code == 0, made.output
    for command in arguments.values():
        done = runner.invoke(app, command)
        assert done.exit_code == 0, done.output
    one, other = PackedDrive(tmp_path / "of_bag"), PackedDrive(tmp_path / "of_drive")
    assert len(one) == len(other) == 4
    motions = [se3.inverse(d.poses[0]) @ d.poses[3] for d in (one, other)]
    np.testing.assert_allclose(motions[0], motions[1], atol=1e-6)


def test_all_drives_of_a_data_set_are_packed_and_a_second_run_makes_only_what_is_missing(
    kitti: Path, tmp_path: Path
) -> None:
    shutil.copytree(kitti / "sequences" / "03", kitti / "sequences" / "05")
    out, arguments = tmp_path / "all", ["train", "pack", str(kitti), str(tmp_path / "all"), "--all"]
    assert CliRunner().invoke(app, arguments).exit_code == 0
    assert [drive.name for drive in open_packed(out)] == ["03", "05"]
    shutil.rmtree(out / "05")
    kept = (out / "03" / "clouds.npy").stat().st_mtime_ns
    assert CliRunner().invoke(app, arguments).exit_code == 0
    assert (out / "03" / "clouds.npy").stat().st_mtime_ns == kept
    assert len(PackedDrive(out / "05")) == 4
    for other, name in (
        (["--preset", "paper"], "preset small"),
        (["--frames", "0:3"], "frames :"),
        (["--set", "input.images=false"], "input"),
    ):
        refused = CliRunner().invoke(app, [*arguments, *other])
        assert f"03: made with {name}" in str(refused.exception)
    (kitti / "sequences" / "05" / "velodyne" / "000001.bin").unlink()  # no other drive, and none whose scans changed
    shutil.rmtree(kitti / "sequences" / "03" / "velodyne")
    fewer = CliRunner().invoke(app, arguments)
    assert re.search(r"05: made with drive of 4 scans \(\w+\), not of 3 scans", str(fewer.exception))
    one_of_all = CliRunner().invoke(app, [*arguments, "--set", "input.sequence=03"])
    assert "packs every drive" in str(one_of_all.exception)
    nothing = CliRunner().invoke(app, ["train", "pack", str(tmp_path / "all" / "03"), str(tmp_path / "x"), "--all"])
    assert "no drives below" in str(nothing.exception)
    by_loader = CliRunner().invoke(app, [*arguments, "--set", "input.dataset=mulran"])
    assert "cannot list the drives of input.dataset=mulran" in str(by_loader.exception)


def test_a_drive_that_cannot_be_packed_does_not_keep_the_others_back(kitti: Path, tmp_path: Path) -> None:
    """Other drives are packed, and the failed ones are named. Previously, the first drive without scans or with a
    missing image ended this call and each later one."""
    for name in ("01", "05"):
        shutil.copytree(kitti / "sequences" / "03", kitti / "sequences" / name)
    for scan in (kitti / "sequences" / "01" / "velodyne").iterdir():
        scan.unlink()
    drive = kitti / "sequences" / "03"
    (drive / "calib.txt").write_text("P2: 50 0 20 0 0 50 15 0 0 0 1 0\nTr: 0 -1 0 0 0 0 -1 0 1 0 0 0\n")
    (drive / "image_2").mkdir()
    for n in (0, 1, 3):
        cv2.imwrite(str(drive / "image_2" / f"{n:06d}.png"), np.zeros((30, 40, 3), np.uint8))
    (drive / "image_2" / "000002.png").write_bytes(b"cut off")
    done = dpm2("train", "pack", kitti, tmp_path / "all", "--all")
    assert done.returncode == 1
    assert "01: left out: " in done.stderr
    assert "image_2/000002.png cannot be read" in done.stderr
    assert "03: left out: 03: frame 2 has no usable image of camera_color_left, frame 0 has one" in done.stderr
    assert done.stderr.endswith("dpm2: 2 of 3 drives were left out: 01, 03\n")
    assert [packed.name for packed in open_packed(tmp_path / "all")] == ["05"]
    assert dpm2("train", "pack", kitti, tmp_path / "all", "--all", "--preset", "none").returncode == 2  # for any drive


@pytest.mark.parametrize(
    ("file", "content"),
    [
        ("about.json", b"[1]"),
        ("clouds.npy", None),
        ("offsets.npy", [0, 5, 10, 99]),
        ("offsets.npy", [0, 10, 5, 15]),
        ("offsets.npy", [0, 5, 15]),
        ("poses.npy", [1, 2, 3]),
        ("poses.npy", [[[np.nan] * 4] * 4] * 3),
        ("clouds.npy", [[0, 0]] * 15),
        ("pixels.npy", None),
        ("K.npy", b""),
        ("T_lidar_cam.npy", [[np.eye(4)]] * 2),
    ],
)
def test_a_packed_drive_that_is_damaged_is_an_error_when_it_is_opened(
    file: str, content: bytes | list[Any] | None, tmp_path: Path
) -> None:
    """The error comes when the drive is opened, not in the middle of a training. None: the file is truncated."""
    folder = tmp_path / "one"
    image = Image(np.zeros((4, 8, 3), np.uint8), Camera(np.eye(3), np.eye(4), (8, 4)))
    write_packed(folder, [Sample(np.zeros((5, 3), np.float32), np.eye(4), (image,)) for _ in range(3)], {})
    assert len(open_packed(tmp_path)[0][2].cloud) == 5
    if isinstance(content, list):
        np.save(folder / file, np.array(content))
    else:
        (folder / file).write_bytes((folder / file).read_bytes()[:-20] if content is None else content)
    with pytest.raises(UsageError, match=f"{folder}: "):
        open_packed(tmp_path)


def test_packing_holds_a_frame_at_a_time(tmp_path: Path) -> None:
    """A hundred frames need less memory than thirty of them together."""
    frame = Sample(np.random.default_rng(0).uniform(-50, 50, (30_000, 3)).astype(np.float32), np.eye(4))
    tracemalloc.start()
    write_packed(tmp_path / "d", (frame for _ in range(100)), {})
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 30 * frame.cloud.nbytes
    drive = PackedDrive(tmp_path / "d")
    assert len(drive) == 100
    np.testing.assert_allclose(drive[99].cloud, frame.cloud, atol=0.0011)


def test_frames_that_differ_leave_nothing_behind(tmp_path: Path) -> None:
    frame = Sample(np.zeros((10, 3), np.float32), np.eye(4), (make_image(np.random.default_rng(0)),))
    with pytest.raises(UsageError, match="some frames have an image and some have none"):
        write_packed(tmp_path / "d", [frame, frame._replace(images=())], {})
    assert not list(tmp_path.iterdir())


def test_a_world_that_cannot_be_written_ends_the_others(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    (tmp_path / "world_001000").symlink_to(tmp_path / "file" / "below")  # blocks the folder of the first world
    with pytest.raises(Dpm2Error, match="not written: Not a directory"):
        generate(tmp_path, GenerateSettings(worlds=20, frames=2, length=60, beams=16, mixture={"tunnel": 1}), 1)
    assert len(list(tmp_path.glob("world_*"))) < 10  # of 20: those that had been started


def test_worlds_of_other_settings_are_not_taken_for_those_that_are_asked_for(tmp_path: Path) -> None:
    """This is an error, since a set that is continued with another sensor would silently mix both."""
    settings = GenerateSettings(worlds=1, frames=2, length=60, beams=16, mixture={"tunnel": 1})
    generate(tmp_path, settings, 1)
    generate(tmp_path, settings, 1)
    generate(tmp_path, settings.model_copy(update={"first_seed": 999, "worlds": 2}), 1)
    assert len(open_packed(tmp_path)) == 2
    with pytest.raises(UsageError, match="world_001000: made with beams 16, not 32"):
        generate(tmp_path, settings.model_copy(update={"beams": 32}), 1)


def test_a_full_disk_is_one_line_and_leaves_nothing(tmp_path: Path) -> None:
    """`ulimit -f` acts as the disk: a file may have no more than 64 kB."""
    code = """
import resource, signal, sys, numpy as np
from pathlib import Path
from dpm2_core.data.packed import Sample, write_packed
from dpm2_core.errors import exit_code
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
resource.setrlimit(resource.RLIMIT_FSIZE, (65536, 65536))
frame = Sample(np.ones((10_000, 3), np.float32), np.eye(4))
sys.exit(exit_code(lambda: write_packed(Path(sys.argv[1]), [frame] * 3, {})))
"""
    done = subprocess.run([sys.executable, "-c", code, tmp_path / "d"], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr.count("\n")) == (1, 1), done.stderr
    assert done.stderr.startswith(f"error: {tmp_path / 'd'}: not written: ")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("mixture", [{}, {"city": 0}, {"city": -1, "tunnel": 2}])
def test_a_mixture_of_nothing_is_an_error(mixture: dict[str, float]) -> None:
    with pytest.raises(UsageError, match=r"mixture"):
        load_settings(GenerateSettings, None, [f"mixture={mixture}"])
