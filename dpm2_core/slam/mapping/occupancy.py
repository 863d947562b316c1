# SPDX-License-Identifier: Apache-2.0
"""A map as a grid of free and occupied cells, in the format of Nav2's map_server.

Each keyframe says what it sees: in every direction the ground up to the first thing that stands on it. A cell is
occupied where more keyframes see something standing in it than see through it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import yaml
from numpy.typing import NDArray
from pydantic import Field

from dpm2_core.config import Settings
from dpm2_core.errors import Dpm2Error
from dpm2_core.files import atomic_write
from dpm2_core.frame import Array, Points
from dpm2_core.geometry import se3
from dpm2_core.geometry.ground import ground_below

Mask = NDArray[np.bool_]

_DIRECTIONS = 720
_OCCUPIED, _FREE, _UNKNOWN = 0, 254, 205  # gray values of map_server
_MOST = 400_000_000  # cells


class OccupancySettings(Settings):
    """The grid that robots plan in."""

    resolution: float = Field(0.1, gt=0)
    """Edge of a cell, m."""
    lowest: float = 0.25
    """Points nearer to the ground than this belong to it, m."""
    highest: float = 2.0
    """Points higher above the ground than this are no obstacle, m."""
    reach: float = Field(30.0, gt=0)
    """Points farther from the sensor than this are not used, m."""


@dataclass(frozen=True, eq=False)
class Grid:
    """Cells (rows, columns) uint8, the row of the largest y first; `origin` is x, y of the lower left corner, m."""

    cells: NDArray[np.uint8]
    origin: tuple[float, float]
    resolution: float


def occupancy_grid(clouds: Sequence[Points], poses: Array, settings: OccupancySettings) -> Grid:
    """The grid of keyframe clouds, each (M, 4) in its own frame, at (N, 4, 4) T_map_kf.

    Raises:
        Dpm2Error: it would be too large.
    """
    size, reach = settings.resolution, settings.reach
    low = np.floor((poses[:, :2, 3].min(0) - reach) / size).astype(np.int64)
    shape = np.ceil((poses[:, :2, 3].max(0) + reach) / size).astype(np.int64) - low + 1
    if shape.prod() > _MOST:
        raise Dpm2Error(f"an occupancy grid of {shape[0]} by {shape[1]} cells: choose a larger --resolution")
    hits, seen = np.zeros(shape, np.uint16), np.zeros(shape, np.uint16)
    for cloud, T_map_kf in zip(clouds, poses, strict=True):
        near = np.einsum("ij,ij->i", cloud[:, :2], cloud[:, :2]) < reach**2
        points = np.asarray(se3.transform(T_map_kf, cloud[near].astype(np.float64)), np.float64)
        if not len(points):
            continue
        height = points[:, 2] - ground_below(points[:, :3])
        stands = (height > settings.lowest) & (height < settings.highest)
        free = _seen_cells(points, stands, height < settings.lowest, T_map_kf[:2, 3], size)
        for grid, xy in ((hits, points[stands, :2]), (seen, free)):
            cells = np.unique(np.floor(xy / size).astype(np.int64) - low, axis=0)
            cells = cells[((cells >= 0) & (cells < shape)).all(1)]
            grid[cells[:, 0], cells[:, 1]] += 1
    grid = np.full(shape, _UNKNOWN, np.uint8)
    grid[seen > 0] = _FREE
    grid[(hits > 0) & (2 * hits >= seen)] = _OCCUPIED
    used = np.argwhere(grid != _UNKNOWN)
    first, last = (used.min(0), used.max(0) + 1) if len(used) else (np.zeros(2, int), np.ones(2, int))
    grid = grid[first[0] : last[0], first[1] : last[1]]
    x, y = np.round((low + first) * size, 6)
    return Grid(np.ascontiguousarray(grid.T[::-1]), (float(x), float(y)), size)


def _seen_cells(
    points: Array, stands: NDArray[np.bool_], ground: NDArray[np.bool_], origin: Array, size: float
) -> Array:
    """x, y of places (K, 2) that are seen to be free: along each direction, ground before anything that stands."""
    away = points[:, :2] - origin
    distance = np.linalg.norm(away, axis=1)
    direction = ((np.arctan2(away[:, 1], away[:, 0]) / (2 * np.pi) % 1.0) * _DIRECTIONS).astype(np.intp) % _DIRECTIONS
    blocked, seen = np.full(_DIRECTIONS, np.inf), np.zeros(_DIRECTIONS)
    np.minimum.at(blocked, direction[stands], distance[stands])
    np.maximum.at(seen, direction[ground], distance[ground])
    # To the farthest ground, but not beyond an obstacle; one is seen as well as the ground before it.
    seen = np.where(np.isfinite(blocked), np.minimum(np.maximum(seen, blocked), blocked - size), seen)
    steps = np.arange(0.0, seen.max(initial=0.0), size / 2)
    within = steps[None] < seen[:, None]
    angle = (np.arange(_DIRECTIONS) + 0.5) / _DIRECTIONS * 2 * np.pi
    unit = np.column_stack([np.cos(angle), np.sin(angle)])
    return origin + (unit[:, None] * steps[None, :, None])[within]


def write_grid(path: Path, grid: Grid) -> Path:
    """Write PATH.yaml and the image PATH.pgm that it names; returns the former.

    Raises:
        Dpm2Error: a file could not be written.
    """
    image, about = path.with_suffix(".pgm"), path.with_suffix(".yaml")
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
        "free_thresh": 0.25,
    }
    with atomic_write(about) as file:
        yaml.safe_dump(content, file, sort_keys=False)
    return about
