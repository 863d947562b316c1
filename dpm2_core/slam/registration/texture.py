# SPDX-License-Identifier: Apache-2.0
"""Texture for directions that the geometry does not constrain: the position along a tunnel or a highway.

Points and descriptors leave a direction unconstrained there: along it, all poses fit equally. The points of one scan
have a brightness in the image taken with it, and the same points are searched in the image of another scan. One number
is unknown, the offset along the unconstrained direction: the best is the one with the highest correlation of the two.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from dpm2_core.config import Settings
from dpm2_core.estimates import Registration
from dpm2_core.frame import Array, Image, Points
from dpm2_core.geometry import se3
from dpm2_core.geometry.calibration import with_calibration
from dpm2_core.geometry.contrast import local_contrast


class VisualSettings(Settings):
    """Offset along an unconstrained direction, by the image or by the intensities of the LiDAR."""

    enabled: bool = True
    """Where scans leave a direction unconstrained, use the intensities of the LiDAR and a camera: the first camera, or
    a second one if the first has no image."""
    min_correlation: float = Field(0.3, ge=0, le=1)
    """Minimum correlation; lower values are discarded."""
    distinct: float = Field(0.1, ge=0, le=1)
    """Minimum margin over the second-best correlation peak; rejects repetitive structure such as lane markings."""


_WIDTH = 640  # pixels: images are reduced to it
_MAX_POINTS = 1500  # compared points
_MIN_DEPTH, _MAX_DEPTH = 2.0, 50.0  # m ahead of the camera: the compared points
_STEPS = (0.1, 0.02)  # m, between the offsets that are tried: everywhere, then around the best
_GLANCE_STEP, _GLANCE_STRIDE = 0.2, 3  # m, between the offsets of a quick search, with every third point
_BLUR = (2.5, 1.0)  # pixels: so that no maximum is missed between two offsets
_NEIGHBOR_DISTANCE = 1.0  # m, before and behind: structure that is the same there does not constrain the offset
_LOCAL_SCALE = 12.0  # pixels: brightness that changes more slowly is no texture
_MIN_POINTS = 100  # points that both images must show
_CORRELATED = 100  # neighboring pixels, and the points between them, that count as one independent value
_COARSE_MARGIN = 0.3  # candidates within it of the best coarse correlation are refined at the fine level
_PEAK_SEPARATION = 0.6  # m: a separate peak, not the slope of the best one


@dataclass(frozen=True, eq=False)
class Texture:
    """Brightness of an image without its slow variation.

    Attributes:
        levels: (h, w) float32, blurred by each of `_BLUR`.
        K: (3, 3) of the reduced image. T_cam_lidar: (4, 4).
        sigma: standard deviation of the camera's position along the motion, m, if the image has its own time.
    """

    levels: tuple[NDArray[np.float32], ...]
    K: Array
    T_cam_lidar: Array
    sigma: float = 0.0

    def project(self, points: Array) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
        """Pixels (..., N, 2) of points (..., N, 3) in the camera frame, m, and a mask of those inside the image."""
        ahead = points[..., 2] > _MIN_DEPTH / 2
        image = points @ self.K.T
        uv = np.asarray(image[..., :2] / np.where(ahead, points[..., 2], 1.0)[..., None], np.float32)
        height, width = self.levels[0].shape
        shown: NDArray[np.bool_] = ahead & (uv >= 0).all(-1) & (uv[..., 0] <= width - 1) & (uv[..., 1] <= height - 1)
        return uv, shown

    def sample(self, points: Array, level: int) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
        """Texture (S, N) at points (S, N, 3) in the camera frame, m, and a mask of those inside the image."""
        uv, shown = self.project(points)
        if not shown.size:  # OpenCV accepts no empty map
            return np.zeros(shown.shape, np.float32), shown
        found = cv2.remap(self.levels[level], uv[..., 0], uv[..., 1], cv2.INTER_LINEAR)
        return np.asarray(found, np.float32), shown


@dataclass(frozen=True, eq=False)
class Reference:
    """Points (N, 3) of a scan in its LiDAR frame, float32, and the change of their texture (N,), per level of blur."""

    points: Points
    texture: tuple[NDArray[np.float32], ...]


@dataclass(frozen=True)
class Peak:
    """An offset along the unconstrained direction, m, its standard deviation, m, and the correlation of two scans."""

    offset: float
    sigma: float
    correlation: float


def textured(image: Image) -> Texture:
    """Brightness without its slow variation, divided by its local contrast, undistorted."""
    camera, gray = image.camera, cv2.cvtColor(image.pixels, cv2.COLOR_RGB2GRAY)
    if camera.distortion:
        gray = cv2.undistort(gray, camera.K, np.array(camera.distortion))
    scale = min(1.0, _WIDTH / camera.size[0])
    size = (round(camera.size[0] * scale), round(camera.size[1] * scale))
    detail = local_contrast(cv2.resize(gray, size, interpolation=cv2.INTER_AREA), _LOCAL_SCALE)
    blurred = tuple(cv2.GaussianBlur(detail, (0, 0), blur) for blur in _BLUR)
    return Texture(blurred, camera.resized(*size).K, se3.inverse(camera.T_lidar_cam))


def reference(points: Points, image: Texture, axis: Array) -> Reference:
    """A subset of the points (P, 4) that are inside the image, spread evenly over the scan.

    Args:
        axis: (3,) in the LiDAR frame, the unconstrained direction; either sign.
    """
    in_camera = se3.transform(image.T_cam_lidar, points[:, :3].astype(np.float64))
    kept = np.flatnonzero(image.project(in_camera)[1] & (in_camera[:, 2] > _MIN_DEPTH) & (in_camera[:, 2] < _MAX_DEPTH))
    kept = kept[:: max(1, len(kept) // _MAX_POINTS)]
    step = image.T_cam_lidar[:3, :3] @ axis
    changes = [_texture_changes(image, in_camera[kept], step, np.zeros(1), level) for level in range(len(_BLUR))]
    shown = changes[0][1][0]
    return Reference(points[kept[shown], :3], tuple(texture[0, shown] for texture, _ in changes))


def along(
    s: VisualSettings, result: Registration, known: Reference, image: Texture, T_ref_target: Array, reach: float
) -> Registration:
    """A registration, moved along its unconstrained direction to where the images match; else unchanged, with a reason.

    Args:
        known: reference that is searched in the image of the source. T_ref_target: (4, 4) from the target to its scan.
        reach: search range to either side, m.
    """
    found = _search(s, known, image, T_ref_target @ result.T_target_source, result.open_direction, reach)
    if isinstance(found, str):
        return result.because(found)
    return moved_along(result, replace(found, sigma=float(np.hypot(found.sigma, image.sigma))), T_ref_target, "visual")


def moved_along(result: Registration, found: Peak, T_ref_target: Array, method: str) -> Registration:
    """A registration, moved along its unconstrained direction to a peak, weighted by their covariances.

    Args:
        T_ref_target: (4, 4) from the target to the scan with which the peak was found. method: of the new result.
    """
    b = np.concatenate([np.zeros(3), result.open_direction])
    prior = result.of_scene  # like points, images do not reduce calibration errors, which grow with the new motion
    gain = prior @ b / (b @ prior @ b + found.sigma**2)
    T = se3.orthonormalized(result.T_target_source @ se3.exp(gain * found.offset))
    covariance = prior - np.outer(gain, b @ prior)
    moved = replace(result, T_target_source=T, covariance=(covariance + covariance.T) / 2, method=method)
    return with_calibration(moved, T_ref_target @ T)


def _search(
    s: VisualSettings, known: Reference, image: Texture, T_ref_lidar: Array, axis: Array, reach: float
) -> Peak | str:
    """The offset along `axis` of the LiDAR frame, or why it is unknown."""
    if len(known.points) < _MIN_POINTS:
        return f"image: only {len(known.points)} points in it"
    best, *others = peaks(s, known, image, T_ref_lidar, axis, reach) or [Peak(0.0, np.inf, 0.0)]
    if best.correlation < s.min_correlation:
        return f"image: no place correlates by {s.min_correlation:.2f}"
    if any(
        p.correlation > best.correlation - s.distinct and abs(p.offset - best.offset) > _PEAK_SEPARATION for p in others
    ):
        return "image: several places are alike"
    return best


def peaks(
    s: VisualSettings, known: Reference, image: Texture, T_ref_lidar: Array, axis: Array, reach: float
) -> list[Peak]:
    """Offsets along `axis` (3,) of the LiDAR frame where the texture of a reference matches an image, the best first.

    Args:
        T_ref_lidar: (4, 4) from the image's LiDAR frame to that of the reference, except for the offset along the axis.
        reach: search range to either side, m.
    """
    offsets = np.arange(-reach, reach + _STEPS[0] / 2, _STEPS[0])
    correlation = _correlation_at_offsets(known, image, T_ref_lidar, axis, offsets, 0)
    candidates = _maxima(correlation, max(s.min_correlation / 2, float(correlation.max()) - _COARSE_MARGIN))
    around = np.arange(-_STEPS[0], _STEPS[0] + _STEPS[1] / 2, _STEPS[1])
    found = []
    for middle in offsets[candidates]:
        fine = _correlation_at_offsets(known, image, T_ref_lidar, axis, middle + around, 1)
        found.append(peak(middle + around, fine, len(known.points) / _CORRELATED))
    return sorted(found, key=lambda one: -one.correlation)


def glance(known: Reference, image: Texture, T_ref_lidar: Array, axis: Array, reach: float) -> Peak:
    """Approximately the best of `peaks`, with fewer points and coarser steps: a tenth of the time."""
    subset = Reference(known.points[::_GLANCE_STRIDE], tuple(level[::_GLANCE_STRIDE] for level in known.texture))
    offsets = np.arange(-reach, reach + _GLANCE_STEP / 2, _GLANCE_STEP)
    correlation = _correlation_at_offsets(subset, image, T_ref_lidar, axis, offsets, 0)
    best = int(correlation.argmax())
    return Peak(float(offsets[best]), _GLANCE_STEP, float(correlation[best]))


def _correlation_at_offsets(
    known: Reference, image: Texture, T_ref_lidar: Array, axis: Array, offsets: Array, level: int
) -> NDArray[np.float32]:
    """Correlation (S,) of the texture with the image for each offset (S,), m, of the LiDAR."""
    in_camera = se3.transform(image.T_cam_lidar @ se3.inverse(T_ref_lidar), known.points.astype(np.float64))
    step = image.T_cam_lidar[:3, :3] @ axis
    return _correlations(known.texture[level], *_texture_changes(image, in_camera, step, offsets, level))


def _texture_changes(
    image: Texture, points: Array, step: Array, offsets: Array, level: int
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Texture (S, N) at points (N, 3) minus `offsets` (S,) times `step` (3,): only its changes along that step.

    Rails and the edges of roads and walls look the same everywhere along them. Therefore the texture is relative to
    that at the points `_NEIGHBOR_DISTANCE` m before and behind, which lie on the same surfaces.
    """
    spacing = float(offsets[1] - offsets[0]) if len(offsets) > 1 else _NEIGHBOR_DISTANCE
    k = round(_NEIGHBOR_DISTANCE / spacing)
    if len(offsets) > 2 * k:  # the positions before and behind are among the offsets
        extended = offsets[0] + spacing * np.arange(-k, len(offsets) + k)
        found, shown = image.sample(points - extended[:, None, None] * step, level)
        parts = [(found[a : a + len(offsets)], shown[a : a + len(offsets)]) for a in (0, k, 2 * k)]
    else:
        parts = [
            image.sample(points - (offsets + a)[:, None, None] * step, level)
            for a in (-_NEIGHBOR_DISTANCE, 0.0, _NEIGHBOR_DISTANCE)
        ]
    (before, in_before), (here, in_here), (behind, in_behind) = parts
    changes = np.asarray(here - (before + behind) / 2, np.float32)
    return changes, in_before & in_here & in_behind


