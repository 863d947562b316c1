# SPDX-License-Identifier: Apache-2.0
"""Folders of PCD and PLY files."""

from __future__ import annotations

import re
import tracemalloc
from pathlib import Path

import numpy as np
import pytest

from dpm2_core.data.cloud_folder import CloudFolder
from dpm2_core.data.open import open_source
from dpm2_core.data.ply import write_ply
from dpm2_core.data.settings import InputSettings
from dpm2_core.frame import Frame

RAMP = np.linspace(0, 0.1, 40)
POINTS = np.random.default_rng(0).uniform(-20, 20, (40, 3)).astype(np.float32)
EPOCH = 1_700_000_000


def write_pcd(path: Path, encoding: str, x: float) -> None:
    pypcd4 = pytest.importorskip("pypcd4", reason="no pypcd4: pip install '.[datasets]'")
    columns = [POINTS[:, 0] * 0 + x, POINTS[:, 1], POINTS[:, 2], np.full(40, 51, np.float32), EPOCH + RAMP]
    kinds = (np.float32, np.float32, np.float32, np.float32, np.float64)
    cloud = pypcd4.PointCloud.from_points(columns, ("x", "y", "z", "intensity", "timestamp"), kinds)
    cloud.save(path, pypcd4.Encoding(encoding))


@pytest.mark.parametrize("encoding", ["ascii", "binary", "binary_compressed"])
def test_pcd_files_in_every_encoding(tmp_path: Path, encoding: str) -> None:
    for n in (10, 9, 2):
        write_pcd(tmp_path / f"scan_{n}.pcd", encoding, n)
    source = open_source(tmp_path)
    assert isinstance(source, CloudFolder)
    frames = list(source.frames())
    assert [frame.points[0, 0] for frame in frames] == [2, 9, 10]
    np.testing.assert_allclose(frames[0].points[:, 3], 0.2)
    assert frames[1].stamp == 100_000_000
    assert frames[0].time_offset is not None
    np.testing.assert_allclose(frames[0].time_offset, RAMP, atol=1e-6)
    assert [note.partition(": ")[2] for note in source.notes] == [
        "the names are not times: scans are assumed to be 0.1 s apart (input.period)"
    ]
    slow = CloudFolder(tmp_path, InputSettings(period=0.5))
    assert [frame.stamp for frame in slow.frames()] == [0, 500_000_000, 1_000_000_000]
    assert [frame.index for frame in source.frames(1, 2)] == [1]


@pytest.mark.parametrize("scale", [1, 10**3, 10**6, 10**9])
def test_names_that_are_times(tmp_path: Path, scale: int) -> None:
    """PLY files without point times: this is reported once."""
    for n in range(3):
        write_ply(tmp_path / f"{(EPOCH + n) * scale}.ply", np.zeros((5, 4), np.float32) + n + 1)
    source = CloudFolder(tmp_path)
    assert [frame.stamp for frame in source.frames()] == [(EPOCH + n) * 10**9 for n in range(3)]
    assert len(source.notes) == 1
    assert "no time field: not de-skewed" in source.notes[0]


@pytest.mark.parametrize("name", ["2023-11-14_22-13-2{}_750", "scan-20231114T22132{}.750", "2023-11-14-22-13-2{}-75"])
def test_names_that_are_dates(tmp_path: Path, name: str) -> None:
    """Names that loggers give to files, with as many decimals of the second as there are."""
    for n in range(3):
        write_ply(tmp_path / f"{name.format(n)}.ply", np.zeros((5, 4), np.float32) + n + 1)
    found = [frame.stamp for frame in CloudFolder(tmp_path).frames()]
    assert found == [1_700_000_000 * 10**9 + 750_000_000 + n * 10**9 for n in range(3)]


@pytest.mark.parametrize("names", [("251370668", "251371071"), ("2023-13-14_22-13-20", "2023-13-14_22-13-21")])
def test_names_that_only_look_like_times(tmp_path: Path, names: tuple[str, str]) -> None:
    """Previously, milliseconds since a start were taken for seconds in 1977, 403 apart. A month 13 is no date."""
    for n, name in enumerate(names):
        write_ply(tmp_path / f"{name}.ply", np.zeros((5, 4), np.float32) + n + 1)
    assert [frame.stamp for frame in CloudFolder(tmp_path).frames()] == [0, 100_000_000]


@pytest.mark.parametrize("name", ["cloud_{}_{}.ply", "{}-{}.ply"])
def test_names_that_are_seconds_and_nanoseconds(tmp_path: Path, name: str) -> None:
    """Sorted by both. Nanoseconds with fewer digits have no leading zeros."""
    stamps = [EPOCH * 10**9 + k * 10**8 + 82 for k in range(8, 13)]
    for n, stamp in enumerate(stamps):
        write_ply(tmp_path / name.format(*divmod(stamp, 10**9)), np.zeros((5, 4), np.float32) + n + 1)
    frames = [*CloudFolder(tmp_path).frames()]
    assert [frame.stamp for frame in frames] == stamps
    assert [frame.points[0, 0] for frame in frames] == [1, 2, 3, 4, 5]


