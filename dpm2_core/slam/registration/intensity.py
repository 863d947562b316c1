# SPDX-License-Identifier: Apache-2.0
"""Intensity for directions that the geometry does not constrain: position along a tunnel or highway, without camera.

As with an image (`texture`), one number is unknown, the offset along the unconstrained direction. A scan is mapped to a
cylinder around that direction, like a tunnel that is cut open and unrolled. The offset is the one at which the
intensities of a scan correlate best with those of the previous scans.

Two effects look like standstill: each beam has its own gain, and structure that does not change along the motion, such
as the edge of a road, is always next to the sensor. So an intensity is taken relative to its neighbors in the beam, and
minus the mean of the previous scans in that direction of the sensor.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import scipy.fft
from numpy.typing import NDArray

from dpm2_core.estimates import Registration
from dpm2_core.frame import NO_POINTS, Array, Points
from dpm2_core.geometry import se3
from dpm2_core.slam.registration.texture import Peak, moved_along, peak

Float = NDArray[np.float32]

_MAX_SCANS, _SPACING = 5, 0.5  # scans that are kept, and the distance between them, m
_MAX_UNKNOWN_SCANS = 5  # scans with unknown motion: after more, the previous scans are not connected to the next one
_BEAM_RESOLUTION = np.radians(0.2)  # beams are farther apart
_NEIGHBORS = 25  # in the beam, to either side
_NOISE = 0.03  # standard deviation of an intensity
_CELL = 0.1  # m along the axis
_ROWS, _COLUMNS = 180, 600  # cells around, and along
_MIN_RADIUS, _MAX_RADIUS = 1.0, 30.0  # m away from the axis
_LOCAL_CELLS = 45  # cells along the axis, to either side: what changes more slowly is no texture
_MIN_KNOWN_CELLS = 4  # minimum number of these with points
_MIN_SPREAD = 0.1  # standard deviations: less is noise
_MAX_CONTRAST = 3.0  # standard deviations: limits the weight of reflectors
_MIN_SHARED_CELLS = 300  # cells, at least
_SEARCH_CELLS = 150  # cells to either side: shows the random correlation
_PEAK_SEPARATION = 6  # cells: a separate peak, not the slope of the best one
_MIN_PEAK, _MIN_PEAK_MARGIN = 5.0, 2.5
"""The best offset must correlate better than at random, and than any other, by this many standard deviations of the
random correlation. In 460 scans without texture these were 4.4 and 2.0 at most, within 6 m."""
_SINGLE_SCAN_GROWTH, _SINGLE_SCAN_MAX = 0.5, 3.0
"""With only one earlier scan `_MIN_PEAK` increases by this per meter of search to a side, and at most by the second.
With vehicles on a road without texture, each matched at its own speed, 0.9 more than `_MIN_PEAK` was reached within
6 m."""
_INDEPENDENT_RATIO = 0.5  # of each cell's information, by the errors of 300 scans of KITTI 00 and 04


class IntensitySearch:
    """Offset of a scan along an unconstrained direction from the previous scans."""

    def __init__(self) -> None:
        self._scans: deque[_PosedScan] = deque(maxlen=_MAX_SCANS)
        self._missed = 0  # scans since the motion was known
        self._last_searched = _Scan(NO_POINTS)  # the last one, which is often the next to be kept

    def update(self, points: Points, T_odom_lidar: Array, connected: bool = True) -> None:
        """Process a scan (P, 4) at its pose (4, 4); `connected` if its motion from the previous scans is known."""
        self._missed = 0 if connected else self._missed + 1
        if self._scans and self._missed <= (_MAX_UNKNOWN_SCANS if self._scans[-1].connected else 0):
            distance = np.linalg.norm(self._scans[-1].T_odom_lidar[:3, 3] - T_odom_lidar[:3, 3])
            if not connected or distance < _SPACING:
                return
        scan = self._last_searched if self._last_searched.points is points else _Scan(points)
        self._scans.append(_PosedScan(scan, T_odom_lidar, connected))

    def along(self, result: Registration, points: Points, reach: float) -> Registration:
        """A registration of a scan (P, 4), moved along its unconstrained direction by `search`, or the reason why not.

        Args:
            reach: search range to either side, m.
        """
        found = self.search(points, result.T_target_source, result.open_direction, reach)
        if isinstance(found, str):
            return result.because(found)
        return moved_along(result, found, se3.inverse(self._scans[-1].T_odom_lidar), "intensity")

    def search(self, points: Points, T_odom_lidar: Array, axis: Array, reach: float) -> Peak | str:
        """Offset of a scan (P, 4) along an axis (3,) of the LiDAR frame, or why it is unknown; "" at the start.

        Args:
            T_odom_lidar: (4, 4), except for the offset along the axis. reach: search range to either side, m.
        """
        if len(self._scans) < _MAX_SCANS:
            return ""
        sensor_pattern = _unroll([one.scan.cells(axis) for one in self._scans], axis)
        n_connected = 1 + next((i for i, one in enumerate(reversed(self._scans)) if not one.connected), _MAX_SCANS - 1)
        T_lidar_odom = se3.inverse(T_odom_lidar)
        known = list(self._scans)[-n_connected:]
        earlier = _unroll([one.scan.cells(axis).moved(T_lidar_odom @ one.T_odom_lidar) for one in known], axis)
        self._last_searched = _Scan(points)
        current = _unroll([self._last_searched.cells(axis)], axis)
        relative = _Unrolled(current.mean - sensor_pattern.mean, current.count)
        min_peak = _MIN_PEAK + (min(_SINGLE_SCAN_GROWTH * reach, _SINGLE_SCAN_MAX) if n_connected == 1 else 0)
        found = _best_peak(_correlation(earlier.texture(), relative.texture()), reach, min_peak)
        distance = float(axis @ (T_lidar_odom @ self._scans[-1].T_odom_lidar)[:3, 3])
        if n_connected == 1 and isinstance(found, Peak) and abs(found.offset - distance) < _SPACING:
            return "intensity: the LiDAR stands still, or what it sees moves with it"
        return found


class _Scan:
    """A scan; its intensity cells are computed when they are first needed."""

    def __init__(self, points: Points) -> None:
        self.points = points
        self._cells: _Cells | None = None

    def cells(self, axis: Array) -> _Cells:
        """Cells around an axis (3,) of the LiDAR frame, or around that of an earlier call: they are fine enough."""
        if self._cells is None:
            self._cells = _to_cells(self.points, axis)
        return self._cells


@dataclass(frozen=True, eq=False)
class _PosedScan:
    """A scan and its pose (4, 4); `connected` if the motion from the previous scan is known."""

    scan: _Scan
    T_odom_lidar: Array
    connected: bool


@dataclass(frozen=True, eq=False)
class _Cells:
    """Points (N, 3) of a scan in its LiDAR frame, m, one per non-empty cell, and their contrast (N,)."""

    points: Float
    contrast: Float

    def moved(self, T: Array) -> _Cells:
        """Transformed by (4, 4)."""
        return _Cells(se3.transform(T, self.points), self.contrast)


@dataclass(frozen=True, eq=False)
class _Unrolled:
    """Mean contrast (_ROWS, _COLUMNS) by the angle around an axis and the position along it, and number of points."""

    mean: Float
    count: Float

    def texture(self) -> _Unrolled:
        """Changes within `_LOCAL_CELLS` along the axis, divided by their spread there; all cells weigh the same."""
        known = (self.count > 0).astype(np.float32)
        count = np.maximum(_window_sums(known), 1)
        deviation = (self.mean - _window_sums(self.mean * known) / count) * known
        spread = np.sqrt(np.maximum(_window_sums(deviation * deviation) / count, 0))
        known *= count >= _MIN_KNOWN_CELLS
        return _Unrolled(
            np.clip(deviation / (spread + _MIN_SPREAD), -_MAX_CONTRAST, _MAX_CONTRAST).astype(np.float32) * known, known
        )


def _contrast(points: Points) -> Float:
    """(P,) intensity of points (P, 4) relative to neighbors in the beam, in standard deviations of these."""
    x, y, z, intensity = points.T
    ring = np.rint(np.arctan2(z, np.hypot(x, y)) / np.float32(_BEAM_RESOLUTION)).astype(np.int64)
    order = np.argsort((ring << 32) + (np.arctan2(y, x) * np.float32(1e8)).astype(np.int64))
    value, ring = intensity[order].astype(np.float64), ring[order]
    total, squares = (np.concatenate([[0.0], np.cumsum(v)]) for v in (value, value * value))
    i = np.arange(len(value))
    first = np.maximum(np.searchsorted(ring, ring, "left"), i - _NEIGHBORS)
    stop = np.minimum(np.searchsorted(ring, ring, "right"), i + _NEIGHBORS + 1)
    mean = (total[stop] - total[first]) / (stop - first)
    variance = np.maximum((squares[stop] - squares[first]) / (stop - first) - mean * mean, 0)
    out = np.empty(len(value), np.float32)
    out[order] = np.clip((value - mean) / np.sqrt(variance + _NOISE**2), -_MAX_CONTRAST, _MAX_CONTRAST)
    return out


def _to_cells(points: Points, axis: Array) -> _Cells:
    """Points (P, 4) averaged in cells around and along an axis (3,)."""
    near = points[(points[:, :3] ** 2).sum(1) < (_COLUMNS * _CELL / 2) ** 2]
    cell, kept = _cell_numbers(near[:, :3], axis)
    count = np.bincount(cell, minlength=_ROWS * _COLUMNS)
    used = np.flatnonzero(count)
    columns = [*near[kept, :3].T, _contrast(near)[kept]]
    means = np.stack([np.bincount(cell, column)[used] / count[used] for column in columns], 1).astype(np.float32)
    return _Cells(means[:, :3], means[:, 3])


def _cell_numbers(points: Float, axis: Array) -> tuple[NDArray[np.int64], NDArray[np.intp]]:
    """Cell numbers, around and along an axis (3,), of those points (N, 3) that are in a cell, and their indices."""
    across = np.linalg.svd(axis[None])[2][1:].astype(np.float32)
    along, (y, z) = points @ axis.astype(np.float32), across @ points.T
    column = np.floor(along / np.float32(_CELL)).astype(np.int64) + _COLUMNS // 2
    away = y * y + z * z
    kept = np.flatnonzero((column >= 0) & (column < _COLUMNS) & (away > _MIN_RADIUS**2) & (away < _MAX_RADIUS**2))
    row = ((np.arctan2(z[kept], y[kept]) + np.float32(np.pi)) * np.float32(_ROWS / (2 * np.pi))).astype(np.int64)
    return row % _ROWS * _COLUMNS + column[kept], kept


def _unroll(scans: list[_Cells], axis: Array) -> _Unrolled:
    points, values = np.concatenate([one.points for one in scans]), np.concatenate([one.contrast for one in scans])
    cell, kept = _cell_numbers(points, axis)
    count = np.bincount(cell, minlength=_ROWS * _COLUMNS)
    mean = np.bincount(cell, values[kept], minlength=_ROWS * _COLUMNS) / np.maximum(count, 1)
    return _Unrolled(*(np.asarray(x, np.float32).reshape(_ROWS, _COLUMNS) for x in (mean, count)))


def _window_sums(values: NDArray[np.floating[Any]]) -> Float:
    """Sums over `_LOCAL_CELLS` to either side."""
    width = 2 * _LOCAL_CELLS + 1
    return np.asarray(
        cv2.boxFilter(values, -1, (width, 1), normalize=False, borderType=cv2.BORDER_CONSTANT), np.float32
    )


def _correlation(a: _Unrolled, b: _Unrolled) -> Array:
    """Correlation (2 `_SEARCH_CELLS` + 1,) of a with b shifted by up to `_SEARCH_CELLS`, NaN where few are shared."""
    n = scipy.fft.next_fast_len(_COLUMNS + _SEARCH_CELLS, real=True)
    (count_a, sum_a, squares_a), (count_b, sum_b, squares_b) = (
        [scipy.fft.rfft(x, n, axis=1) for x in (one.count, one.mean, one.mean**2)] for one in (a, b)
    )

    def summed(x: NDArray[np.complexfloating], y: NDArray[np.complexfloating]) -> Array:
        sums = scipy.fft.irfft(np.einsum("ij,ij->j", x, y.conj()), n).astype(np.float64)
        return np.concatenate([sums[-_SEARCH_CELLS:], sums[: _SEARCH_CELLS + 1]])

    shared = summed(count_a, count_b)
    count = np.maximum(shared, 1)
    mean_a, mean_b = summed(sum_a, count_b) / count, summed(count_a, sum_b) / count
    var_a, var_b = summed(squares_a, count_b) / count - mean_a**2, summed(count_a, squares_b) / count - mean_b**2
    covariance = summed(sum_a, sum_b) / count - mean_a * mean_b
    return np.where(shared < _MIN_SHARED_CELLS, np.nan, covariance / np.sqrt(np.maximum(var_a * var_b, 1e-6)))


def _best_peak(correlation: Array, reach: float, min_peak: float) -> Peak | str:
    offset = np.arange(-_SEARCH_CELLS, _SEARCH_CELLS + 1)
    known = np.isfinite(correlation)
    within = known & (np.abs(offset) * _CELL <= reach)
    if known.sum() < _SEARCH_CELLS or not within.any():
        return "intensity: too little is seen again"
    best = int(np.where(within, correlation, -1).argmax())
    others = known & (np.abs(offset - offset[best]) > _PEAK_SEPARATION)
    random = 1.4826 * float(np.median(np.abs(correlation[others] - np.median(correlation[others]))))
    top, second = float(correlation[best]), float(np.max(correlation[others & within], initial=0.0))
    around = slice(max(best - 1, 0), best + 2)
    if (
        not random or top <= min_peak * random or not top >= correlation[around].max()
    ):  # no maximum: next to a peak beyond the search range
        return "intensity: no place stands out"
    if top - second < _MIN_PEAK_MARGIN * random:
        return "intensity: several places are alike"
    return peak(offset[around] * _CELL, correlation[around], _INDEPENDENT_RATIO * random**-2)
