# SPDX-License-Identifier: Apache-2.0
"""The live grid contains the walls of a simulated building, and equals the grid of all keyframes whatever happened
before."""

from __future__ import annotations

from collections.abc import Callable
from itertools import count
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.ndimage import binary_dilation

from dpm2_core.data.open import open_source
from dpm2_core.frame import Array, Points
from dpm2_core.geometry import se3
from dpm2_core.sim.lidar import Lidar
from dpm2_core.sim.materials import Label
from dpm2_core.sim.settings import LidarConfig
from dpm2_core.sim.world import World, build_world
from dpm2_core.slam.mapping.occupancy import ground_tilt, occupancy_grid
from dpm2_core.slam.mapping.occupancy_map import FREE, OCCUPIED, UNKNOWN, Grid, OccupancyMap, OccupancySettings
from dpm2_core.slam.store.cloud_codec import pack_cloud
from dpm2_core.slam.store.cloud_store import CloudStore, Loan
from test.helpers.maps import stored

SENSOR = 0.6  # m above the floor
SETTINGS = OccupancySettings(reach=20.0)
Mask = NDArray[np.bool_]


@pytest.fixture(scope="module")
def world() -> World:
    """A floor of rooms."""
    return build_world("loop", "indoor", seed=3, length=100.0, traffic=0.0)


@pytest.fixture(scope="module")
def drive(world: World) -> tuple[CloudStore, Array]:
    """20 scans with 32 beams, 1 s apart."""
    lidar, noise = Lidar(LidarConfig(columns=1024, beams=32)), np.random.default_rng(0)
    poses = np.array([world.drive_pose(2.0 + n, SENSOR) for n in range(20)])
    return stored(lidar.scan(world, T, 2.0 + n, noise).points for n, T in enumerate(poses)), poses


def same(a: Grid, b: Grid) -> bool:
    return a.origin == b.origin and a.resolution == b.resolution and np.array_equal(a.cells, b.cells)


class Truth:
    """Ground truth 0.35 to 1.75 m above the floor, as visible from some poses, in cells of 0.1 m."""

    def __init__(self, world: World, poses: Array, grid: Grid) -> None:
        self._low, self.shape = np.round(np.array(grid.origin) / 0.1).astype(int), grid.cells.T.shape
        angle = np.radians(np.arange(0, 360, 0.25))
        rays = np.column_stack([np.cos(angle), np.sin(angle), 0 * angle]).astype(np.float32)
        self.walls, things, free = (np.zeros(self.shape, bool) for _ in range(3))
        for T in poses:
            nearest = np.full(len(rays), SETTINGS.reach)
            for height in np.arange(0.35, 1.8, 0.2):
                origin = np.tile((T[:3, 3] + [0, 0, height - SENSOR]).astype(np.float32), (len(rays), 1))
                hits = world.scene.cast(origin, rays, SETTINGS.reach)
                hit = hits.face >= 0
                nearest = np.minimum(nearest, np.where(hit, hits.distance, SETTINGS.reach))
                places = (origin + rays * hits.distance[:, None])[:, :2]
                self._mark(things, places[hit])
                wall = hit & (world.static.label[hits.face] == Label.BUILDING)
                self._mark(self.walls, places[wall & (abs(height - 0.95) < 0.01)])
            for ray, way in zip(rays[:, :2], nearest, strict=True):
                self._mark(free, T[:2, 3] + np.arange(0.3, way - 0.15, 0.05)[:, None] * ray)
        self.free = free & ~binary_dilation(things, np.ones((3, 3)))

    def _mark(self, cells: Mask, places: Array) -> None:
        at = np.floor(places / 0.1).astype(int) - self._low
        at = at[((at >= 0) & (at < self.shape)).all(1)]
        cells[at[:, 0], at[:, 1]] = True


