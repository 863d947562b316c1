# SPDX-License-Identifier: Apache-2.0
"""Image corners with depth from a scan: points that two images show alike, however smooth the geometry is."""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from dpm2_core.frame import Array, Points
from dpm2_core.geometry import se3
from dpm2_core.geometry.contrast import local_contrast
from dpm2_core.geometry.edges import spaced
from dpm2_core.geometry.point_grid import PointGrid
from dpm2_core.geometry.sampling import neighbours

SIDE = 8  # samples along a patch
TEXTURE = SIDE * SIDE
"""Number of values in a patch."""
_SIZE = 1.5  # m, edge of the patch around a corner
_SPACING = 0.5  # m between two corners
_NEAR, _FAR = 2.0, 35.0  # m of depth: farther away, a pixel is as wide as the spacing of corners
_CANDIDATES = 600
_BORDER = 4  # pixels without a corner
_LOCAL = 8.0  # pixels: slower changes of brightness are no texture
_NEIGHBORS, _WITHIN = 12, 10.0  # points of the scan that give the depth, pixels
_BELL = 4.0  # pixels, standard deviation of their weights
_ROUNDS = (0.2, 0.05, 0.05)  # relative residuals that count half in the plane fits: rain, and points behind the plane
_SURFACE, _LEAST = 0.05, 5  # relative residual and number of the points that make up the surface
_SHARE = 0.5  # smallest share of the weights around a corner on its surface
_CLEAN = 4  # power of that share in a corner's score: corners at borders of surfaces are not repeatable
_BLURS = (0.7, 1.4, 2.8, 5.6)  # pixels: a patch is sampled from the image whose blur is half the sample spacing


class Corners(NamedTuple):
    """Corner positions (k, 3), m, in the LiDAR frame, and the patch (k, TEXTURE) around each, of unit length."""

    xyz: Points
    texture: NDArray[np.float32]


def no_corners() -> Corners:
    """An empty set of corners."""
    return Corners(np.zeros((0, 3), np.float32), np.zeros((0, TEXTURE), np.float32))


def image_corners(pixels: NDArray[np.uint8], K: Array, T_lidar_cam: Array, cloud: Points, most: int) -> Corners:
    """Up to `most` corners of an image (H, W, 3) that lie on a surface of the scan, strongest first.

    Args:
        K: (3, 3) of the image, without distortion. T_lidar_cam: (4, 4). cloud: (N, 3) m.
    """
    detail = local_contrast(cv2.cvtColor(pixels, cv2.COLOR_RGB2GRAY), _LOCAL)
    uv, score = _corners(cv2.GaussianBlur(detail, (0, 0), _BLURS[0]))
    in_camera = se3.transform(se3.inverse(T_lidar_cam), cloud[:, :3].astype(np.float64))
    depth, share = _depth(uv, in_camera, K, detail.shape)
    order = np.argsort(-score * share**_CLEAN, kind="stable")[: np.count_nonzero(share)]
    uv, depth = uv[order], depth[order]
    at = np.concatenate([uv, np.ones((len(uv), 1))], 1) @ np.linalg.inv(K).T * depth[:, None]
    xyz = se3.transform(T_lidar_cam, at).astype(np.float32)
    kept = spaced(xyz, _SPACING, most)
    return Corners(xyz[kept], _patches(detail, uv[kept], K[0, 0] * _SIZE / depth[kept]))


def _corners(image: NDArray[np.float32]) -> tuple[Array, NDArray[np.float32]]:
    """(k, 2) subpixel positions u, v of the local maxima of the smaller eigenvalue of the structure tensor (J. Shi,
    C. Tomasi, "Good Features to Track", CVPR 1994), and those eigenvalues."""
    score = cv2.cornerMinEigenVal(image, 3, ksize=3)
    top = (score == cv2.dilate(score, np.ones((5, 5), np.uint8))) & (score > 0)
    top[:_BORDER] = top[-_BORDER:] = top[:, :_BORDER] = top[:, -_BORDER:] = False
    v, u = np.nonzero(top)
    order = np.argsort(-score[v, u], kind="stable")[:_CANDIDATES]
    v, u = v[order], u[order]
    middle = score[v, u]
    shift = _parabola(score[v, u - 1], middle, score[v, u + 1]), _parabola(score[v - 1, u], middle, score[v + 1, u])
    return np.stack([u + shift[0], v + shift[1]], 1).astype(np.float64), middle


