# SPDX-License-Identifier: Apache-2.0
"""A map as a grid of free and occupied cells, in the format of Nav2's map_server.

Each keyframe observes, in every direction, the free ground up to the first obstacle. A cell is occupied if more
keyframes see an obstacle in it than see through it; newer keyframes have a larger weight.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import yaml
from numpy.typing import NDArray

from dpm2_core.errors import Dpm2Error
from dpm2_core.files import atomic_write
from dpm2_core.frame import Array, Points
from dpm2_core.geometry.sampling import evenly
from dpm2_core.geometry.scale import is_room
from dpm2_core.geometry.tilt import up_of
from dpm2_core.slam.mapping.occupancy_map import Grid, OccupancyMap, OccupancySettings
from dpm2_core.slam.store.cloud_store import CloudStore

_MAX_CELLS = 400_000_000  # cells
_MAX_CHECKED, _MIN_GROUND_RATIO = 30, 0.3  # keyframes that are checked, and the fraction of them that must show ground
_SQUARE = 5.0  # m: the steepest ramp rises by less than a storey within one
_MAX_HEIGHT_DIFFERENCE = 2.4  # m, of keyframes: less than a floor's height, more than a LiDAR's above its base
_UPSIDE_DOWN = np.diag(np.array([1, -1, -1], np.float32))


def occupancy_grid(clouds: CloudStore, poses: Array, settings: OccupancySettings) -> Grid:
    """The grid of keyframe clouds at (N, 4, 4) T_map_kf.

    Raises:
        Dpm2Error: the grid would be too large.
    """
    shape = np.ceil((np.ptp(poses[:, :2, 3], axis=0) + 2 * settings.reach) / settings.resolution) + 1
    if shape.prod() > _MAX_CELLS:
        raise Dpm2Error(f"an occupancy grid of {shape[0]:.0f} by {shape[1]:.0f} cells: choose a larger --resolution")
    occupancy = OccupancyMap(settings, 2 * _MAX_CELLS)
    occupancy.update(clouds, poses)
    return occupancy.grid()


def ground_tilt(clouds: CloudStore, poses: Array) -> float:
    """Tilt of the ground in keyframes against the map's x and y, degrees; 0 if they show no ground.

    Some of the keyframe clouds at (N, 4, 4) T_map_kf are checked, as seen from the LiDAR. Upside down is recognized
    outdoors only: rooms have ceilings.
    """
    checked = evenly(len(poses), _MAX_CHECKED).tolist()
    views = ((node, clouds[node][:, :3] - clouds.origin(node).astype(np.float32)) for node in checked)
    found = [(node, up) for node, cloud in views if (up := _up_direction(cloud)) is not None]
    if len(found) < _MIN_GROUND_RATIO * len(checked):
        return 0.0
    x, y, z = np.median([poses[node, :3, :3] @ up for node, up in found], axis=0)
    return float(np.degrees(np.arctan2(np.hypot(x, y), z)))


def why_of_no_use(poses: Array) -> str:
    """Why a grid of keyframes at (N, 4, 4) T_map_kf is unusable, as it shows several levels; empty if it is usable."""
    if not len(poses) or (height := _height_difference(poses)) <= _MAX_HEIGHT_DIFFERENCE:
        return ""
    why = "because of storeys (make one map of each) or of drift without a loop"
    return f"do not use it: parts of the map lie up to {height:.1f} m above each other, {why}"


def _height_difference(poses: Array) -> float:
    """Largest difference in height, m, of keyframes at (N, 4, 4) T_map_kf, N > 0, within one square of 5 m."""
    _, square = np.unique(np.floor(poses[:, :2, 3] / _SQUARE), axis=0, return_inverse=True)
    lowest, highest = np.full((2, len(poses)), [[np.inf], [-np.inf]])
    np.minimum.at(lowest, square, poses[:, 2, 3])
    np.maximum.at(highest, square, poses[:, 2, 3])
    return float((highest - lowest).max())


def _up_direction(cloud: Points) -> NDArray[np.float32] | None:
    """Up direction (3,) in a cloud (M, 4), also if z points roughly down; None if it shows no ground."""
    up = up_of(cloud)
    if up is None and is_room(cloud) is False and (flipped := up_of(cloud[:, :3] @ _UPSIDE_DOWN)) is not None:
        return _UPSIDE_DOWN @ flipped
    return up


def write_grid(path: Path, grid: Grid) -> Path:
    """Write PATH.yaml and the image PATH.pgm that it refers to; returns the former.

    Raises:
        Dpm2Error: a file could not be written.
    """
    image, metadata = path.with_suffix(".pgm"), path.with_suffix(".yaml")
    rows, columns = grid.cells.shape
    with atomic_write(image, "wb") as file:
        file.write(f"P5\n{columns} {rows}\n255\n".encode("ascii"))
        file.write(grid.cells.tobytes())
    content = {
        "image": image.name,
        "mode": "trinary",
        "resolution": grid.resolution,
        "origin": [*grid.origin, 0.0],
        "negate": 0,
        "occupied_thresh": 0.65,
        "free_thresh": 0.196,  # below (255 - 205) / 255, which is unknown: map_server has no rule for 205 itself
    }
    with atomic_write(metadata) as file:
        yaml.safe_dump(content, file, sort_keys=False)
    return metadata