@pytest.mark.slow
def test_walls_are_occupied_and_rooms_are_free(world: World, drive: tuple[CloudStore, Array]) -> None:
    """At least 95 % of the wall cells hit by a ray at 0.95 m are occupied, cell for cell, and less than 1 % of the free
    ones."""
    clouds, poses = drive
    whole = OccupancyMap(SETTINGS, 10**7)
    assert whole.update(clouds, poses)
    grid = whole.grid()
    truth, cells = Truth(world, poses, grid), grid.cells[::-1].T
    assert truth.walls.sum() > 500
    assert truth.free.sum() > 5000
    near = binary_dilation(cells == OCCUPIED, np.ones((3, 3)))
    assert (cells[truth.walls] == OCCUPIED).mean() > 0.95  # exactly this cell of 0.1 m
    assert near[truth.walls].mean() > 0.99
    assert (cells[truth.free] == OCCUPIED).mean() < 0.01
    assert (cells[truth.free] == FREE).mean() > 0.9


@pytest.mark.slow
def test_a_loop_that_moves_everything_leaves_no_trace(drive: tuple[CloudStore, Array]) -> None:
    """Keyframes are added at drifting poses, then all poses are corrected. The grid is as if the poses had been known
    from the start. Rotations too small to be visible may remain, so the walls are compared to one cell."""
    clouds, poses = drive
    drifted = poses @ se3.exp([0.0, 0.0, 0.3, 2.0, -1.0, 0.0])
    live = OccupancyMap(SETTINGS, 10**7)
    for n in range(1, len(poses) + 1):
        assert live.update(clouds, drifted[:n])
    assert live.update(clouds, poses)
    expected, found = occupancy_grid(clouds, poses, SETTINGS), live.grid()
    assert np.abs(np.subtract(found.origin, expected.origin)).max() < 0.31  # a cell or two at the border
    low = np.round((np.subtract(found.origin, expected.origin)) / 0.1).astype(int)
    padded = [np.pad((grid.cells[::-1].T == OCCUPIED), 10) for grid in (expected, found)]
    a, b = padded[0], np.zeros_like(padded[0])
    places = np.argwhere(padded[1]) + low
    places = places[((places >= 0) & (places < a.shape)).all(1)]
    b[places[:, 0], places[:, 1]] = True
    assert (a & binary_dilation(b, np.ones((3, 3)))).sum() > 0.99 * a.sum()
    assert (b & binary_dilation(a, np.ones((3, 3)))).sum() > 0.99 * b.sum()


def room(thing: bool = False) -> Points:
    """A floor 0.6 m below, walls at 3 m, and optionally an object at x = 1.55."""
    x, y = (v.ravel() for v in np.meshgrid(np.arange(-2.95, 3, 0.1), np.arange(-2.95, 3, 0.1)))
    floor = np.column_stack([x, y, np.full(len(x), -SENSOR)])
    y, z = (v.ravel() for v in np.meshgrid(np.arange(-3, 3, 0.05), np.arange(-0.6, 1.5, 0.1)))
    walls = [np.column_stack([np.full(len(y), side * 3.05), y, z]) for side in (-1, 1)]
    box = np.array([[1.55, 0.05, z] for z in (-0.2, 0.0, 0.2, 0.4)]) if thing else np.zeros((0, 3))
    points = np.concatenate([floor, *walls, box])
    return np.column_stack([points, np.zeros(len(points))]).astype(np.float32)


