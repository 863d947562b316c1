# SPDX-License-Identifier: Apache-2.0
"""The data sets that KISS-ICP reads."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from dpm2_core.data.kiss_datasets import KissSource
from dpm2_core.data.open import open_source
from dpm2_core.data.settings import InputSettings
from dpm2_core.errors import UsageError
from dpm2_core.extras import MissingPackageError
from dpm2_core.geometry import se3

STAMPS = (1_700_000_000_000_000_000, 1_700_000_000_300_000_000)
"""Stamps, ns, of two scans; two scans between them were lost."""


@pytest.fixture
def mulran(tmp_path: Path) -> Path:
    """Two scans of 64 x 1024 points in the format of MulRan, 1 m apart."""
    (tmp_path / "KAIST01" / "Ouster").mkdir(parents=True)
    rows = []
    for n in range(2):
        scan = np.zeros((64 * 1024, 4), np.float32)
        scan[:, 0] = 10 - n
        scan.tofile(tmp_path / "KAIST01" / "Ouster" / f"{STAMPS[n]}.bin")
        pose = np.hstack([np.eye(3), [[-n], [0], [0]]])
        rows.append(f"{STAMPS[n]}," + ",".join(str(v) for v in pose.ravel()) + "\n")
    (tmp_path / "KAIST01" / "global_pose.csv").write_text("".join(rows))
    return tmp_path / "KAIST01"


def test_a_data_set_of_kiss_icp(mulran: Path) -> None:
    """The times begin at the stamp, as Ouster's driver has it."""
    pytest.importorskip("kiss_icp")
    source = open_source(mulran, InputSettings(dataset="mulran"))
    assert isinstance(source, KissSource)
    first, second = source.frames()
    assert (len(source), len(first.points), first.points[0, 0], second.points[0, 0]) == (2, 65536, 10, 9)
    assert (first.time_offset[0], first.time_offset[-1]) == (0.0, pytest.approx(0.1 * 1023 / 1024))
    assert (first.stamp, second.stamp) == STAMPS
    np.testing.assert_allclose(np.linalg.norm(source.poses[1, :3, 3]), 1, atol=1e-3)


def test_a_folder_that_is_no_drive(mulran: Path) -> None:
    """The message names what is missing, and where it was found."""
    pytest.importorskip("kiss_icp")
    with pytest.raises(UsageError, match=r"no Ouster/\*.bin in this folder, but in KAIST01 below it; .*global_pose"):
        open_source(mulran.parent, InputSettings(dataset="mulran"))
    (mulran / "global_pose.csv").unlink()
    with pytest.raises(UsageError, match=r"KAIST01: no global_pose.csv in this folder"):
        open_source(mulran, InputSettings(dataset="mulran"))


def test_damaged_scans_are_named(mulran: Path) -> None:
    """An empty scan has a problem; one that is cut short is used, but not de-skewed."""
    pytest.importorskip("kiss_icp")
    empty, short = sorted((mulran / "Ouster").iterdir())
    empty.write_bytes(b"")
    short.write_bytes(short.read_bytes()[:1600])
    source = open_source(mulran, InputSettings(dataset="mulran"))
    first, second = source.frames()
    assert first.problem == f"{empty}: no points"
    assert (second.problem, second.time_offset, len(second.points)) == (None, None, 100)
    assert source.notes == [f"{mulran}: scans of other than 64 x 1024 points: not de-skewed (first {short})"]
    short.write_bytes(short.read_bytes()[:1500])
    assert str(short) in (source.frame(1).problem or "")


