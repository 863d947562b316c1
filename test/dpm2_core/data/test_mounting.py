# SPDX-License-Identifier: Apache-2.0
"""/tf_static in a bag gives the up direction of its LiDAR, as it does for the nodes."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from dpm2_core.data.bags import BagSource
from dpm2_core.data.convert import convert
from dpm2_core.data.messages import point_columns
from dpm2_core.geometry import se3

from ...helpers.rooms import boxes, scan

Roll = tuple[float, float]
"""Roll and pitch of a frame in its parent, degrees."""


def rotation(turn: Roll) -> NDArray[np.float64]:
    return Rotation.from_euler("xy", turn, degrees=True).as_matrix()


def read(
    bags: Any, folder: Path, links: Sequence[tuple[str, str, Roll]], turn: Roll = (0, 0), first: Sequence[Any] = ()
) -> BagSource:
    """A bag of two clouds of a street, from a LiDAR that is mounted with a rotation; `first`: cloud messages before
    them."""
    hull, things = np.array([[-60, -12, 0], [60, 12, 30.0]]), boxes((-40, -8), (40, 8), 20, np.array([4.0, 2.0, 2.0]))
    points = scan(se3.make(np.eye(3), [0, 0, 1.7]), hull, things, 0)
    columns = point_columns(se3.transform(se3.make(rotation(turn).T, np.zeros(3)), points))
    clouds = [*((0.9, "/points", cloud) for cloud in first)]
    clouds += [(t, "/points", bags.cloud_of(t, columns)) for t in (1.0, 1.1)]
    placed = [bags.transform(parent, child, (0.5, 0, 1.7), rotation(roll)) for parent, child, roll in links]
    return BagSource(bags.write(folder / "b", [*((0.5, "/tf_static", message) for message in placed), *clouds]))


def ups(source: BagSource) -> NDArray[np.float64]:
    return np.array([frame.up for frame in source.frames()])


def said(source: BagSource) -> list[str]:
    return [note for note in source.notes if note.startswith("/tf_static")]


@pytest.mark.parametrize(("turn", "up"), [((180, 0), (0, 0, -1)), ((0, 30), (-0.5, 0, 0.75**0.5))])
def test_up_is_that_of_the_root_above_the_lidar(bags: Any, tmp_path: Path, turn: Roll, up: tuple[float, ...]) -> None:
    """And not that of the frame in which the base moves. A tilt is reported, because it rotates the map."""
    links = [("odom", "base_link", (90.0, 0.0)), ("base_link", "velo_link", turn)]
    source = read(bags, tmp_path, links, turn)
    np.testing.assert_allclose(ups(source), [up, up], atol=1e-9)
    angle = round(np.degrees(np.arccos(up[2])))
    assert said(source) == [
        f"/tf_static shows the LiDAR tilted by {angle} degrees in base_link (by which the map is leveled)"
    ]


@pytest.mark.parametrize("links", [[], [("velo_link", "cam", (90, 0))], [("base_link", "velo_link", (0, 0))]])
def test_a_lidar_that_stands_or_of_which_nothing_is_known_has_its_own_z(
    bags: Any, tmp_path: Path, links: list[tuple[str, str, Roll]]
) -> None:
    source = read(bags, tmp_path, links)
    assert ups(source).tolist() == [[0, 0, 1]] * 2
    assert said(source) == []


def test_a_root_in_which_the_ground_is_not_level_is_no_base(bags: Any, tmp_path: Path) -> None:
    """A camera, whose extrinsics are often published as their inverse: its z axis points ahead."""
    source = read(bags, tmp_path, [("camera_optical", "velo_link", (0, -90))])
    assert ups(source).tolist() == [[0, 0, 1]] * 2
    (note,) = said(source)
    assert note.startswith(
        "/tf_static shows the LiDAR tilted by 90 degrees in camera_optical (which is not used as base"
    )


def test_a_driver_that_begins_with_an_empty_cloud_says_nothing_of_the_ground(bags: Any, tmp_path: Path) -> None:
    """The next cloud shows it."""
    source = read(bags, tmp_path, [("camera_optical", "velo_link", (0, -90))], first=[bags.cloud(0.9, count=0)])
    assert ups(source).tolist() == [[0, 0, 1]] * 3
    assert "which is not used as base" in said(source)[0]


def test_a_converted_bag_has_the_mount(bags: Any, tmp_path: Path) -> None:
    """Its LiDAR has the same pose in its base, with the same tilt: it leads to the same map, level as before."""
    source = read(bags, tmp_path, [("odom", "base", (0.0, 0.0)), ("base", "velo_link", (0, 30))], (0, 30))
    convert(source, tmp_path / "converted")
    converted = BagSource(tmp_path / "converted")
    np.testing.assert_allclose(ups(converted), ups(source), atol=1e-12)
    T = converted.transforms.lookup("base_link", converted.lidar_frame)
    np.testing.assert_allclose(T, source.transforms.lookup("base", "velo_link"), atol=1e-12)


def test_a_converted_bag_has_no_base_that_is_none(bags: Any, tmp_path: Path) -> None:
    convert(read(bags, tmp_path, [("camera_optical", "velo_link", (0, -90))]), tmp_path / "converted")
    assert BagSource(tmp_path / "converted").transforms.frames == []
