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
_PATCH_SIZE = 1.5  # m, edge of the patch around a corner
_SPACING = 0.5  # m between two corners
_MIN_DEPTH, _MAX_DEPTH = 2.0, 35.0  # m of depth: farther away, a pixel is as wide as the spacing of corners
_MAX_CANDIDATES = 600
_BORDER = 4  # pixels without a corner
_TEXTURE_SCALE = 8.0  # pixels: slower changes of brightness are no texture
_N_NEIGHBORS, _RADIUS = 12, 10.0  # points of the scan that give the depth, pixels
_WEIGHT_SIGMA = 4.0  # pixels, standard deviation of their weights
# Relative residuals that count half in the plane fits: rain, and points behind the plane.
_ROBUST_SCALES = (0.2, 0.05, 0.05)
_MAX_RESIDUAL, _MIN_POINTS = 0.05, 5  # relative residual and number of the points that make up the surface
_MIN_SHARE = 0.5  # smallest share of the weights around a corner on its surface
_SHARE_POWER = 4  # power of that share in a corner's score: corners at borders of surfaces are not repeatable
_BLUR_SIGMAS = (0.7, 1.4, 2.8, 5.6)  # pixels: a patch is sampled from the image whose blur is half the sample spacing


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
    detail = local_contrast(cv2.cvtColor(pixels, cv2.COLOR_RGB2GRAY), _TEXTURE_SCALE)
    uv, score = _find_corners(cv2.GaussianBlur(detail, (0, 0), _BLUR_SIGMAS[0]))
    in_camera = se3.transform(se3.inverse(T_lidar_cam), cloud[:, :3].astype(np.float64))
    depth, share = _pixel_depth(uv, in_camera, K, detail.shape)
    order = np.argsort(-score * share**_SHARE_POWER, kind="stable")[: np.count_nonzero(share)]
    uv, depth = uv[order], depth[order]
    corners = np.concatenate([uv, np.ones((len(uv), 1))], 1) @ np.linalg.inv(K).T * depth[:, None]
    xyz = se3.transform(T_lidar_cam, corners).astype(np.float32)
    kept = spaced(xyz, _SPACING, most)
    return Corners(xyz[kept], _patches(detail, uv[kept], K[0, 0] * _PATCH_SIZE / depth[kept]))


def _find_corners(image: NDArray[np.float32]) -> tuple[Array, NDArray[np.float32]]:
    """(k, 2) subpixel positions u, v of the local maxima of the smaller eigenvalue of the structure tensor (J. Shi,
    C. Tomasi, "Good Features to Track", CVPR 1994), and those eigenvalues."""
    score = cv2.cornerMinEigenVal(image, 3, ksize=3)
    top = (score == cv2.dilate(score, np.ones((5, 5), np.uint8))) & (score > 0)
    top[:_BORDER] = top[-_BORDER:] = top[:, :_BORDER] = top[:, -_BORDER:] = False
    v, u = np.nonzero(top)
    order = np.argsort(-score[v, u], kind="stable")[:_MAX_CANDIDATES]
    v, u = v[order], u[order]
    middle = score[v, u]
    shift = (
        _peak_position(score[v, u - 1], middle, score[v, u + 1]),
        _peak_position(score[v - 1, u], middle, score[v + 1, u]),
    )
    return np.stack([u + shift[0], v + shift[1]], 1).astype(np.float64), middle


def _peak_position(
    before: NDArray[np.float32], middle: NDArray[np.float32], after: NDArray[np.float32]
) -> NDArray[np.float32]:
    """Position of the maximum of the parabola through three values, one apart: -0.5 .. 0.5 from the middle one."""
    curvature = 2 * (2 * middle - before - after)
    return np.clip((after - before) / np.maximum(curvature, 1e-12), -0.5, 0.5)