@pytest.mark.parametrize("yaw", [0.3, 2.0])  # not 0: the rays to points of a grid lie between two directions
def test_what_is_free_is_seen_from_the_lidar(yaw: float) -> None:
    """With the base 2 m behind the LiDAR, the grid is that of the LiDAR alone, at first and after the pose has changed.
    Seen from the base, the room would be free behind the object, and not in front of it."""
    mount = se3.make(np.eye(3), [2.0, 0.0, 1.0])
    T, T_later = se3.exp([0, 0, yaw, 0.32, 0.11, 0]), se3.exp([0, 0, yaw + 0.5, 3.34, 1.13, 0])
    cloud = room(thing=True)
    cloud = cloud[~((cloud[:, 0] > 1.6) & (np.abs(cloud[:, 1]) < 0.1))]  # its shadow

    def grids(T_kf_lidar: Array, origin: Array) -> list[Grid]:
        live, clouds = OccupancyMap(SETTINGS, 10**7), stored([se3.transform(T_kf_lidar, cloud)], origin)
        drawn = []
        for T_map_lidar in (T, T_later):
            live.update(clouds, (T_map_lidar @ se3.inverse(T_kf_lidar))[None])
            drawn.append(live.grid())
        return drawn

    expected, found = grids(np.eye(4), np.zeros(3)), grids(mount, mount[:3, 3])
    assert differ(expected[0], found[0]) <= 0.002  # the floor's height is estimated in cells of the map
    assert differ(expected[1], found[1]) <= 0.002
    assert differ(expected[0], grids(mount, np.zeros(3))[0]) > 0.01


def differ(a: Grid, b: Grid) -> float:
    """Fraction of the cells known to at least one of two grids in which the grids differ."""
    places = []
    for grid in (a, b):
        rows, columns = np.nonzero(grid.cells[::-1] != UNKNOWN)
        low = np.round(np.array(grid.origin) / grid.resolution).astype(int)
        values = grid.cells[::-1][rows, columns].tolist()
        places.append(set(zip((columns + low[0]).tolist(), (rows + low[1]).tolist(), values, strict=True)))
    return len(places[0] ^ places[1]) / len(places[0] | places[1])