def _parabola(
    before: NDArray[np.float32], middle: NDArray[np.float32], after: NDArray[np.float32]
) -> NDArray[np.float32]:
    """Position of the maximum of the parabola through three values, one apart: -0.5 .. 0.5 from the middle one."""
    bend = 2 * (2 * middle - before - after)
    return np.clip((after - before) / np.maximum(bend, 1e-12), -0.5, 0.5)


def _depth(uv: Array, in_camera: NDArray[np.floating], K: Array, shape: tuple[int, ...]) -> tuple[Array, Array]:
    """Depth (k,) m of pixels (k, 2) on the plane through the points (N, 3) around each, and the share (k,) of these
    points on the plane. The share is 0 if there is no such plane, or if it is too near or too far.

    On every plane, the inverse depth is linear in the pixel coordinates.
    """
    points = in_camera[in_camera[:, 2] > _NEAR / 2]
    at = points @ K.T
    at[:, :2] /= at[:, 2:]
    height, width = shape[:2]
    shown = (at[:, :2] > -_WITHIN).all(1) & (at[:, 0] < width + _WITHIN) & (at[:, 1] < height + _WITHIN)
    inverse, at = 1 / points[shown, 2], at[shown]
    if not len(at) or not len(uv):
        return np.zeros(len(uv)), np.zeros(len(uv))
    at[:, 2] = 0
    grid = PointGrid(at, _WITHIN / 2)
    index = neighbours(grid, np.pad(uv, ((0, 0), (0, 1))), _NEIGHBORS, _WITHIN)
    away = at[index, :2] - uv[:, None]
    squared = (away * away).sum(-1)
    bell = np.exp(-squared / (2 * _BELL**2)) * (squared <= _WITHIN**2)
    bell[:, 1:][index[:, 1:] == index[:, :1]] = 0  # if there are fewer neighbors, the nearest is repeated
    inverse = inverse[index]
    at_corner, on_plane = _plane(away, inverse, bell)
    share = (bell * on_plane).sum(1) / np.maximum(bell.sum(1), 1e-9)
    depth = 1 / at_corner
    known = ((bell * on_plane > 0).sum(1) >= _LEAST) & (share > _SHARE) & (depth > _NEAR) & (depth < _FAR)
    return depth, share * known


def _plane(away: Array, inverse: Array, weight: Array) -> tuple[Array, NDArray[np.bool_]]:
    """Fit planes to points at offsets `away` (k, n, 2), pixels, from corners, with inverse depths and weights (k, n).
    Returns the inverse depth (k,) at the corners, and which points are on their plane."""
    A = np.concatenate([away, np.ones((*inverse.shape, 1))], -1)
    middle = np.median(inverse, 1)
    residual = inverse - middle[:, None]
    for scale in _ROUNDS:
        robust = weight / (1 + (residual / (scale * middle[:, None])) ** 2) ** 2
        left = (A * robust[..., None]).transpose(0, 2, 1)
        plane = np.linalg.solve(left @ A + np.diag([0.5, 0.5, 1e-9]), left @ inverse[..., None])[..., 0]
        residual = inverse - np.einsum("nki,ni->nk", A, plane)
        middle = np.maximum(plane[:, 2], 1e-3)
    return middle, np.abs(residual) < _SURFACE * middle[:, None]


def _patches(detail: NDArray[np.float32], uv: Array, size: Array) -> NDArray[np.float32]:
    """Patches (k, TEXTURE) around pixels (k, 2), `size` (k,) pixels wide, with zero mean and unit length."""
    steps = np.linspace(-0.5, 0.5, SIDE)
    du, dv = (part.ravel() for part in np.meshgrid(steps, steps))
    u, v = ((uv[:, i, None] + size[:, None] * part).astype(np.float32) for i, part in enumerate((du, dv)))
    level = np.log2(np.maximum(size / (SIDE - 1) / (2 * _BLURS[0]), 1)).round().clip(max=len(_BLURS) - 1)
    out = np.zeros((len(uv), TEXTURE), np.float32)
    for i, blur in enumerate(_BLURS):
        if (rows := level == i).any():
            image = cv2.GaussianBlur(detail, (0, 0), blur)
            out[rows] = cv2.remap(image, u[rows], v[rows], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT)
    out -= out.mean(1, keepdims=True)
    return out / np.maximum(np.linalg.norm(out, axis=1, keepdims=True), 1e-6)
