# SPDX-License-Identifier: Apache-2.0
"""Estimates the up direction of a scan as the normal of the ground, if enough ground is visible around the sensor."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from dpm2_core.descriptors import is_level, levelling
from dpm2_core.frame import Array, Up
from dpm2_core.geometry.voxel import voxel_first

_MAX_SLOPE = 40.0  # degrees: if the sensor is tilted by no more than this, a wall next to it is steeper
_MAX_RANGE = 25.0  # m: farther away the ground may have another slope
_VOXEL = 0.75  # m, so that the ground close by does not outweigh the rest
_PLANE_TOLERANCE = 0.15  # m from a plane: points that lie in it
_HEIGHTS = (0.2, 4.0)  # m of the sensor above the ground
_N_CANDIDATES = 256
_MIN_GROUND_SHARE = 0.12  # smallest fraction of the points that lie in the ground...
_MAX_BELOW = 0.4  # ...and largest number below it, relative to those in it: ditches, and slopes behind them
_N_SCORED = 1000  # points by which a plane is chosen
_SECTORS, _MIN_SECTORS = 8, 3  # of a revolution; ground is in at least so many of them, unlike a single hill or wall


def up_of(points: NDArray[np.floating]) -> NDArray[np.float32] | None:
    """Unit normal (3,) of the ground of (N, 3+) points in the sensor's axes, whose z points roughly up.

    None for a scan that shows no ground, such as of a cluttered room, or whose ground is steeper than 40 degrees.
    """
    points = points.astype(np.float32, copy=False)
    xyz = points[voxel_first(points, _VOXEL, 0.5, _MAX_RANGE), :3].astype(np.float64)
    if len(xyz) < 64:
        return None
    normals, heights = _candidate_planes(xyz)
    if not len(normals):
        return None
    above = xyz[:: max(len(xyz) // _N_SCORED, 1)] @ normals.T + heights
    score = (np.abs(above) < _PLANE_TOLERANCE).sum(0) - 2 * (above < -_PLANE_TOLERANCE).sum(0)
    normal, height = normals[score.argmax()], heights[score.argmax()]
    for _ in range(3):
        ground = xyz[np.abs(xyz @ normal + height) < _PLANE_TOLERANCE]
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
        up_leveled = tilt_of(np.ascontiguousarray(cloud[:, :3] @ R.T))
        return up if up_leveled is None else up_leveled @ R
    ground_up = up_of(cloud)
    return None if ground_up is None or is_level(ground_up) else ground_up


def _candidate_planes(xyz: Array) -> tuple[Array, Array]:
    """Unit normals (K, 3) of candidate ground planes through three points, and sensor heights (K,) above them."""
    rng = np.random.default_rng(0)  # deterministic for a scan
    low = xyz[xyz[:, 2] <= np.median(xyz[:, 2])] if len(xyz) > 256 else xyz
    a, b, c = low[rng.integers(len(low), size=(3, _N_CANDIDATES))]
    normals = np.cross(b - a, c - a)
    length = np.linalg.norm(normals, axis=1)
    is_large = length > 4.0  # m2: points close together do not define a plane
    normals = normals[is_large] / length[is_large, None]
    normals[normals[:, 2] < 0] *= -1
    heights = -np.einsum("ij,ij->i", normals, a[is_large])
    possible = (normals[:, 2] > np.cos(np.radians(_MAX_SLOPE))) & (heights > _HEIGHTS[0]) & (heights < _HEIGHTS[1])
    return normals[possible], heights[possible]


def _is_ground(xyz: Array, normal: Array, height: float) -> bool:
    above = xyz @ normal + height
    in_plane = np.abs(above) < _PLANE_TOLERANCE
    if not np.cos(np.radians(_MAX_SLOPE)) < normal[2] or not _HEIGHTS[0] < height < _HEIGHTS[1]:
        return False
    sector = ((np.arctan2(xyz[in_plane, 1], xyz[in_plane, 0]) / (2 * np.pi) + 0.5) * _SECTORS).astype(int) % _SECTORS
    n_sectors = (np.bincount(sector, minlength=_SECTORS) > 0.02 * in_plane.sum()).sum()
    return bool(
        in_plane.mean() >= _MIN_GROUND_SHARE
        and (above < -_PLANE_TOLERANCE).sum() <= _MAX_BELOW * in_plane.sum()
        and n_sectors >= _MIN_SECTORS
    )
