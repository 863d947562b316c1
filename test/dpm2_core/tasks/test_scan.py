# SPDX-License-Identifier: Apache-2.0
"""Scans of the tasks: layouts, classes, twins, gaps, and what is rejected before a training begins."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch

from dpm2_core.diffslam.windows import ContiguousWindows
from dpm2_core.errors import UsageError
from dpm2_core.tasks.drives import TaskDriveSettings, make_task_drives
from dpm2_core.tasks.ground_task import ground_of
from dpm2_core.tasks.open import open_scans

SEMANTIC = Path(__file__).resolve().parents[3].parent / "shared" / "kitti" / "semantic"


def test_a_scan_is_what_its_files_hold(write_drive: Callable[..., Path], tmp_path: Path) -> None:
    """Points, classes without the number of the object, the twin, and the scan's sequence and number."""
    write_drive(tmp_path / "sequences" / "08", range(3, 6))
    scans = open_scans(tmp_path, ("labels", "static"))
    assert len(scans) == 3
    scan = scans[1]
    assert scan.sequence == "sequences/08"
    assert scan.number == 4
    raw = np.fromfile(tmp_path / "sequences/08/velodyne/000004.bin", "<f4").reshape(-1, 4)
    assert np.array_equal(scan.points.numpy(), raw)
    assert scan.labels is not None
    assert scan.labels.dtype == torch.int64
    assert set(scan.labels.tolist()) == {0, 10, 40, 50}
    assert scan.static is not None
    assert np.array_equal(scan.static.numpy(), raw[:-100])


def test_points_that_are_none_are_left_out_with_their_classes(write_drive: Callable[..., Path], tmp_path: Path) -> None:
    """Invalid points are removed with their classes, and an unknown intensity becomes 0. Previously, GndNet learned
    nothing from such scans, or its training stopped."""
    folder = write_drive(tmp_path / "00", range(2))
    path = folder / "velodyne" / "000000.bin"
    raw = np.fromfile(path, "<f4").reshape(-1, 4)
    labels = np.fromfile(folder / "labels" / "000000.label", "<u4") & 0xFFFF
    damaged = raw.copy()
    damaged[3, 1], damaged[5, 3], damaged[7, 0] = np.nan, np.nan, np.inf
    damaged.tofile(path)
    scan = open_scans(folder, ("labels",))[0]
    left = np.delete(raw, [3, 7], 0)
    left[4, 3] = 0
    np.testing.assert_array_equal(scan.points.numpy(), left)
    assert scan.labels is not None
    np.testing.assert_array_equal(scan.labels.numpy(), np.delete(labels, [3, 7]))
    np.full((len(raw), 4), np.nan, "<f4").tofile(path)
    with pytest.raises(UsageError, match=r"velodyne/000000.bin: no valid points"):
        open_scans(folder, ("labels",))[0]


def test_folders_of_every_depth_and_gaps(write_drive: Callable[..., Path], tmp_path: Path) -> None:
    """A sequence, a data set, a folder of data sets; a missing number starts a new sequence for windows."""
    one = write_drive(tmp_path / "a" / "sequences" / "00", [0, 1, 2, 5, 6])
    write_drive(tmp_path / "b" / "sequences" / "00", range(4))
    write_drive(tmp_path / "b" / "sequences" / "01", range(2))
    assert open_scans(one).lengths == [3, 2]
    assert open_scans(tmp_path / "b").lengths == [4, 2]
    everything = open_scans(tmp_path)
    assert everything.lengths == [3, 2, 4, 2]
    for window in ContiguousWindows(everything.lengths, 2):
        a, b = (everything[i] for i in window)
        assert (a.sequence, a.number + 1) == (b.sequence, b.number)


def test_without_labels_or_twins(write_drive: Callable[..., Path], tmp_path: Path) -> None:
    """They are None; a task that needs them reports it before it begins."""
    folder = write_drive(tmp_path / "00")
    for kind in ("labels", "static"):
        for path in (folder / kind).iterdir():
            path.unlink()
        (folder / kind).rmdir()
    scan = open_scans(folder)[0]
    assert scan.labels is None
    assert scan.static is None
    for need in ("labels", "static"):
        with pytest.raises(UsageError, match=f"00: no {need}/ next to velodyne/"):
            open_scans(folder, (need,))
    with pytest.raises(UsageError, match="scan 0: no labels"):
        ground_of(scan)


@pytest.mark.parametrize(
    ("kind", "name", "keep", "message"),
    [
        ("labels", "000002.label", -4, "1599 labels for 1600 points"),
        ("labels", "000002.label", -3, "not a multiple of"),
        ("velodyne", "000001.bin", -16, "1600 labels for 1599 points"),
        ("velodyne", "000001.bin", -7, "not a multiple of"),
        ("static", "000005.bin", -1, "not a multiple of"),
        ("static", "000005.bin", 0, "the file is empty"),
        ("velodyne", "000004.bin", 0, "the file is empty"),
        ("labels", "000000.label", None, "No such file"),
        ("static", "000003.bin", None, "No such file"),
    ],
)
def test_damaged_files_are_named_at_once(
    write_drive: Callable[..., Path], tmp_path: Path, kind: str, name: str, keep: int | None, message: str
) -> None:
    """A label file of the wrong length, a truncated scan, a missing twin: file and reason, when the folder is
    opened."""
    folder = write_drive(tmp_path / "00")
    path = folder / kind / name
    data = path.read_bytes()
    path.unlink()
    if keep is not None:
        path.write_bytes(data[:keep])
    with pytest.raises(UsageError, match=message) as rejected:
        open_scans(tmp_path)
    assert f"00/{'labels' if 'labels for' in message else kind}/{name[:6]}" in str(rejected.value)