def test_the_truth_of_mulran_is_of_the_lidar(mulran: Path) -> None:
    """Its file has poses of the car, by the millisecond; the LiDAR on the roof faces backwards, and not quite."""
    pytest.importorskip("kiss_icp")
    turn = Rotation.from_euler("xyz", [0.0001, 0.0003, 179.6654], degrees=True).as_matrix()
    T_base_lidar = se3.make(turn, np.array([1.7042, -0.021, 1.8047]))
    UTM = se3.make(Rotation.from_euler("z", 1.0).as_matrix(), np.array([332000.0, 4026000.0, 21.0]))

    def T_world_base(seconds: float) -> Any:
        return UTM @ se3.exp([0.02 * seconds, 0.3 * seconds, 0.5 * seconds, 15 * seconds, 0, 0])

    times = np.arange(-0.005, 0.29, 0.01)
    rows = [",".join(map(str, [STAMPS[0] + round(t * 1e9), *T_world_base(t)[:3].ravel()])) for t in times]
    (mulran / "global_pose.csv").write_text("\n".join(rows) + "\n")
    (mulran / "Ouster" / f"{STAMPS[1]}.bin").rename(mulran / "Ouster" / f"{STAMPS[0] + 10**8}.bin")
    (mulran / "Ouster" / f"{STAMPS[1]}.bin").write_bytes(b"")
    source = open_source(mulran, InputSettings(dataset="mulran"))
    T = se3.inverse(T_base_lidar) @ se3.inverse(T_world_base(0)) @ T_world_base(0.1) @ T_base_lidar
    np.testing.assert_allclose(source.poses[:2], [np.eye(4), T], atol=1e-5)
    assert np.isnan(source.poses[2]).all()  # the file ends before
    assert source.notes == [f"{mulran}: 1 of 3 frames have no pose"]
    assert source.truth == "global_pose.csv"


