# SPDX-License-Identifier: Apache-2.0
"""Which way is up in a scan: square to the ground, where enough of it is seen around the sensor."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from dpm2_core.descriptors import is_level, levelling
from dpm2_core.frame import Array, Up
from dpm2_core.geometry.voxel import voxel_first

_STEEPEST = 40.0  # degrees: a wall beside a sensor that is tilted by no more than this is steeper
_REACH = 25.0  # m: farther away the ground is another one
_VOXEL = 0.75  # m, so that the ground near by does not count for all
_NEAR = 0.15  # m from a plane: what lies in it
_HEIGHT = (0.2, 4.0)  # m of the sensor above the ground
_TRIES = 256
_LEAST = 0.12  # fraction of the points that lie in the ground, at least...
_BELOW = 0.4  # ...and so many times as many beneath it, at most: ditches, and slopes behind them
_SCORED = 1000  # points that a plane is chosen by
_SECTORS, _AROUND = 8, 3  # of a turn: ground in so many of them, neither a hill alone nor a wall is


def up_of(points: NDArray[np.floating]) -> NDArray[np.float32] | None:
    """Unit vector (3,) square to the ground of (N, 3+) points in the sensor's axes, of which z points up by and large.

    None of a scan that shows no ground, such as of a room full of things, or whose ground is steeper than 40 degrees.
    """
    points = points.astype(np.float32, copy=False)
    xyz = points[voxel_first(points, _VOXEL, 0.5, _REACH), :3].astype(np.float64)
    if len(xyz) < 64:
        return None
    normals, heights = _planes(xyz)
    if not len(normals):
        return None
    above = xyz[:: max(len(xyz) // _SCORED, 1)] @ normals.T + heights
    score = (np.abs(above) < _NEAR).sum(0) - 2 * (above < -_NEAR).sum(0)
    normal, height = normals[score.argmax()], heights[score.argmax()]
    for _ in range(3):
        ground = xyz[np.abs(xyz @ normal + height) < _NEAR]
        normal = np.linalg.eigh(np.cov(ground.T))[1][:, 0]
        normal = normal if normal[2] > 0 else -normal
        height = -float(ground.mean(0) @ normal)
    return normal.astype(np.float32) if _is_ground(xyz, normal, height) else None


def tilt_of(cloud: NDArray[np.floating], mounted: Up | None = None) -> NDArray[np.float32] | None:
    """Unit vector (3,) that points up in a cloud (N, 3+) of a tilted sensor, which is read in level axes.

    None where the sensor is level, or neither the ground nor its mounting shows how it is.

    Args:
        mounted: which way is up by the mounting; from there the ground is looked for.
    """
    if mounted is not None and not is_level(up := np.array(mounted, np.float32)):
        R = levelling(up)
        more = tilt_of(np.ascontiguousarray(cloud[:, :3] @ R.T))
        return up if more is None else more @ R
    seen = up_of(cloud)
    return None if seen is None or is_level(seen) else seen


def _planes(xyz: Array) -> tuple[Array, Array]:
    """Unit normals (K, 3) and heights (K,) of the sensor above planes through three points that may be the ground."""
    noise = np.random.default_rng(0)  # the same scan has the same ground
    low = xyz[xyz[:, 2] <= np.median(xyz[:, 2])] if len(xyz) > 256 else xyz
    a, b, c = low[noise.integers(len(low), size=(3, _TRIES))]
    normals = np.cross(b - a, c - a)
    length = np.linalg.norm(normals, axis=1)
    wide = length > 4.0  # m2: of points close together no plane is known
    normals = normals[wide] / length[wide, None]
    normals[normals[:, 2] < 0] *= -1
    heights = -np.einsum("ij,ij->i", normals, a[wide])
    possible = (normals[:, 2] > np.cos(np.radians(_STEEPEST))) & (heights > _HEIGHT[0]) & (heights < _HEIGHT[1])
    return normals[possible], heights[possible]


def _is_ground(xyz: Array, normal: Array, height: float) -> bool:
    above = xyz @ normal + height
    on = np.abs(above) < _NEAR
    if not np.cos(np.radians(_STEEPEST)) < normal[2] or not _HEIGHT[0] < height < _HEIGHT[1]:
        return False
    sector = ((np.arctan2(xyz[on, 1], xyz[on, 0]) / (2 * np.pi) + 0.5) * _SECTORS).astype(int) % _SECTORS
    around = (np.bincount(sector, minlength=_SECTORS) > 0.02 * on.sum()).sum()
    return bool(on.mean() >= _LEAST and (above < -_NEAR).sum() <= _BELOW * on.sum() and around >= _AROUND)