def test_the_digest_shows_a_change_of_any_scan(write_drive: Callable[..., Path], tmp_path: Path) -> None:
    """New labels, a shorter scan, another twin: each in the last scan. A copy in another folder has the same digest.
    Previously only the first scan of a sequence counted."""
    drive, copy = write_drive(tmp_path / "a" / "00"), write_drive(tmp_path / "b" / "00")
    digests = [open_scans(drive).digest()]
    assert open_scans(copy).digest() == digests[0]
    labels, scan, twin = (drive / name for name in ("labels/000005.label", "velodyne/000005.bin", "static/000005.bin"))
    labels.write_bytes(labels.read_bytes().replace(b"\x32\0\0\0", b"\x33\0\0\0"))
    digests.append(open_scans(drive).digest())
    labels.write_bytes(labels.read_bytes()[:-4])
    scan.write_bytes(scan.read_bytes()[:-16])
    digests.append(open_scans(drive).digest())
    twin.write_bytes(twin.read_bytes()[::-1])
    digests.append(open_scans(drive).digest())
    assert len(set(digests)) == 4


def test_a_name_is_that_of_the_outermost_folders_that_have_it(write_drive: Callable[..., Path], tmp_path: Path) -> None:
    """Each drive of `dpm2 train tasks-data` is a data set with a sequence 00. Previously, the name 00 selected all of
    these."""
    for drive in ("00", "01"):
        write_drive(tmp_path / drive / "sequences" / "00")
    assert open_scans(tmp_path, sequences=["00"]).lengths == open_scans(tmp_path / "00").lengths
    assert open_scans(tmp_path / "01", sequences=["00"]).lengths == open_scans(tmp_path / "01").lengths
    assert open_scans(tmp_path, sequences=["00", "01"]).lengths == open_scans(tmp_path).lengths


def test_no_scans(tmp_path: Path) -> None:
    """An empty folder, a folder that does not exist, velodyne/ without scans."""
    with pytest.raises(UsageError, match="no such folder"):
        open_scans(tmp_path / "nowhere")
    with pytest.raises(UsageError, match="no scans; want sequences"):
        open_scans(tmp_path)
    (tmp_path / "velodyne").mkdir()
    with pytest.raises(UsageError, match=r"no scans \(velodyne"):
        open_scans(tmp_path)


@pytest.mark.slow
def test_synthetic_drives(tmp_path: Path) -> None:
    """Train and validation are separate, with exact labels and twins; a second call changes nothing."""
    settings = TaskDriveSettings.model_validate(
        {"train": 2, "train_frames": 2, "val": 1, "val_frames": 2, "lidar": {"columns": 64, "beams": 16}}
    )
    info: list[tuple[str, int, int]] = []
    make_task_drives(tmp_path, settings, 1, lambda *step: info.append(step))
    assert info[-1] == ("val/00", 2, 2)
    train, val = (open_scans(tmp_path / which, ("labels", "static")) for which in ("train", "val"))
    assert (train.lengths, val.lengths) == ([2, 2], [2])
    clouds = [train[0].points, train[2].points, val[0].points]
    assert not any(a.shape == b.shape and torch.equal(a, b) for a in clouds for b in clouds if a is not b)
    ground, counted = ground_of(train[0])
    assert ground.float().mean() > 0.2
    assert bool(counted.all())
    info.clear()
    make_task_drives(tmp_path, settings, 1, lambda *step: info.append(step))
    assert info == []


def test_two_real_scans(tmp_path: Path) -> None:
    """Two scans of SemanticKITTI, in its layout: the road under the car is labelled ground, 1.7 m below the sensor."""
    if not SEMANTIC.is_dir():
        pytest.skip("the two labelled scans are not beside this repository")
    for kind, ending in (("velodyne", "bin"), ("labels", "label")):
        (tmp_path / "sequences" / "00" / kind).mkdir(parents=True)
        for path in SEMANTIC.glob(f"*.{ending}"):
            (tmp_path / "sequences" / "00" / kind / path.name).symlink_to(path)
    scans = open_scans(tmp_path, ("labels",))
    assert scans.lengths == [2]
    for i in range(2):
        scan = scans[i]
        ground, counted = ground_of(scan)
        near = ground & (scan.points[:, :2].norm(dim=1) < 8)
        assert float(scan.points[near, 2].median()) == pytest.approx(-1.7, abs=0.15)
        assert 0.9 < float(counted.float().mean()) <= 1.0
