# SPDX-License-Identifier: Apache-2.0
"""PCD and LAS as other programs read them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from dpm2_core.data.pcd import write_las, write_pcd
from dpm2_core.errors import Dpm2Error

POINTS = np.random.default_rng(0).uniform(0, 1, (50, 4)).astype(np.float32) * np.float32([300, 400, 5, 1])


@pytest.mark.parametrize("count", [50, 0])
def test_pcd(tmp_path: Path, count: int) -> None:
    write_pcd(tmp_path / "a.pcd", POINTS[:count])
    head, _, body = (tmp_path / "a.pcd").read_bytes().partition(b"DATA binary\n")
    fields = dict(line.split(" ", 1) for line in head.decode("ascii").splitlines() if not line.startswith("#"))
    assert fields["FIELDS"].split() == ["x", "y", "z", "intensity"]
    assert fields["SIZE"].split() == ["4"] * 4
    assert fields["TYPE"].split() == ["F"] * 4
    assert int(fields["POINTS"]) == int(fields["WIDTH"]) * int(fields["HEIGHT"]) == count
    np.testing.assert_array_equal(np.frombuffer(body, "<f4").reshape(-1, 4), POINTS[:count])


@pytest.mark.parametrize("count", [50, 0])
def test_las(tmp_path: Path, count: int) -> None:
    laspy = pytest.importorskip("laspy")
    write_las(tmp_path / "a.las", POINTS[:count])
    las = laspy.read(tmp_path / "a.las")
    assert len(las.points) == count
    xyz = np.column_stack([las.x, las.y, las.z])
    np.testing.assert_allclose(xyz.reshape(-1, 3), POINTS[:count, :3], atol=6e-4)  # millimeters
    np.testing.assert_allclose(np.asarray(las.intensity) / 65535, POINTS[:count, 3], atol=1e-5)


def test_a_folder_in_the_way(tmp_path: Path) -> None:
    with pytest.raises(Dpm2Error, match=str(tmp_path)):
        write_pcd(tmp_path, POINTS)
