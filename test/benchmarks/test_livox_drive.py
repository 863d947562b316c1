# SPDX-License-Identifier: Apache-2.0
"""Scans and poses of a folder become a KITTI sequence with the same points, times and motion."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from benchmarks.livox_drive import write_sequence
from dpm2_core.data.kitti import KittiSource
from dpm2_core.data.pcd import write_pcd
from dpm2_core.data.settings import InputSettings
from dpm2_core.errors import UsageError
from dpm2_core.geometry import se3

TIMES = (1.6e9, 1.6e9 + 0.5, 1.6e9 + 1.0)
T_WORLD_LIDAR = se3.exp(np.outer(np.arange(3), [0, 0, 0.2, 0.5, 0.1, 0])) @ se3.exp([0.1, 0, 0, 0, 0, 1])


@pytest.fixture
def folder(tmp_path: Path, noise: np.random.Generator) -> Path:
    pytest.importorskip("pypcd4", reason="no pypcd4: pip install '.[datasets]'")
    rows = []
    for i, (T, time) in enumerate(zip(T_WORLD_LIDAR, TIMES, strict=True)):
        write_pcd(tmp_path / f"full{i}.pcd", noise.uniform(1, 9, (50 + i, 4)).astype(np.float32))
        rows += [*T[:3], [0, 0, 0, time]]
    lines = [",".join(f"{number:.9f}" for number in row) + ",\n" for row in rows]
    (tmp_path / "alidarPose.csv").write_text("".join(lines))
    return tmp_path


def test_a_drive_keeps_its_points_times_and_motion(folder: Path, tmp_path: Path) -> None:
    write_sequence(folder, tmp_path / "00")
    source = KittiSource(tmp_path / "00", InputSettings(vertical_angle_correction_deg=0))
    frames = list(source.frames())
    assert [len(frame.points) for frame in frames] == [50, 51, 52]
    np.testing.assert_allclose([frame.stamp * 1e-9 for frame in frames], [0, 0.5, 1.0], atol=1e-6)
    assert source.poses is not None
    steps = se3.inverse(source.poses[:-1]) @ source.poses[1:]
    np.testing.assert_allclose(steps, se3.inverse(T_WORLD_LIDAR[:-1]) @ T_WORLD_LIDAR[1:], atol=1e-6)


def test_what_is_missing_or_in_the_way_is_an_error(folder: Path, tmp_path: Path) -> None:
    poses = folder / "alidarPose.csv"
    rows = poses.read_text().splitlines(keepends=True)
    for text, words in (("".join(rows[:8]), "8 rows for 3 scans"), ("1,0,?,0,\n", "could not convert")):
        poses.write_text(text)
        with pytest.raises(UsageError, match=rf"alidarPose\.csv: .*{words}"):
            write_sequence(folder, tmp_path / "00")
    assert not (tmp_path / "00").exists()
    poses.write_text("".join(rows))
    write_sequence(folder, tmp_path / "00")
    with pytest.raises(UsageError, match="exists already"):
        write_sequence(folder, tmp_path / "00")