def test_loaders_that_cannot_are_named(mulran: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("kiss_icp")
    with pytest.raises(UsageError, match=r"input.dataset=kiti: there is no such loader; there are apollo, boreas"):
        open_source(mulran, InputSettings(dataset="kiti"))
    with pytest.raises(UsageError, match=r"KAIST01: no velodyne_sync/\*.bin in this folder; input.dataset=nclt"):
        open_source(mulran, InputSettings(dataset="nclt"))
    monkeypatch.setitem(sys.modules, "kiss_icp.datasets", None)
    with pytest.raises(MissingPackageError, match=r"input.dataset=mulran needs the package .*dpm2_ros\[datasets\]"):
        open_source(mulran, InputSettings(dataset="mulran"))


@pytest.mark.parametrize(
    ("lidar", "fields", "unit"),
    [
        ("Ouster", "i:<f4 time:<u4 r:<u2 ring:<u2 a:<u2", 1e9),
        ("Velodyne", "i:<f4 ring:<u2 time:<f4", 1),
        ("Avia", "r:u1 tag:u1 line:u1 time:<u4", 1e9),
        ("Aeva", "r:<f4 v:<f4 time:<i4 line:u1 i:<f4", 1e9),
    ],
)
def test_times_of_helipr_count_from_the_stamp(tmp_path: Path, lidar: str, fields: str, unit: float) -> None:
    """HeLiPR's toolbox adds the time of a point to the name of its file; a sweep need not begin at its stamp."""
    pytest.importorskip("kiss_icp")
    names = [tuple(field.split(":")) for field in ("x:<f4 y:<f4 z:<f4 " + fields).split()]
    (tmp_path / "LiDAR" / lidar).mkdir(parents=True)
    (tmp_path / "LiDAR_GT").mkdir()
    scan = np.zeros(100, np.dtype(names))
    scan["x"], scan["time"] = 5, np.linspace(0.01, 0.1, 100) * unit
    scan.tofile(tmp_path / "LiDAR" / lidar / f"{STAMPS[0]}.bin")
    (tmp_path / "LiDAR_GT" / f"global_{lidar}_gt.txt").write_text(f"{STAMPS[0]} 0 0 0 0 0 0 1\n" * 2)
    (tmp_path / "LiDAR" / lidar / f"{STAMPS[1]}.bin").write_bytes(scan.tobytes())
    first, _ = open_source(tmp_path, InputSettings(dataset="helipr", sequence=lidar)).frames()
    np.testing.assert_allclose(first.time_offset, np.linspace(0.01, 0.1, 100)[: len(first.points)], atol=1e-6)


def test_times_of_boreas_are_those_of_its_files(tmp_path: Path) -> None:
    """They count from the stamp, which is the middle of the sweep; the sweep may begin at any azimuth."""
    pytest.importorskip("kiss_icp")
    (tmp_path / "lidar").mkdir()
    (tmp_path / "applanix").mkdir()
    rows = ["GPSTime,easting,northing,altitude,vel_east,vel_north,vel_up,roll,pitch,heading,angvel_z,angvel_y,angvel_x"]
    azimuth = np.linspace(1.0, 1.0 - 2 * np.pi, 100)
    for n, stamp in enumerate(STAMPS):
        scan = np.zeros((100, 6), np.float32)
        scan[:, 0], scan[:, 1], scan[:, 5] = np.cos(azimuth), np.sin(azimuth), np.linspace(-0.05, 0.05, 100)
        scan.tofile(tmp_path / "lidar" / f"{stamp // 1000}.bin")
        rows.append(f"{stamp // 1000},{n}" + 11 * ",0")
    (tmp_path / "applanix" / "lidar_poses.csv").write_text("\n".join(rows) + "\n")
    source = open_source(tmp_path, InputSettings(dataset="boreas"))
    for frame, stamp in zip(source.frames(), STAMPS, strict=True):
        assert frame.stamp == stamp
        np.testing.assert_allclose(frame.time_offset, np.linspace(-0.05, 0.05, 100), atol=1e-6)


def test_velodyne_of_helipr(tmp_path: Path) -> None:
    """`input.sequence` names the LiDAR; the names of the scans are their times."""
    pytest.importorskip("kiss_icp")
    (tmp_path / "LiDAR" / "Velodyne").mkdir(parents=True)
    (tmp_path / "LiDAR_GT").mkdir()
    kind = np.dtype([("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("i", "<f4"), ("ring", "<u2"), ("time", "<f4")])
    rows = []
    for n, stamp in enumerate(STAMPS):
        scan = np.zeros(100, kind)
        scan["x"], scan["time"] = 10 - n, np.linspace(0, 0.1, 100)
        scan.tofile(tmp_path / "LiDAR" / "Velodyne" / f"{stamp}.bin")
        rows.append(f"{stamp} {n} 0 0 0 0 0 1\n")
    (tmp_path / "LiDAR_GT" / "global_Velodyne_gt.txt").write_text("".join(rows))
    source = open_source(tmp_path, InputSettings(dataset="helipr", sequence="Velodyne"))
    first, second = source.frames()
    assert (first.stamp, second.stamp, second.points[0, 0]) == (*STAMPS, 9)
    assert first.time_offset is not None
    assert source.poses[1, 0, 3] == 1
    with pytest.raises(UsageError, match=r"no LiDAR/Ouster/\*.bin in this folder; input.dataset=helipr needs"):
        open_source(tmp_path, InputSettings(dataset="helipr", sequence="Ouster"))
    with pytest.raises(UsageError, match=r"choose a LiDAR with input.sequence: Ouster, Velodyne, Avia, Aeva"):
        open_source(tmp_path, InputSettings(dataset="helipr"))
    truth = tmp_path / "LiDAR_GT" / "global_Velodyne_gt.txt"
    truth.write_text(rows[0])
    with pytest.raises(UsageError, match=r"global_Velodyne_gt.txt: 1 poses for 2 scans"):
        open_source(tmp_path, InputSettings(dataset="helipr", sequence="Velodyne"))


def test_nclt(tmp_path: Path) -> None:
    """File names are microseconds. Only a part of the scans has ground truth, and only these are used."""
    pytest.importorskip("kiss_icp")
    drive = tmp_path / "2012-01-08"
    (drive / "velodyne_sync").mkdir(parents=True)
    (tmp_path / "ground_truth").mkdir()
    for n, stamp in enumerate((STAMPS[0] - 10**9, *STAMPS)):
        scan = np.full((50, 4), (100 + n) * 200, "<i2")
        scan.tofile(drive / "velodyne_sync" / f"{stamp // 1000}.bin")
    rows = [f"{(STAMPS[0] + late) // 1000},{late / 1e9},0,0,0,0,0\n" for late in (-(10**8), 10**9)]
    (tmp_path / "ground_truth" / "groundtruth_2012-01-08.csv").write_text("".join(rows))
    source = open_source(drive, InputSettings(dataset="nclt"))
    first, second = source.frames()
    assert (first.stamp, second.stamp, second.points[0, 0], second.time_offset) == (*STAMPS, 2, None)
    assert source.notes == [f"{drive}: no time field: not de-skewed"]


def test_far_points_of_nclt(tmp_path: Path) -> None:
    """Its numbers are unsigned: 0.005 m each, from -100 m; y to the right and z down."""
    pytest.importorskip("kiss_icp")
    drive = tmp_path / "2012-01-08"
    (drive / "velodyne_sync").mkdir(parents=True)
    (tmp_path / "ground_truth").mkdir()
    stamp = STAMPS[0] // 1000
    near, far = (20200, 19800, 20400, 0), (35000, 5000, 34000, 0)
    np.array([near, far], "<u2").tofile(drive / "velodyne_sync" / f"{stamp}.bin")
    rows = [f"{stamp + late},0,0,0,0,0,0\n" for late in (-1, 1)]
    (tmp_path / "ground_truth" / "groundtruth_2012-01-08.csv").write_text("".join(rows))
    (frame,) = open_source(drive, InputSettings(dataset="nclt")).frames()
    np.testing.assert_allclose(frame.points[:, :3], [[1, 1, -2], [75, 75, -70]], atol=1e-4)


def test_truth_that_is_unknown_in_part(tmp_path: Path) -> None:
    """NCLT's files have rows of nan, such as at the start."""
    pytest.importorskip("kiss_icp")
    drive = tmp_path / "2012-01-08"
    (drive / "velodyne_sync").mkdir(parents=True)
    (tmp_path / "ground_truth").mkdir()
    rows = []
    for n in range(-1, 4):
        stamp = (STAMPS[0] + n * 10**8) // 1000
        np.full((50, 4), 20200, "<i2").tofile(drive / "velodyne_sync" / f"{stamp}.bin")
        rows.append(f"{stamp},{'nan,nan,nan,nan,nan,nan' if n < 1 else f'{n},0,0,0,0,0'}\n")
    (tmp_path / "ground_truth" / "groundtruth_2012-01-08.csv").write_text("".join(rows))
    source = open_source(drive, InputSettings(dataset="nclt"))
    assert np.isnan(source.poses[0]).all()
    assert source.poses[1:, 0, 3].tolist() == [1, 2]
    assert source.notes == [f"{drive}: 1 of 3 frames have no pose"]


def test_what_a_loader_lacks_is_said_with_the_error_that_follows(tmp_path: Path) -> None:
    """The loader of Newer College prints that a package is missing, and fails only at the first scan."""
    pytest.importorskip("kiss_icp")
    if importlib.util.find_spec("pyntcloud") is not None:
        pytest.skip("pyntcloud is installed")
    scans = tmp_path / "raw_format" / "ouster_scan"
    scans.mkdir(parents=True)
    (scans / "cloud_1583836591_182590976.pcd").write_text("")
    (tmp_path / "ground_truth").mkdir()
    row = "1583836591,182590976,0,0,0,0,0,0,1\n"
    (tmp_path / "ground_truth" / "registered_poses.csv").write_text("#sec,nsec,x,y,z,qx,qy,qz,qw\n" + 2 * row)
    (frame,) = open_source(tmp_path, InputSettings(dataset="ncd")).frames()
    assert frame.problem is not None
    assert "ouster_scan/cloud_1583836591_182590976.pcd" in frame.problem
    assert "pip install pyntcloud" in frame.problem
