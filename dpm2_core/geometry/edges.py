# SPDX-License-Identifier: Apache-2.0
"""Vertical edges and poles of a cloud: points that are repeatable from other poses, unlike farthest points."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from dpm2_core.frame import Array, Points
from dpm2_core.geometry.compiled import compiled
from dpm2_core.geometry.point_grid import PointGrid
from dpm2_core.geometry.sampling import Index, neighbours
from dpm2_core.geometry.voxel import voxel_first

SPACING = 0.9  # m between two edges: those of one pole are HEIGHT apart
HEIGHT = 1.0  # m; edges lie at multiples of it: at arbitrary heights, two scans' points on a pole would not coincide
_NEIGHBOURS, _RADIUS = 16, 1.5  # m
_MIN_LENGTH = 1.0  # m, smallest vertical extent of the neighborhood of an edge
_MAX_GAP = 0.5  # m, largest gap between measured heights of an edge: with sparser beams its position is uncertain
_MIN_SCORE = 0.2  # smallest score of an edge: that of an upright patch five points high and four wide
_CELL = 0.45  # m, of the columns that may contain an edge, and of the grid that thins the many candidates of an edge
_CANDIDATES_PER_EDGE = 16  # best candidates per requested edge: more than there are within the spacing of one


def vertical_edges(cloud: Points, grid: PointGrid, most: int) -> Points:
    """Up to `most` (k, 3) points on vertical edges and poles, best score first, `SPACING` m apart.

    A point is the mean of 16 neighbors whose extent is linear and vertical, moved along it to the nearest multiple of
    `HEIGHT` above the origin. Sparse beams, and scenes without vertical structure, give fewer or none: each must have
    been measured at heights no farther apart than 0.5 m, over 1 m.

    Args:
        cloud: (N, 3) m, with one point per voxel of about 0.3 m. grid: of the cloud.
    """
    candidates = cloud[_in_tall_columns(cloud)]
    candidates = candidates[voxel_first(candidates, _CELL)]
    if most <= 0 or not len(candidates):
        return np.zeros((0, 3), np.float32)
    index = neighbours(grid, candidates, _NEIGHBOURS, _RADIUS)
    height = np.sort(cloud[index, 2], 1)
    is_upright = (height[:, -1] - height[:, 0] >= _MIN_LENGTH) & (np.diff(height, axis=1).max(1) <= _MAX_GAP)
    neighborhoods = cloud[index[is_upright]] - candidates[is_upright, None]
    mean = neighborhoods.mean(1)
    neighborhoods -= mean[:, None]
    score = verticality(neighborhoods)
    order = np.argsort(-score, kind="stable")[: _CANDIDATES_PER_EDGE * most]
    order = order[score[order] >= _MIN_SCORE]
    edges = _at_multiples_of_height((candidates[is_upright] + mean)[order], neighborhoods[order])
    return edges[spaced(edges, SPACING, most)]


def _at_multiples_of_height(mean: Points, centered: NDArray[np.floating]) -> Points:
    """The (N, 3) means of (N, k, 3) neighborhoods, moved to a multiple of `HEIGHT` along the line fitted over height.

    The shift is at most half of `HEIGHT`, which a neighborhood of `_MIN_LENGTH` spans to either side."""
    height = centered[..., 2:]
    slope = (centered[..., :2] * height).sum(1) / (height * height).sum(1)
    z = np.round(mean[:, 2:] / HEIGHT) * HEIGHT
    return np.hstack([mean[:, :2] + slope * (z - mean[:, 2:]), z]).astype(np.float32)


def verticality(centered: NDArray[np.floating]) -> Array:
    """(N,) 0..1 of centered (N, k, 3) neighborhoods: 1 is a vertical line, 0 a patch without a direction.

    (sqrt l1 - sqrt l2) / sqrt l1 with the largest eigenvalues of the covariance, times the vertical part of the axis.
    """
    C = (centered.transpose(0, 2, 1) @ centered).astype(np.float64) / centered.shape[1]
    xx, xy, xz, yy, yz, zz = C[:, 0, 0], C[:, 0, 1], C[:, 0, 2], C[:, 1, 1], C[:, 1, 2], C[:, 2, 2]
    mean = (xx + yy + zz) / 3
    a, d, f = xx - mean, yy - mean, zz - mean
    spread = np.sqrt((a * a + d * d + f * f + 2 * (xy * xy + xz * xz + yz * yz)) / 6)
    det = a * (d * f - yz * yz) - xy * (xy * f - yz * xz) + xz * (xy * yz - d * xz)
    angle = np.arccos(np.clip(det / np.maximum(2 * spread**3, 1e-300), -1, 1)) / 3
    largest = mean + 2 * spread * np.cos(angle)
    middle = mean + 2 * spread * np.cos(angle - 2 * np.pi / 3)
    a, d, f = xx - largest, yy - largest, zz - largest
    # The adjugate of C - l1 I is a multiple of the outer product of the axis with itself.
    minors = np.stack([d * f - yz * yz, a * f - xz * xz, a * d - xy * xy])
    total = minors.sum(0)
    vertical = np.sqrt(np.clip(minors[2] / np.where(total > 0, total, 1.0), 0, 1)) * (total > 0)
    ratio = np.sqrt(np.maximum(middle, 0) / np.maximum(largest, 1e-12))
    return np.clip(1 - ratio, 0, 1) * vertical


def spaced(points: Points, spacing: float, most: int) -> Index:
    """Ascending indices of the first `most` of the (N, 3) points that remain if each kept point, in order, removes
    those within `spacing` m of it."""
    return _select_spaced(points.astype(np.float64), spacing * spacing, most)


@compiled("i8[::1](f8[:, ::1], f8, i8)")
def _select_spaced(points: Array, squared: float, most: int) -> Index:
    """Compares each point with the kept ones, which are few."""
    kept, count = np.empty(min(most, len(points)), np.int64), 0
    for i in range(len(points)):
        if count == len(kept):
            break
        free = True
        for j in range(count):
            k = kept[j]
            x, y, z = points[i, 0] - points[k, 0], points[i, 1] - points[k, 1], points[i, 2] - points[k, 2]
            if x * x + y * y + z * z <= squared:
                free = False
                break
        if free:
            kept[count] = i
            count += 1
    return kept[:count].copy()


def _in_tall_columns(cloud: Points) -> NDArray[np.bool_]:
    """Mask of the points in columns that are at least as tall as an edge, so not of ground or roofs."""
    cell = np.floor(cloud[:, :2] / _CELL).astype(np.int64)
    cell -= cell.min(0, initial=0)
    width = int(cell[:, 1].max(initial=0)) + 1
    column = cell[:, 0] * width + cell[:, 1]
    low = np.full(column.max(initial=-1) + 1, np.inf, np.float32)
    high = -low
    np.minimum.at(low, column, cloud[:, 2])
    np.maximum.at(high, column, cloud[:, 2])
    return (high - low >= _MIN_LENGTH)[column]
