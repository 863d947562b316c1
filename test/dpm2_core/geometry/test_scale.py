# SPDX-License-Identifier: Apache-2.0
"""Rooms are distinguished from streets in scans of any LiDAR; in doubt there is no result."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from dpm2_core.data.kitti import KittiSource
from dpm2_core.data.settings import InputSettings
from dpm2_core.geometry import se3
from dpm2_core.geometry.scale import ROOM_SCALE, is_enclosed, is_room, scale_of
from dpm2_core.geometry.voxel import voxel_first
from test.helpers.rooms import FURNITURE, frames, scan, walk

MIDDLE = se3.make(np.eye(3), [0, 0, 0.6])


@pytest.mark.parametrize("voxel", [0.0, 0.1, 0.3])
def test_a_room_and_a_street(voxel: float) -> None:
    """For a whole scan and for a keyframe's cloud."""
    room, street = frames(MIDDLE[None])[0].points, frames(MIDDLE[None], street=True)[0].points
    if voxel:
        room, street = room[voxel_first(room, voxel)], street[voxel_first(street, voxel)]
    assert is_room(room) is True
    assert is_room(street) is False
    assert (scale_of(room), scale_of(street)) == (ROOM_SCALE, 1)


def test_a_hall_is_a_room_from_wherever_in_it() -> None:
    """It shows as many cells as an ambiguous scene. Previously, keyframes a step apart counted as a room and as a
    street, and such descriptors are not compared."""
    hull = np.array([[-6.3, -6.3, 0], [6.3, 6.3, 5.0]])
    for x in (-2.9, 0.0, 2.9):
        points = scan(se3.make(np.eye(3), [x, 0, 1.3]), hull, FURNITURE, 0)
        assert len(voxel_first(points, 0.5)) > 800
        assert is_room(points) is True


def test_a_yard_that_is_seen_densely_is_none() -> None:
    """A hand-held LiDAR with a field of view of 70 degrees, in a yard: its points are near, and many more than in a
    hall. Previously, one scan in 90 counted as a room and could not be compared with the others: the odometry was lost
    there."""
    rng = np.random.default_rng(0)
    azimuth, elevation = np.radians(rng.uniform(-35, 35, 20_000)), np.radians(rng.uniform(-35, 35, 20_000))
    rays = np.stack([np.cos(azimuth) * np.cos(elevation), np.sin(azimuth) * np.cos(elevation), np.sin(elevation)], -1)
    points = np.ones((20_000, 4), np.float32)
    points[:, :3] = rays * rng.uniform(3, 10, 20_000)[:, None]
    assert is_room(points) is False


def test_too_little_says_nothing() -> None:
    points = frames(MIDDLE[None])[0].points
    assert is_room(points[:10]) is None
    assert is_room(np.zeros((1000, 4), np.float32)) is None
    assert is_room(np.full((1000, 4), np.nan, np.float32)) is None
    assert is_room(np.zeros((0, 4), np.float32)) is None
    holes = points.copy()
    holes[::3, :3] = np.nan
    holes[1::3, :3] = 0
    assert is_room(holes) is True
    assert is_room(frames(walk(1))[0].points) is True


@pytest.mark.parametrize("sequence", ["00", "04"])
def test_no_scan_of_kitti_is_a_room(kitti_root: Path, sequence: str) -> None:
    """The behavior of the defaults on real streets stays the same."""
    source = KittiSource(kitti_root / "sequences" / sequence, InputSettings(images=False))
    assert {is_room(frame.points) for frame in source.frames()} == {False}


CABIN = np.array([[-1.05, -1.1, 0], [1.05, 1.1, 2.4]])


@pytest.mark.parametrize(
    ("hull", "enclosed"),
    [
        (CABIN, True),
        (CABIN * [1, 4, 1], False),  # a corridor
        (CABIN * [1.5, 1.5, 1], False),  # a small room
    ],
)
def test_a_cabin_encloses_and_a_room_does_not(hull: np.ndarray, enclosed: bool) -> None:
    points = scan(MIDDLE, hull, np.zeros((0, 2, 3)), 0)
    assert is_enclosed(points) is enclosed
    again = np.concatenate([points, np.full((500, 4), np.nan, np.float32), np.zeros((500, 4), np.float32)])
    assert is_enclosed(again) is enclosed


def test_a_part_of_the_view_encloses_nothing() -> None:
    """An open door, a LiDAR that only looks ahead, a handful of points."""
    points = scan(MIDDLE, CABIN, np.zeros((0, 2, 3)), 0)
    door = points.copy()
    door[(np.abs(points[:, 1]) < 0.4) & (points[:, 0] > 0.9), :3] *= 8
    assert not is_enclosed(door)
    assert not is_enclosed(points[points[:, 0] > 0])
    assert not is_enclosed(points[:: len(points) // 100])
    assert not is_enclosed(points[:0])
