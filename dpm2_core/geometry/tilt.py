# SPDX-License-Identifier: Apache-2.0
"""Estimates the up direction of a scan as the normal of the ground, if enough ground is visible around the sensor."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from dpm2_core.descriptors import is_level, levelling
from dpm2_core.frame import Array, Up
from dpm2_core.geometry.voxel import voxel_first

_STEEPEST = 40.0  # degrees: if the sensor is tilted by no more than this, a wall next to it is steeper
_REACH = 25.0  # m: farther away the ground may have another slope
_VOXEL = 0.75  # m, so that the ground close by does not outweigh the rest
_NEAR = 0.15  # m from a plane: points that lie in it
_HEIGHT = (0.2, 4.0)  # m of the sensor above the ground
_TRIES = 256
_LEAST = 0.12  # smallest fraction of the points that lie in the ground...
_BELOW = 0.4  # ...and largest number below it, relative to those in it: ditches, and slopes behind them
_SCORED = 1000  # points by which a plane is chosen
_SECTORS, _AROUND = 8, 3  # of a revolution; ground is in at least _AROUND of them, unlike a single hill or a wall


def up_of(points: NDArray[np.floating]) -> NDArray[np.float32] | None:
    """Unit normal (3,) of the ground of (N, 3+) points in the sensor's axes, whose z points roughly up.

    None for a scan that shows no ground, such as of a cluttered room, or whose ground is steeper than 40 degrees.
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
    """Unit up vector (3,) in a cloud (N, 3+) of a tilted sensor, whose cloud is then processed in level axes.

    None if the sensor is level, or if neither the ground nor its mounting shows its tilt.

    Args:
        mounted: up direction from the mounting; the search for the ground starts from it.
    """
    if mounted is not None and not is_level(up := np.array(mounted, np.float32)):
        R = levelling(up)
        more = tilt_of(np.ascontiguousarray(cloud[:, :3] @ R.T))
        return up if more is None else more @ R
    seen = up_of(cloud)
    return None if seen is None or is_level(seen) else seen


def _planes(xyz: Array) -> tuple[Array, Array]:
    """Unit normals (K, 3) of candidate ground planes through three points, and sensor heights (K,) above them."""
    noise = np.random.default_rng(0)  # deterministic for a scan
    low = xyz[xyz[:, 2] <= np.median(xyz[:, 2])] if len(xyz) > 256 else xyz
    a, b, c = low[noise.integers(len(low), size=(3, _TRIES))]
    normals = np.cross(b - a, c - a)
    length = np.linalg.norm(normals, axis=1)
    wide = length > 4.0  # m2: points close together do not define a plane
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
