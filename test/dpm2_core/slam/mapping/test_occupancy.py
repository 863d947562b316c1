# SPDX-License-Identifier: Apache-2.0
"""The grid for Nav2: walls are occupied, the visible space in front of them is free, the rest is unknown."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import yaml

from dpm2_core.errors import Dpm2Error
from dpm2_core.frame import NO_POINTS, Points
from dpm2_core.geometry import se3
from dpm2_core.slam.mapping.occupancy import occupancy_grid, write_grid
from dpm2_core.slam.mapping.occupancy_map import Grid, OccupancySettings
from test.helpers.maps import stored

SETTINGS = OccupancySettings(resolution=0.25, reach=20.0)


def room(slope: float = 0.0) -> Points:
    """Ground 1.7 m below with a slope (m/m along x), a wall of 3 m at x = 8, a beam at 4 m height; seen from 0, 0."""
    x, y = (v.ravel() for v in np.meshgrid(np.arange(-12, 7.9, 0.2), np.arange(-12, 12, 0.2)))
    ground = np.column_stack([x, y, slope * x - 1.7])
    y, z = (v.ravel() for v in np.meshgrid(np.arange(-6, 6, 0.1), np.arange(0.1, 3, 0.2)))
    wall = np.column_stack([np.full(len(y), 8.01), y, 8 * slope - 1.7 + z])
    beam = np.column_stack([np.full(200, 3.0), np.linspace(-5, 5, 200), np.full(200, 3 * slope + 2.3)])
    points = np.concatenate([ground, wall, beam])
    return np.column_stack([points, np.zeros(len(points))]).astype(np.float32)


def read_back(path: Path) -> tuple[np.ndarray, dict[str, object]]:
    """The grid as Nav2 reads it: both files in the trinary mode of nav2_map_server/src/map_io.cpp, from the lowest
    y."""
    about = yaml.safe_load(path.read_text())
    magic, size, depth, pixels = (path.parent / about["image"]).read_bytes().split(b"\n", 3)
    assert (magic, depth) == (b"P5", b"255")
    columns, rows = map(int, size.split())
    gray = np.frombuffer(pixels, np.uint8).reshape(rows, columns)[::-1]
    occupancy = 1.0 - gray / 255
    cells = np.full(gray.shape, -1)
    cells[occupancy < about["free_thresh"]] = 0
    cells[about["occupied_thresh"] < occupancy] = 100
    return cells, about


def test_each_value_is_to_nav2_what_it_is_here(tmp_path: Path) -> None:
    """Occupied, unknown, free: for Nav2, only a value between its two thresholds is unknown."""
    path = write_grid(tmp_path / "grid.yaml", Grid(np.uint8([[0, 205, 254]]), (0.0, 0.0), 0.25))
    assert read_back(path)[0].tolist() == [[100, -1, 0]]


@pytest.mark.parametrize("slope", [0.0, 0.08])
def test_a_wall_before_the_unknown(tmp_path: Path, slope: float) -> None:
    T = se3.make(np.eye(3), [100.0, -50.0, 3.0])
    path = write_grid(tmp_path / "grid.yaml", occupancy_grid(stored([room(slope)]), T[None], SETTINGS))
    cells, about = read_back(path)
    assert about["resolution"] == 0.25
    assert about["mode"] == "trinary"

    def at(x: float, y: float) -> int:
        """Value at a position relative to the sensor."""
        column = int((x + 100 - about["origin"][0]) // 0.25)
        row = int((y - 50 - about["origin"][1]) // 0.25)
        inside = 0 <= row < cells.shape[0] and 0 <= column < cells.shape[1]
        return int(cells[row, column]) if inside else -1

    assert [at(8.1, y) for y in (-5, 0, 5)] == [100, 100, 100]
    assert [at(x, y) for x, y in ((2, 0), (6, 3), (-9, 0), (0, 9), (3, 1))] == [0] * 5  # also under the beam
    assert [at(x, y) for x, y in ((9.5, 0), (12, 2), (0, 18))] == [-1] * 3  # behind the wall, beyond the ground
    assert (cells == 100).sum() <= 49 * 2  # only the wall


def test_a_thing_that_most_keyframes_see_through_is_free() -> None:
    empty, thing = room(), np.concatenate([room(), np.float32([[5, 0, z, 0] for z in (-1.0, -0.5, 0.0)])])
    poses = np.repeat(np.eye(4)[None], 4, 0)
    for clouds, expected in (([thing, empty, empty, empty], 254), ([thing] * 4, 0)):
        grid = occupancy_grid(stored(clouds), poses, SETTINGS)
        row = grid.cells.shape[0] - 1 - int((0.1 - grid.origin[1]) // 0.25)
        assert grid.cells[row, int((5.1 - grid.origin[0]) // 0.25)] == expected


def test_nothing_and_too_much() -> None:
    grid = occupancy_grid(stored([NO_POINTS]), np.eye(4)[None], SETTINGS)
    assert (grid.cells == 205).all()
    far = np.stack([np.eye(4), se3.make(np.eye(3), [1e6, 1e6, 0])])
    with pytest.raises(Dpm2Error, match="larger --resolution"):
        occupancy_grid(stored([room()] * 2), far, SETTINGS)