@pytest.mark.parametrize(
    "names",
    [
        [f"{EPOCH + n // 10}_{n % 10}50000" for n in range(8, 13)],
        [f"{EPOCH + n // 10}_{n % 10}50" for n in range(8, 13)],
        [f"20231114_2213{59 + n // 10 * 41}_{n % 10}50" for n in range(8, 13)],
        [f"2023-11-14-22-13-{n}" for n in (8, 9, 10, 11, 12)],
        [f"run2_{n}" for n in (9, 10, 11, 12, 13)],
    ],
)
def test_names_of_several_numbers_are_in_the_order_of_all(tmp_path: Path, names: list[str]) -> None:
    for n, name in enumerate(names):
        write_ply(tmp_path / f"{name}.ply", np.zeros((5, 4), np.float32) + n + 1)
    frames = [*CloudFolder(tmp_path).frames()]
    assert [frame.points[0, 0] for frame in frames] == [1, 2, 3, 4, 5]
    assert np.diff([frame.stamp for frame in frames]).tolist() == [10**8] * 4


@pytest.mark.parametrize(
    ("numbers", "scans", "missing"),
    [
        ((9, 10, 11, 14, 15, 18), (0, 1, 2, 5, 6, 9), 4),
        ((100, 110, 130, 140), (0, 1, 3, 4), 1),
        ((20, 122, 221, 323), (0, 1, 2, 3), 0),  # milliseconds of a clock
        ((1, 1, 2), (0, 1, 2), 0),
    ],
)
def test_numbers_that_are_missing_are_scans_that_are(
    tmp_path: Path, numbers: tuple[int, ...], scans: tuple[int, ...], missing: int
) -> None:
    """Without the time of missing scans, a real drive of which 78 of 175 scans were kept looked like another drive to
    the odometry: 6 m off."""
    for n, number in enumerate(numbers):
        write_ply(
            tmp_path / f"{'ab'[n % 2] * (len(set(numbers)) < len(numbers))}scan_{number}.ply",
            np.ones((5, 4), np.float32),
        )
    source = CloudFolder(tmp_path)
    assert source.stamps.tolist() == [scan * 10**8 for scan in scans]
    assert sum(f"{missing} numbers are missing" in note for note in source.notes) == (missing > 0)


def test_a_damaged_file_is_a_failed_frame(tmp_path: Path) -> None:
    for n in range(4):
        write_pcd(tmp_path / f"{n}.pcd", "binary", n)
    (tmp_path / "1.pcd").write_bytes((tmp_path / "1.pcd").read_bytes()[:300])
    (tmp_path / "2.pcd").write_bytes(b"")
    problems = [frame.problem for frame in CloudFolder(tmp_path).frames()]
    assert problems[0] is None
    assert problems[3] is None
    assert "1.pcd: cannot be read as PCD" in (problems[1] or "")
    assert "2.pcd: cannot be read as PCD" in (problems[2] or "")


def only_frame(folder: Path) -> tuple[Frame, int]:
    """The frame of a folder with one scan, and the peak memory for reading it, bytes."""
    source = CloudFolder(folder)
    tracemalloc.start()
    try:
        (frame,) = source.frames()
        return frame, tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize("before", ["", " ", "# DATA\n#" + 70_000 * "a" + "\n"])
def test_a_header_of_millions_of_columns_is_refused_before_they_are_made(tmp_path: Path, before: str) -> None:
    pytest.importorskip("pypcd4", reason="no pypcd4: pip install '.[datasets]'")
    header = (
        f"VERSION 0.7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\n{before}COUNT 400000 1 1\n"
        "WIDTH 1\nHEIGHT 1\nPOINTS 1\nDATA ascii\n"
    )
    (tmp_path / "0.pcd").write_text(header + "1 2 3\n")
    frame, most = only_frame(tmp_path)
    assert "0.pcd: cannot be read as PCD: more than 1000 columns" in (frame.problem or "")
    assert most < 5e6


@pytest.mark.parametrize("encoding", ["binary", "binary_compressed"])
@pytest.mark.parametrize("points", [41, 10**9])
def test_more_points_than_there_are_bytes_for_are_refused_before_there_is_room_for_them(
    tmp_path: Path, encoding: str, points: int
) -> None:
    write_pcd(tmp_path / "0.pcd", encoding, 0.0)
    header, data, rest = (tmp_path / "0.pcd").read_bytes().partition(f"DATA {encoding}\n".encode())
    count = int(re.findall(rb"POINTS (\d+)", header)[0])
    assert count != points
    (tmp_path / "0.pcd").write_bytes(header.replace(b"POINTS %d" % count, b"POINTS %d" % points) + data + rest)
    frame, most = only_frame(tmp_path)
    assert f"{points} points announced" in (frame.problem or "")
    assert most < 5e6