def _maxima(correlation: NDArray[np.float32], least: float) -> NDArray[np.intp]:
    """Interior local maxima of the correlation above `least`."""
    inner = correlation[1:-1]
    return 1 + np.flatnonzero((inner >= correlation[:-2]) & (inner > correlation[2:]) & (inner > least))


def _correlations(
    values: NDArray[np.float32], found: NDArray[np.float32], shown: NDArray[np.bool_]
) -> NDArray[np.float32]:
    """Correlation (S,) of values (N,) with each row of found (S, N) where shown; 0 if too few are shown."""
    weight = shown.astype(np.float32)
    count = weight.sum(1)
    x = (values - (weight @ values / np.maximum(count, 1))[:, None]) * weight
    y = (found - ((found * weight).sum(1) / np.maximum(count, 1))[:, None]) * weight
    spread = np.sqrt((x * x).sum(1) * (y * y).sum(1))
    return np.where(count >= _MIN_POINTS, (x * y).sum(1) / np.maximum(spread, 1e-6), 0.0)


def peak(offsets: NDArray[np.floating[Any]], correlation: NDArray[np.floating[Any]], independent: float) -> Peak:
    """Maximum of a parabola through the top of the correlation (S,) at offsets (S,), m, of `independent` values.

    The information of a shift in y = x(shift) + noise is n (dx/dshift)^2 / var(noise); both follow from the correlation
    r and its second derivative: -n r'' r / (1 - r^2).
    """
    i = int(np.clip(correlation.argmax(), 1, len(offsets) - 2))
    before, top, after = correlation[i - 1 : i + 2].astype(float)
    step = offsets[1] - offsets[0]
    curvature = max((2 * top - before - after) / step**2, 1e-3)
    offset = offsets[i] + float(np.clip((after - before) / (2 * curvature * step), -step, step))
    information = independent * curvature * max(top, 1e-6) / max(1 - top * top, 1e-3)
    return Peak(offset, float(max(0.01, information**-0.5)), float(correlation.max()))
