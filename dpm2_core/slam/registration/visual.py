# SPDX-License-Identifier: Apache-2.0
"""The image where the geometry is silent: how far along a tunnel or a highway.

Points and descriptors leave a direction open there: along it, every pose fits alike. The points of an earlier scan have
a brightness in the image that was taken with it, and the same points are looked for in the image of this scan. One
number is unknown, the way along the open direction; it is the one at which the two brightnesses correlate best. In town
no direction is open, and no image is ever touched.

Both images are of one camera. One is enough for one number, so that of two cameras the second is asked only where the
earlier scan has no image of the first.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from dpm2_core.config import Settings
from dpm2_core.frame import Array, Frame, Image, Points, Registration
from dpm2_core.geometry import se3
from dpm2_core.slam.preprocess import Scan
from dpm2_core.slam.registration.protocol import Prediction, ScanRegistration


class VisualSettings(Settings):
    """How far along, by the image."""

    enabled: bool = True
    """Ask a camera where scans leave a direction open: the first one; a second one only where that has no image."""
    sigma: float = Field(0.08, gt=0)
    """Standard deviation of the position in its worst direction above which it counts as open, m."""
    reach: float = Field(6.0, gt=0)
    """Farthest that is looked to either side, m; less where the motion so far says more."""
    baseline: float = Field(3.0, gt=0)
    """Way after which another image is the one to compare with, m."""
    points: int = Field(1500, gt=0)
    """So many points are compared."""
    width: int = Field(640, gt=0)
    """Images are reduced to this width, pixels."""
    min_correlation: float = Field(0.3, ge=0, le=1)
    """Minimum correlation; lower values are discarded."""
    distinct: float = Field(0.1, ge=0, le=1)
    """Minimum margin over the second-best correlation peak; rejects repetitive structure such as lane markings."""


_NEAR, _FAR = 2.0, 50.0  # m ahead of the camera: the compared points
_STEPS = (0.1, 0.02)  # m, between the places tried: everywhere, then around the best
_BLUR = (2.5, 1.0)  # pixels: so that nothing is missed between two of them
_LOCAL = 12.0  # pixels: light that changes more slowly is no texture
_LEAST = 100  # points that both images must show
_CORRELATED = 100  # pixels next to each other, and the points between them, say the same
_COARSE_MARGIN = 0.3  # candidates within it of the best coarse correlation are refined at the fine level
_APART = 0.6  # m: other places, not the slope of the best one


@dataclass(frozen=True, eq=False)
class _GrayImage:
    """Texture (h, w) float32 at each of `_BLUR`, K (3, 3) of the reduced image, T_cam_lidar (4, 4)."""

    texture: tuple[NDArray[np.float32], ...]
    K: Array
    T_cam_lidar: Array

    def project(self, points: Array) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
        """Pixels (..., N, 2) of points (..., N, 3) of the camera frame, m, and which of them the image shows."""
        ahead = points[..., 2] > _NEAR / 2
        image = points @ self.K.T
        uv = np.asarray(image[..., :2] / np.where(ahead, points[..., 2], 1.0)[..., None], np.float32)
        height, width = self.texture[0].shape
        shown: NDArray[np.bool_] = ahead & (uv >= 0).all(-1) & (uv[..., 0] <= width - 1) & (uv[..., 1] <= height - 1)
        return uv, shown

    def sample(self, points: Array, level: int) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
        """Texture (S, N) at points (S, N, 3) of the camera frame, m, and which of them the image shows."""
        uv, shown = self.project(points)
        found = cv2.remap(self.texture[level], uv[..., 0], uv[..., 1], cv2.INTER_LINEAR)
        return np.asarray(found, np.float32), shown


@dataclass(frozen=True, eq=False)
class _Reference:
    """An image whose scan was taken at T_odom_lidar (4, 4), and points (N, 3) of that scan in its LiDAR frame."""

    image: _GrayImage
    points: Array
    T_odom_lidar: Array


class VisualScanRegistration:
    """Any registration, and the image along the direction that it leaves open."""

    def __init__(self, settings: VisualSettings, registration: ScanRegistration) -> None:
        self._settings = settings
        self._registration = registration
        self._last: tuple[Scan, Array] | None = None  # a scan with images and where it was taken
        self._reference: _Reference | None = None  # made of it when first needed

    uses_images = True

    def __len__(self) -> int:
        return len(self._registration)

    def clear(self) -> None:
        self._registration.clear()
        self._last = self._reference = None

    def fresh(self) -> VisualScanRegistration:
        return VisualScanRegistration(self._settings, self._registration.fresh())

    def prepare(self, frame: Frame, twist: Array) -> Scan:
        return replace(self._registration.prepare(frame, twist), images=frame.images)

    def rejection(self, scan: Scan) -> str:
        return self._registration.rejection(scan)

    def register(self, scan: Scan, prediction: Prediction) -> Registration:
        result = self._registration.register(scan, prediction)
        if not result.ok or self._last is None or result.worst_sigma <= self._settings.sigma:
            return result
        earlier = self._last[0].images[0].camera.name
        image = next((image for image in scan.images if image.camera.name == earlier), None)
        return result if image is None else self._along(result, image, prediction.information)

    def update(self, scan: Scan, T_odom_lidar: Array) -> bool:
        if scan.images and self._wants(T_odom_lidar):
            self._last, self._reference = (scan, T_odom_lidar), None
        return self._registration.update(scan, T_odom_lidar)

    def _wants(self, T_odom_lidar: Array) -> bool:
        if self._last is None or self._reference is None:
            return True
        return bool(np.linalg.norm(self._last[1][:3, 3] - T_odom_lidar[:3, 3]) >= self._settings.baseline)

    def _along(self, result: Registration, image: Image, information: Array | None) -> Registration:
        """The result moved along its open direction to where the images agree; unchanged if they do not."""
        s = self._settings
        axis = result.open_direction
        b = np.concatenate([np.zeros(3), axis])
        reach = s.reach
        if information is not None:
            reach = min(reach, max(_APART, 4 * float(np.sqrt(b @ np.linalg.solve(information, b)))))
        if self._reference is None:
            assert self._last is not None
            self._reference = self._made(*self._last)
        found = self._search(self._reference, _textured(image, s.width), result.T_target_source, axis, reach)
        if isinstance(found, str):
            return replace(result, reason="; ".join(part for part in (result.reason, found) if part))
        offset, sigma = found
        gain = result.covariance @ b / (b @ result.covariance @ b + sigma**2)
        T = se3.orthonormalized(result.T_target_source @ se3.exp(gain * offset))
        covariance = result.covariance - np.outer(gain, b @ result.covariance)
        return replace(result, T_target_source=T, covariance=(covariance + covariance.T) / 2, method="visual")

    def _made(self, scan: Scan, T_odom_lidar: Array) -> _Reference:
        image = _textured(scan.images[0], self._settings.width)
        points = _ahead(scan.points, image, self._settings.points)
        return _Reference(image, points, T_odom_lidar)

    def _search(
        self, reference: _Reference, image: _GrayImage, T_odom_lidar: Array, axis: Array, reach: float
    ) -> tuple[float, float] | str:
        """Way along `axis` of the LiDAR frame and its standard deviation, m; or why it is not known."""
        s = self._settings
        if len(reference.points) < _LEAST:
            return f"image: only {len(reference.points)} points in it"
        here = _moved(reference.image.T_cam_lidar, reference.points)[None]
        values = [reference.image.sample(here, level)[0][0] for level in (0, 1)]
        there = _moved(image.T_cam_lidar @ se3.inverse(T_odom_lidar) @ reference.T_odom_lidar, reference.points)
        step = image.T_cam_lidar[:3, :3] @ axis
        offsets = np.arange(-reach, reach + _STEPS[0] / 2, _STEPS[0])
        correlation = _correlations(values[0], *image.sample(there - offsets[:, None, None] * step, 0))
        candidates = _maxima(correlation, max(s.min_correlation / 2, float(correlation.max()) - _COARSE_MARGIN))
        if not len(candidates):
            return f"image: a correlation of only {max(float(correlation.max()), 0):.2f}"
        around = np.arange(-_STEPS[0], _STEPS[0] + _STEPS[1] / 2, _STEPS[1])
        peaks = []
        for middle in offsets[candidates]:
            near = middle + around
            fine = _correlations(values[1], *image.sample(there - near[:, None, None] * step, 1))
            peaks.append((float(fine.max()), near, fine))
        peaks.sort(key=lambda peak: -peak[0])
        best, near, fine = peaks[0]
        if best < s.min_correlation:
            return f"image: a correlation of only {max(best, 0):.2f}"
        others = [top for top, there, _ in peaks if abs(there[0] - near[0]) > _APART]
        if others and others[0] > best - s.distinct:
            return "image: several places are alike"
        return _peak(near, fine, len(reference.points))


def _maxima(correlation: NDArray[np.float32], least: float) -> NDArray[np.intp]:
    """Interior local maxima of the correlation above `least`."""
    inner = correlation[1:-1]
    return 1 + np.flatnonzero((inner >= correlation[:-2]) & (inner > correlation[2:]) & (inner > least))


def _textured(image: Image, width: int) -> _GrayImage:
    """Brightness without its slow changes, over its local contrast, undistorted."""
    camera, gray = image.camera, cv2.cvtColor(image.pixels, cv2.COLOR_RGB2GRAY)
    if camera.distortion:
        gray = cv2.undistort(gray, camera.K, np.array(camera.distortion))
    scale = min(1.0, width / camera.size[0])
    size = (round(camera.size[0] * scale), round(camera.size[1] * scale))
    gray = cv2.resize(gray, size, interpolation=cv2.INTER_AREA).astype(np.float32)
    detail = gray - cv2.GaussianBlur(gray, (0, 0), _LOCAL)
    detail /= np.sqrt(cv2.GaussianBlur(detail * detail, (0, 0), 2 * _LOCAL)) + 2.0  # gray levels: less is noise
    K = np.diag([size[0] / camera.size[0], size[1] / camera.size[1], 1.0]) @ camera.K
    return _GrayImage(
        tuple(cv2.GaussianBlur(detail, (0, 0), blur) for blur in _BLUR), K, se3.inverse(camera.T_lidar_cam)
    )


def _ahead(points: Points, image: _GrayImage, count: int) -> Array:
    """At most `count` of the points (P, 4) that the image shows, (N, 3) float64, spread evenly over the scan."""
    in_camera = _moved(image.T_cam_lidar, points[:, :3].astype(np.float64))
    kept = np.flatnonzero(image.project(in_camera)[1] & (in_camera[:, 2] > _NEAR) & (in_camera[:, 2] < _FAR))
    return points[kept[:: max(1, len(kept) // count)], :3].astype(np.float64)


def _moved(T: Array, points: Array) -> Array:
    return points @ T[:3, :3].T + T[:3, 3]


def _correlations(
    values: NDArray[np.float32], found: NDArray[np.float32], shown: NDArray[np.bool_]
) -> NDArray[np.float32]:
    """Correlation (S,) of values (N,) with each row of found (S, N) over what is shown; 0 where that is too little."""
    weight = shown.astype(np.float32)
    count = weight.sum(1)
    x = (values - (weight @ values / np.maximum(count, 1))[:, None]) * weight
    y = (found - ((found * weight).sum(1) / np.maximum(count, 1))[:, None]) * weight
    spread = np.sqrt((x * x).sum(1) * (y * y).sum(1))
    return np.where(count >= _LEAST, (x * y).sum(1) / np.maximum(spread, 1e-6), 0.0)


def _peak(offsets: Array, correlation: NDArray[np.float32], points: int) -> tuple[float, float]:
    """Maximum of a parabola through the top, and its standard deviation, m.

    The information of a shift in y = x(shift) + noise is n (dx/dshift)^2 / var(noise); both follow from the correlation
    r and its second derivative: -n r'' r / (1 - r^2).
    """
    i = int(np.clip(correlation.argmax(), 1, len(offsets) - 2))
    before, top, after = correlation[i - 1 : i + 2].astype(float)
    step = offsets[1] - offsets[0]
    bend = max((2 * top - before - after) / step**2, 1e-3)
    offset = offsets[i] + float(np.clip((after - before) / (2 * bend * step), -step, step))
    information = points / _CORRELATED * bend * top / max(1 - top * top, 1e-3)
    return offset, float(max(0.01, information**-0.5))