def at(grid: Grid, x: float, y: float) -> int:
    row, column = ((v - low) // grid.resolution for v, low in ((y, grid.origin[1]), (x, grid.origin[0])))
    return int(grid.cells[::-1][int(row), int(column)])


class Counted(CloudStore):
    """Cloud store that counts how often a cloud is read."""

    read = 0

    def whole(self, index: int) -> Points:
        self.read += 1
        return super().whole(index)


def test_what_moved_away_is_left_out_once_it_is_known() -> None:
    """No cloud is read again before that."""
    cloud, clouds, live = room(thing=True), Counted(), OccupancyMap(SETTINGS, 10**7)
    clouds.append(pack_cloud(cloud))
    for _ in range(2):
        live.update(clouds, np.eye(4)[None])
        assert at(live.grid(), 1.55, 0.05) == OCCUPIED
        assert clouds.read == 1
    clouds.set_moving(0, np.arange(len(cloud)) >= len(room()))
    live.update(clouds, np.eye(4)[None])
    assert at(live.grid(), 1.55, 0.05) == FREE
    assert clouds.read == 2
    fresh = OccupancyMap(SETTINGS, 10**7)
    fresh.update(clouds, np.eye(4)[None])
    assert same(live.grid(), fresh.grid())


@pytest.mark.parametrize("thing", [True, False])
@pytest.mark.parametrize("borrows", [True, False])
def test_what_was_moved_goes_and_what_is_new_appears_when_the_robot_comes_by(thing: bool, borrows: bool) -> None:
    """In each of four rounds, three keyframes are in the room and eleven elsewhere, whether or not they find the place
    again. Their earlier observations and poses leave no trace."""
    live, clouds, there = OccupancyMap(SETTINGS, 10**7), stored([]), thing
    poses = np.repeat(np.eye(4)[None], 4 * 14, 0)
    for node in range(4 * 14):
        lap, at_home = node // 14, node % 14 < 3
        poses[node, 0, 3] = 0.01 * lap if at_home else 50.0 + lap
        there = thing == (lap % 2 == 0)
        clouds.append(pack_cloud(room(there and at_home)))
        if borrows and lap:
            clouds.borrow(node, Loan(node % 14, np.eye(4)))
        assert live.update(clouds, poses[: node + 1])
        if node % 14 > 1:
            assert at(live.grid(), 1.55, 0.05) == (OCCUPIED if there else FREE)
    fresh = OccupancyMap(SETTINGS, 10**7)
    fresh.update(clouds, poses)
    assert same(live.grid(), fresh.grid())


def test_its_size_is_bounded_and_it_grows_fine_again() -> None:
    """Poses that a wrong loop moves far away make the cells coarse, but do not take much memory. Once corrected, they
    have no effect."""
    live, clouds, poses = OccupancyMap(SETTINGS, 1_000_000), stored([room()] * 2), np.repeat(np.eye(4)[None], 2, 0)
    far = poses.copy()
    far[1, :2, 3] = 5000.0
    live.update(clouds, far)
    grid = live.grid()
    assert grid.cells.size <= 1_000_000
    assert grid.resolution == pytest.approx(0.1 * 2**6)
    live.update(clouds, poses)
    assert live.grid().resolution == 0.1
    assert at(live.grid(), 3.05, 0.0) == OCCUPIED


def test_the_newest_come_first_when_time_is_short(monkeypatch: pytest.MonkeyPatch) -> None:
    clock: Callable[[], float] = count().__next__
    monkeypatch.setattr("dpm2_core.slam.mapping.occupancy_map.time.monotonic", clock)
    poses = np.repeat(np.eye(4)[None], 3, 0)
    poses[:, 0, 3] = [0.0, 50.0, 100.0]
    live, clouds = OccupancyMap(SETTINGS, 10**7), stored([room()] * 3)
    assert not live.update(clouds, poses, seconds=1.5)  # each reading of the clock takes a second
    grid = live.grid()
    assert grid.origin[0] > 90.0
    while not live.update(clouds, poses, seconds=1.5):
        pass
    assert [at(live.grid(), x + 3.05, 0.0) for x in (0.0, 50.0, 100.0)] == [OCCUPIED] * 3
    assert at(live.grid(), 25.0, 0.0) == UNKNOWN


def known(grid: Grid) -> set[tuple[int, int]]:
    """Cells of 0.1 m that are not unknown, by x and y; a larger cell counts as all cells within it."""
    times = round(grid.resolution / 0.1)
    places = np.argwhere(np.kron(grid.cells[::-1].T != UNKNOWN, np.ones((times, times), bool)))
    return set(map(tuple, (places + np.round(np.array(grid.origin) / 0.1).astype(int)).tolist()))


@pytest.mark.parametrize("most", [10**7, 300_000])
def test_a_drive_that_leaves_the_grid_loses_nothing_of_it(most: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """There is time for three keyframes per message. A grid of at most 300,000 cells needs larger cells from 24 m
    on."""
    poses = np.repeat(np.eye(4)[None], 12, 0)
    poses[:, 0, 3] = 10.0 * np.arange(12)
    live, before, sizes = OccupancyMap(SETTINGS, most), set[tuple[int, int]](), set[float]()
    clouds = stored([room()] * 12)
    for count_of in range(1, 13):
        clock: Callable[[], float] = count().__next__
        monkeypatch.setattr("dpm2_core.slam.mapping.occupancy_map.time.monotonic", clock)
        live.update(clouds, poses[:count_of], seconds=3.5)
        grid = live.grid()
        sizes.add(grid.resolution)
        now = known(grid)
        assert before <= now
        before = now if grid.resolution == 0.1 else set()  # fans in cells of 0.2 m are rounded differently
    assert sizes == ({0.1} if most == 10**7 else {0.1, 0.2})
    while not live.update(clouds, poses, seconds=1.5):
        pass
    fresh = OccupancyMap(SETTINGS, most)
    fresh.update(clouds, poses)
    assert same(live.grid(), fresh.grid())


def test_fans_outside_the_new_place_of_the_grid_leave_no_trace() -> None:
    """The poses move far away at once and back again; the cells keep their size."""
    clouds, poses = stored([room(), room(thing=True)]), np.repeat(np.eye(4)[None], 2, 0)
    far = poses.copy()
    far[:, 0, 3] = 90.0
    live, fresh = OccupancyMap(SETTINGS, 10**7), OccupancyMap(SETTINGS, 10**7)
    for where in (poses, far, poses):
        live.update(clouds, where)
    fresh.update(clouds, poses)
    assert same(live.grid(), fresh.grid())


def test_only_what_is_placed_is_drawn_and_taken_back_when_it_no_longer_is() -> None:
    clouds, poses = stored([room(), room(thing=True)]), np.repeat(np.eye(4)[None], 2, 0)
    poses[1, 0, 3] = 50.0
    live, fresh = OccupancyMap(SETTINGS, 10**7), OccupancyMap(SETTINGS, 10**7)
    fresh.update(clouds, poses[:1])
    for placed in (True, False, True, False):
        live.update(clouds, poses, placed=np.array([True, placed]))
        assert same(live.grid(), fresh.grid()) != placed
    live.update(clouds, poses)
    assert at(live.grid(), 51.55, 0.05) == OCCUPIED


@pytest.mark.long
def test_a_robot_that_stays_for_days_keeps_its_walls() -> None:
    """Previously, 16-bit counts lost the walls after 16,384 keyframes in one position, and everything after twice as
    many."""
    settings, count = OccupancySettings(reach=2.0, resolution=0.5), 16_500
    around = np.linspace(0, 2 * np.pi, 60, endpoint=False)
    wall = np.stack([1.5 * np.cos(around), 1.5 * np.sin(around), 0 * around, 0 * around], 1)
    floor = wall * [0.8, 0.8, 1, 1] - [0, 0, 0.6, 0]
    cloud = np.concatenate([wall, wall + np.array([0, 0, 0.5, 0]), floor]).astype(np.float32)
    grids = []
    for keyframes in (2, count):
        grid = OccupancyMap(settings, 10_000)
        assert grid.update(stored([cloud] * keyframes), np.tile(np.eye(4), (keyframes, 1, 1)))
        grids.append(grid.grid().cells)
    assert (grids[0] == OCCUPIED).any()
    np.testing.assert_array_equal(*grids)


@pytest.mark.parametrize("degrees", [0, 20, 35, 180])
def test_how_far_a_map_is_tilted_shows_its_ground(recording: Path, degrees: float) -> None:
    """It is the same in each keyframe, as for a LiDAR that is mounted tilted. The tolerance is the accuracy of the
    ground in a scan."""
    T_tilted_level = se3.exp([np.radians(degrees), 0, 0, 0, 0, 0])
    scene = next(iter(open_source(recording).frames())).points
    cloud = se3.transform(T_tilted_level, scene).astype(np.float32)
    poses = np.array(
        [T_tilted_level @ se3.exp([0, 0, 0.1 * n, n, 0, 0]) @ se3.inverse(T_tilted_level) for n in range(9)]
    )
    assert ground_tilt(stored([cloud] * 9), poses) == pytest.approx(degrees, abs=2.0)
    mount = np.array([-0.6, 0.0, 1.7])  # above a base on the ground: no sensor at the base is above the ground
    on_base = [cloud + np.append(mount, 0).astype(np.float32)] * 9
    assert ground_tilt(stored(on_base, mount), poses) == pytest.approx(degrees, abs=2.0)


def test_of_a_level_building_and_of_clouds_without_ground_no_tilt_is_known(drive: tuple[CloudStore, Array]) -> None:
    """Neither a ceiling nor a wall is ground."""
    clouds, poses = drive
    assert ground_tilt(clouds, poses) < 2.0
    wall = np.random.default_rng(0).uniform([5, -20, -1, 0], [5.1, 20, 8, 1], (5000, 4)).astype(np.float32)
    assert ground_tilt(stored([wall]), np.eye(4)[None]) == 0.0