def _pixel_depth(uv: Array, in_camera: NDArray[np.floating], K: Array, shape: tuple[int, ...]) -> tuple[Array, Array]:
    """Depth (k,) m of pixels (k, 2) on the plane through the points (N, 3) around each, and the share (k,) of these
    points on the plane. The share is 0 if there is no such plane, or if it is too near or too far.

    On every plane, the inverse depth is linear in the pixel coordinates.
    """
    points = in_camera[in_camera[:, 2] > _MIN_DEPTH / 2]
    pixels = points @ K.T
    pixels[:, :2] /= pixels[:, 2:]
    height, width = shape[:2]
    in_image = (pixels[:, :2] > -_RADIUS).all(1) & (pixels[:, 0] < width + _RADIUS) & (pixels[:, 1] < height + _RADIUS)
    inverse_depth, pixels = 1 / points[in_image, 2], pixels[in_image]
    if not len(pixels) or not len(uv):
        return np.zeros(len(uv)), np.zeros(len(uv))
    pixels[:, 2] = 0
    grid = PointGrid(pixels, _RADIUS / 2)
    index = neighbours(grid, np.pad(uv, ((0, 0), (0, 1))), _N_NEIGHBORS, _RADIUS)
    offsets = pixels[index, :2] - uv[:, None]
    squared = (offsets * offsets).sum(-1)
    weights = np.exp(-squared / (2 * _WEIGHT_SIGMA**2)) * (squared <= _RADIUS**2)
    weights[:, 1:][index[:, 1:] == index[:, :1]] = 0  # if there are fewer neighbors, the nearest is repeated
    inverse_depth = inverse_depth[index]
    at_corner, on_plane = _fit_planes(offsets, inverse_depth, weights)
    share = (weights * on_plane).sum(1) / np.maximum(weights.sum(1), 1e-9)
    depth = 1 / at_corner
    known = (
        ((weights * on_plane > 0).sum(1) >= _MIN_POINTS)
        & (share > _MIN_SHARE)
        & (depth > _MIN_DEPTH)
        & (depth < _MAX_DEPTH)
    )
    return depth, share * known


def _fit_planes(offsets: Array, inverse_depth: Array, weight: Array) -> tuple[Array, NDArray[np.bool_]]:
    """Fit planes to points at `offsets` (k, n, 2), pixels, from corners, with inverse depths and weights (k, n).
    Returns the inverse depth (k,) at the corners, and which points are on their plane."""
    A = np.concatenate([offsets, np.ones((*inverse_depth.shape, 1))], -1)
    at_corner = np.median(inverse_depth, 1)
    residual = inverse_depth - at_corner[:, None]
    for scale in _ROBUST_SCALES:
        robust = weight / (1 + (residual / (scale * at_corner[:, None])) ** 2) ** 2
        Aw = (A * robust[..., None]).transpose(0, 2, 1)
        plane = np.linalg.solve(Aw @ A + np.diag([0.5, 0.5, 1e-9]), Aw @ inverse_depth[..., None])[..., 0]
        residual = inverse_depth - np.einsum("nki,ni->nk", A, plane)
        at_corner = np.maximum(plane[:, 2], 1e-3)
    return at_corner, np.abs(residual) < _MAX_RESIDUAL * at_corner[:, None]


def _patches(detail: NDArray[np.float32], uv: Array, size: Array) -> NDArray[np.float32]:
    """Patches (k, TEXTURE) around pixels (k, 2), `size` (k,) pixels wide, with zero mean and unit length."""
    steps = np.linspace(-0.5, 0.5, SIDE)
    du, dv = (part.ravel() for part in np.meshgrid(steps, steps))
    u, v = ((uv[:, i, None] + size[:, None] * part).astype(np.float32) for i, part in enumerate((du, dv)))
    level = np.log2(np.maximum(size / (SIDE - 1) / (2 * _BLUR_SIGMAS[0]), 1)).round().clip(max=len(_BLUR_SIGMAS) - 1)
    out = np.zeros((len(uv), TEXTURE), np.float32)
    for i, blur in enumerate(_BLUR_SIGMAS):
        if (rows := level == i).any():
            image = cv2.GaussianBlur(detail, (0, 0), blur)
            out[rows] = cv2.remap(image, u[rows], v[rows], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT)
    out -= out.mean(1, keepdims=True)
    return out / np.maximum(np.linalg.norm(out, axis=1, keepdims=True), 1e-6)
